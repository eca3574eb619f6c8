"""Compiles missing kernels in a process of its own, and records on disk that all are compiled.

The compiler keeps 200 MiB that its process never returns, so it must not run in the process that flies.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

from kiteline_hw.system.process import StopSignal

_KERNELS = "_kernels"  # suffix of kernel modules
_POLL_S = 0.1  # s between two looks at the compiler
_TIMEOUT_S = 900.0  # s that a slow board may take to compile all


def fill(module: str, stop: StopSignal | None = None) -> bool:
    """Run `python -m module` to compile the kernels of all loaded modules, unless they are; True if they are now.

    If nothing can be written, the caller compiles in its own process. stop: ends the compilation.
    """
    if filled():
        return True
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        compiler = subprocess.Popen(
            [sys.executable, "-m", module],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        with compiler:
            try:
                if _ended(compiler, stop) and compiler.returncode == 0:
                    mark()
            finally:
                compiler.kill()
    return filled()


def _ended(compiler: subprocess.Popen[bytes], stop: StopSignal | None) -> bool:
    """Wait for the compiler to end; False if a signal came first. Raises TimeoutExpired."""
    if stop is None:
        compiler.wait(_TIMEOUT_S)
        return True
    for _ in range(round(_TIMEOUT_S / _POLL_S)):
        if compiler.poll() is not None:
            return True
        if stop.wait(_POLL_S):
            return False
    raise subprocess.TimeoutExpired(compiler.args, _TIMEOUT_S)


def filled() -> bool:
    """True if the present kernels of all loaded modules are compiled for this processor."""
    path = _path()
    try:
        return path is not None and _needed() <= set(path.read_text().splitlines())
    except (OSError, ValueError):
        return False


def mark() -> None:
    """Record that the kernels of all loaded modules are compiled."""
    path = _path()
    if path is not None:
        with contextlib.suppress(OSError):
            new = path.with_name(f"{path.name}.{os.getpid()}")
            new.write_text("\n".join(sorted(_needed())) + "\n")
            os.replace(new, path)


def _path() -> Path | None:
    """The file of the record: beside the first kernel of the first module."""
    for _, module in _modules():
        for value in vars(module).values():
            folder = getattr(getattr(value, "stats", None), "cache_path", None)
            if folder:
                return Path(folder) / "kiteline-compiled"
    return None


def _needed() -> set[str]:
    """One line per module, with everything its compiled code depends on."""
    import llvmlite.binding as llvm
    import numba

    machine = f"{llvm.get_host_cpu_name()} {llvm.get_host_cpu_features().flatten()}"
    compiler = hashlib.blake2b(machine.encode(), digest_size=8).hexdigest()
    versions = f"{platform.python_version()} {numba.__version__} {compiler}"
    about = [(name, os.stat(module.__file__)) for name, module in _modules()]
    return {f"{name} {file.st_mtime_ns} {file.st_size} {versions}" for name, file in about}


def _modules() -> list[tuple[str, Any]]:
    loaded = [(name, module) for name, module in sys.modules.items() if name.endswith(_KERNELS)]
    return sorted((name, module) for name, module in loaded if getattr(module, "__file__", None))
