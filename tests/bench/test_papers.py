"""Flights as papers flew them: throttled, in several maps, along their sequences."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from kiteline_bench.harness.bars import Bar, Bench, FlightFailed
from kiteline_bench.harness.result import FlownProcesses
from kiteline_bench.papers import simulated_vehicle as vehicle
from kiteline_bench.papers.ds_ptam import PERCENTS, _unless_failed, table, throttled_bars
from kiteline_bench.papers.initialisation import bound
from kiteline_bench.papers.segfloor.scenes import Scene, corridor_1, corridor_2, synthetic, trajectory
from kiteline_bench.papers.sequences import _ORB_SLAM2, DataSequence, SequenceResult, find_sequences, sequence_bars
from kiteline_bench.papers.several_maps.several_maps import (
    SEQUENCE_03,
    SEQUENCE_07,
    Experiment,
    Outcome,
    _tell,
    bars,
    broken,
    overlapping,
    own,
    robots,
    run,
)
from kiteline_bench.papers.throttled import MODES, NO_ERRORS, Errors, Throttled, paper_errors
from kiteline_core.arrays import F64
from kiteline_core.frame import Trajectory
from kiteline_core.geometry import se3
from kiteline_hw.ports import SourceError
from kiteline_hw.sim.truth.occupancy import FREE, occupancy
from kiteline_lab.flights.flight_report import write_tum
from kiteline_lab.flights.outcome import FlightOutcome


def flight(mode: str, percent: float, max_abs_m: float, dropped: int) -> Throttled:
    errors = Errors(max_abs_m, 0.01, 0.002, 1.0, 0.2, 0.05)
    return Throttled(mode, percent, errors, 0.1, 100, 100 - dropped, 0, dropped, 1, 20.0, 0, None)


def test_errors_are_the_papers(tmp_path: Path) -> None:
    n = 20
    t_ns = 50_000_000 * np.arange(n, dtype=np.int64)
    truth = np.array([se3.from_rt(np.eye(3), np.array([0.1 * k, 0.0, 0.0])) for k in range(n)])
    offset = se3.from_rt(se3.so3_exp(np.array([0.0, 0.0, 0.3])), np.array([5.0, 1.0, 0.0]))
    found = truth.copy()
    found[10:, 1, 3] += 0.2  # a jump, which stays
    write_tum(tmp_path / "live.tum", list(zip(t_ns.tolist(), offset @ found, strict=True)))
    errors, live = paper_errors(tmp_path / "live.tum", Trajectory(t_ns, truth))
    assert live is not None
    assert (errors.max_abs_m, errors.max_rel_m) == pytest.approx((0.2, 0.2), abs=1e-5)
    assert errors.rmse_rel_m == pytest.approx(0.2 / np.sqrt(n - 1), abs=1e-5)
    assert errors.max_abs_deg == pytest.approx(0.0, abs=1e-3)
    short, _ = paper_errors(tmp_path / "live.tum", Trajectory(t_ns, truth), until_m=0.55)
    assert short.max_abs_m == pytest.approx(0.0, abs=1e-5)
    assert paper_errors(tmp_path / "none.tum", Trajectory(t_ns, truth)) == (NO_ERRORS, None)
    (tmp_path / "empty.tum").touch()
    assert paper_errors(tmp_path / "empty.tum", Trajectory(t_ns, truth)) == (NO_ERRORS, None)


def test_a_part_that_cannot_be_flown_is_a_bar_that_is_not_met(tmp_path: Path) -> None:
    def part(bench: Bench) -> list[Bar]:
        raise FlightFailed("base ended")

    [bar] = _unless_failed(Bench(tmp_path, tmp_path, lambda _: None), "street", part)
    assert (bar.met, bar.measured) == (False, "base ended")


def test_bars_say_what_one_computer_loses() -> None:
    flights = {(mode, percent): [flight(mode, percent, 0.2, 0)] for mode in MODES for percent in PERCENTS}
    assert all(bar.met for bar in throttled_bars("room", flights))
    assert "loses nothing" in throttled_bars("room", flights)[1].measured
    flights["local", 25.0] = [flight("local", 25.0, 0.5, 40)]
    flights["distributed", 25.0] = [flight("distributed", 25.0, 0.31, 0)]
    ratio, said = throttled_bars("room", flights)[:2]
    assert not ratio.met
    assert said.measured == "loses: 40 % of the frames without a pose and 0.500 m, distributed 0 % and 0.310 m"
    text = table("room", flights)
    assert "| 25 | tracker + mapper, one computer | 0.500 |" in text


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


def folder(tmp_path: Path) -> Path:
    """Data sets as they lie when their archives are unpacked side by side."""
    kitti = tmp_path / "kitti" / "dataset" / "sequences" / "07"
    for place in (
        kitti / "image_0", tmp_path / "euroc" / "MH_01_easy" / "mav0" / "cam0",
        tmp_path / "dataset-room1_512_16" / "mav0" / "mocap0",
        tmp_path / "rgbd_dataset_freiburg2_pioneer_slam2" / "rgb", tmp_path / "notes",
    ):  # fmt: skip
        place.mkdir(parents=True)
    (kitti / "calib.txt").write_text("")
    return tmp_path


def test_sequences_are_found_by_their_layout_at_any_depth(tmp_path: Path) -> None:
    found = find_sequences(folder(tmp_path))
    assert [(s.kind, s.name) for s in found] == [
        ("TUM-VI", "dataset-room1_512_16"), ("EuRoC", "MH_01_easy"), ("KITTI", "07"),
        ("TUM", "rgbd_dataset_freiburg2_pioneer_slam2"),
    ]  # fmt: skip
    assert found[2].source == f"kitti:{tmp_path}/kitti/dataset/sequences/07"
    assert [s.printed_m(_ORB_SLAM2) for s in found] == [None, 0.035, 0.5, None]


def test_the_recordings_of_the_benchmarks_are_such_a_folder(data_dir: Path) -> None:
    kinds = {s.name: s.kind for s in find_sequences(data_dir)}
    assert kinds["kitti_straight"] == "KITTI"
    assert kinds["euroc_mh01_air"] == "EuRoC"
    assert kinds["tum_rgbd_xyz"] == "TUM"


def test_a_folder_without_sequences_says_what_was_expected(tmp_path: Path) -> None:
    (tmp_path / "pictures").mkdir()
    with pytest.raises(SourceError, match=r"no sequence found.*calib\.txt.*mav0.*rgb\.txt"):
        find_sequences(tmp_path)
    with pytest.raises(SourceError, match="no such folder"):
        find_sequences(tmp_path / "absent")


def test_the_thesis_cuts_its_own_sequences(tmp_path: Path) -> None:
    pioneer, seven = sorted(own(folder(tmp_path)), key=lambda e: len(e.scenarios))
    assert len(pioneer.scenarios) == 1
    assert seven.theirs is SEQUENCE_07 and seven.merges == 2
    assert [(p.from_s, p.to_s) for s in seven.scenarios for p in s.parts] == [
        (-0.05, 39.95), (37.95, 69.95), (67.95, 110.05),
    ]  # fmt: skip


def test_other_sequences_are_not_the_thesis_s(data_dir: Path) -> None:
    with pytest.raises(SourceError, match="none of the thesis's sequences"):
        own(data_dir)


def test_sequences_that_are_cut_short_or_broken_are_bars_that_are_not_met(
    tmp_path: Path, data_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """51 of KITTI 03's 801 frames leave the second robot without any; of 05 there is nothing but a folder."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sequences" / "05" / "image_0").mkdir(parents=True)
    (tmp_path / "sequences" / "05" / "calib.txt").write_text("")
    (tmp_path / "sequences" / "03").symlink_to(data_dir / "kitti_straight")
    met = {bar.name: bar.met for bar in run(Bench(tmp_path, tmp_path, lambda _: None, sequences=tmp_path))}
    assert met["KITTI 05: flown"] is False and met["KITTI 03: merges"] is False


def test_a_short_name_is_no_other_sequence() -> None:
    assert DataSequence("KITTI", "straight", "").printed_m(_ORB_SLAM2) is None


def test_an_error_beside_a_printed_one_counts_with_nearly_all_frames_tracked(tmp_path: Path) -> None:
    def met(name: str, tracked: int) -> bool:
        flown = FlownProcesses(tmp_path, {"agents": [{"tracked": tracked, "frames": 100}]}, FlightOutcome([None]))
        [bar] = sequence_bars(SequenceResult(DataSequence("KITTI", name, ""), flown, None, None))
        return bar.met

    assert [met("07", tracked) for tracked in (100, 95, 94, 0)] == [True, True, False, False]
    assert [met("mine", tracked) for tracked in (94, 0)] == [True, False]


@pytest.mark.parametrize(
    ("make", "area_m2", "way_m"), [(corridor_1, 10.0, 12.5), (corridor_2, 7.9, 8.3), (synthetic, 682.7, 138.4)]
)  # fmt: skip
def test_areas_and_ways_are_those_of_the_thesis(
    make: Callable[[int], Scene], area_m2: float, way_m: float
) -> None:  # fmt: skip
    scene = make(4)
    true = occupancy(scene.world, 0.1, 2.0, 0.02 if area_m2 < 100.0 else 0.05)
    _, poses = trajectory(scene)
    free = true.image == FREE
    assert free.sum() * true.cell_m**2 == pytest.approx(area_m2, rel=0.02)
    _, pieces = cv2.connectedComponents(free.astype(np.uint8), connectivity=4)
    assert pieces.max() == 1
    clear_m = cv2.distanceTransform(free.astype(np.uint8), cv2.DIST_L2, 5) * true.cell_m
    cells = np.floor((poses[:, :2, 3] - true.corner) / true.cell_m).astype(int)
    assert clear_m[cells[:, 1], cells[:, 0]].min() > 0.15
    assert np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum() == pytest.approx(way_m, rel=0.03)
    assert np.allclose(poses[:, 2, 3], scene.camera_m)
    assert np.allclose(-poses[:, 2, 2], np.sin(scene.tilt_rad))  # it looks down by the tilt


@pytest.mark.parametrize("planar", [True, False])
def test_the_bound_of_known_poses_is_reached_by_least_squares_and_odometry_makes_it_larger(planar: bool) -> None:
    model, rng = vehicle.VehicleModel(planar), np.random.default_rng(3)
    T_o_c = vehicle.loop(planar)[:26] @ vehicle.camera().T_b_c
    point, sigma = T_o_c[0, :3, :3] @ np.array([1.0, -0.5, 7.0]) + T_o_c[0, :3, 3], 0.002
    known = bound(model, T_o_c, point, sigma, odometry=False)

    def residual(at: F64, xy: F64) -> F64:
        local = np.einsum("kji,kj->ki", T_o_c[:, :3, :3], at - T_o_c[:, :3, 3])
        return np.asarray((local[:, :2] / local[:, 2:] - xy).ravel())

    exact = residual(point, np.zeros((len(T_o_c), 2))).reshape(-1, 2)
    errors = []
    for _ in range(400):
        xy, at = exact + sigma * rng.standard_normal(exact.shape), point.copy()
        for _ in range(4):
            J = np.stack([residual(at + 1e-6 * axis, xy) - residual(at, xy) for axis in np.eye(3)], axis=1) / 1e-6
            at -= np.linalg.lstsq(J, residual(at, xy), rcond=None)[0]
        errors.append(at - point)
    assert np.trace(np.cov(np.array(errors).T)) == pytest.approx(np.trace(known), rel=0.25)
    told = bound(model, T_o_c, point, sigma, odometry=True)
    assert (np.linalg.eigvalsh(told - known) > -1e-12).all() and np.trace(told) > 2.0 * np.trace(known)
