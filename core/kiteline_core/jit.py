"""The decorator that compiles kernels: cached on disk, without the interpreter lock, with strict arithmetic."""

import gc
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any, TypeVar


def _import_numba() -> tuple[ModuleType, dict[str, Any]]:
    """Import numba without scipy: it takes 10 MiB for linear algebra that no kernel uses. Also the options of njit."""
    hidden = "scipy" not in sys.modules
    if hidden:
        sys.modules["scipy"] = None  # type: ignore[assignment]  # makes numba's import of it fail
    try:
        import numba
        import numba.core.event

        from kiteline_core import kernel_compiler
    finally:
        if hidden:
            del sys.modules["scipy"]
    return numba, kernel_compiler.install()


_numba, _options = _import_numba()
F = TypeVar("F", bound=Callable[..., Any])


class _CollectorPause(_numba.core.event.Listener):  # type: ignore[misc, name-defined]
    """Pause the cyclic garbage collector during a compilation: scanning its syntax trees takes 15 % of the time."""

    def __init__(self) -> None:
        self._depth = 0  # compilations of callees nest in those of their callers
        self._was_enabled = False

    def on_start(self, _event: object) -> None:
        if self._depth == 0:
            self._was_enabled = gc.isenabled()
            gc.disable()
        self._depth += 1

    def on_end(self, _event: object) -> None:
        self._depth -= 1
        if self._depth == 0 and self._was_enabled:
            gc.enable()


_numba.core.event.register("numba:compile", _CollectorPause())


def njit(function: F) -> F:
    """Compile a kernel: arrays in, caller's arrays out; no parallel, no fastmath, no objects.

    One whose name begins with an underscore is a `helper`.
    """
    return _compiled(function, function.__name__.startswith("_"))


def helper(function: F) -> F:
    """Compile a function that only kernels call, into each of them; it cannot be called from Python."""
    return _compiled(function, True)


def _compiled(function: F, is_helper: bool) -> F:
    compiled: F = _numba.njit(
        cache=True, nogil=True, no_cfunc_wrapper=True, no_cpython_wrapper=is_helper, **_options
    )(function)  # fmt: skip
    return compiled
