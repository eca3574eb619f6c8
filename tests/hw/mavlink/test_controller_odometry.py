"""Velocities of a flight controller against values by hand: frames, signs, clocks, and unusable messages."""

from dataclasses import replace
from math import cos, pi, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kiteline_core.frame import UNMEASURED, OdometryBatch
from kiteline_core.geometry import se3
from kiteline_core.geometry.end_rates import end_rates
from kiteline_hw.mavlink.codec import MavlinkCodec
from kiteline_hw.mavlink.controller_odometry import (
    ControllerOdometry,
    ControllerOdometryConfig,
    OdometrySource,
    StampClock,
    parse_odometry_option,
)
from kiteline_hw.mavlink.controller_session import ControllerSession
from kiteline_hw.mavlink.coordinate_frames import controller_rates, local_pose, mounting
from kiteline_hw.mavlink.messages import Attitude, Heartbeat, LocalPosition, MavlinkMessage, Odometry, WheelDistance
from kiteline_hw.sim.flight_controller import FlightController

S = 1_000_000_000
NAN = float("nan")
CODEC = MavlinkCodec(1, 1)  # of the autopilot
STILL = (0.0, 0.0, 0.0)
EAST, EAST_Q = (0.0, 0.0, pi / 2), (cos(pi / 4), 0.0, 0.0, sin(pi / 4))  # the nose points east

# forward 1, right 2, down 3 m/s, in the axes of three bodies
BODIES = {"frd": [1.0, 2.0, 3.0], "flu": [1.0, -2.0, -3.0], "rdf": [2.0, 3.0, 1.0]}


def odometry(
    velocity: tuple[float, float, float], rate: tuple[float, float, float] = (0.0, 0.0, 0.0), *, t_us: int = 1_000_000,
    child: int = 12, q: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0), stated: float = NAN,
) -> Odometry:  # fmt: skip
    return Odometry(
        t_us, (0.0,) * 3, q, velocity, rate, (NAN, *(0.0,) * 20), (stated, *(0.0,) * 20), 0, 100, frame_id=1,
        child_frame_id=child, estimator_type=8, system=1, component=1,
    )  # fmt: skip


def told(source: ControllerOdometry, *messages: object, now_ns: int = 5 * S) -> OdometryBatch | None:
    for k, message in enumerate(messages):
        source.receive(message, now_ns + k * 20_000_000)  # type: ignore[arg-type]
    return source.take_until(now_ns + 100 * S)


def local(
    velocity: tuple[float, float, float], angles: tuple[float, float, float], rate: tuple[float, ...] = STILL
) -> list[MavlinkMessage]:
    """An attitude, and a velocity in the local frame."""
    return [Attitude(1000, angles, rate), LocalPosition(1010, STILL, velocity)]


@pytest.mark.parametrize(
    ("axes", "messages", "velocity", "rate"),
    [
        *[(axes, [odometry((1.0, 2.0, 3.0))], velocity, STILL) for axes, velocity in BODIES.items()],
        # A turn to the right. FRD: about down. FLU: about up it is to the left, so negative. A camera's y points down.
        ("frd", [odometry(STILL, (0.0, 0.0, 0.3))], STILL, (0.0, 0.0, 0.3)),
        ("flu", [odometry(STILL, (0.0, 0.0, 0.3))], STILL, (0.0, 0.0, -0.3)),
        ("rdf", [odometry(STILL, (0.0, 0.0, 0.3))], STILL, (0.0, 0.3, 0.0)),
        # Flying east with the nose to the east, climbing and turning; flying north with the nose to the east.
        ("flu", local((0.0, 2.0, -0.5), EAST, (0.0, 0.0, 0.1)), (2.0, 0.0, 0.5), (0.0, 0.0, -0.1)),
        ("flu", local((1.5, 0.0, 0.0), EAST), (0.0, 1.5, 0.0), STILL),
        ("frd", local((0.0, 0.0, 1.0), (pi / 2, 0.0, 0.0)), (0.0, 1.0, 0.0), STILL),  # falling, right wing down
        ("frd", [odometry((0.0, 2.0, 0.0), child=1, q=EAST_Q)], (2.0, 0.0, 0.0), STILL),  # child frame: local
    ],
)
def test_motion_by_hand(axes: str, messages: list[MavlinkMessage], velocity: list[float], rate: list[float]) -> None:
    batch = told(ControllerOdometry(OdometrySource.CONTROLLER, mounting(axes)), *messages)
    np.testing.assert_allclose(batch.velocity[0], velocity, atol=1e-9)
    np.testing.assert_allclose(batch.rate[0], rate, atol=1e-12)


def test_lever_arm_between_camera_and_controller() -> None:
    # The controller 0.4 m behind the camera (FLU body at the camera); a turn to the right swings the camera right.
    source = ControllerOdometry(OdometrySource.CONTROLLER, mounting("flu", (-0.4, 0.0, 0.0)))
    batch = told(source, odometry((1.0, 0.0, 0.0), (0.0, 0.0, 0.5)))
    np.testing.assert_allclose(batch.velocity[0], [1.0, -0.2, 0.0], atol=1e-4)


def test_unknown_frames_are_ignored() -> None:
    source = ControllerOdometry(OdometrySource.CONTROLLER, mounting("frd"))
    assert told(source, odometry((1.0, 0.0, 0.0), child=21)) is None
    assert told(source, odometry((NAN, 0.0, 0.0))) is None
    assert told(source, odometry((1.0, 0.0, 0.0), child=1, q=(0.0,) * 4)) is None
    assert told(source, LocalPosition(1000, (0.0,) * 3, (1.0, 0.0, 0.0))) is None  # no attitude
    assert source.unusable == 3
    # our own poses, sent back by a router
    assert told(source, replace(odometry((1.0, 0.0, 0.0)), component=197)) is None


def test_reported_covariances_are_used() -> None:
    source = ControllerOdometry(OdometrySource.CONTROLLER, mounting("flu"))
    triangle = [0.0] * 21
    for at, variance in zip((0, 6, 11, 15, 18, 20), (0.01, 0.04, 0.09, 1e-4, 1e-4, 4e-4), strict=True):
        triangle[at] = variance
    batch = told(source, replace(odometry((1.0, 0.0, 0.0)), velocity_covariance=triangle))
    np.testing.assert_allclose(batch.velocity_cov[0].diagonal(), [0.01, 0.04, 0.09])
    np.testing.assert_allclose(batch.rate_cov[0].diagonal(), [1e-4, 1e-4, 4e-4])


# wheels


def rolled(t_ms: int, left: float, right: float) -> WheelDistance:
    return WheelDistance(t_ms * 1000, (left, right))


def test_equal_wheel_speeds_are_forward_motion() -> None:
    batch = told(
        ControllerOdometry(OdometrySource.WHEELS, mounting("flu")), rolled(1000, 5.0, 7.0), rolled(1020, 5.03, 7.03)
    )
    np.testing.assert_allclose(batch.velocity[0], [1.5, 0.0, 0.0], atol=1e-9)
    assert batch.rate_cov[0, 2, 2] >= UNMEASURED  # without a track, no turn
    assert batch.velocity_cov[0, 0, 0] < batch.velocity_cov[0, 1, 1] < 0.1


def test_a_faster_left_wheel_turns_right() -> None:
    source = ControllerOdometry(OdometrySource.WHEELS, mounting("flu"), ControllerOdometryConfig(track_m=0.5))
    batch = told(source, rolled(1000, 0.0, 0.0), rolled(1100, 0.12, 0.08))
    np.testing.assert_allclose(batch.velocity[0], [1.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(batch.rate[0], [0.0, 0.0, -0.8], atol=1e-9)  # 0.4 m/s over 0.5 m, about up


def test_wheels_over_long_gaps_and_backward_stamps_give_no_sample() -> None:
    source = ControllerOdometry(OdometrySource.WHEELS, mounting("flu"))
    assert told(source, rolled(1000, 0.0, 0.0), rolled(3000, 9.0, 9.0)) is None
    assert told(source, rolled(10, 0.0, 0.0)) is None  # another boot
    batch = told(source, rolled(30, 0.02, 0.02))
    np.testing.assert_allclose(batch.velocity[0, 0], 1.0)


# clocks and the connection


def test_the_least_delay_sets_the_clock() -> None:
    clock = StampClock(ControllerOdometryConfig())
    delays = [30, 12, 5, 40, 8]
    ours = [clock.to_ours(k * S // 50, 7 * S + k * S // 50 + d * 1_000_000) for k, d in enumerate(delays)]
    # what came with 5 ms is as near as it gets; later stamps keep to it but for the drift that clocks may have
    assert ours[2] == 7 * S + 2 * S // 50 + 5_000_000
    assert abs(ours[4] - (7 * S + 4 * S // 50 + 5_000_000)) < 100_000


def test_a_reboot_of_the_controller_resets_the_clock() -> None:
    clock = StampClock(ControllerOdometryConfig())
    clock.to_ours(100 * S, 107 * S)
    assert clock.to_ours(1 * S, 110 * S) == 110 * S


def test_a_reboot_is_noticed_when_the_new_clock_has_passed_the_old_one() -> None:
    clock = StampClock(ControllerOdometryConfig())
    for k in range(100):  # up for 5 s when it is heard first
        clock.to_ours(5 * S + k * S // 100, 60 * S + k * S // 100)
    last_ns = 0
    for k in range(200):  # silent for 30 s, and up again for 20 s
        now_ns = 91 * S + k * S // 100
        last_ns = clock.to_ours(20 * S + k * S // 100, now_ns)
    assert last_ns == 91 * S + 199 * S // 100
    # what a stalled computer reads all at once is as old as it says
    stalled_ns = [clock.to_ours(22 * S + k * S // 100, 96 * S) for k in range(300)]
    np.testing.assert_allclose(stalled_ns, [93 * S + k * S // 100 for k in range(300)], atol=S // 500)


def test_odometry_through_the_session() -> None:
    wanted = ControllerOdometry(OdometrySource.CONTROLLER, mounting("flu"))
    stream = ControllerSession(mounting("flu"), odometry=wanted, system=1)
    stream.receive(CODEC.encode(odometry((1.0, 2.0, 3.0))), 9 * S)
    assert stream.take_odometry(8 * S) is None  # later than that instant
    batch = stream.take_odometry(9 * S)
    np.testing.assert_allclose(batch.velocity[0], [1.0, -2.0, -3.0], atol=1e-6)
    assert batch.t_ns.tolist() == [9 * S]
    assert ControllerSession(mounting("flu")).take_odometry(9 * S) is None


MESSAGES = [
    Attitude(5, (0.1, 0.2, 0.3), (1.0, 2.0, 3.0), 1),
    LocalPosition(6, (1.0, 2.0, 3.0), (4.0, 5.0, 6.0)),
    WheelDistance(7, (0.5, -0.25, 8.0)),
]


@pytest.mark.parametrize("message", MESSAGES)
def test_messages_round_trip(message: Attitude | LocalPosition | WheelDistance) -> None:
    found = MavlinkCodec().receive(CODEC.encode(message))
    assert len(found) == 1
    assert type(found[0]) is type(message)
    for a, b in zip(_numbers(found[0]), _numbers(message), strict=True):
        assert a == pytest.approx(b, rel=1e-6)


def _numbers(message: object) -> list[float]:
    values = [getattr(message, name) for name in message.__dataclass_fields__]  # type: ignore[attr-defined]
    return [float(x) for v in values for x in (v if isinstance(v, tuple) else (v,))]


def test_messages_are_requested_while_the_controller_is_silent() -> None:
    controller = FlightController("px4")
    stream = ControllerSession(mounting("flu"), odometry=ControllerOdometry(OdometrySource.WHEELS, mounting("flu")))
    heartbeat = controller.codec.encode(Heartbeat(10, 12))
    asked = [len(stream.receive(heartbeat, t * S)) for t in range(4)]
    assert asked == [1, 0, 1, 0]  # once in two seconds
    stream.receive(CODEC.encode(rolled(4000, 0.0, 0.0)), 4 * S)
    stream.receive(CODEC.encode(rolled(4020, 0.0, 0.0)), 4 * S + 20_000_000)
    assert stream.receive(heartbeat, 5 * S) == []
    assert ControllerSession(mounting("flu")).receive(heartbeat, 0) == []


@given(st.lists(st.floats(-2.0, 2.0), min_size=12, max_size=12).map(np.array), st.sampled_from(["flu", "frd", "rdf"]))
@settings(max_examples=60)
def test_our_odometry_read_back_is_our_motion(numbers: np.ndarray, axes: str) -> None:
    """The way out (tested against flight controllers' rules) and the way in are each other's inverse."""
    T_b_f = mounting(axes, (0.3, -0.2, 0.1))
    before, twist, dt = se3.exp(numbers[:6]), numbers[6:], 1e-4
    now = before @ se3.exp(twist * dt)
    velocity, rate = controller_rates(now, *end_rates((0, 100_000), (before, now), 100_000), T_b_f)
    _, q = local_pose(now, T_b_f)
    message = odometry(tuple(velocity), tuple(rate), q=tuple(q))  # type: ignore[arg-type]
    batch = told(ControllerOdometry(OdometrySource.CONTROLLER, T_b_f), message)
    np.testing.assert_allclose(batch.velocity[0], twist[:3], atol=5e-3)
    np.testing.assert_allclose(batch.rate[0], twist[3:], atol=5e-3)


def test_the_odometry_option() -> None:
    assert parse_odometry_option("controller") == (OdometrySource.CONTROLLER, 0.0)
    assert parse_odometry_option("wheels:0.42") == (OdometrySource.WHEELS, 0.42)
    for text in ("gps", "wheels:x", "controller:1", "wheels:-1", ""):
        with pytest.raises(ValueError, match="expected controller, wheels or wheels:TRACK_M"):
            parse_odometry_option(text)


ANY = st.floats(width=32) | st.sampled_from([NAN, float("inf"), -float("inf"), 0.0, 3.4e38])
THREE = st.tuples(ANY, ANY, ANY)
STAMP = st.integers(0, 2**64 - 1) | st.integers(0, 10**7)
MESSAGES = st.one_of(
    st.builds(Attitude, st.integers(0, 2**32 - 1) | st.integers(0, 99), THREE, THREE),
    st.builds(LocalPosition, st.integers(0, 2**32 - 1) | st.integers(0, 99), THREE, THREE),
    st.builds(WheelDistance, STAMP, st.lists(ANY, max_size=4).map(tuple)),
    st.builds(
        odometry, THREE, THREE, t_us=STAMP, child=st.sampled_from([1, 12, 20, 21]), q=st.tuples(ANY, ANY, ANY, ANY),
        stated=ANY,
    ),
)  # fmt: skip


@given(st.sampled_from(OdometrySource), st.lists(MESSAGES, max_size=20))
def test_whatever_numbers_arrive_only_finite_velocities_pass(source: OdometrySource, messages: list[object]) -> None:
    batch = told(ControllerOdometry(source, mounting("flu")), *messages)
    if batch is not None:
        assert np.isfinite(batch.velocity).all() and np.isfinite(batch.rate).all()
