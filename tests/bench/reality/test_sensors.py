"""Sensors that come late, have holes or end: what the flights are made of, and how each is judged."""

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from kiteline_bench.harness.bars import Bench
from kiteline_bench.harness.faults import dark_between, samples_between, within
from kiteline_bench.harness.odometer import NOISE_M_S, SCALE, measured_along, with_odometer_between
from kiteline_bench.harness.recording import Recording, load
from kiteline_bench.reality.flown import Flown, flown
from kiteline_bench.reality.sensors import figures as judging
from kiteline_bench.reality.sensors.cases import CASES, DARK, IMUS, ODOMETERS, Case
from kiteline_bench.reality.sensors.figures import _drifting, judged, off_after_dark_m
from kiteline_bench.reality.sensors.missing import _spread
from kiteline_core.frame import ImuBatch, Trajectory
from kiteline_core.geometry import se3

NO_IMU, IMU, LATE_IMU, HOLE, IMU_ENDS = IMUS
NO_ODOMETER, ODOMETER, LATE_ODOMETER, ODOMETER_ENDS = ODOMETERS
BRIGHT, DARK_1, DARK_4 = DARK
PLAIN = Case(NO_IMU, NO_ODOMETER, BRIGHT)


@pytest.fixture(scope="module")
def recorded(recording: Path) -> Recording:
    return load(str(recording))


@pytest.fixture(scope="module")
def flight(recorded: Recording, tmp_path_factory: pytest.TempPathFactory) -> Flown:
    folder = tmp_path_factory.mktemp("bench")
    return flown(Bench(folder, folder, lambda _: None), "wall", recorded)


def test_samples_and_images_are_there_in_their_spans_alone(recorded: Recording) -> None:
    items = [
        replace(item, imu=ImuBatch(item.frame.t_ns + 5_000_000 * np.arange(10), np.zeros((10, 3)), np.ones((10, 3))))
        for item in recorded.items
    ]
    spans = ((-np.inf, 0.3), (0.6, 0.9))
    cut = samples_between(replace(recorded, items=tuple(items)), spans)
    left = np.concatenate([item.imu.t_ns for item in cut.items if item.imu is not None])
    seconds = (left - recorded.items[0].frame.t_ns) * 1e-9
    assert within(seconds, spans).all() and len(left) == pytest.approx(120, abs=2)
    assert any(item.imu is None for item in cut.items)
    dark = [float(item.frame.left.std()) < 3.0 for item in dark_between(recorded, ((0.3, 0.6),)).items]
    assert np.flatnonzero(dark).tolist() == list(range(6, 12))
    assert not within(np.arange(3.0), ()).any()


def test_an_odometer_measures_along_the_true_path_with_its_scale_and_noise() -> None:
    t_s = np.arange(0.0, 20.0, 0.05)
    turns = np.array([se3.so3_exp(np.array([0.0, 0.2 * np.sin(t), 0.4 * t])) for t in t_s])
    places = np.stack([2.0 * np.cos(0.4 * t_s), 2.0 * np.sin(0.4 * t_s), 0.3 * np.sin(t_s)], axis=1)
    truth = Trajectory(
        np.asarray(1e9 * t_s, np.int64) + 7, np.array([se3.from_rt(r, p) for r, p in zip(turns, places, strict=True)])
    )
    measured = measured_along(truth)
    assert measured.t_ns[0] == truth.t_ns[0] and (np.diff(measured.t_ns) == 20_000_000).all()
    at = (measured.t_ns - truth.t_ns[0]) * 1e-9
    true = np.stack([-0.8 * np.sin(0.4 * at), 0.8 * np.cos(0.4 * at), 0.3 * np.cos(at)], axis=1)
    turned = np.array([se3.so3_exp(np.array([0.0, 0.2 * np.sin(t), 0.4 * t])) for t in at])
    off = np.einsum("nij,nj->ni", turned, measured.velocity) - SCALE * true
    assert off.std() == pytest.approx(NOISE_M_S, rel=0.1) and np.abs(off.mean(axis=0)).max() < 0.004
    np.testing.assert_allclose(np.sqrt(measured.velocity_cov[0]), NOISE_M_S * np.eye(3), atol=1e-12)


def test_an_odometer_measures_in_its_spans_alone(recorded: Recording) -> None:
    driven = with_odometer_between(recorded, ((0.5, 1.0),))
    stamps = np.concatenate([item.odometry.t_ns for item in driven.items if item.odometry is not None])
    seconds = (stamps - recorded.items[0].frame.t_ns) * 1e-9
    assert len(stamps) == pytest.approx(25, abs=1) and seconds.min() >= 0.5 and seconds.max() < 1.0
    assert all(item.odometry is None for item in with_odometer_between(recorded, ()).items)


def test_every_pair_of_values_is_flown() -> None:
    for pair in (
        lambda case: (case.imu, case.odometer),
        lambda case: (case.imu, case.dark),
        lambda case: (case.odometer, case.dark),
    ):
        everything = {pair(Case(*values)) for values in product(IMUS, ODOMETERS, DARK)}
        assert {pair(case) for case in CASES} == everything
    assert len(CASES) == 20 and CASES[0].plain and not any(case.plain for case in CASES[1:])


def test_a_metre_is_known_once_a_sensor_has_measured_along_with_images() -> None:
    assert PLAIN.metre_from_s == np.inf and PLAIN.metre_s(np.inf) == 0.0
    assert Case(IMU, NO_ODOMETER, DARK_4).metre_from_s == pytest.approx(8.0)
    assert Case(LATE_IMU, NO_ODOMETER, BRIGHT).metre_from_s == pytest.approx(13.0)
    assert Case(LATE_IMU, NO_ODOMETER, DARK_1).metre_from_s == pytest.approx(19.5)
    assert Case(NO_IMU, ODOMETER_ENDS, BRIGHT).metre_from_s == pytest.approx(8.0)
    assert Case(LATE_IMU, LATE_ODOMETER, DARK_1).metre_s(12.0) == pytest.approx(5.5)


def test_the_world_is_turned_upright_by_an_imu_that_comes_late() -> None:
    assert Case(LATE_IMU, ODOMETER, BRIGHT).upright == ((5.0, 6.0),)
    assert not any(Case(imu, ODOMETER, BRIGHT).upright for imu in IMUS if imu is not LATE_IMU)


def test_what_measures_through_the_dark_bounds_the_error_at_its_end() -> None:
    assert off_after_dark_m(PLAIN, 1.0) == 0.0
    assert off_after_dark_m(Case(NO_IMU, ODOMETER_ENDS, DARK_4), 1.0) == np.inf  # falls silent in it
    assert off_after_dark_m(Case(HOLE, NO_ODOMETER, DARK_1), 1.0) == np.inf
    by_imu, by_both = (off_after_dark_m(Case(IMU, odometer, DARK_4), 1.0) for odometer in (NO_ODOMETER, ODOMETER))
    assert 0.03 < by_both < by_imu < 0.5
    assert off_after_dark_m(Case(IMU, NO_ODOMETER, DARK_1), 1.0) < by_imu


def with_estimates(flight: Flown, change: object) -> Flown:
    estimates = [change(k, e) for k, e in enumerate(flight.run.estimates)]  # type: ignore[operator]
    return replace(flight, run=replace(flight.run, estimates=estimates))


def test_a_good_flight_is_within_its_bounds(flight: Flown) -> None:
    found = judged(PLAIN, flight, flight)
    assert found.wait_s == 0.0 and found.untold == 0.0 and found.lost == 0.0 and found.quality > 90.0
    assert 0.0 < max(found.over.values()) <= 0.5
    assert np.isnan(found.tilt_deg)  # no IMU measured the vertical
    silent = replace(flight, run=replace(flight.run, metric=[False] * len(flight.run.metric)))
    assert judged(Case(IMU, NO_ODOMETER, BRIGHT), silent, None).wait_s == np.inf
    unknown = judged(PLAIN, silent, None)  # one camera alone: nothing tells the metre
    assert np.isnan(unknown.wait_s) and unknown.untold == 0.0 and np.isnan(unknown.over["live"])
    assert judged(PLAIN, flight, None).untold == 1.0


def test_errors_of_a_flight_are_found(flight: Flown, monkeypatch: pytest.MonkeyPatch) -> None:
    imu = Case(IMU, NO_ODOMETER, BRIGHT)
    lean, true = se3.so3_exp(np.radians([3.0, 0.0, 0.0])), [T[:3, :3] for T in flight.run.truth]
    tilted = with_estimates(flight, lambda k, e: replace(e, R_l_o=lean @ true[k] @ e.T_o_b[:3, :3].T))
    assert judged(imu, tilted, flight).tilt_deg == pytest.approx(3.0, abs=0.01)
    withheld = with_estimates(flight, lambda _, e: replace(e, R_l_o=None))
    assert judged(imu, withheld, flight).tilt_deg == pytest.approx(180.0)
    missing = with_estimates(flight, lambda k, e: replace(e, tracked=e.tracked and not 10 <= k < 14))
    assert judged(imu, missing, flight).lost == 4.0
    doubtful = with_estimates(flight, lambda k, e: replace(e, quality=20 if k % 3 else e.quality))
    assert judged(imu, doubtful, flight).quality == 20.0

    def moved(k: int, T: np.ndarray) -> np.ndarray:
        return se3.from_rt(np.eye(3), np.array([0.0, 0.0, 0.5 * (k >= 15)])) @ T

    stepped = with_estimates(
        flight, lambda k, e: replace(e, T_m_b=moved(k, e.T_m_b), T_o_b=moved(k, e.T_o_b), T_w_b=None)
    )
    over = judged(imu, stepped, flight).over
    monkeypatch.setattr(judging, "_LEAST_WAY_M", 0.1)
    after = judged(Case(IMU, NO_ODOMETER, replace(DARK_1, spans=((0.7, 0.75),))), stepped, flight)
    assert after.live_scale < 2.0 < judged(imu, stepped, flight).live_scale  # a step in the dark is no scale
    assert over["odometry"] > 2.0 and over["live"] > 2.0 and over["base"] <= 0.5


def test_live_poses_are_judged_from_when_the_world_is_upright(flight: Flown) -> None:
    lean = se3.from_rt(se3.so3_exp(np.array([0.0, 0.0, 0.3])), np.zeros(3))
    before = with_estimates(flight, lambda k, e: replace(e, T_w_b=lean @ e.T_m_b if k < 15 else e.T_m_b))
    late = Case(replace(LATE_IMU, spans=((1e-9, np.inf),)), NO_ODOMETER, BRIGHT)
    whole = judged(Case(IMU, NO_ODOMETER, BRIGHT), before, flight)
    assert judged(late, before, flight).over["live"] <= 0.5 < whole.over["live"]
    assert judged(late, before, flight).over["odometry"] == whole.over["odometry"]


def test_frames_in_the_dark_are_not_lost_and_what_nothing_measures_is_not_judged(flight: Flown) -> None:
    early = replace(DARK_1, spans=((0.5, 0.7),))
    blind = with_estimates(flight, lambda k, e: replace(e, tracked=e.tracked and not 10 <= k < 16))
    assert judged(Case(IMU, NO_ODOMETER, early), blind, flight).lost == 2.0
    unmeasured = judged(Case(NO_IMU, NO_ODOMETER, early), blind, flight)
    assert unmeasured.lost == 2.0 and np.isnan(unmeasured.over["odometry"]) and unmeasured.over["base"] <= 0.5
    assert np.isnan(judged(Case(NO_IMU, NO_ODOMETER, early), blind, None).lost)  # one camera has no metre then
    imu_before = replace(IMU_ENDS, spans=((-np.inf, 0.5),))
    assert np.isnan(judged(Case(imu_before, NO_ODOMETER, early), blind, flight).tilt_deg)


def test_steps_that_are_no_scale_are_left_out() -> None:
    assert _drifting(PLAIN) == ()
    assert _drifting(Case(IMU, NO_ODOMETER, DARK_1)) == ((10.0, 11.5),)
    assert _drifting(Case(IMU_ENDS, NO_ODOMETER, DARK_1)) == ((10.0, np.inf),)
    assert _drifting(Case(LATE_IMU, ODOMETER, BRIGHT)) == ((5.0, 6.0),)


def test_the_worst_flight_is_named(flight: Flown) -> None:
    good = replace(judged(PLAIN, flight, flight), name="good", lost=0.0)
    found = [good, replace(good, name="bad", lost=7.0), replace(good, name="unknown", lost=float("nan"))]
    median, worst = _spread("frames", found, lambda f: f.lost, 3.0, 3.0, "", 0)
    assert (median.name, median.met) == ("frames, median of 2", False)
    assert (worst.name, worst.measured, worst.met) == ("frames, worst", "7 (bad)", False)
    assert len(_spread("frames", found, lambda f: f.lost, None, 8.0, "", 0)) == 1
