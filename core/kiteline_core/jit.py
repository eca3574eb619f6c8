"""The one way in which kernels are compiled: cached on disk, without the interpreter lock, with strict arithmetic."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any, TypeVar


def _numba_alone() -> ModuleType:
    """numba without scipy, which it imports where it can: 10 MiB for linear algebra that no kernel uses."""
    hidden = "scipy" not in sys.modules
    if hidden:
        sys.modules["scipy"] = None  # type: ignore[assignment]  # so that importing it fails
    try:
        import numba
    finally:
        if hidden:
            del sys.modules["scipy"]
    return numba


_numba = _numba_alone()
F = TypeVar("F", bound=Callable[..., Any])


def njit(function: F) -> F:
    """Compile a kernel: arrays in, caller's arrays out; no parallel, no fastmath, no objects.

    One whose name begins with an underscore is called by other kernels alone: Python has no way to it, which takes half
    of what a small one costs to compile. Assigning arrays to slices costs a quarter of a second each, a loop nothing.
    """
    helper = function.__name__.startswith("_")
    compiled: F = _numba.njit(cache=True, nogil=True, no_cfunc_wrapper=True, no_cpython_wrapper=helper)(function)
    return compiled
