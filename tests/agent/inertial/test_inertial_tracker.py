"""The inertial tracker on simulated flights: starts, fuses, coasts, finds a wrong level, a time offset and a scale."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest

from kiteline_agent.inertial.fixed_lag import InertialState, VisualPoints
from kiteline_agent.inertial.imu_initialisation import InertialStartState
from kiteline_agent.inertial.inertial_config import InertialConfig, SelfCalibrationConfig
from kiteline_agent.inertial.inertial_tracker import InertialTracker
from kiteline_agent.inertial.scale_filter import camera_scaled
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuBatch, ImuCalibration
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_hw.sim.sensors import imu as sim_imu
from kiteline_hw.sim.world.built_in_paths import built_in_path
from kiteline_hw.sim.world.path import Path

CALIBRATION = ImuCalibration()
CHEAP = ImuCalibration(gyro_noise=1e-3, gyro_walk=8e-5, accel_noise=6e-3, accel_walk=4e-3)
T_B_C = se3.from_rt(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.1, 0.03, -0.02]))
CAMERA = RectifiedCamera(752, 480, 450.0, 450.0, 375.5, 239.5, 0.11, True, T_B_C)
FRAME_NS = 50_000_000
NOISE_PX = 0.3
HASTE = 0.4  # the course in so much of its time


@dataclass
class Step:
    """One frame as the tracker gets it, and the truth."""

    t_ns: int
    imu: ImuBatch
    visual: F64
    points: VisualPoints
    truth: F64


def flight(
    frames: int, seed: int = 0, rest_s: float = 0.0, late_ns: int = 0, T_m_w: F64 | None = None,
    calibration: ImuCalibration = CALIBRATION,
) -> list[Step]:  # fmt: skip
    """A lively flight along the room's course. late_ns: images are so much later than stamped. T_m_w: map."""
    T_m_w = np.eye(4) if T_m_w is None else T_m_w
    rng = np.random.default_rng([seed, 2])
    path = built_in_path("room", (frames * 0.05 + 3.0) / HASTE, T_B_C, 0)
    path = Path(path.coefficients, path.knot_s * HASTE, path.length_s * HASTE, 0.7, rest_s)
    stamps = np.arange(frames, dtype=np.int64) * FRAME_NS + 100_000_000
    imu_t = np.arange(0, int(stamps[-1]) + 1, 5_000_000, dtype=np.int64)
    samples = sim_imu.measure(path, imu_t, 0, calibration, seed)
    truth = path.motion((stamps + late_ns) * 1e-9).T_w_b
    cloud = truth[:, :3, 3].mean(axis=0) + rng.uniform(-6.0, 6.0, (3000, 3))
    steps, done = [], 0
    for k in range(frames):
        end = int(np.searchsorted(imu_t, stamps[k], "right"))
        batch = ImuBatch(imu_t[done:end], samples.gyro[done:end], samples.accel[done:end])
        done = end
        error = np.concatenate([0.0006 * rng.normal(size=3), 0.0003 * rng.normal(size=3)])
        T = T_m_w @ truth[k]
        steps.append(Step(int(stamps[k]), batch, T @ se3.exp(error), see(truth[k], cloud, rng, T_m_w), T))
    return steps


def see(T_w_b: F64, cloud: F64, rng: np.random.Generator, T_m_w: F64) -> VisualPoints:
    c = CAMERA
    p = se3.transform(se3.inverse(T_w_b @ T_B_C), cloud)
    z = np.maximum(p[:, 2], 1e-3)
    uvd = np.column_stack([c.fx * p[:, 0] / z + c.cx, c.fy * p[:, 1] / z + c.cy, c.bf / z])
    good = (p[:, 2] > 0.5) & (uvd[:, 0] > 0) & (uvd[:, 0] < c.width) & (uvd[:, 1] > 0) & (uvd[:, 1] < c.height)
    chosen = np.flatnonzero(good)[:60]
    n = len(chosen)
    observed = uvd[chosen] + NOISE_PX * rng.normal(size=(n, 3))
    xyz = se3.transform(T_m_w, cloud[chosen])
    return VisualPoints(xyz, np.zeros((n, 3)), observed, np.full(n, NOISE_PX), np.ones(n, np.bool_))


def run(
    steps: list[Step], blind: range = range(0), config: InertialConfig | None = None,
    calibration: ImuCalibration = CALIBRATION,
) -> tuple[InertialTracker, list[InertialState | None]]:  # fmt: skip
    tracker = InertialTracker(CAMERA, calibration, config or InertialConfig())
    states: list[InertialState | None] = []
    for k, step in enumerate(steps):
        tracker.predict(step.imu, step.t_ns)
        states.append(
            tracker.dead_reckon(step.t_ns) if k in blind else tracker.update(step.t_ns, step.visual, step.points)
        )
    return tracker, states


def apart_m(state: InertialState | None, T: F64) -> float:
    return float(np.linalg.norm(state.T_m_b[:3, 3] - T[:3, 3]))


def test_starts_at_rest_and_smooths() -> None:
    steps = flight(70, rest_s=1.0)
    tracker, states = run(steps)
    assert tracker.started == "rest"
    assert states[12] is not None
    fused = [apart_m(s, step.truth) for s, step in zip(states[30:], steps[30:])]
    assert np.sqrt(np.mean(np.square(fused))) < 0.002
    # from frame to frame it moves as the vehicle moves, better than the images alone say
    jitter = [
        np.linalg.norm((b.T_m_b - a.T_m_b)[:3, 3] - (t1.truth - t0.truth)[:3, 3])
        for a, b, t0, t1 in zip(states[30:], states[31:], steps[30:], steps[31:])
        if a is not None and b is not None
    ]
    rough = [np.linalg.norm((b.visual - a.visual)[:3, 3] - (b.truth - a.truth)[:3, 3]) for a, b in pairwise(steps[30:])]
    assert np.mean(jitter) < 0.3 * np.mean(rough)


@pytest.mark.parametrize("seed", [1, 2])
def test_starts_in_motion_in_a_map_that_is_not_level(seed: int) -> None:
    lean = se3.from_rt(se3.so3_exp(np.array([0.3, -0.2, 0.5])), np.array([1.0, 0.0, 2.0]))
    steps = flight(60, seed, T_m_w=lean)
    tracker, states = run(steps)
    assert tracker.started == "motion"
    assert next(k for k, s in enumerate(states) if s is not None) < 25
    level_R = tracker.gravity_rotation()
    upright = level_R @ lean[:3, :3]
    assert upright[2, 2] > np.cos(np.radians(1.0))
    assert apart_m(states[-1], steps[-1].truth) < 0.004


def test_prediction_is_near_what_comes() -> None:
    steps = flight(60, 3)
    tracker = InertialTracker(CAMERA, CALIBRATION, InertialConfig())
    assert tracker.predict(steps[0].imu, steps[0].t_ns) is None
    for k, step in enumerate(steps):
        ahead = tracker.predict(step.imu if k else None, step.t_ns)
        if k >= 30:
            assert np.linalg.norm(ahead[:3, 3] - step.truth[:3, 3]) < 0.006
            assert np.linalg.norm(se3.so3_log(ahead[:3, :3].T @ step.truth[:3, :3])) < 0.003
        tracker.update(step.t_ns, step.visual, step.points)


def test_two_seconds_of_dead_reckoning() -> None:
    steps = flight(110, 4)
    tracker, states = run(steps, range(60, 100))
    end = states[99]
    assert apart_m(end, steps[99].truth) < 0.12
    assert end is not None and states[59] is not None
    error = end.T_m_b[:3, 3] - steps[99].truth[:3, 3]
    assert error @ np.linalg.solve(end.pose_cov[:3, :3], error) < 16.3  # 99.9 % of 3 degrees of freedom
    assert np.trace(end.pose_cov[:3, :3]) > 10.0 * np.trace(states[59].pose_cov[:3, :3])
    assert apart_m(states[-1], steps[-1].truth) < 0.004
    assert tracker.image_loss_s == 0.0


def test_dead_reckoning_for_too_long_is_reported() -> None:
    steps = flight(60, 4)
    config = InertialConfig(max_dead_reckoning_s=0.5)
    tracker, states = run(steps, range(40, 60), config)
    assert states[49] is not None and states[51] is None
    assert not tracker.running


@pytest.mark.parametrize(("frames", "goes_on"), [(2, True), (8, False)])
def test_a_hole_in_the_samples_is_survived(frames: int, goes_on: bool) -> None:
    """A short one is bridged by the images; after a long one the state begins anew."""
    steps = flight(90, 5)
    tracker = InertialTracker(CAMERA, CALIBRATION, InertialConfig())
    running, apart = [], []
    for k, step in enumerate(steps):
        tracker.predict(None if 40 <= k < 40 + frames else step.imu, step.t_ns)
        state = tracker.update(step.t_ns, step.visual, step.points)
        running.append(tracker.running)
        apart.append(apart_m(state, step.truth) if state is not None else 0.0)
    assert running[39] and running[40 + frames] == goes_on and running[-1]
    assert max(apart[30:]) < 0.01


@pytest.mark.parametrize("late_ns", [25_000_000, 12_000_000, -8_000_000])
@pytest.mark.parametrize("calibration", [CALIBRATION, CHEAP])
def test_time_offset_is_found_and_applied(late_ns: int, calibration: ImuCalibration) -> None:
    """Also where the samples of a frame come after it, and where rates change by little more than their noise."""
    steps = flight(160, 6, late_ns=late_ns, calibration=calibration)
    tracker, states = run(steps, calibration=calibration)
    offset_s, sigma_s = tracker.time_offset_s
    assert offset_s == pytest.approx(late_ns * 1e-9, abs=1.5e-3)
    assert sigma_s < 1e-3
    assert apart_m(states[-1], steps[-1].truth) < 0.004


def test_a_configured_time_offset_holds_and_changes_are_told() -> None:
    steps = flight(60, 6, late_ns=12_000_000)
    tracker, states = run(
        steps, config=InertialConfig(calibration=SelfCalibrationConfig(offset_s=0.012, apply_offset=False))
    )
    assert tracker.offset_report()["applied_ms"] == 12.0
    assert tracker.offset_report()["ms"] == pytest.approx(12.0, abs=2.0)
    assert tracker.take_calibration_events() == []
    assert apart_m(states[-1], steps[-1].truth) < 0.004
    tracker, told = InertialTracker(CAMERA, CALIBRATION, InertialConfig()), []
    for step in flight(160, 6, late_ns=12_000_000):
        tracker.predict(step.imu, step.t_ns)
        tracker.update(step.t_ns, step.visual, step.points)
        told += [(tracker.time_offset_s[0], line) for line in tracker.take_calibration_events() if "IMU's time" in line]
    found_ms = [1e3 * offset_s for offset_s, _ in told]
    assert all(abs(b - a) >= 1.0 for a, b in pairwise([0.0, *found_ms]))  # no line says what one before said
    assert found_ms[-1] == pytest.approx(12.0, abs=1.5)


@pytest.mark.parametrize("late_ns", [40_000_000, 100_000_000])
def test_samples_that_come_late_start_the_state_and_do_no_harm(late_ns: int) -> None:
    """What has not come yet is held at the last sample: neither a start nor a pose may rest on that."""
    steps = flight(100, 6, late_ns=late_ns)
    known = InertialConfig(calibration=SelfCalibrationConfig(offset_s=1e-9 * late_ns))
    tracker, states = run(steps, config=known)
    started = [k for k, state in enumerate(states) if state is not None]
    assert started and started[0] < 40
    assert max(apart_m(states[k], steps[k].truth) for k in started) < 0.01
    up = tracker.state
    assert up is not None and np.linalg.norm(up.tilt) < 0.01


def test_accelerations_that_have_not_come_tell_no_lengths() -> None:
    """The newest sample, held for 50 ms, is no acceleration: a scale by such intervals is percents off."""
    steps = flight(60, 6)
    tracker, _ = run(steps)
    before, last = steps[-9].t_ns, steps[-1].t_ns
    assert tracker.samples_between(before, last) is not None
    assert tracker.samples_between(before, last + 10_000_000) is not None
    assert tracker.samples_between(before, last + 50_000_000) is None


def mono_start(tracker: InertialTracker, step: Step, velocity: F64, unit: float) -> F64:
    """Start at a step, in a map of which one unit is `unit` metres. Returns the body's pose there."""
    pose = camera_scaled(step.truth, 1.0 / unit, T_B_C[:3, 3])
    cov = np.diag(np.repeat([0.01, 0.01, 0.05, 0.002, 0.05, 0.01], [3, 3, 3, 3, 3, 2]) ** 2)
    gravity = np.array([0.0, 0.0, -9.81])
    tracker.start(step.t_ns, pose, InertialStartState(pose, velocity / unit, np.zeros(6), gravity, cov))
    return pose


def in_unit(points: VisualPoints, unit: float) -> VisualPoints:
    return replace(
        points,
        xyz=points.xyz / unit,
        observed=np.append(points.observed[:, :2], -np.ones((len(points.xyz), 1)), axis=1),
    )


@pytest.mark.parametrize("corrected_every", [1000, 20])
@pytest.mark.parametrize("unit", [1.0, 0.94, 1.06])
def test_a_wrong_scale_is_found_and_corrected(unit: float, corrected_every: int) -> None:
    """A monocular map that is 6 % off is found within seconds, a right one is left alone.

    It makes no difference that the base moves the map every second and leaves its lengths as they are.
    """
    steps = flight(260, 7)
    tracker = InertialTracker(CAMERA, CALIBRATION, InertialConfig(), metric=False)
    tracker.predict(steps[10].imu, steps[10].t_ns)
    velocity = (steps[11].truth[:3, 3] - steps[9].truth[:3, 3]) / 0.1
    mono_start(tracker, steps[10], velocity, unit)
    total = unit
    corrections = []
    for k, step in enumerate(steps[11:], 1):
        tracker.predict(step.imu, step.t_ns)
        visual = camera_scaled(step.visual, 1.0 / total, T_B_C[:3, 3])
        tracker.update(step.t_ns, visual, in_unit(step.points, total))
        if k % corrected_every == 0:
            tracker.scale_map(1.0)
        found = tracker.scale.correction()
        if found is not None:
            factor, sigma = found
            corrections.append(factor)
            assert sigma < 0.03
            tracker.rescale(factor)
            total /= factor
    assert tracker.metric and tracker.running
    assert total == pytest.approx(1.0, abs=0.025)
    assert len(corrections) <= 3
    assert bool(corrections) == (unit != 1.0)


@pytest.mark.parametrize("unit", [0.96, 1.04])
def test_velocity_follows_lengths_that_the_base_corrects(unit: float) -> None:
    """A map that is 4 % off is corrected under the camera: the velocity in it was as wrong."""
    steps, at = flight(64, 7), 60
    tracker = InertialTracker(CAMERA, CALIBRATION, InertialConfig(), metric=False)
    tracker.predict(steps[10].imu, steps[10].t_ns)
    mono_start(tracker, steps[10], (steps[11].truth[:3, 3] - steps[9].truth[:3, 3]) / 0.1, unit)
    for k, step in enumerate(steps[11:-1], 11):
        if k == at:
            before = camera_scaled(steps[k - 1].visual, 1.0 / unit, T_B_C[:3, 3])
            watched = tracker.scale.scale[0]
            tracker.move_map(steps[k - 1].visual @ se3.inverse(before))
            tracker.scale_map(unit)
            assert tracker.scale.scale[0] == pytest.approx(watched / unit)
        total = unit if k < at else 1.0
        tracker.predict(step.imu, step.t_ns)
        visual = camera_scaled(step.visual, 1.0 / total, T_B_C[:3, 3])
        state = tracker.update(step.t_ns, visual, in_unit(step.points, total))
        true = (steps[k + 1].truth - steps[k - 1].truth)[:3, 3] / 0.1
        assert k < at or (state is not None and np.linalg.norm(state.velocity - true) < 0.02)  # 0.03 to 0.06 if not


def test_a_moved_map_and_a_new_one() -> None:
    steps = flight(90, 8)
    shift = se3.exp(np.array([0.2, 0.1, -0.1, 0.01, 0.02, 0.1]))
    tracker = InertialTracker(CAMERA, CALIBRATION, InertialConfig())
    for k, step in enumerate(steps):
        if k == 40:
            tracker.move_map(shift)
        if k == 60:
            tracker.reset()
            assert not tracker.running
        T = shift if k >= 40 else np.eye(4)
        points = VisualPoints(
            se3.transform(T, step.points.xyz), step.points.ray, step.points.observed, step.points.sigma_px,
            step.points.inlier,
        )  # fmt: skip
        ahead = tracker.predict(step.imu, step.t_ns)
        if 40 <= k < 60:
            assert np.linalg.norm(ahead[:3, 3] - (T @ step.truth)[:3, 3]) < 0.006
        tracker.update(step.t_ns, T @ step.visual, points)
    assert tracker.running and tracker.state is not None
    assert apart_m(tracker.state, shift @ steps[-1].truth) < 0.004


def test_a_new_map_after_a_blackout_needs_no_new_start() -> None:
    steps = flight(80, 4)
    tracker = InertialTracker(CAMERA, CALIBRATION, InertialConfig())
    shift = np.eye(4)
    for k, step in enumerate(steps):
        tracker.predict(step.imu, step.t_ns)
        if 30 <= k <= 50:
            state = tracker.dead_reckon(step.t_ns)
        if k == 50:  # texture again, but nothing that is known
            shift = state.T_m_b @ se3.inverse(step.truth)
            tracker.begin_map(step.t_ns, state.T_m_b)
            assert tracker.image_loss_s == 0.0
        if not 30 <= k <= 50:
            points = VisualPoints(
                se3.transform(shift, step.points.xyz), step.points.ray, step.points.observed, step.points.sigma_px,
                step.points.inlier,
            )  # fmt: skip
            state = tracker.update(step.t_ns, shift @ step.visual, points)
            if k > 50:
                assert apart_m(state, shift @ step.truth) < 0.01
    assert tracker.running and tracker.started == "motion"


@pytest.mark.parametrize("limit", [{}, {"rest_gyro_rad_s": 1e-5}, {"rest_accel_m_s2": 1e-4}])
def test_how_much_motors_may_shake_at_rest_is_an_option(limit: dict[str, float]) -> None:
    tracker, _ = run(flight(20, rest_s=1.0), config=replace(InertialConfig(), **limit))
    assert (tracker.started == "rest") == (not limit)
