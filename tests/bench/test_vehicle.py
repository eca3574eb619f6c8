"""The bench on the vehicle: its physics, what it says without an autopilot, and how it counts."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from kiteline_bench.harness.bars import Bench
from kiteline_bench.vehicle import controllers, faults
from kiteline_bench.vehicle.sitl import flights
from kiteline_bench.vehicle.sitl.arducopter import VARIABLE
from kiteline_bench.vehicle.sitl.copter import Copter
from kiteline_bench.vehicle.sitl.loop import Truth
from kiteline_hw.sim.flight_controller import VisionSample

DT_S = 0.0025


def pwm(front_right: float, rear_left: float, front_left: float, rear_right: float) -> np.ndarray:
    return np.array([1000 + 1000 * u for u in (front_right, rear_left, front_left, rear_right)], np.uint16)


def flown(copter: Copter, motors: np.ndarray, seconds: float) -> Copter:
    for _ in range(round(seconds / DT_S)):
        copter.step(motors, DT_S)
    return copter


def test_on_the_ground_it_stands_and_measures_gravity() -> None:
    copter = flown(Copter(), pwm(0.1, 0.1, 0.1, 0.1), 1.0)
    assert np.array_equal(copter.position_m, np.zeros(3))
    assert np.allclose(copter.force_m_s2, [0.0, 0.0, -9.80665])
    assert copter.t_s == pytest.approx(1.0)


def test_it_climbs_and_what_it_measures_is_its_motion() -> None:
    copter = flown(Copter(), pwm(0.6, 0.6, 0.6, 0.6), 0.3)
    before = copter.velocity_m_s.copy()
    flown(copter, pwm(0.6, 0.6, 0.6, 0.6), DT_S)
    measured = copter.R_n_f @ copter.force_m_s2 + [0.0, 0.0, 9.80665]
    assert np.allclose(measured, (copter.velocity_m_s - before) / DT_S, atol=1e-9)
    assert copter.position_m[2] < -0.05  # up


@pytest.mark.parametrize(
    ("motors", "axis"), [((0.5, 0.6, 0.6, 0.5), 0), ((0.6, 0.5, 0.6, 0.5), 1), ((0.6, 0.6, 0.5, 0.5), 2)]
)  # rolls right by the left motors, lifts its nose by the front ones, turns clockwise against those that turn back
def test_motors_turn_it_as_in_arducopters_quadrotor_x(motors: tuple[float, ...], axis: int) -> None:
    copter = flown(Copter(), pwm(0.6, 0.6, 0.6, 0.6), 0.2)
    flown(copter, pwm(*motors), 0.1)
    rate = copter.rate_rad_s
    assert rate[axis] > 0.1 and np.abs(np.delete(rate, axis)).max() < 0.02


def test_the_message_is_what_ardupilots_parser_takes() -> None:
    text = flown(Copter(), pwm(0.6, 0.6, 0.6, 0.6), 0.2).message(0.1)
    assert text.startswith(b"\n{") and text.endswith(b"}\n")
    assert b'"gyro":[' in text and b", " in text  # no space after a colon, one between numbers
    state = json.loads(text)
    assert state["timestamp"] == pytest.approx(0.1)
    assert math.hypot(*state["quaternion"]) == pytest.approx(1.0)


def test_truth_is_interpolated_across_south() -> None:
    truth = Truth([0.0, 1.0], [np.zeros(3), np.ones(3)], [3.1, -3.1])
    position, heading = truth.at(np.array([0.5]))
    assert np.allclose(position, 0.5) and math.cos(heading[0] - math.pi) == pytest.approx(1.0)


def test_without_an_autopilot_the_loop_is_not_flown_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    bench = Bench(tmp_path, tmp_path, lambda text: None)
    assert flights.run(bench) == [] and VARIABLE in bench.more[0]
    monkeypatch.setenv(VARIABLE, str(tmp_path / "none"))
    assert not flights.run(bench)[0].met


def test_wrong_axes_are_named_and_right_ones_are_not() -> None:
    assert controllers._named_s("ardupilot", "frd", "flu") < 5.0


def test_jitter_and_rate_are_those_of_the_samples() -> None:
    rng = np.random.default_rng(1)
    samples = []
    for k in range(400):
        t_ns = k * 25_000_000
        late_ns = 10_000_000 + round(rng.uniform(-2e6, 2e6))
        samples.append(VisionSample(t_ns + late_ns, t_ns, (0, 0, 0), (1, 0, 0, 0), (0, 0, 0), None, 0, 90))
    jitter_ms, rate_hz = controllers._timing(samples)
    assert 1.5 < jitter_ms < 2.0 and rate_hz == pytest.approx(40.0, rel=0.01)
    assert controllers._timing(samples[:1]) == (math.inf, 0.0)


def test_what_is_said_twice_does_not_count_as_once() -> None:
    once = ["camera /dev/video0 was unplugged: plug it in again"] * 2 + ["camera images again after 2.0 s"] * 2
    once += ["flight controller: the device is missing", "/tmp/ttyACM0 is open", "flight controller: silent for 5 s"]
    once += ["flight controller: is back: ArduPilot"]
    assert all(bar.met for bar in faults._said("\n".join(once)))
    twice = [*once, "flight controller: silent for 5 s"]
    assert [bar.met for bar in faults._said("\n".join(twice))].count(False) == 1


def test_an_agent_that_died_meets_no_bar(tmp_path: Path) -> None:
    bars = faults._tracked("cameras unplugged at 5\nTraceback", tmp_path)
    assert len(bars) == 3 and not any(bar.met for bar in bars)
