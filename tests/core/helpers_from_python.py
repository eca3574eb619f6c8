"""Helpers of kernels, made callable from Python."""

from collections.abc import Callable
from functools import cache
from typing import Any

import numba


@cache
def from_python(helper: Any) -> Callable[..., Any]:
    """Compile a `kiteline_core.jit.helper` once more, with a wrapper for calls from Python."""
    compiled: Callable[..., Any] = numba.njit(nogil=True)(helper.py_func)
    return compiled
