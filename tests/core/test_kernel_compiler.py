import operator
import re
from typing import Any

import numba
import numpy as np
import pytest
from numba.core.registry import cpu_target
from numba.core.types.functions import BaseFunction

from kiteline_core import kernel_compiler
from kiteline_core.kernel_compiler import KernelCompiler, install, remembered_call_type


@numba.njit
def _helper(line: Any, k: int) -> tuple[int, float]:
    return k // 3, line[k] / max(line[0], 1.0)


def _kernel(a: Any, out: Any, flags: Any) -> int:
    scratch = np.empty((3, 3))
    n, best = a.shape[0], -1
    for i in range(n):
        scratch[i % 3, 2] = abs(a[i, -1])
        if flags[i] or scratch[i % 3, 2] > 0.5:
            whole, part = _helper(a[i], 1)
            best = whole if best < 0 else best + int(part)
    k = 0
    while k < n and not flags[k]:
        out[k] = np.sqrt(scratch[k % 3, 2]) + (1 << k)
        k += 1
    return best - k


def _code(options: dict[str, Any]) -> str:
    """LLVM's code of the kernel. Names are blanked: they hold counters and addresses."""
    compiled: Any = numba.njit(nogil=True, **options)(_kernel)
    compiled(np.eye(4), np.zeros(4), np.zeros(4, np.bool_))
    (code,) = compiled.inspect_llvm().values()
    return re.sub(r'_ZN[\w.$]+|@[\w.$"]+|[!#]\d+|\d{6,}', "", code)


def test_the_short_pipeline_makes_the_same_code() -> None:
    assert _code({"pipeline_class": KernelCompiler}) == _code({})


def test_remembered_types_are_the_resolved_ones() -> None:
    context = cpu_target.typing_context
    t = numba.types
    numbers = [t.int64, t.int32, t.uint8, t.float64, t.float32, t.boolean]
    for operation in (operator.add, operator.mul, operator.truediv, operator.lt, operator.iadd, max, min):
        function = context.resolve_value_type(operation)
        for a in numbers:
            for b in numbers:
                expected = kernel_compiler._resolve(function, context, (a, b), {})
                for _ in range(2):
                    assert remembered_call_type(function, context, (a, b), {}) == expected


def test_a_type_is_resolved_once(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[Any] = []
    resolve = kernel_compiler._resolve

    def counted(function: Any, context: Any, args: Any, kws: Any) -> Any:
        calls.append(args)
        return resolve(function, context, args, kws)

    monkeypatch.setattr(kernel_compiler, "_resolve", counted)
    context = cpu_target.typing_context
    function = context.resolve_value_type(operator.sub)
    vars(function).pop("_kiteline_signatures", None)
    for _ in range(3):
        remembered_call_type(function, context, (numba.types.int8, numba.types.float32), {})
    assert len(calls) == 1


def test_an_untried_version_of_numba_compiles_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_compiler, "TRIED", ("0.0.",))
    before = BaseFunction.get_call_type
    assert install() == {}
    assert BaseFunction.get_call_type is before
