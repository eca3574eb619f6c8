"""What the numbers in a log depend on beside the code: library versions, and the CPU kernels that libraries choose."""

import ctypes
import hashlib
import importlib
import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import cv2
import numpy as np

from kiteline_hw.system.kernel_cache import compiled_for

MACHINE = "machine"  # its name in the metadata of a log

_LIBRARIES = ("numpy", "numba", "opencv-python-headless", "gtsam")


@cache
def machine() -> str:
    """Processor type, versions, the kernels of OpenBLAS, numpy and OpenCV, and numba's CPU, as one line.

    Where it is the same, a replay computes the same bits.
    """
    versions = [f"{name} {_version(name)}" for name in _LIBRARIES]
    kernels = f"OpenBLAS for {_blas_core()}", f"numpy for {_numpy_features()}", f"OpenCV for {_opencv_features()}"
    return "; ".join((platform.machine(), *versions, *kernels, f"numba for {_numba_cpu()}"))


def apart(one: str, other: str) -> tuple[str, str]:
    """The parts in which two machines differ, of each."""
    a, b = (text.split("; ") for text in (one, other))
    return "; ".join(part for part in a if part not in b), "; ".join(part for part in b if part not in a)


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "none"


def _blas_core() -> str:
    """The CPU that OpenBLAS took its kernels for."""
    folder = Path(np.__file__).parent.parent / "numpy.libs"
    for file in sorted(folder.glob("libscipy_openblas*")):
        try:
            name = ctypes.CDLL(str(file)).scipy_openblas_get_corename64_
        except (OSError, AttributeError):
            continue
        name.restype = ctypes.c_char_p
        return str(name().decode())
    return "unknown"


def _numpy_features() -> str:
    """The highest group of CPU features that numpy dispatches to."""
    core = importlib.import_module("numpy._core._multiarray_umath")
    found = [name for name in core.__cpu_dispatch__ if core.__cpu_features__.get(name)]
    return "+".join(found) or "baseline"


def _opencv_features() -> str:
    """The highest CPU feature that OpenCV dispatches to; those that the CPU lacks end in "?"."""
    found = [word.strip("*") for word in cv2.getCPUFeaturesLine().split() if not word.endswith("?")]
    return found[-1] if found else "baseline"


def _numba_cpu() -> str:
    """The CPU that numba compiles for, and a digest of its features."""
    name, features = compiled_for()
    return f"{name} {hashlib.sha256(features.encode()).hexdigest()[:6]}"
