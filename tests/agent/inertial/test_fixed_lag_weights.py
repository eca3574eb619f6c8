"""What measurements are worth in the fixed-lag smoother: walks, floors, lengths, velocities, repeated errors."""

from dataclasses import replace

import numpy as np
import pytest

from kiteline_agent.inertial.fixed_lag import BodyVelocity, FixedLagSmoother, tilt_of
from kiteline_agent.inertial.inertial_config import FixedLagConfig, StartDeviations
from kiteline_agent.inertial.preintegration import Samples, preintegrate
from kiteline_agent.inertial.scale_filter import camera_scaled
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from tests.agent.lag_flights import CALIBRATION, CAMERA, GRAVITY, STEP_S, T_B_C, Flight, make_flight, see

PLAIN = FixedLagConfig(
    visual_inflation=1.0, imu_inflation=1.0, turn_floor_rad=1e-7, velocity_floor_m_s=1e-6, position_floor_m=1e-6,
    tilt_walk_rad=0.0,
)  # fmt: skip
CERTAIN = StartDeviations(1e-4, 1e-4, 1e-4, 1e-4, 1e-3, 1e-5)
RATE = np.array([0.3, -0.2, 4.0])


def begun(config: FixedLagConfig, deviations: StartDeviations = CERTAIN) -> FixedLagSmoother:
    """A body at rest in its map, which the samples of `at_rest` leave there."""
    smoother = FixedLagSmoother(CAMERA, CALIBRATION, config)
    smoother.start(np.eye(4), np.zeros(3), np.zeros(6), GRAVITY, deviations)
    return smoother


def at_rest(dt_s: float, rate: F64 | None = None, accel: F64 | None = None) -> Samples:
    t = np.linspace(0.0, dt_s, 11)
    gyro, force = np.zeros(3) if rate is None else rate, -GRAVITY if accel is None else accel - GRAVITY
    return Samples(t, np.tile(gyro, (11, 1)), np.tile(force, (11, 1)))


@pytest.mark.parametrize("frames", [5, 20])
def test_biases_walk_by_the_time_that_passes_not_by_its_frames(frames: int) -> None:
    extra = np.array([2e-3, 0.02])
    smoother, twice = begun(PLAIN), begun(PLAIN)
    twice.extra_walk = extra
    for one in (smoother, twice):
        for _ in range(frames):
            one.add(at_rest(1.0 / frames), None)
    walk = np.array([CALIBRATION.gyro_walk, CALIBRATION.accel_walk])
    for one, density in ((smoother, walk), (twice, np.hypot(walk, extra))):
        grown = np.diag(one.state.cov)[9:15] - np.repeat([1e-4, 1e-3], 3) ** 2
        np.testing.assert_allclose(grown, np.repeat(density**2, 3), rtol=1e-3)


@pytest.mark.parametrize("frames", [5, 20])
def test_the_vertical_walks_likewise(frames: int) -> None:
    walk, frame_s = 3e-3, 1.0 / frames
    smoother = begun(replace(PLAIN, tilt_walk_rad=walk))
    for _ in range(frames):
        smoother.add(at_rest(frame_s), None)
    left_s = 1.0 - frame_s * (PLAIN.states - 1)  # of the intervals that have left the window
    np.testing.assert_allclose(np.diag(smoother.state.cov)[15:], 1e-10 + walk**2 * left_s, rtol=1e-3)


def test_an_interval_is_no_better_known_than_its_floors() -> None:
    floors = np.repeat([0.02, 0.3, 0.1], 3)
    smoother = begun(replace(PLAIN, turn_floor_rad=0.02, velocity_floor_m_s=0.3, position_floor_m=0.1))
    cov = smoother.add(at_rest(0.05), None).cov
    np.testing.assert_allclose(np.sqrt(np.diag(cov))[[0, 1, 2, 6, 7, 8, 3, 4, 5]], floors, rtol=1e-3)


def test_uncertain_lengths_make_a_change_of_velocity_uncertain_along_it() -> None:
    accel, dt_s = np.array([3.0, -1.0, 0.5]), 0.1
    smoother = begun(PLAIN)
    certain = smoother.add(at_rest(dt_s, accel=accel), None).cov
    smoother = begun(PLAIN)
    cov = smoother.add(at_rest(dt_s, accel=accel), None, length_error=0.02).cov
    off = np.zeros(17)
    off[6:9] = PLAIN.length_inflation * 0.02 * accel * dt_s
    off[3:6] = 0.5 * dt_s * off[6:9]
    np.testing.assert_allclose(cov - certain, np.outer(off, off), atol=1e-6 * off.max() ** 2 + 1e-9)


def test_noise_counts_more_by_its_inflation_also_once_late_samples_have_come() -> None:
    samples, sizes = at_rest(0.05), []
    for factor, late in ((1.0, False), (3.0, False), (3.0, True)):
        smoother = begun(replace(PLAIN, imu_inflation=factor))
        smoother.add(samples, None)
        if late:
            smoother.replace(0, samples)
        sizes.append(float(np.trace(np.linalg.inv(smoother._imu_info[0])[3:6, 3:6])))
    np.testing.assert_allclose(np.divide(sizes[1:], sizes[0]), 9.0, rtol=1e-3)


def test_pixels_count_less_where_their_errors_last_over_frames() -> None:
    flight, sigma = make_flight(3, 2), []
    for inflation in (1.0, 16.0):
        smoother = FixedLagSmoother(CAMERA, CALIBRATION, replace(PLAIN, visual_inflation=inflation))
        unknown = StartDeviations(1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
        smoother.start(flight.pose(0), flight.velocity[0], np.zeros(6), GRAVITY, unknown)
        state = smoother.add(flight.samples(0), see(flight, 1, np.random.default_rng(2), 0.3))
        sigma.append(np.sqrt(np.diag(state.cov)[:6]))
    np.testing.assert_allclose(sigma[1] / sigma[0], 4.0, rtol=0.02)


@pytest.mark.parametrize("off_m_s", [0.0, 0.5])
def test_an_odometer_s_velocity_turns_with_the_body_until_the_frame(off_m_s: float) -> None:
    """What it says, how sure it is of each axis, and how sure it counts: as if it had said so at the frame."""
    accel, dt_s, age_s = np.array([1.0, 2.0, 0.0]), 0.05, 0.04
    said = np.array([0.2 + off_m_s, -0.1, 0.3])
    cov, inflated = np.diag([0.1, 0.2, 0.5]) ** 2, np.diag([0.3, 0.1, 0.6]) ** 2
    samples, states = at_rest(dt_s, RATE, accel), []
    motion = preintegrate(samples, np.zeros(6), CALIBRATION)
    R = se3.so3_exp(RATE * age_s)
    change = (motion.turn.T @ (motion.vp[:3] + GRAVITY * dt_s)) * age_s / dt_s
    now = BodyVelocity(R.T @ said + change, R.T @ cov @ R, R.T @ inflated @ R)
    for velocity in (BodyVelocity(said, cov, inflated, age_s), now):
        smoother = begun(replace(PLAIN, velocity_gate=1e9), StartDeviations(velocity_m_s=0.05))
        states.append(smoother.add(samples, None, velocity))
    np.testing.assert_allclose(states[0].velocity, states[1].velocity, atol=1e-9)
    np.testing.assert_allclose(states[0].cov, states[1].cov, atol=1e-12)


def test_a_velocity_counts_by_its_inflated_covariance_and_less_where_it_is_a_surprise() -> None:
    before = begun(PLAIN, StartDeviations(velocity_m_s=0.05))
    own = before.add(at_rest(0.05), None).cov
    for off_m_s in (0.0, 1.0):
        smoother = begun(replace(PLAIN, velocity_gate=1e9), StartDeviations(velocity_m_s=0.05))
        said, cov = np.array([off_m_s, 0.0, 0.0]), 0.05**2 * np.eye(3)
        after = smoother.add(at_rest(0.05), None, BodyVelocity(said, cov, 4.0 * cov)).cov
        square = off_m_s**2 / (0.05**2 + 0.05**2)  # the gate takes the start's velocity as it was
        weight = min(1.0, np.sqrt(7.81 / max(square, 1e-9)))
        told = np.linalg.inv(np.linalg.inv(own[6:9, 6:9]) + weight * np.linalg.inv(4.0 * cov))
        np.testing.assert_allclose(after[6:9, 6:9], told, rtol=0.02, atol=1e-6)


def test_a_scaled_map_scales_all_but_the_lever_arm() -> None:
    """A body without weight that drifts evenly: in a map that is scaled on the way it ends scaled likewise."""
    config = replace(PLAIN, imu_inflation=1e-3, velocity_floor_m_s=1e-9, position_floor_m=1e-9, fresh=3, iterations=6)
    T = np.tile(np.eye(4), (101, 1, 1))
    T[:, :3, 3] = np.outer(np.arange(101) * STEP_S, [0.4, -0.2, 0.1])
    none, velocity = np.zeros((101, 3)), np.tile([0.4, -0.2, 0.1], (101, 1))
    flight = Flight(T, velocity, none, none, np.random.default_rng(3).uniform(-6.0, 6.0, (3000, 3)))
    start = replace(CERTAIN, turn_rad=0.02, position_m=0.1, accel_bias_m_s2=1e-6)
    steady = replace(CALIBRATION, gyro_walk=1e-7, accel_walk=1e-7)
    factor, centre, ends = 1.3, np.array([0.5, -0.4, 0.2]), []
    for scaled in (False, True):
        rng = np.random.default_rng(5)
        smoother = FixedLagSmoother(CAMERA, steady, config, gravity_m_s2=0.0)
        smoother.start(np.eye(4), velocity[0], np.zeros(6), GRAVITY, start)
        for k in range(10):
            if scaled and k == 8:
                before = smoother.state.cov
                smoother.scale_map(factor, centre)
                grown = np.repeat([1.0, factor, 1.0], [3, 6, 8])
                np.testing.assert_allclose(smoother.state.cov, before * np.outer(grown, grown))
            points = see(flight, k + 1, rng, 0.3)
            points = replace(points, ray=0.2 * rng.normal(size=points.xyz.shape))
            points.observed[:, 2] = -1.0  # which tells lengths
            if scaled and k >= 8:
                points = replace(points, xyz=centre + factor * (points.xyz - centre), ray=factor * points.ray)
            state = smoother.add(flight.samples(k), points)
        ends.append(state)
    plain, after = ends
    sigma = np.sqrt(np.diag(plain.cov)[:9])
    goal = camera_scaled(plain.T_m_b, factor, T_B_C[:3, 3], centre)
    turn = se3.so3_log(goal[:3, :3].T @ after.T_m_b[:3, :3])
    assert np.all(np.abs(turn) < 0.1 * sigma[:3])
    assert np.all(np.abs(after.T_m_b[:3, 3] - goal[:3, 3]) < 0.1 * factor * sigma[3:6])
    assert np.all(np.abs(after.velocity - factor * plain.velocity) < 0.1 * factor * sigma[6:])
    np.testing.assert_allclose(np.sqrt(np.diag(after.cov)[:9]), sigma * np.repeat([1.0, factor], [3, 6]), rtol=0.03)


def test_a_new_map_takes_over_what_is_uncertain_of_the_attitude() -> None:
    """By its definition the body is turned exactly as said in the new map; velocity and vertical are so no longer."""
    T, at = se3.exp(np.array([0.0, 0.0, 0.0, 0.2, -0.3, 1.0])), se3.exp(np.array([1.0, 2.0, 3.0, 0.1, -0.2, 0.5]))
    velocity, cov = np.array([2.0, -1.0, 0.5]), 1e-14 * np.eye(17)
    half = np.array([[3.0, 1.0, 0.0], [0.0, 2.0, -1.0], [1.0, 0.0, 1.0]]) * 1e-3
    cov[:3, :3] = half @ half.T
    smoother = FixedLagSmoother(CAMERA, CALIBRATION, PLAIN)
    smoother.start(T, velocity, np.zeros(6), GRAVITY, StartDeviations(), cov)
    smoother.begin_map(at)

    def in_new_map(turn: F64) -> F64:
        R_new_old = at[:3, :3] @ (T[:3, :3] @ se3.so3_exp(turn)).T
        return np.concatenate([R_new_old @ velocity, tilt_of(R_new_old @ GRAVITY)])

    j = np.column_stack([(in_new_map(1e-6 * e) - in_new_map(-1e-6 * e)) / 2e-6 for e in np.eye(3)])
    told = smoother.state.cov[np.ix_([6, 7, 8, 15, 16], [6, 7, 8, 15, 16])]
    np.testing.assert_allclose(told, j @ cov[:3, :3] @ j.T, rtol=1e-4, atol=1e-10)
