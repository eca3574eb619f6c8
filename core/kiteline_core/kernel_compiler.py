"""Shortcuts through numba's compiler: the same machine code, in four fifths of the time.

They reach into numba, so a version that they were not tried with compiles without them. Their test compares the code.
"""

from __future__ import annotations

from typing import Any

import llvmlite.binding.ffi
import numba
from numba.core import typed_passes, untyped_passes
from numba.core.compiler import CompilerBase
from numba.core.compiler_machinery import PassManager
from numba.core.targetconfig import ConfigStack
from numba.core.types.functions import BaseFunction

TRIED = ("0.68.",)  # beginnings of numba's versions


class KernelCompiler(CompilerBase):
    """The compiler without the passes for closures, array expressions and literal arguments, which no kernel has."""

    def define_pipelines(self) -> list[Any]:
        """Return the one pipeline, from byte code to machine code."""
        passes: Any = PassManager("kernel")  # type: ignore[no-untyped-call]
        for step in (
            untyped_passes.TranslateByteCode, untyped_passes.FixupArgs, untyped_passes.IRProcessing,
            untyped_passes.GenericRewrites, untyped_passes.ReconstructSSA,
            typed_passes.NopythonTypeInference, typed_passes.PreLowerStripPhis,
            typed_passes.IRLegalization, typed_passes.AnnotateTypes, typed_passes.NativeLowering,
            typed_passes.NoPythonBackend,
        ):  # fmt: skip
            passes.add_pass(step, step.__name__)
        passes.finalize()
        return [passes]


_resolve = BaseFunction.get_call_type


def remembered_call_type(function: Any, context: Any, args: Any, kws: Any) -> Any:
    """Resolve an operator or builtin once for each combination of argument types.

    numba tries all overloads anew at each place in the source; nine in ten are repetitions, a sixth of all time.
    """
    if kws:
        return _resolve(function, context, args, kws)
    flags = ConfigStack.top_or_none()  # type: ignore[no-untyped-call]  # overloads are compiled under the flags of their caller
    key = context, tuple(args), None if flags is None else str(flags._values)
    known = function.__dict__.setdefault("_kiteline_signatures", {})
    if key not in known:
        signature = _resolve(function, context, args, kws)
        if not all(one.is_precise() for one in args):
            return signature
        known[key] = signature
    return known[key]


def install() -> dict[str, Any]:
    """Install the shortcuts if this version of numba was tried with them; the options of numba.njit that they need."""
    if not numba.__version__.startswith(TRIED):
        return {}
    setattr(BaseFunction, "get_call_type", remembered_call_type)  # noqa: B010  mypy forbids the assignment
    llvmlite.binding.ffi.lib._lock._cblist.clear()  # events of each call of LLVM, to which nothing listens
    return {"pipeline_class": KernelCompiler}
