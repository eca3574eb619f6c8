"""The one way in which kernels are compiled: cached on disk, without the interpreter lock, with strict arithmetic."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba

F = TypeVar("F", bound=Callable[..., Any])


def njit(function: F) -> F:
    """Compile a kernel: arrays in, caller's arrays out; no parallel, no fastmath, no objects."""
    compiled: F = numba.njit(cache=True, nogil=True)(function)
    return compiled
