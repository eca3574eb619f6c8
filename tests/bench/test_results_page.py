"""The results file: sections are replaced, bars are met or not, the summary stands on top."""

import importlib
from pathlib import Path

import pytest

from kiteline_bench import benchmark
from kiteline_bench.benchmark import data_folder, main
from kiteline_bench.harness.bars import Bar, Bench, FlightFailed, at_most, is_true
from kiteline_bench.harness.results_page import HEADLINES, replace_section, section
from kiteline_hw.ports import SourceError


def test_bars_are_met_up_to_their_limit() -> None:
    assert at_most("x", 2.0, 2.0, "ms").met
    assert not at_most("x", 2.001, 2.0, "ms").met
    assert not at_most("x", float("nan"), 2.0, "ms").met
    assert is_true("x", "all", False).measured == "no"


def test_a_section_replaces_its_older_self_only() -> None:
    one = section("a", "One", [at_most("x", 1.0, 2.0, "m")])
    two = section("b", "Two", [at_most("y", 3.0, 2.0, "m")])
    text = replace_section(replace_section("", "One", one), "Two", two)
    assert text.startswith("# Results")
    assert "**no**" in text
    newer = section("a", "One", [at_most("x", 1.5, 2.0, "m")])
    text = replace_section(text, "One", newer)
    assert text.count("\n## ") == 3  # the summary stands above them
    assert "1.500 m" in text and "1.000 m" not in text
    assert text.index("## Summary") < text.index("## One") < text.index("## Two")


def test_the_summary_counts_bars_and_lists_headlines() -> None:
    (title, name), *_ = HEADLINES
    met = section("a", title, [at_most(name, 1.5, 2.0, "m"), at_most("z", 1.0, 2.0, "m")], ["### Deeper\n\n## no"])
    unmet = section("b/part", "Two", [at_most("y", 3.0, 2.0, "m")])
    text = replace_section(replace_section("", title, met), "Two", unmet)
    summary = text[text.index("## Summary") : text.index(f"## {title}")]
    assert f"| {title} | `kiteline bench a` | 2 of 2 |" in summary
    assert "| Two | `kiteline bench b/part` | **0 of 1** |" in summary
    assert f"| {name} | 1.500 m | <= 2 m |" in summary
    assert replace_section(text, "Two", unmet) == text


def test_the_command_writes_what_it_measured_and_tells_of_a_bar_that_is_not_met(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("KITELINE_DATA", str(tmp_path))
    monkeypatch.setattr(benchmark, "BENCHMARKS", {"fake": __name__})
    monkeypatch.setattr(importlib, "import_module", lambda name: FakeBench if name == __name__ else __import__(name))
    results = tmp_path / "docs" / "results.md"
    assert main(["fake", "--results", str(results)]) == 1
    assert "| speed | <= 1 ms | 2.000 ms | **no** |" in results.read_text()
    assert "`kiteline bench fake`" in results.read_text()
    with pytest.raises(SystemExit):
        main(["nothing"])
    assert "there are: fake\n" in capsys.readouterr().err


def test_an_unknown_part_is_told_with_the_parts_there_are(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["papers/maps"])
    assert "there are: papers/ekf, papers/ds-ptam," in capsys.readouterr().err


def test_a_flight_that_fails_does_not_keep_others_from_being_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(bench: Bench) -> list[Bar]:
        raise FlightFailed("agent 0 ended")

    parts = {"first": ("First", failing), "second": ("Second", lambda _: [at_most("speed", 1.0, 2.0, "ms")])}
    monkeypatch.setenv("KITELINE_DATA", str(tmp_path))
    monkeypatch.setattr(benchmark, "parts", lambda name: [(f"fake/{key}", *part) for key, part in parts.items()])
    results = tmp_path / "results.md"
    with pytest.raises(FlightFailed, match="agent 0 ended"):
        main(["fake", "--results", str(results)])
    assert "## Second" in results.read_text() and "## First" not in results.read_text()


class FakeBench:
    TITLE = "Fake"

    @staticmethod
    def run(bench: Bench) -> list[Bar]:
        with pytest.raises(SourceError, match="KITELINE_DATA"):
            bench.source("missing.mcap")
        return [at_most("speed", 2.0, 1.0, "ms")]


def test_without_recordings_it_says_where_to_look(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KITELINE_DATA", str(tmp_path / "nowhere"))
    with pytest.raises(SourceError, match="KITELINE_DATA"):
        data_folder()
