"""Shortcuts through numba's compiler: kernels that compute the same, compiled in half of the time.

They reach into numba, so a version that they were not tried with compiles without them. Their tests compare results.
"""

from typing import Any

import llvmlite.binding as llvm
import llvmlite.binding.ffi
import numba
from numba.core import caching, ir, postproc, transforms, typed_passes, types, untyped_passes
from numba.core.base import BaseContext
from numba.core.codegen import JITCodeLibrary, JITCPUCodegen
from numba.core.compiler import CompilerBase
from numba.core.compiler_machinery import PassManager
from numba.core.dispatcher import Dispatcher
from numba.core.lowering import Lower
from numba.core.targetconfig import ConfigStack
from numba.core.types.functions import BaseFunction
from numba.np import arrayobj

from kiteline_core import kernel_files, kernel_lowering

TRIED = ("0.68.",)  # beginnings of numba's versions


class KernelCompiler(CompilerBase):
    """The compiler without the passes for closures, array expressions and literal arguments, which no kernel has.

    Without the listing of types, too: it holds on to the whole source tree, and is printed into the cache.
    """

    def define_pipelines(self) -> list[Any]:
        """Return the one pipeline, from byte code to machine code."""
        passes: Any = PassManager("kernel")  # type: ignore[no-untyped-call]
        for step in (
            untyped_passes.TranslateByteCode, untyped_passes.FixupArgs, untyped_passes.IRProcessing,
            untyped_passes.GenericRewrites, untyped_passes.ReconstructSSA,
            typed_passes.NopythonTypeInference, typed_passes.PreLowerStripPhis,
            typed_passes.IRLegalization, typed_passes.NativeLowering, typed_passes.NoPythonBackend,
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

    def add_ir_module(self, ir_module: Any) -> None:
        """Take a function's code, and take apart its description, which refers to itself: no garbage collection."""
        super().add_ir_module(ir_module)  # type: ignore[no-untyped-call]
        for function in ir_module.functions:
            for block in function.blocks:
                block.instructions.clear()
            function.blocks.clear()

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
_post_process = postproc.PostProcessor.run
_abi_size = BaseContext.get_abi_sizeof
_sizes: dict[str, int] = {}
_set_env = JITCPUCodegen.set_env
_call_type = types.Dispatcher.get_call_type
_resolve = BaseFunction.get_call_type


def lower(self: Any, state: Any) -> Any:
    """Generate the code of a function; find out whether only compiled functions call it."""
    if state.library is None:
        state.library = state.targetctx.codegen().create_library(state.func_id.func_qualname)
        state.library.enable_object_caching()
    flags, is_numbas = state.flags, state.func_id.modname.startswith("numba.")
    if flags.no_cpython_wrapper and (flags.no_cfunc_wrapper or is_numbas):
        flags.no_cfunc_wrapper = True
        state.library.is_linked_only = True
    with kernel_lowering.code_of(isinstance(state.pipeline, KernelCompiler) and not is_numbas, state):
        return _lower(self, state)  # type: ignore[no-untyped-call]


def post_process(self: Any, emit_dels: bool = False, extend_lifetimes: bool = False) -> None:
    """Find the variables' lifetimes where they are used: in the last run, which ends variables, and in generators."""
    if emit_dels or self.func_ir.is_generator:
        _post_process(self, emit_dels, extend_lifetimes)
        return
    self.func_ir.blocks = transforms.canonicalize_cfg(self.func_ir.blocks)  # type: ignore[no-untyped-call]
    self.func_ir.variable_lifetime = postproc.VariableLifetime(self.func_ir.blocks)  # type: ignore[no-untyped-call]


def abi_size(self: Any, kind: Any) -> int:
    """Return the bytes of a type of LLVM; numba has a module parsed for each variable."""
    name = str(kind)
    if name not in _sizes:
        _sizes[name] = _abi_size(self, kind)  # type: ignore[no-untyped-call]
    return _sizes[name]


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
        (postproc.PostProcessor, "run", post_process),
        (BaseContext, "get_abi_sizeof", abi_size),
        (ir.Inst, "_rec_list_vars", variables_in),
        (arrayobj, "fix_integer_index", kernel_lowering.plain_index),
        (Lower, "extract_function_arguments", kernel_lowering.borrowed_arguments),
        (Lower, "lower_getitem", kernel_lowering.get_item),
        (Lower, "lower_setitem", kernel_lowering.set_item),
        (Lower, "delvar", kernel_lowering.delete_variable),
        (caching.IndexDataCacheFile, "save", kernel_files.save),
        (caching.Cache, "load_overload", kernel_files.load_overload),
        (caching.Cache, "save_overload", kernel_files.save_overload),
        (Dispatcher, "enable_caching", kernel_files.enable_caching),
    ):
        setattr(owner, name, value)
    llvmlite.binding.ffi.lib._lock._cblist.clear()  # events of each call of LLVM, to which nothing listens
    return {"pipeline_class": KernelCompiler}
