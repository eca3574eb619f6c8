"""Bars on flights in several maps: a map that is missing, wrong or inaccurate is not passed."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from kiteline_bench.harness.bars import Bench
from kiteline_bench.papers.several_maps.several_maps import (
    SEQUENCE_03,
    Experiment,
    Outcome,
    _tell,
    bars,
    broken,
    overlapping,
    robots,
)


def outcome(**changes: object) -> Outcome:
    """Two robots whose maps were merged, 1 cm off on 100 m."""
    two = Experiment("two robots", SEQUENCE_03, robots("mcap:F", 10.0, [(0, 30), (10, 40)]), 1)
    return replace(Outcome(two, 2, 2, 1, 100.0, 0.01, 0.02), **changes)  # type: ignore[arg-type]


def test_a_good_flight_passes() -> None:
    assert all(bar.met for bar in bars(outcome()))


@pytest.mark.parametrize(
    "changes",
    [{"merges": 0}, {"placed": 1}, {"maps": 1, "placed": 1}, {"apart_m": 2.0}, {"ate_m": 0.04},
     {"ate_m": float("inf")}],
)  # fmt: skip
def test_a_bad_flight_does_not(changes: dict[str, object]) -> None:
    assert not all(bar.met for bar in bars(outcome(**changes)))


def test_an_error_without_one_of_the_maps_is_no_joint_error() -> None:
    assert [bar.met for bar in bars(outcome(placed=1))] == [False, True, False]


def test_a_flight_that_was_not_broken_merges_nothing() -> None:
    once = Experiment("a loss", SEQUENCE_03, broken("mcap:F", [(0.0, 5.0), (7.0, 9.0)]), maps=2)
    assert all(bar.met for bar in bars(outcome(experiment=once)))
    assert not all(bar.met for bar in bars(outcome(experiment=once, maps=1, placed=1, merges=0)))


def test_the_table_has_rows_of_flights_without_poses(tmp_path: Path) -> None:
    bench = Bench(tmp_path, tmp_path, lambda _: None)
    nothing = outcome(maps=0, placed=0, merges=0, path_m=0.0, ate_m=float("inf"), apart_m=float("inf"))
    _tell(bench, [nothing, outcome(placed=1)])
    assert [row.count("| - | - |") for row in bench.more[-1].splitlines()[-2:]] == [1, 1]


def test_the_limit_is_a_third_of_the_figure_in_proportion_to_the_path() -> None:
    assert outcome().limit_m == pytest.approx(0.6 / 560.0 * 100.0 / 3.0)


def test_maps_without_a_common_place_must_stay_apart() -> None:
    apart = replace(outcome().experiment, merges=0)
    assert [bar.met for bar in bars(outcome(experiment=apart))] == [False]
    assert [bar.met for bar in bars(outcome(experiment=apart, merges=0))] == [True]
    assert [bar.met for bar in bars(outcome(experiment=apart, merges=0, maps=1))] == [False]


def test_neighbouring_pieces_share_twenty_frames() -> None:
    pieces = overlapping(440, 3)
    assert (pieces[0][0], pieces[-1][1]) == (0, 440)
    assert [a[1] - b[0] for a, b in pairwise(pieces)] == [20, 20]


def test_a_broken_flight_is_one_robot_that_sees_nothing_for_a_while() -> None:
    [scenario] = broken("mcap:F", [(0.0, 5.0), (4.0, 9.0), (12.0, 20.0)])
    assert [(p.from_s, p.to_s, p.dark) for p in scenario.parts] == [
        (0.0, 5.0, False), (4.0, 6.0, True), (4.0, 9.0, False), (12.0, 14.0, True), (12.0, 20.0, False),
    ]  # fmt: skip
    assert not scenario.has_imu
