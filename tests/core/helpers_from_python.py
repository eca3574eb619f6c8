"""Helpers of kernels, made callable from Python."""

from collections.abc import Callable
from functools import cache
from types import FunctionType
from typing import Any

from kiteline_core import jit


@cache
def from_python(helper: Any) -> Callable[..., Any]:
    """Compile a `kiteline_core.jit.helper` once more, with a wrapper for calls from Python.

    The copy has a name of its own, under which numba keeps it on disk beside the helper.
    """
    function = helper.py_func
    copy = FunctionType(
        function.__code__, function.__globals__, f"{function.__name__}_from_python", function.__defaults__
    )
    copy.__module__ = function.__module__
    copy.__name__ = copy.__name__.lstrip("_")  # of an underscore njit would make a helper again
    copy.__qualname__ = copy.__name__
    return jit.njit(copy)
