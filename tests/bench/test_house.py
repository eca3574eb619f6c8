"""The shape of the sources is measured: sizes, import circles, also those of types alone."""

from collections import Counter
from pathlib import Path

from kiteline_bench.benchmark import BENCHMARKS, parts
from kiteline_bench.harness.bars import Bench
from kiteline_bench.system.house import runs_of_make_test
from kiteline_bench.system.structure import ROOT, Sources, by_sub_package, circles


def write(root: Path, **modules: str) -> Sources:
    """A room "core" with modules by name, "__" for a dot."""
    for name, text in modules.items():
        path = root / "core" / "kiteline_core" / f"{name.replace('__', '/')}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        (path.parent / "__init__.py").touch()
        path.write_text(text)
    return Sources.of(root, ("core",))


def test_imports_are_found_anywhere_in_a_module(tmp_path: Path) -> None:
    sources = write(
        tmp_path,
        a="from __future__ import annotations\nimport kiteline_core.b\nimport os\n",
        b="if TYPE_CHECKING:\n    from kiteline_core import a\n",
        c="def f():\n    from kiteline_core.b import name\n",
    )
    assert sources.imports() == {
        "kiteline_core.a": {"kiteline_core.b"},
        "kiteline_core.b": {"kiteline_core.a"},
        "kiteline_core.c": {"kiteline_core.b"},
    }
    assert circles(sources.imports()) == [["kiteline_core.a", "kiteline_core.b"]]
    assert sources.lines()["kiteline_core.b"] == 2
    assert sources.folder_sizes() == {str(tmp_path / "core" / "kiteline_core"): 3}


def test_sub_packages_can_form_a_circle_where_modules_do_not(tmp_path: Path) -> None:
    sources = write(
        tmp_path, x__one="import kiteline_core.y.one\n", y__one="", y__two="import kiteline_core.x.two\n", x__two=""
    )
    assert not circles(sources.imports())
    assert circles(by_sub_package(sources.imports())) == [["kiteline_core.x", "kiteline_core.y"]]


def test_circles_are_whole_and_apart() -> None:
    graph = {"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": {"e"}, "e": {"d"}, "f": {"a"}}
    assert circles(graph) == [["a", "b", "c"], ["d", "e"]]


def test_these_sources_are_measured_and_have_no_circles(tmp_path: Path) -> None:
    ((_, _, run),) = parts("house/structure")
    bench = Bench(tmp_path, tmp_path, lambda _: None)
    bars = run(bench)
    assert len(bars) == 5 and all(bar.measured for bar in bars)
    assert all(bar.met for bar in bars if "circles" in bar.name), bench.more
    assert {"kiteline_core", "kiteline_bench.benchmark"} <= set(Sources.of(ROOT).files)


def test_each_benchmark_is_found() -> None:
    assert len(BENCHMARKS) > 8
    assert all(parts(name) for name in BENCHMARKS)


def test_the_suite_is_timed_as_make_runs_it() -> None:
    runs = runs_of_make_test((ROOT / "Makefile").read_text(encoding="utf-8"))
    assert [run[-2:] for run in runs] == [["-m", "not alone"], ["-m", "alone"]]


def test_tests_are_small_files_in_small_folders() -> None:
    folders: Counter[Path] = Counter()
    for path in (ROOT / "tests").glob("**/*.py"):
        folders[path.parent] += 1
        assert len(path.read_text(encoding="utf-8").splitlines()) <= 400, path
    assert len(folders) > 20
    assert [str(folder) for folder, count in folders.items() if count > 14] == []
