"""Motion over a loss, motion between frames, and an IMU that falls silent."""

import numpy as np
import pytest

from kiteline_agent.config import OdometerConfig
from kiteline_agent.inertial.gravity_alignment import up_of
from kiteline_agent.inertial.inertial_config import InertialConfig, StartDeviations
from kiteline_agent.inertial.inertial_tracker import InertialTracker
from kiteline_agent.motion.loss_motion import LossMotion, LossMotionEstimator, _largest
from kiteline_agent.motion.motion_model import MotionModel
from kiteline_agent.motion.recent_motion import RecentMotion
from kiteline_agent.tracking.pose_state import PoseState
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuBatch, ImuCalibration
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera

CALIBRATION = ImuCalibration()
CAMERA = RectifiedCamera(752, 480, 420.0, 420.0, 376.0, 240.0, 0.11, True, np.eye(4))
CONFIG = InertialConfig()
PERIOD_NS = 50_000_000
UP = np.array([0.0, 0.0, 9.81])
VELOCITY = np.array([0.8, -0.3, 0.1])


def flown(accel_error: F64, gap: int, seen: int) -> tuple[list[LossMotion], F64]:
    """A straight flight: `gap` frames without images, then `seen` frames in a new submap. Returns the motions told, and
    by how much dead reckoning was off.

    accel_error: (3,) m/s^2, from the begin of the loss on.
    """
    tracker = InertialTracker(CAMERA, CALIBRATION, CONFIG)
    estimator = LossMotionEstimator(tracker, CALIBRATION, CONFIG.gravity_m_s2)
    tracker._smoother.start(np.eye(4), VELOCITY, np.zeros(6), -UP, StartDeviations(1e-3, 1e-3, 0.01, 1e-4, 0.1, 5e-3))
    tracker._set_last(0, np.eye(4))
    told, off = [], np.zeros(3)
    for k in range(1, gap + seen + 1):
        stamps = np.arange((k - 1) * PERIOD_NS, k * PERIOD_NS + 1, 5_000_000)
        accel = np.tile(UP + accel_error, (len(stamps), 1))
        tracker.predict(ImuBatch(stamps[1:], np.zeros((len(stamps) - 1, 3)), accel[1:]), k * PERIOD_NS)
        true = VELOCITY * k * PERIOD_NS * 1e-9
        if k <= gap:
            state = tracker.dead_reckon(k * PERIOD_NS)
            off = true - state.T_m_b[:3, 3]
        if k == gap:
            first = estimator.begin(k * PERIOD_NS, state.T_m_b, np.eye(3))
            assert first is not None
            told.append(first)
            tracker.begin_map(k * PERIOD_NS, state.T_m_b)
        elif k > gap:
            T_m_b = se3.from_rt(np.eye(3), true - off)  # the new submap lies where dead reckoning put it
            again = estimator.update(k * PERIOD_NS, T_m_b)
            told += [] if again is None else [again]
            tracker._set_last(k * PERIOD_NS, T_m_b)
    return told, off


@pytest.mark.parametrize("gap", [10, 30, 60])
def test_the_velocity_after_a_loss_tells_most_of_the_error(gap: int) -> None:
    (first, second), off = flown(np.array([0.15, -0.1, 0.05]), gap, 6)
    assert np.array_equal(first.shift, np.zeros(3))
    assert float(np.linalg.norm(off)) > 0.02
    assert float(np.linalg.norm(off - second.shift)) < 0.35 * float(np.linalg.norm(off))
    assert second.sigma_m < 0.6 * first.sigma_m
    assert second.sigma_rad == first.sigma_rad
    for motion in (first, second):
        assert float(np.linalg.norm(off - motion.shift)) < 3.0 * np.sqrt(3.0) * motion.sigma_m


def test_a_true_dead_reckoning_stays() -> None:
    (first, second), off = flown(np.zeros(3), 30, 6)
    assert float(np.linalg.norm(off)) < 1e-3
    assert float(np.linalg.norm(second.shift)) < 5e-3
    assert second.sigma_m < first.sigma_m


def test_a_loss_is_measured_once_and_not_from_too_few_frames() -> None:
    assert len(flown(np.zeros(3), 30, 3)[0]) == 1
    assert len(flown(np.zeros(3), 30, 12)[0]) == 2


def test_without_dead_reckoning_there_is_no_motion() -> None:
    tracker = InertialTracker(CAMERA, CALIBRATION, CONFIG)
    estimator = LossMotionEstimator(tracker, CALIBRATION, CONFIG.gravity_m_s2)
    assert estimator.begin(0, np.eye(4), np.eye(3)) is None
    assert estimator.update(10**9, np.eye(4)) is None


def test_up_is_that_of_the_state_and_as_certain() -> None:
    tracker = InertialTracker(CAMERA, CALIBRATION, CONFIG)
    assert tracker.state is None
    T_m_b = se3.exp(np.array([0.0, 0.0, 0.0, 0.3, -0.2, 0.9]))
    gravity = -9.81 * np.array([0.05, -0.02, 1.0]) / np.linalg.norm([0.05, -0.02, 1.0])
    deviations = StartDeviations(turn_rad=0.01, tilt_rad=0.02)
    tracker._smoother.start(T_m_b, VELOCITY, np.zeros(6), gravity, deviations)
    assert tracker.state is not None
    found = up_of(tracker.state)
    assert np.allclose(found[0], -T_m_b[:3, :3].T @ gravity / 9.81, atol=1e-9)
    assert found[1] == pytest.approx(np.hypot(0.01, 0.02), rel=0.01)


def test_a_deviation_is_never_none_at_all() -> None:
    """A record cannot tell a deviation of 0."""
    assert 0.0 < _largest(np.zeros((3, 3))) < 1e-5


MS = 1_000_000


def at(t_s: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = 1.5 * t_s**2  # 3 m/s^2
    return T


def test_it_is_of_the_instant_asked_for_but_looks_ahead_one_frame_at_most() -> None:
    motion = RecentMotion()
    for i in range(10):
        motion.add(i * 50 * MS, at(0.05 * i), measured=True)
    for ask_ms, t_s in ((450, 0.45), (480, 0.48), (500, 0.5), (900, 0.5)):
        found = motion.rates(ask_ms * MS)
        assert found[0] == pytest.approx([3.0 * t_s, 0.0, 0.0], abs=1e-6)


def test_a_loss_forgets_the_motion() -> None:
    motion = RecentMotion()
    for i in range(5):
        motion.add(i * 50 * MS, at(0.05 * i), measured=i != 3)
    assert motion.rates(210 * MS) is None


@pytest.mark.parametrize("driven", [False, True])
def test_without_a_known_velocity_an_odometer_predicts_else_the_camera_and_the_gyro(
    monkeypatch: pytest.MonkeyPatch, driven: bool
) -> None:
    pose, by_odometer = PoseState(), se3.from_rt(np.eye(3), np.array([9.0, 0.0, 0.0]))
    model = MotionModel(CAMERA, CALIBRATION, CONFIG, OdometerConfig(), pose, metric=True)
    pose.measured(se3.from_rt(np.eye(3), VELOCITY * PERIOD_NS * 1e-9), PERIOD_NS * 1e-9)
    assert model.tracker is not None
    model.tracker.begin_map(0, pose.T_m_c)
    monkeypatch.setattr(model.odometer, "predict", lambda *_: by_odometer if driven else None)
    rate = np.array([0.0, 0.4, 0.0])
    for k in (1, 2):  # the first of them has no pose by images
        stamps = np.arange((k - 1) * PERIOD_NS, k * PERIOD_NS + 1, 5_000_000)[k > 1 :]
        imu = ImuBatch(stamps, np.tile(rate, (len(stamps), 1)), np.tile(UP, (len(stamps), 1)))
        predicted = model.predict(k * PERIOD_NS, imu, PERIOD_NS * 1e-9)
        model.dead_reckon(predicted, k * PERIOD_NS)
        pose.guess(predicted, PERIOD_NS * 1e-9)
    if driven:
        assert np.array_equal(predicted, by_odometer)
    else:
        np.testing.assert_allclose(predicted[:3, 3], 3.0 * VELOCITY * PERIOD_NS * 1e-9, atol=1e-9)
        np.testing.assert_allclose(se3.so3_log(predicted[:3, :3]), 2.0 * rate * PERIOD_NS * 1e-9, atol=1e-6)


def test_wrong_samples_and_those_sent_twice_are_left_out_before_anything_else() -> None:
    rng = np.random.default_rng(0)
    model = MotionModel(CAMERA, CALIBRATION, CONFIG, OdometerConfig(), PoseState(), metric=True)
    stamps = np.arange(0, 1200 * 5_000_000, 5_000_000)
    gyro, accel = 0.01 * rng.standard_normal((1200, 3)), UP + 0.2 * rng.standard_normal((1200, 3))
    wrong = np.arange(200, 1190, 30)
    accel[wrong, 0] += 70.0
    times: list[int] = []
    for k in range(0, 1200, 10):
        for _ in range(2):
            out = model.timed(ImuBatch(stamps[k : k + 10], gyro[k : k + 10], accel[k : k + 10]))
            times += [] if out is None else out.t_ns.tolist()
    assert times == np.delete(stamps, wrong).tolist()
    assert any("left out" in event for event in model.take_events())


@pytest.mark.parametrize("late_ns", [0, 40_000_000])
def test_samples_up_to_a_frame_have_come_once_they_are_there(late_ns: int) -> None:
    tracker = InertialTracker(CAMERA, CALIBRATION, CONFIG)
    for k in range(1, 21):
        stamps = np.arange((k - 1) * PERIOD_NS, k * PERIOD_NS, 5_000_000) + 5_000_000 - late_ns
        n = len(stamps)
        tracker.predict(ImuBatch(stamps, np.zeros((n, 3)), np.tile(UP, (n, 1))), k * PERIOD_NS)
        tracker._set_last(k * PERIOD_NS, np.eye(4))
        assert tracker.has_samples(k * PERIOD_NS) == (late_ns == 0)
        assert tracker.has_samples((k - 1) * PERIOD_NS)
    assert (tracker.samples_between(15 * PERIOD_NS, 20 * PERIOD_NS) is None) == (late_ns > 0)
    assert tracker.samples_between(10 * PERIOD_NS, 19 * PERIOD_NS) is not None
