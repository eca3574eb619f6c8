"""The session with a flight controller: what modelled ArduPilot and PX4 accept, when, and with which values."""

from dataclasses import replace
from math import cos, inf, nan, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from kiteline_hw.mavlink.codec import MavlinkCodec
from kiteline_hw.mavlink.controller_session import ControllerSession
from kiteline_hw.mavlink.coordinate_frames import mounting
from kiteline_hw.mavlink.messages import Heartbeat, ObstacleDistance, Odometry, TimeSync
from kiteline_hw.ports import PoseSample
from kiteline_hw.sim.flight_controller import FlightController

S = 1_000_000_000
KINDS = ("ardupilot", "px4")


def circling(t_ns: int, *, tracked: bool = True, quality: int = 80, epoch: int = 0) -> PoseSample:
    """On a circle of 5 m to the left at 2 m/s, nose along the path, climbing with 0.5 m/s. Body FLU."""
    t_s = t_ns / S
    a = 0.4 * t_s
    t = np.array(
        [
            [cos(a), -sin(a), 0.0, 5.0 * sin(a)],
            [sin(a), cos(a), 0.0, 5.0 - 5.0 * cos(a)],
            [0.0, 0.0, 1.0, 0.5 * t_s],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
    return PoseSample(t_ns, t, tracked, quality, epoch)


def fly(
    stream: ControllerSession, controller: FlightController, seconds: float, rate_hz: float, start_ns: int = 0
) -> list[int]:
    """Feed poses at a rate; times at which ODOMETRY was accepted or dropped."""
    sent = []
    for i in range(round(seconds * rate_hz)):
        now_ns = start_ns + round(i * S / rate_hz)
        before = stream.counters.odometry
        for message in stream.step(circling(now_ns), now_ns):
            controller.receive(message, now_ns)
        if stream.counters.odometry > before:
            sent.append(now_ns)
    return sent


@pytest.mark.parametrize("kind", KINDS)
def test_controllers_accept_every_message_with_the_true_motion(kind: str) -> None:
    controller = FlightController(kind)  # type: ignore[arg-type]
    stream = ControllerSession(mounting("flu"))
    fly(stream, controller, 3.0, 30.0)
    assert not controller.dropped
    assert len(controller.accepted) == 89  # all but the first, which has no velocity yet
    assert controller.heartbeats == {(1, 197): 3}
    assert controller.resets == 0 and controller.healthy(3 * S) and not controller.healthy(4 * S)
    last = controller.accepted[-1]
    # At 2.9667 s: 1.1867 rad round the circle, 5 sin = 4.6356 forward, 5 - 5 cos = 3.1262 to the left, 1.4833 up.
    np.testing.assert_allclose(last.position_m, [4.6356, -3.1262, -1.4833], atol=1e-4)
    np.testing.assert_allclose(last.q, [0.82908, 0.0, 0.0, -0.55913], atol=1e-5)  # cos, -sin of half the angle
    np.testing.assert_allclose(last.velocity_m_s, [0.75, -1.854, -0.5], atol=0.02)  # 2 cos, -2 sin: along the path
    assert last.position_error_m is not None and 0.001 < last.position_error_m < 0.2
    assert last.t_ns // 1000 == last.received_ns // 1000


@pytest.mark.parametrize("rate_hz", [10.0, 20.0, 30.0, 31.0, 60.0, 90.0, 200.0])
def test_rate(rate_hz: float) -> None:
    stream = ControllerSession(mounting("flu"))
    sent = fly(stream, FlightController("px4"), 10.0, rate_hz)
    rate = (len(sent) - 1) / ((sent[-1] - sent[0]) / S)
    assert rate <= 30.1
    assert rate >= min(rate_hz, 30.0) - (0.1 if rate_hz in (10.0, 20.0, 30.0, 60.0, 90.0) else 1.5)


def test_rate_with_a_jittering_camera() -> None:
    rng = np.random.default_rng(5)
    stream = ControllerSession(mounting("flu"))
    for i in range(300):
        t_ns = round(i * S / 30.0)
        stream.step(circling(t_ns), t_ns + int(rng.integers(0, 4_000_000)))
    assert stream.counters.odometry > 290


def test_an_untracked_pose_is_marked_and_ardupilot_drops_it() -> None:
    ardupilot, stream = FlightController("ardupilot"), ControllerSession(mounting("flu"))
    fly(stream, ardupilot, 1.0, 30.0)
    accepted = len(ardupilot.accepted)
    for message in stream.step(circling(S, tracked=False, quality=70), S):
        ardupilot.receive(message, S)
    assert len(ardupilot.accepted) == accepted
    assert ardupilot.dropped == {"quality below VISO_QUAL_MIN": 1}


def test_poses_that_were_guessed_tell_no_velocity() -> None:
    """Found again a metre beside where it was guessed to be: a velocity of the path that was seen, not of the step."""
    controller, stream = FlightController("px4"), ControllerSession(mounting("flu"))
    fly(stream, controller, 1.0, 30.0)
    for k in range(30, 40):
        pose = circling(k * S // 30, tracked=k >= 33)
        if not pose.tracked:
            pose.T_o_b[:2, 3] += 1.0
        for message in stream.step(pose, pose.t_ns):
            controller.receive(message, pose.t_ns)
        speed = np.linalg.norm(controller.accepted[-1].velocity_m_s)
        assert k < 33 or abs(speed - np.hypot(2.0, 0.5)) < 0.05


def test_reset_counter_follows_the_epoch_alone() -> None:
    controller, stream = FlightController("ardupilot"), ControllerSession(mounting("flu"))
    for i in range(60):
        pose = circling(i * S // 30, epoch=300 if i < 30 else 301)
        for message in stream.step(pose, pose.t_ns):
            controller.receive(message, pose.t_ns)
    assert controller.resets == 1
    assert {s.reset_counter for s in controller.accepted} == {300 % 256, 301 % 256}


def test_poses_that_are_not_sent() -> None:
    stream = ControllerSession(mounting("flu"))
    stream.step(circling(0), 0)
    broken = circling(S // 30)
    broken.T_o_b[0, 3] = np.nan
    far = circling(S // 30)
    far.T_o_b[1, 3] = 1e7
    for pose in (broken, far):
        assert stream.step(pose, S // 30) == []
    assert stream.counters.invalid == 2
    assert stream.step(circling(0), S // 30) == [] and stream.counters.stale == 1
    assert stream.step(circling(S // 2), S // 2) == []  # after half a second without poses
    assert stream.counters.without_velocity == 2
    assert len(stream.step(circling(S // 2 + S // 30), S // 2 + S // 30)) == 1


@pytest.mark.parametrize(
    ("change", "ardupilot_takes", "px4_takes"),
    [
        ({}, True, True),
        ({"frame_id": 1}, False, True),
        ({"frame_id": 8}, False, False),
        ({"child_frame_id": 8}, False, True),
        ({"estimator_type": 4}, True, False),
        ({"q": (0.0, 0.0, 0.0, 0.0)}, False, False),
        ({"velocity_m_s": (float("nan"),) * 3}, False, True),
    ],
)
def test_the_model_rejects_what_controllers_reject(
    change: dict[str, object], ardupilot_takes: bool, px4_takes: bool
) -> None:
    good = Odometry(1, (0.0,) * 3, (1.0, 0.0, 0.0, 0.0), (0.0,) * 3, (0.0,) * 3, (0.1,) * 21, (0.1,) * 21, 0, 90)
    data = MavlinkCodec().encode(replace(good, **change))  # type: ignore[arg-type]
    for kind, takes in (("ardupilot", ardupilot_takes), ("px4", px4_takes)):
        controller = FlightController(kind)  # type: ignore[arg-type]
        assert controller.receive(data, 0) == []  # never a word
        assert bool(controller.accepted) == takes
        assert controller.dropped.total() == (not takes)


def test_timesync_is_answered_from_the_same_clock() -> None:
    controller, stream = FlightController("px4"), ControllerSession(mounting("flu"))
    ahead_ns = 5 * S  # the companion's clock
    for message in controller.poll(1000):
        for answer in stream.receive(message, 1000 + ahead_ns + 300):
            controller.receive(answer, 1600)
    assert controller.clock_offset_ns == ahead_ns
    for i in range(3):
        pose = circling(10 * S + i * S // 30)
        for message in stream.step(pose, pose.t_ns):
            controller.receive(message, pose.t_ns - ahead_ns)
    last = controller.accepted[-1]
    assert abs(last.t_ns - last.received_ns) < 1000
    # An answer (tc1 set) is no question: answering it would never end.
    assert stream.receive(MavlinkCodec(1, 1).encode(TimeSync(7, 8)), 0) == []


def test_the_controller_is_known_by_its_heartbeat() -> None:
    controller, stream = FlightController("ardupilot"), ControllerSession(mounting("flu"))
    assert stream.autopilot(0) is None
    for message in controller.poll(0):
        stream.receive(message, 0)
    seen = stream.autopilot(S)
    assert (seen.system, seen.component, seen.autopilot) == (1, 1, 3)
    assert stream.autopilot(4 * S) is None
    stream.receive(MavlinkCodec(255, 190).encode(Heartbeat(6, 8)), 4 * S)  # a ground station
    assert stream.autopilot(4 * S) is None
    assert stream.take_imu(9 * S) is None  # nobody asked for it


NOISE = st.one_of(st.binary(max_size=80), st.sampled_from([b"\xfd", b"\xfe\x09", b"\xfd\xff\x01", b"\xfd\xff\x00"]))


@settings(max_examples=150, deadline=None)
@given(st.lists(NOISE, max_size=8))
def test_messages_after_any_bytes_are_parsed(pieces: list[bytes]) -> None:
    stream = ControllerSession(mounting("flu"), system=1)
    controller = MavlinkCodec(1, 1)
    for piece in pieces:
        stream.receive(piece, 0)
        assert len(stream.receive(controller.encode(TimeSync(0, 5)), 0, datagram=True)) == 1  # a datagram starts afresh
    for piece in pieces:
        stream.receive(piece, 0)
    answers = [a for _ in range(40) for a in stream.receive(controller.encode(TimeSync(0, 2**60 + 5)), 0)]
    assert len(answers) >= 25  # on a byte stream a stray marker hides what follows until 280 bytes have come


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_damaged_messages_are_dropped(data: st.DataObject) -> None:
    good = bytearray(MavlinkCodec(1, 1).encode(TimeSync(0, 123456789)))
    index = data.draw(st.integers(0, len(good) - 1))
    good[index] ^= data.draw(st.integers(1, 255))
    stream = ControllerSession(mounting("flu"))
    assert stream.receive(bytes(good), 0, datagram=True) == []


def test_noise_does_not_fill_memory() -> None:
    codec = MavlinkCodec()
    for i in range(400):
        codec.receive(bytes((i * 7 + j * 13) % 256 for j in range(997)))
    assert len(codec._mav.buf) < 10_000


def test_a_poses_own_covariance_is_sent() -> None:
    T_b_f = mounting("flu", (0.0, 2.0, 0.0))
    stream, controller = ControllerSession(T_b_f), FlightController("px4")
    cov = np.diag([0.09, 0.04, 0.01, 0.0, 0.0, 0.0025])
    for i in range(3):
        pose = replace(circling(i * S // 30), cov=cov)
        for message in stream.step(pose, pose.t_ns):
            controller.receive(message, pose.t_ns)
    data = stream.step(replace(circling(S // 5), cov=cov), S // 5)[-1]
    found = list(MavlinkCodec().receive(data))
    assert len(found) == 1 and isinstance(found[0], Odometry)
    full = np.zeros((6, 6))
    full[np.triu_indices(6)] = found[0].pose_covariance
    # 2 m to the left of the body's origin, an error of yaw of 0.05 rad is one of 0.1 m along the body's x
    a = 0.4 * 0.2
    along = np.array([cos(a), sin(a)])
    want = np.diag([0.09, 0.04]) + 0.01 * np.outer(along, along) + 1e-4 * np.eye(2)
    np.testing.assert_allclose(full[:2, :2], np.triu(want * [[1, -1], [-1, 1]]), atol=1e-6)
    np.testing.assert_allclose(np.diag(full)[2:], [0.0101, 2.5e-5, 2.5e-5, 0.0025 + 2.5e-5], atol=1e-6)


def test_a_pose_with_velocity_and_rate_is_sent_at_once_and_as_of_its_time() -> None:
    stream, T_b_f = ControllerSession(mounting("flu", (0.2, 0.1, 0.0))), mounting("flu", (0.2, 0.1, 0.0))
    pose = circling(S)
    velocity, rate = np.array([1.0, 2.0, 0.5]), np.array([0.0, 0.0, 0.4])
    message = stream._pose_message(replace(pose, velocity=velocity, rate=rate), S)
    step_s = 1e-5
    moved = pose.T_o_b.copy()
    moved[:3, 3] += step_s * velocity
    moved[:3, :3] = moved[:3, :3] @ np.array([[1.0, -0.4 * step_s, 0.0], [0.4 * step_s, 1.0, 0.0], [0.0, 0.0, 1.0]])
    speed = np.linalg.inv(pose.T_o_b @ T_b_f)[:3, :3] @ ((moved - pose.T_o_b) @ T_b_f)[:3, 3] / step_s
    assert message.velocity_m_s == pytest.approx(speed.tolist(), abs=1e-4)
    assert message.rate_rad_s == pytest.approx([0.0, 0.0, -0.4])


@pytest.mark.parametrize("rate_hz", [10.0, 20.0, 30.0, 60.0])
def test_velocity_without_a_sensor_is_of_the_instant_of_the_pose(rate_hz: float) -> None:
    """Starting with 3 m/s^2 forward, half a frame late would be 7.5 cm/s too slow at 20 Hz."""
    stream = ControllerSession(mounting("flu"))
    compared = 0
    for i in range(round(rate_hz)):
        t_s = i / rate_hz
        T_o_b = np.eye(4)
        T_o_b[0, 3] = 1.5 * t_s**2
        message = stream._pose_message(PoseSample(round(t_s * S), T_o_b, True, 90), round(t_s * S))
        if message is not None and t_s > 0.25:
            assert message.velocity_m_s[0] == pytest.approx(3.0 * t_s, abs=1e-3)
            compared += 1
    assert compared >= 7


def test_distances_around_the_vehicle_as_the_dialect_builds_them() -> None:
    """Ahead first, clockwise, in cm: 20 cm at least, beyond the reach free, unknown told as unknown."""
    distance_m = [1.5, 0.05, inf, nan, *[9.0] * 68]
    sent = common.MAVLink(None).parse_buffer(MavlinkCodec().encode(ObstacleDistance(7, distance_m, 10.0)))[0]
    assert sent.get_type() == "OBSTACLE_DISTANCE" and sent.time_usec == 7
    assert list(sent.distances[:5]) == [150, 20, 1001, 65535, 900]
    assert (sent.increment, sent.increment_f, sent.angle_offset, sent.frame) == (5, 5.0, 0.0, 12)
    assert (sent.min_distance, sent.max_distance) == (20, 1000)
