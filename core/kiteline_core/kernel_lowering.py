"""Code of kernels: indices, elements and arguments that are arrays, without what only Python's rules need.

These functions take the place of numba's own where a kernel is translated; `kernel_compiler` installs them.
"""

import contextlib
from collections.abc import Iterator
from typing import Any

from numba.core import ir, types
from numba.core.lowering import Lower
from numba.np import arrayobj

_VIEWS = (  # operations that make an array from one that is there
    "getitem", "static_getitem", "build_tuple", "phi", "cast", "exhaust_iter", "getiter", "iternext", "pair_first"
)  # fmt: skip

_fix_index = arrayobj.fix_integer_index
_arguments = Lower.extract_function_arguments
_delete_variable = Lower.delvar
_get_item = Lower.lower_getitem
_set_item = Lower.lower_setitem
_lowering = [False]  # whether the code that is being generated is a kernel's, innermost last


@contextlib.contextmanager
def code_of(is_kernel: bool, state: Any) -> Iterator[None]:
    """Generate the code of a function: of a kernel, or of one of numba's own functions that a kernel calls."""
    if is_kernel and not _makes_arrays(state):
        state.targetctx.enable_nrt = False  # nothing to count: arrays belong to the caller
    _lowering.append(is_kernel)
    try:
        yield
    finally:
        _lowering.pop()


def _makes_arrays(state: Any) -> bool:
    """True if a function makes an array, or returns one."""

    def is_counted(variable: Any) -> bool:
        return _is_counted(state.targetctx, state.typemap[variable.name])

    made = (
        one.value for block in state.func_ir.blocks.values() for one in block.body
        if isinstance(one, ir.Assign) and isinstance(one.value, ir.Expr) and is_counted(one.target)
    )  # fmt: skip
    return not _holds_numbers(state.return_type) or any(
        one.op not in _VIEWS or (one.op == "getitem" and is_counted(one.index)) for one in made
    )


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


def _is_counted(context: Any, kind: Any) -> bool:
    return context.data_model_manager[kind].contains_nrt_meminfo()  # type: ignore[no-any-return]


def _without_owner(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    if _is_tuple(kind):
        for i, part in enumerate(kind.types):
            inner = _without_owner(context, builder, part, builder.extract_value(value, i))
            value = builder.insert_value(value, inner, i)
    elif isinstance(kind, types.Array):
        field = context.data_model_manager[kind].get_field_position("meminfo")
        value = builder.insert_value(value, value.type.elements[field](None), field)
    return value


def delete_variable(self: Any, name: str) -> None:
    """End a variable: numba reads it for the last time and clears it, which only counted arrays need."""
    kind = self.typeof(name)
    if not _lowering[-1] or (self.context.enable_nrt and _is_counted(self.context, kind)):
        _delete_variable(self, name)  # type: ignore[no-untyped-call]
    elif name not in self._blk_local_varmap or self._disable_sroa_like_opt:
        self._singly_assigned_vars.discard(name)
        self._alloca_var(name, kind)


def plain_index(context: Any, builder: Any, kind: Any, index: Any, size: Any) -> Any:
    """Take a kernel's index as it is: no kernel counts from the end of an array by a negative one.

    The choice at each access stands in the way of vectors. With NUMBA_BOUNDSCHECK=1 a negative index raises IndexError.
    """
    if not _lowering[-1]:
        return _fix_index(context, builder, kind, index, size)  # type: ignore[no-untyped-call]
    return context.cast(builder, index, kind, types.intp if kind.signed else types.uintp)


def get_item(self: Any, result_kind: Any, expression: Any, array: Any, index: Any, signature: Any) -> Any:
    """Read an element of an array from its place; leave views and other containers to numba."""
    place = _place(self, signature, array, index)
    if place is None:
        return _get_item(self, result_kind, expression, array, index, signature)  # type: ignore[no-untyped-call]
    item = arrayobj.load_item(self.context, self.builder, signature.args[0], place)  # type: ignore[no-untyped-call]
    return self.context.cast(self.builder, item, signature.return_type, result_kind)


def set_item(self: Any, array: Any, index: Any, value: Any, signature: Any) -> Any:
    """Write an element of an array to its place; leave parts of arrays and other containers to numba."""
    place = _place(self, signature, array, index)
    if place is None:
        return _set_item(self, array, index, value, signature)  # type: ignore[no-untyped-call]
    kind = signature.args[0]
    item = self.context.cast(self.builder, self.loadvar(value.name), self.typeof(value.name), kind.dtype)
    return arrayobj.store_item(self.context, self.builder, kind, item, place)  # type: ignore[no-untyped-call]


def _place(self: Any, signature: Any, array: Any, index: Any) -> Any:
    """Return the address of one element of a contiguous array; None if the index denotes anything else.

    numba copies the array's description to memory and reads all of it at each access: a quarter of all code that LLVM
    is given, and takes out again.
    """
    context, builder = self.context, self.builder
    kind, index_kind = signature.args[:2]
    kinds = index_kind.types if _is_tuple(index_kind) else (index_kind,)
    if (
        not _lowering[-1] or context.enable_boundscheck or type(kind) is not types.Array or kind.layout != "C"
        or len(kinds) != kind.ndim or not all(isinstance(one, types.Integer) for one in kinds)
    ):  # fmt: skip
        return None
    value = self.loadvar(array.name)
    given = context.cast(builder, self.loadvar(index.name), self.typeof(index.name), index_kind)
    parts = [builder.extract_value(given, i) for i in range(len(kinds))] if _is_tuple(index_kind) else [given]
    at, *more = [plain_index(context, builder, one, part, None) for one, part in zip(kinds, parts, strict=True)]
    field = context.data_model_manager[kind].get_field_position
    for axis, part in enumerate(more, 1):
        length = builder.extract_value(value, (field("shape"), axis))
        at = builder.add(builder.mul(at, length), part)
    return builder.gep(builder.extract_value(value, field("data")), [at])
