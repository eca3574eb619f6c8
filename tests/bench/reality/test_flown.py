"""The figures of the reality benches, on a flight whose errors are known."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from kiteline_agent.agent import Agent
from kiteline_agent.runtime.frame_counts import live_pose
from kiteline_bench.agent.consistency import nees_band
from kiteline_bench.harness.bars import Bench
from kiteline_bench.harness.recording import Item, Recording, load
from kiteline_bench.reality.flown import Flown, flown, spread
from kiteline_bench.reality.worn import as_measured_by, unfound
from kiteline_core.frame import Frame, ImuBatch
from kiteline_core.geometry import se3
from kiteline_hw.sim.source import open_sim


def quiet(tmp_path: Path, data: Path = Path(), starts: int = 0) -> Bench:
    return Bench(data, tmp_path, lambda _: None, starts=starts)


@pytest.fixture(scope="module")
def flight(data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Flown:
    """Seven seconds of the room with a base."""
    room = load(str(data_dir / "room_flight.mcap"), frames=140)
    return flown(quiet(tmp_path_factory.mktemp("bench"), data_dir), "room", room)


def test_a_good_flight(flight: Flown) -> None:
    assert flight.run.lost == 0 and len(flight.refined) == 140
    assert flight.ate_m("base") <= 1.2 * flight.ate_m("live") < 0.02
    assert flight.metric_after_s == 0.0 and flight.lost_after_metric == 0 and flight.false_metric() < 0.02


def scaled(flight: Flown, factor: float) -> Flown:
    """The flight with lengths in another unit."""

    def in_unit(T: np.ndarray | None) -> np.ndarray:
        return se3.from_rt(T[:3, :3], factor * T[:3, 3])

    estimates = [replace(e, T_m_b=in_unit(e.T_m_b), T_o_b=in_unit(e.T_o_b), T_w_b=None)
                 for e in flight.run.found]  # fmt: skip
    return replace(flight, run=replace(flight.run, estimates=estimates))


def test_a_wrong_unit_that_is_said_to_be_metres_is_found(flight: Flown) -> None:
    wrong = scaled(flight, 1.1)
    assert wrong.false_metric() == pytest.approx(0.1, abs=0.03)
    assert wrong.false_metric(((0.0, 7.0),)) == 0.0
    assert wrong.scale_error("live", 2.0) == pytest.approx(0.1, abs=0.02)
    silent = replace(wrong, run=replace(wrong.run, metric=[False] * 140))
    assert silent.false_metric() == 0.0 and silent.metric_after_s == float("inf") and silent.lost_after_metric == 140
    late = replace(wrong, run=replace(wrong.run, metric=[k >= 60 for k in range(140)]))
    assert late.metric_after_s == pytest.approx(3.0, abs=0.01)


def test_a_jump_beside_the_odometry_is_measured(flight: Flown) -> None:
    moved = list(flight.run.found)
    for k in range(70, 140):
        shift = np.eye(4)
        shift[0, 3] = 0.05
        pose = live_pose(moved[k])
        moved[k] = replace(moved[k], T_w_b=shift @ pose)
    jumping = replace(flight, run=replace(flight.run, estimates=moved))
    assert jumping.largest_jump_m() == pytest.approx(0.05, abs=0.012)
    assert flight.largest_jump_m() < 0.02


def test_bars_of_several_flights_and_the_starts_of_a_quick_look(tmp_path: Path) -> None:
    bars = spread("x", [1.0, 3.0, 2.0], 2.5, "m", 1)
    assert [(bar.measured, bar.met) for bar in bars] == [("2.0 m", True), ("3.0 m", False)]
    assert spread("x", [3.0], 2.5, "", worst=3.5)[1].met
    assert quiet(tmp_path, starts=3).chosen(range(10)) == [0, 3, 6]
    assert quiet(tmp_path).chosen((4, 5)) == [4, 5] == quiet(tmp_path, starts=9).chosen((4, 5))


def test_what_a_calibration_leaves_is_measured_against_the_true_rig() -> None:
    """A box that reports the true axes and offset has found all; one that reports the told ones, nothing."""
    worn = open_sim("room", rig="worn", seconds=1.0, scale=0.2, texture_bits=6).worn
    truth = json.loads(json.dumps(worn.to_json()))
    turn = worn.true.T_b_c[:3, :3] @ worn.told.T_b_c[:3, :3].T

    class Box:
        def __init__(self, share: float) -> None:
            self.share = share

        def motion_reports(self) -> dict[str, Any]:
            matrices = {"gyro": worn.imu.gyro_matrix @ turn, "accel": worn.imu.accel_matrix @ turn}
            found = {n: {"matrix": (np.eye(3) + self.share * (m - np.eye(3))).tolist()} for n, m in matrices.items()}
            return {"imu_calibration": found, "time_offset": {"ms": -1000.0 * self.share * worn.late_s}}

    for share in (1.0, 0.6, 0.0):
        found = unfound(cast(Agent, Box(share)), truth)
        assert set(found) == {"axes of the gyro", "axes of the accel", "time offset"}
        assert all(left == pytest.approx(1.0 - share, abs=1e-9) for left in found.values())


def test_a_flight_is_measured_by_the_imu_of_another_rig() -> None:
    """What the other IMU measures and when, so that its own truth undoes it."""
    rigs = [open_sim("room", rig="worn", rig_seed=s, seconds=1.0, scale=0.2, texture_bits=6).worn for s in (1, 2)]
    truth, other = (json.loads(json.dumps(rig.to_json())) for rig in rigs)
    samples = np.random.default_rng(0).normal(size=(4, 3))
    turn = {k: np.array(t["true"]["T_b_c"])[:3, :3] @ np.array(t["told"]["T_b_c"])[:3, :3].T
            for k, t in (("one", truth), ("other", other))}  # fmt: skip
    seen = ImuBatch(np.arange(4), samples @ (np.array(truth["gyro_matrix"]) @ turn["one"]).T, samples)
    flight = Recording(rigs[0].told, None, (Item(Frame(0, np.zeros((4, 4), np.uint8)), seen),))
    there = as_measured_by(flight, truth, other).items[0].imu
    np.testing.assert_allclose(there.gyro, samples @ (np.array(other["gyro_matrix"]) @ turn["other"]).T, atol=1e-12)
    late_s = other["frame_stamps_late_s"] - truth["frame_stamps_late_s"]
    np.testing.assert_allclose(there.t_ns, np.arange(4) - round(1e9 * late_s))


def test_the_band_of_the_nees_narrows_with_the_number_of_flights() -> None:
    assert nees_band(30) == pytest.approx((4.82, 7.30), abs=0.01)
    assert nees_band(1) == pytest.approx((1.24, 14.45), abs=0.15)
