import ast
import operator
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from numba.core import caching, ir
from numba.core.compiler import run_frontend
from numba.core.lowering import Lower
from numba.core.registry import cpu_target
from numba.core.types.functions import BaseFunction
from numba.np import arrayobj

from kiteline_core import kernel_compiler, kernel_lowering
from kiteline_core.imaging.matching_kernels import fill_cells
from kiteline_core.kernel_compiler import KernelCompiler, install, remembered_call_type
from kiteline_core.pose.pnp_kernels import p3p

with_shortcuts = pytest.mark.skipif(
    not numba.__version__.startswith(kernel_compiler.TRIED), reason="kernels are compiled as this numba does"
)


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
    """LLVM's code of the kernel. Names and their lengths are blanked: they hold counters and addresses."""
    compiled: Any = numba.njit(nogil=True, **options)(_kernel)
    compiled(np.eye(4), np.zeros(4), np.zeros(4, np.bool_))
    (code,) = compiled.inspect_llvm().values()
    return re.sub(r'_ZN[\w.$]+|@[\w.$"]+|[!#]\d+|\[\d+ x i8\]|\d{6,}', "", code)


@with_shortcuts
def test_the_short_pipeline_makes_the_same_code(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arrayobj, "fix_integer_index", kernel_lowering._fix_index)
    for name, usual in (
        ("extract_function_arguments", kernel_lowering._arguments), ("delvar", kernel_lowering._delete_variable),
        ("lower_getitem", kernel_lowering._get_item), ("lower_setitem", kernel_lowering._set_item),
    ):  # fmt: skip
        monkeypatch.setattr(Lower, name, usual)
    assert _code({"pipeline_class": KernelCompiler}) == _code({})


def _at(line: Any, k: int) -> float:
    return line[k] + line.max()


@with_shortcuts
def test_a_kernel_takes_an_index_as_it_is() -> None:
    line = np.arange(4.0)
    usual: Any = numba.njit(_at)
    kernel: Any = numba.njit(pipeline_class=KernelCompiler)(_at)
    checked: Any = numba.njit(pipeline_class=KernelCompiler, boundscheck=True)(_at)
    assert usual(line, -1) == 6.0
    assert [kernel(line, k) for k in range(4)] == [checked(line, k) for k in range(4)] == [3.0, 4.0, 5.0, 6.0]
    for k in (-1, 4):
        with pytest.raises(IndexError):
            checked(line, k)


def _sum_of_views(levels: Any, rows: Any, out: Any) -> float:
    scratch = np.zeros((4, 4))
    total = 0.0
    for i in range(rows.shape[0]):
        line = levels[rows[i] % 2][rows[i]]
        part = scratch[i % 4]
        for k in range(part.shape[0]):
            part[k] += line[k]
        out[i] = part[0]
        total += scratch[i % 4, 3]
    return total


@with_shortcuts
def test_views_of_a_kernels_arguments_are_not_counted() -> None:
    levels, rows = (np.arange(40.0).reshape(10, 4), np.ones((10, 4), np.float64)), np.array([3, 4, 9, 1, 0, 2])
    counted = []
    for options in ({}, {"pipeline_class": KernelCompiler}):
        compiled: Any = numba.njit(nogil=True, no_cfunc_wrapper=True, **options)(_sum_of_views)
        ours, theirs = np.zeros(6), np.zeros(6)
        held = [sys.getrefcount(one) for one in (*levels, rows, ours)]
        assert compiled(levels, rows, ours) == _sum_of_views(levels, rows, theirs)
        assert np.array_equal(ours, theirs)
        assert [sys.getrefcount(one) for one in (*levels, rows, ours)] == held
        (code,) = compiled.inspect_llvm().values()
        counted.append(code.count("call void @NRT_incref"))
    assert counted[1] < counted[0]


def _sum_of_rows(levels: Any, rows: Any) -> float:
    total = 0.0
    for i in range(rows.shape[0]):
        line = levels[rows[i] % 2][rows[i]]
        for value in line[1:]:
            total += value
    return total


def _sum_of_some(levels: Any, rows: Any) -> float:
    total = 0.0
    for i in range(rows.shape[0]):
        some = levels[0][rows[i]]
        total += some[some > 3.0].sum()
    return total


@pytest.mark.parametrize(("function", "counts"), [(_sum_of_rows, False), (_sum_of_some, True)])
@with_shortcuts
def test_only_a_kernel_that_makes_an_array_counts(function: Any, counts: bool) -> None:
    levels, rows = (np.arange(40.0).reshape(10, 4), np.ones((10, 4))), np.array([3, 4, 9, 1, 0, 2])
    compiled: Any = numba.njit(nogil=True, no_cfunc_wrapper=True, pipeline_class=KernelCompiler)(function)
    held = [sys.getrefcount(one) for one in (*levels, rows)]
    assert compiled(levels, rows) == function(levels, rows)
    assert [sys.getrefcount(one) for one in (*levels, rows)] == held
    (code,) = compiled.inspect_llvm().values()
    own = code.partition("define ")[2].partition("\n}")[0]  # without the wrapper that Python calls
    assert ("NRT_" in own) == counts


def _mixed_elements(bits: Any, codes: Any, columns: Any, pair: Any, out: Any) -> float:
    row, k, total = codes[1], np.uint8(2), 0.0
    for i in range(bits.shape[0]):
        if bits[i] and pair[1][i, 1] > 0:
            total += row[k] + codes[np.int32(i % 2), k] * columns[i, 0] + columns[0][i]
        out[i, 1, k] = codes[0, i] + 300
        out[i, 0] = row[i]
        bits[i] = not bits[i]
    return total


def test_elements_of_all_kinds_are_read_and_written() -> None:
    """Of rows, of arrays that are not contiguous, by small and unsigned indices, converted to another type."""
    results = []
    for options in (None, {}, {"pipeline_class": KernelCompiler}):
        codes = np.arange(8, dtype=np.uint16).reshape(2, 4)
        bits, out = np.array([True, False, True]), np.zeros((3, 2, 4), np.float32)
        pair = codes.astype(np.int8), np.ones((3, 2), np.int16)
        function: Any = _mixed_elements if options is None else numba.njit(**options)(_mixed_elements)
        total = function(bits, codes, np.linspace(0.0, 1.0, 9).reshape(3, 3).T, pair, out)
        results.append([total, *bits, *out.ravel()])
    assert results[0] == results[1] == results[2]


@numba.njit(nogil=True, no_cfunc_wrapper=True, no_cpython_wrapper=True, pipeline_class=KernelCompiler)
def _upper(a: Any, k: int) -> Any:
    return a[k:]


def _fill_views(n: int, out: Any) -> None:
    for i in range(n):
        view = _upper(np.full(512, float(i)), i % 7)
        other = np.full(512, -1.0)  # takes the memory of the first array if that was given up too early
        out[i] = view[0] + other[0]


def test_a_view_that_a_helper_returns_keeps_its_array() -> None:
    found, wanted = np.zeros(200), np.zeros(200)
    numba.njit(nogil=True, pipeline_class=KernelCompiler)(_fill_views)(200, found)
    for i in range(200):
        wanted[i] = i - 1.0
    assert np.array_equal(found, wanted)


def test_no_kernel_counts_from_the_end_of_an_array() -> None:
    root = Path(__file__).parents[2]
    rooms = ("core", "codec", "hw", "agent", "basestation", "lab", "bench")
    modules = [path for room in rooms for path in (root / room).rglob("*_kernels.py")]
    assert len(modules) > 30
    for path in modules:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Subscript):
                parts = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
                negative = [p for p in parts if isinstance(p, ast.UnaryOp) and isinstance(p.op, ast.USub)]
                assert not negative, f"{path.name}:{node.lineno}"


@numba.njit(nogil=True, no_cfunc_wrapper=True, no_cpython_wrapper=True, pipeline_class=KernelCompiler)
def _mean(line: Any, k: int) -> float:
    total = 0.0
    for i in range(k):
        total += line[i]
    return total // k + np.floor(line.sum())


def _means(a: Any, k: int) -> tuple[float, float]:
    return _mean(a[0], k), _mean(a[:, 0], k)


@with_shortcuts
def test_a_helper_is_translated_in_its_callers_only() -> None:
    compiled: Any = numba.njit(_means)
    values = np.arange(12.0).reshape(3, 4)
    assert compiled(values, 3) == (_mean.py_func(values[0], 3), _mean.py_func(values[:, 0], 3))
    assert len(_mean.overloads) == 2
    engine = cpu_target.target_context.codegen()._engine
    for result in _mean.overloads.values():
        assert result.library.is_linked_only
        assert not engine.is_symbol_defined(result.fndesc.llvm_cpython_wrapper_name)
    with pytest.raises(ZeroDivisionError):
        compiled(values, 0)


@with_shortcuts
def test_helpers_are_read_from_the_cache(tmp_path: Path) -> None:
    """A second process loads the caller, and nothing of what compiles; a third compiles another caller with the helper
    from the cache.
    """
    (tmp_path / "cached.py").write_text(
        "from kiteline_core.jit import njit\n\n"
        "@njit\ndef _twice(a, i):\n    return 2.0 * a[i]\n\n"
        "@njit\ndef first(a):\n    return _twice(a, 1) + 1.0\n\n"
        "@njit\ndef second(a):\n    return _twice(a, 2) + a[0]\n"
    )
    environment = {
        **os.environ,
        "NUMBA_CACHE_DIR": str(tmp_path),
        "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path]),
    }
    lines = []
    for call in ("first", "first", "second"):
        code = (
            f"import numpy as np, cached, sys\nprint(cached.{call}(np.arange(6.0)), "
            f"len(cached.{call}.stats.cache_hits), len(cached._twice.stats.cache_hits), "
            f"len(cached._twice.stats.cache_misses), 'numba.np.arraymath' in sys.modules)"
        )
        done = subprocess.run(
            [sys.executable, "-c", code], env=environment, stdout=subprocess.PIPE, text=True, check=True
        )
        lines.append(done.stdout.split())
    assert lines == [
        ["3.0", "0", "0", "1", "True"], ["3.0", "1", "0", "0", "False"], ["4.0", "0", "1", "0", "True"],
    ]  # fmt: skip


@with_shortcuts
def test_processes_that_write_to_the_cache_at_once_lose_nothing(tmp_path: Path) -> None:
    slow = (
        "from numba.core.caching import IndexDataCacheFile as File\nimport time, sys\nfrom kiteline_core import jit\n"
        "load = File._load_index\nFile._load_index = lambda self: (load(self), time.sleep(.02))[0]\n"
        "file = File(sys.argv[1], 'kernel', 'source')\n"
        "for k in range(8): file.save((sys.argv[2], k), sys.argv[2] * k)\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    writers = [subprocess.Popen([sys.executable, "-c", slow, str(tmp_path), who], env=environment) for who in "ab"]
    assert [writer.wait(60) for writer in writers] == [0, 0]
    file: Any = caching.IndexDataCacheFile(str(tmp_path), "kernel", "source")  # type: ignore[no-untyped-call]
    assert {(who, k): file.load((who, k)) for who in "ab" for k in range(8)} == {
        (who, k): who * k for who in "ab" for k in range(8)
    }


def _listed(value: Any) -> list[Any]:
    """Variables of an instruction, as numba lists them."""
    if isinstance(value, ir.Var):
        return [value]
    if isinstance(value, ir.Inst):
        return value.list_vars()  # type: ignore[no-untyped-call, no-any-return]
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, (list, tuple)) else ()
    return [one for part in parts for one in _listed(part)]


def test_variables_of_instructions_are_all_found() -> None:
    functions = [_kernel, _means, fill_cells.py_func, p3p.py_func]  # type: ignore[attr-defined]
    found = 0
    for function in functions:
        blocks = run_frontend(function).blocks  # type: ignore[no-untyped-call]
        for block in blocks.values():
            for instruction in block.body:
                assert list(map(id, instruction.list_vars())) == list(map(id, _listed(vars(instruction))))
                found += len(instruction.list_vars())
    assert found > 1000


@with_shortcuts
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
