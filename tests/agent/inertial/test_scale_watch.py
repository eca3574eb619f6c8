"""Which intervals the scale filter is given, and when."""

from typing import Any, cast

import numpy as np

from kiteline_agent.inertial.fixed_lag import InertialState
from kiteline_agent.inertial.preintegration import Samples
from kiteline_agent.inertial.scale_filter import ScaleFilter
from kiteline_agent.inertial.scale_watch import ScaleWatch
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3

FRAME_NS = 50_000_000
PER_INTERVAL = 8  # frames
STATE = InertialState(np.eye(4), np.array([1.0, 2.0, 3.0]), np.zeros(6), np.zeros(2), np.eye(17))
SAMPLES = Samples(np.array([0.0, 0.4]), np.zeros((2, 3)), np.zeros((2, 3)))


class Filter:
    """In place of ScaleFilter: what it was given."""

    def __init__(self) -> None:
        self.running = True
        self.added: list[tuple[F64, F64]] = []
        self.resumed = 0
        self.calls: list[str] = []

    def add(self, T_m_b0: F64, T_m_b1: F64, samples: Samples, gyro_bias: F64, depth_m: float) -> None:
        assert samples is SAMPLES
        self.added.append((T_m_b0, T_m_b1))
        self.depth_m = depth_m

    def resume(self, velocity: F64) -> None:
        assert velocity is STATE.velocity
        self.resumed += 1

    def wait(self, dt_s: float) -> None:
        self.calls.append(f"wait {dt_s:g} s")

    def rotate_map(self, R_new_old: F64) -> None:
        self.calls.append("rotate")

    def scale_map(self, factor: float) -> None:
        self.calls.append("scale")


class Flight:
    """Frames whose samples come `late_ns` after them."""

    def __init__(self, late_ns: int = 0) -> None:
        self.filter, self.late_ns, self.t_ns = Filter(), late_ns, 0
        self.gap = False
        self.watch = ScaleWatch(
            cast("ScaleFilter", cast("Any", self.filter)), np.zeros(3), self.has_come, self.samples_between
        )

    def has_come(self, t_ns: int) -> bool:
        return t_ns <= self.t_ns - self.late_ns

    def samples_between(self, from_ns: int, to_ns: int) -> Samples | None:
        assert self.has_come(to_ns)
        return None if self.gap else SAMPLES

    def fly(self, frames: int) -> None:
        for _ in range(frames):
            self.watch.see(self.t_ns, pose(self.t_ns // FRAME_NS), 3.0, STATE)
            self.t_ns += FRAME_NS


def pose(number: int) -> F64:
    return se3.from_rt(np.eye(3), np.array([float(number), 0.0, 0.0]))


def positions(flight: Flight) -> list[tuple[float, float]]:
    return [(float(a[0, 3]), float(b[0, 3])) for a, b in flight.filter.added]


def test_intervals_follow_each_other() -> None:
    flight = Flight()
    flight.fly(2 * PER_INTERVAL + 1)
    assert positions(flight) == [(0.0, 8.0), (8.0, 16.0)] and flight.filter.resumed == 1  # at the begin


def test_an_interval_waits_for_its_last_samples() -> None:
    flight = Flight(2 * FRAME_NS)
    flight.fly(PER_INTERVAL + 2)
    assert positions(flight) == []
    flight.fly(PER_INTERVAL + 1)
    assert positions(flight) == [(0.0, 8.0), (8.0, 16.0)] and flight.filter.resumed == 1


def test_a_waiting_interval_moves_with_the_map() -> None:
    flight = Flight(2 * FRAME_NS)
    flight.fly(PER_INTERVAL + 2)
    flight.watch.move_map(se3.from_rt(np.eye(3), np.array([100.0, 0.0, 0.0])))
    flight.watch.scale_map(2.0, np.zeros(3))
    flight.fly(1)
    assert positions(flight) == [(200.0, 216.0)] and flight.filter.calls == ["rotate", "scale"]
    assert flight.filter.depth_m == 6.0


def test_samples_that_are_an_interval_late_are_none() -> None:
    flight = Flight(10 * FRAME_NS)
    flight.fly(3 * PER_INTERVAL)
    assert positions(flight) == [] and flight.filter.resumed >= 2


def test_over_a_gap_the_filter_goes_on_at_the_velocity() -> None:
    flight = Flight()
    flight.gap = True
    flight.fly(2 * PER_INTERVAL + 1)
    assert positions(flight) == [] and flight.filter.resumed == 3


def test_after_a_late_gap_it_begins_at_the_present_frame() -> None:
    flight = Flight(2 * FRAME_NS)
    flight.gap = True
    flight.fly(PER_INTERVAL + 3)  # the gap is known of at frame 10
    assert flight.filter.resumed == 2
    flight.gap = False
    flight.fly(PER_INTERVAL + 2)
    assert positions(flight) == [(10.0, 18.0)]


def test_after_a_loss_it_begins_anew() -> None:
    flight = Flight()
    flight.fly(PER_INTERVAL)
    flight.watch.forget()
    flight.fly(PER_INTERVAL + 1)
    assert positions(flight) == [(8.0, 16.0)]


def test_without_a_state_it_waits_and_then_goes_on() -> None:
    flight = Flight()
    flight.fly(PER_INTERVAL)
    for _ in range(4):  # the IMU's samples are missing
        flight.watch.see(flight.t_ns, pose(0), 3.0, None)
        flight.t_ns += FRAME_NS
    flight.fly(PER_INTERVAL + 1)
    assert flight.filter.calls == ["wait 0.2 s"] and flight.filter.resumed == 2
    assert positions(flight) == [(12.0, 20.0)]


def test_a_start_forgets_the_time_without_a_state() -> None:
    flight = Flight()
    flight.watch.see(flight.t_ns, pose(0), 3.0, None)
    flight.watch.begin()
    flight.fly(1)
    assert flight.filter.calls == []
