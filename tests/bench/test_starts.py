"""Median ratios of errors, and the pieces of a recording."""

from itertools import pairwise
from pathlib import Path

import pytest

from kiteline_bench.harness import starts
from kiteline_bench.harness.bars import Bench


def a_bench(folder: Path) -> Bench:
    return Bench(folder, folder, lambda _: None)


def test_the_median_counts_and_every_pair_is_listed(tmp_path: Path) -> None:
    bench = a_bench(tmp_path)
    bar = starts.median_ratio(bench, "x", [(0.002, 0.001), (0.001, 0.001), (0.0009, 0.001)], 1.1)
    assert bar.met and bar.measured == "1.00" and bar.name == "x: median of 3"
    assert bench.more == ["x, mm: 2.0 / 1.0 = 2.00, 1.0 / 1.0 = 1.00, 0.9 / 1.0 = 0.90."]
    assert not starts.median_ratio(bench, "x", [(0.002, 0.001), (0.0012, 0.001), (0.0009, 0.001)], 1.1).met


def test_pieces_overlap_and_cover_the_flight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spans: list[tuple[float, float]] = []
    monkeypatch.setattr(starts, "length_s", lambda _: 100.0)

    def note(bench: Bench, source: Path, name: str, begin_s: float, end_s: float) -> Path:
        spans.append((begin_s, end_s))
        return bench.folder / name

    monkeypatch.setattr(starts, "cut", note)
    names = starts.pieces(a_bench(tmp_path), Path("flight.mcap"), "a", 3, 0.05, 6.0)
    assert len(set(names)) == 3
    assert spans[0][0] == 0.0 and spans[2][1] >= 100.0
    assert [round(a[1] - b[0], 6) for a, b in pairwise(spans)] == [5.0, 5.0]
    assert abs(spans[0][1] - (100 / 3 + 6.0 + 2.5)) < 1e-9
