"""Shortcuts through numba's compiler: kernels that compute the same, in two thirds of the time.

They reach into numba, so a version that they were not tried with compiles without them. Their tests compare results.
"""

import contextlib
import fcntl
import os
from typing import Any

import llvmlite.binding as llvm
import llvmlite.binding.ffi
import numba
from numba.core import caching, ir, typed_passes, types, untyped_passes
from numba.core.codegen import JITCodeLibrary, JITCPUCodegen
from numba.core.compiler import CompilerBase
from numba.core.compiler_machinery import PassManager
from numba.core.dispatcher import Dispatcher
from numba.core.lowering import Lower
from numba.core.runtime.nrt import rtsys
from numba.core.targetconfig import ConfigStack
from numba.core.types.functions import BaseFunction
from numba.np import arrayobj

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


class KernelLibrary(JITCodeLibrary):
    """Code of a function and of those that it calls.

    A function that only compiled functions call is linked into each of them, which optimise and translate it together
    with their own code: by itself it is only simplified. numba does all of it at every level.
    """

    is_linked_only = False

    def _optimize_functions(self, ll_module: Any) -> None:
        ll_module.data_layout = self._codegen._data_layout
        if not self.is_linked_only:  # the passes over the whole module do what those over each function do
            return
        passes, builder = self._codegen._function_pass_manager()  # type: ignore[no-untyped-call]
        for function in ll_module.functions:
            if not function.is_declaration:
                passes.run(function, builder)

    def _optimize_final_module(self) -> None:
        if not self.is_linked_only:
            passes, builder = self._codegen._module_pass_manager()  # type: ignore[no-untyped-call]
            passes.run(self._final_module, builder)

    def _finalize_final_module(self) -> None:
        if self.is_linked_only:
            self._finalized = True
        else:
            super()._finalize_final_module()  # type: ignore[no-untyped-call]

    def serialize_using_object_code(self) -> Any:
        """Return what the cache on disk keeps."""
        if not self.is_linked_only:
            return super().serialize_using_object_code()  # type: ignore[no-untyped-call]
        self._ensure_finalized()  # type: ignore[no-untyped-call]
        return self.name, "bitcode", self._get_module_for_linking().as_bitcode()  # type: ignore[no-untyped-call]

    @classmethod
    def _unserialize(cls, codegen: Any, state: Any) -> Any:
        name, kind, code = state
        if kind != "bitcode":
            return super()._unserialize(codegen, state)  # type: ignore[no-untyped-call]
        self = codegen.create_library(name)
        self.is_linked_only = self._finalized = True
        self._final_module = self._shared_module = llvm.parse_bitcode(code)
        return self


_lower = typed_passes.NativeLowering.run_pass
_set_env = JITCPUCodegen.set_env
_call_type = types.Dispatcher.get_call_type
_resolve = BaseFunction.get_call_type
_fix_index = arrayobj.fix_integer_index
_enable_caching = Dispatcher.enable_caching
_save_overload = caching.Cache.save_overload
_arguments = Lower.extract_function_arguments
_lowering = [False]  # whether the code that is being generated is a kernel's, innermost last


def lower(self: Any, state: Any) -> Any:
    """Generate the code of a function; find out whether only compiled functions call it."""
    if state.library is None:
        state.library = state.targetctx.codegen().create_library(state.func_id.func_qualname)
        state.library.enable_object_caching()
    flags = state.flags
    if flags.no_cpython_wrapper and (flags.no_cfunc_wrapper or state.func_id.modname.startswith("numba.")):
        flags.no_cfunc_wrapper = True
        state.library.is_linked_only = True
    _lowering.append(isinstance(state.pipeline, KernelCompiler) and not state.func_id.modname.startswith("numba."))
    try:
        return _lower(self, state)  # type: ignore[no-untyped-call]
    finally:
        _lowering.pop()


def borrowed_arguments(self: Any) -> Any:
    """Take a kernel's arrays without an owner: their caller holds them, so that no view of them need be counted.

    Counting takes a locked instruction at each view, and stands in the way of other optimisations. A function that
    returns an array counts, since its caller may give up the array that the result is a view of.
    """
    arguments = _arguments(self)  # type: ignore[no-untyped-call]
    if _lowering[-1] and _holds_numbers(self.fndesc.restype):
        kinds = self.fndesc.argtypes
        self.fnargs = [_without_owner(self.context, self.builder, *one) for one in zip(kinds, arguments, strict=True)]
    return self.fnargs


def _is_tuple(kind: Any) -> bool:
    return isinstance(kind, types.BaseTuple)


def _holds_numbers(kind: Any) -> bool:
    if _is_tuple(kind):
        return all(map(_holds_numbers, kind.types))
    return isinstance(kind, (types.Number, types.Boolean, types.NoneType))


def _without_owner(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    if _is_tuple(kind):
        for i, part in enumerate(kind.types):
            inner = _without_owner(context, builder, part, builder.extract_value(value, i))
            value = builder.insert_value(value, inner, i)
    elif isinstance(kind, types.Array):
        field = context.data_model_manager[kind].get_field_position("meminfo")
        value = builder.insert_value(value, value.type.elements[field](None), field)
    return value


def plain_index(context: Any, builder: Any, kind: Any, index: Any, size: Any) -> Any:
    """Take a kernel's index as it is: no kernel counts from the end of an array by a negative one.

    The choice at each access stands in the way of vectors. With NUMBA_BOUNDSCHECK=1 a negative index raises IndexError.
    """
    if not _lowering[-1]:
        return _fix_index(context, builder, kind, index, size)  # type: ignore[no-untyped-call]
    return context.cast(builder, index, kind, types.intp if kind.signed else types.uintp)


def set_env(self: Any, env_name: str, env: Any) -> None:
    """Tell a function its environment; one that is linked only has no address by itself."""
    if self._engine.is_symbol_defined(env_name):
        _set_env(self, env_name, env)  # type: ignore[no-untyped-call]


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


def call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
    """Resolve a call of one kernel by another. Constants are numbers like others: no compilation for each of them."""
    if self.dispatcher._compiler.pipeline_class is KernelCompiler:
        args = tuple(types.unliteral(one) for one in args)  # type: ignore[no-untyped-call]
    return _call_type(self, context, args, kws)


def save(self: Any, key: Any, data: Any) -> None:
    """Write a compiled function to the cache, one process at a time and the index last.

    numba reads the index, adds to it and writes the code after it. Two processes that compile a function for different
    types at once would lose one of them, or find the code of one under the types of the other.
    """
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):  # a file system without locks
            folder = os.open(self._cache_path, os.O_RDONLY)
            stack.callback(os.close, folder)
            fcntl.flock(folder, fcntl.LOCK_EX)
        overloads = self._load_index()
        free = (name for k in range(1, len(overloads) + 2) if (name := self._data_name(k)) not in overloads.values())
        name = overloads.get(key) or next(free)
        self._save_data(name, data)
        self._save_index({**overloads, key: name})


unkept: list[str] = []  # why compiled code of this process is not in the cache, if it is not


def enable_caching(self: Any) -> None:
    """Keep compiled code on disk, if there is a folder that takes it; numba would refuse to make the function."""
    try:
        _enable_caching(self)
    except RuntimeError as error:
        unkept.append(str(error))


def load_overload(self: Any, signature: Any, context: Any) -> Any:
    """Load compiled code from the cache, or return None.

    numba first loads what only a compilation needs, scipy among it where it is installed: half a second of CPU and
    25 MiB in each process. A compilation loads that by itself.
    """
    rtsys.initialize(context)  # memory management, which compiled code refers to
    return self._load_overload(signature, context)


def save_overload(self: Any, signature: Any, data: Any) -> None:
    """Keep compiled code, if the disk takes it. It is in memory in either case: numba would not let it run."""
    try:
        _save_overload(self, signature, data)  # type: ignore[no-untyped-call]
    except OSError as error:
        unkept.append(error.strerror or str(error))


_OTHER, _VARIABLE, _INSTRUCTION, _SEQUENCE, _MAPPING = range(5)
_kinds: dict[type, int] = {}


def _kind(cls: type) -> int:
    _kinds[cls] = (
        _VARIABLE if issubclass(cls, ir.Var) else _INSTRUCTION if issubclass(cls, ir.Inst)
        else _SEQUENCE if issubclass(cls, (list, tuple)) else _MAPPING if issubclass(cls, dict) else _OTHER
    )  # fmt: skip
    return _kinds[cls]


def variables_in(instruction: Any, value: Any) -> list[Any]:
    """Variables in the fields of an instruction, in order; numba's own walk tests each value against five types."""
    found: list[Any] = []
    for part in value.values() if isinstance(value, dict) else value:
        cls = type(part)
        kind = _kinds[cls] if cls in _kinds else _kind(cls)
        if kind == _VARIABLE:
            found.append(part)
        elif kind == _INSTRUCTION:
            found.extend(part.list_vars())
        elif kind != _OTHER:
            found.extend(variables_in(instruction, part))
    return found


def install() -> dict[str, Any]:
    """Install the shortcuts if this version of numba was tried with them; the options of numba.njit that they need."""
    if not numba.__version__.startswith(TRIED):
        return {}
    for owner, name, value in (
        (BaseFunction, "get_call_type", remembered_call_type),
        (types.Dispatcher, "get_call_type", call_type),
        (typed_passes.NativeLowering, "run_pass", lower),
        (JITCPUCodegen, "_library_class", KernelLibrary),
        (JITCPUCodegen, "set_env", set_env),
        (arrayobj, "fix_integer_index", plain_index),
        (Lower, "extract_function_arguments", borrowed_arguments),
        (ir.Inst, "_rec_list_vars", variables_in),
        (caching.IndexDataCacheFile, "save", save),
        (caching.Cache, "load_overload", load_overload),
        (caching.Cache, "save_overload", save_overload),
        (Dispatcher, "enable_caching", enable_caching),
    ):
        setattr(owner, name, value)
    llvmlite.binding.ffi.lib._lock._cblist.clear()  # events of each call of LLVM, to which nothing listens
    return {"pipeline_class": KernelCompiler}
