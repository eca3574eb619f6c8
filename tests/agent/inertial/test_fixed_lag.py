"""The fixed-lag smoother: marginalisation against the whole problem, honesty, dead reckoning, maps that move."""

from dataclasses import replace

import numpy as np
import pytest

from kiteline_agent.inertial.fixed_lag import BodyVelocity, FixedLagSmoother, InertialState, tilt_by_direction, tilt_of
from kiteline_agent.inertial.inertial_config import FixedLagConfig, StartDeviations
from kiteline_agent.inertial.preintegration import Samples
from kiteline_agent.initialisation.window.window_state import tangent
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from tests.agent.lag_flights import CALIBRATION, CAMERA, FRAME_STEPS, GRAVITY, STEP_S, Flight, make_flight, see

EXACT = FixedLagConfig(
    visual_inflation=1.0, imu_inflation=1.0, turn_floor_rad=1e-7, velocity_floor_m_s=1e-6, position_floor_m=1e-6,
    tilt_walk_rad=0.0,
)  # fmt: skip


def error_of(state: InertialState, T: F64) -> F64:
    """[rotation on the right, position] of the truth relative to the estimate."""
    return np.concatenate([se3.so3_log(state.T_m_b[:3, :3].T @ T[:3, :3]), T[:3, 3] - state.T_m_b[:3, 3]])


def fly(
    seed: int, frames: int, config: FixedLagConfig, noisy: bool = True, bias: F64 | None = None, tilt: float = 0.0,
    blind: range = range(0), driven: F64 | None = None,
) -> tuple[Flight, list[InertialState], FixedLagSmoother]:  # fmt: skip
    """A flight with noise that is what the calibration says. tilt: rad by which gravity is wrong at the start.
    driven: (3,) m/s, error of an odometer's velocities.
    """
    rng = np.random.default_rng([seed, 1])
    flight = make_flight(seed, frames)
    bias = np.zeros(6) if bias is None else bias
    smoother = FixedLagSmoother(CAMERA, CALIBRATION, config)
    d = StartDeviations()
    first = flight.pose(0) @ se3.exp(
        np.concatenate([0.02 * rng.normal(size=3), 0.02 * rng.normal(size=3)]) if noisy else np.zeros(6)
    )
    gravity = se3.so3_exp(np.array([tilt, 0.0, 0.0])) @ GRAVITY
    smoother.start(first, flight.velocity[0], np.zeros(6), gravity, d)
    root = np.sqrt(1.0 / STEP_S) if noisy else 0.0
    gyro = flight.gyro + bias[:3] + root * CALIBRATION.gyro_noise * rng.normal(size=flight.gyro.shape)
    accel = flight.accel + bias[3:] + root * CALIBRATION.accel_noise * rng.normal(size=flight.accel.shape)
    measured = replace(flight, gyro=gyro, accel=accel)
    states = []
    for k in range(frames):
        points = None if k + 1 in blind else see(flight, k + 1, rng, 0.3 if noisy else 0.0)
        velocity = None
        if driven is not None:
            true = flight.pose(k + 1)[:3, :3].T @ flight.velocity[(k + 1) * FRAME_STEPS]
            cov = 0.05**2 * np.eye(3)
            velocity = BodyVelocity(true + driven + 0.05 * rng.normal(size=3), cov, cov)
        state = smoother.add(measured.samples(k), points, velocity)
        assert state is not None
        states.append(state)
    return flight, states, smoother


def test_without_noise_the_truth_stays() -> None:
    flight, states, _ = fly(3, 12, EXACT, noisy=False)
    assert np.abs(error_of(states[-1], flight.pose(12))).max() < 2e-4  # what the midpoint rule leaves at 200 Hz
    assert np.abs(states[-1].velocity - flight.velocity[120]).max() < 2e-3
    assert np.abs(states[-1].tilt).max() < 2e-3


@pytest.mark.parametrize("seed", [1, 2])
def test_a_short_window_says_what_a_long_one_says(seed: int) -> None:
    """Marginalisation loses nothing: 3 states and all 16 agree in estimate and in covariance."""
    bias = np.array([0.004, -0.003, 0.002, 0.05, -0.03, 0.04])
    config = replace(EXACT, iterations=5, fresh=30, chi2=1e6)
    _, short, _ = fly(seed, 15, replace(config, states=3), bias=bias)
    _, long, _ = fly(seed, 15, replace(config, states=16), bias=bias)
    a, b = short[-1], long[-1]
    sigma = np.sqrt(np.diag(b.cov))
    assert np.all(np.abs(error_of(a, b.T_m_b)) < 0.1 * sigma[:6])
    assert np.all(np.abs(a.velocity - b.velocity) < 0.1 * sigma[6:9])
    assert np.all(np.abs(a.bias - b.bias) < 0.1 * sigma[9:15])
    np.testing.assert_allclose(np.sqrt(np.diag(a.cov)), sigma, rtol=0.05)


def test_condensed_points_say_what_points_say() -> None:
    _, one, _ = fly(4, 15, replace(EXACT, fresh=1))
    _, all_, _ = fly(4, 15, replace(EXACT, fresh=9))
    sigma = np.sqrt(np.diag(all_[-1].cov))
    assert np.all(np.abs(error_of(one[-1], all_[-1].T_m_b)) < 0.2 * sigma[:6])


def test_covariance_is_consistent() -> None:
    """Normalised squared errors of pose, velocity and biases stay within their band over independent flights."""
    pose, rest = [], []
    for seed in range(24):
        rng = np.random.default_rng([seed, 7])
        bias = np.concatenate([0.01 * rng.normal(size=3), 0.1 * rng.normal(size=3)])
        flight, states, _ = fly(seed, 12, EXACT, bias=bias)
        s = states[-1]
        e = error_of(s, flight.pose(12))
        pose.append(e @ np.linalg.solve(s.cov[:6, :6], e))
        d = np.concatenate([flight.velocity[120] - s.velocity, bias - s.bias])
        rest.append(d @ np.linalg.solve(s.cov[6:15, 6:15], d))
    # 99.9 % bands of the mean of 24 chi-squares with 6 and 9 degrees of freedom
    assert 3.9 < np.mean(pose) < 8.6
    assert 6.3 < np.mean(rest) < 12.2


def test_biases_and_a_wrong_level_are_found() -> None:
    bias = np.array([0.02, -0.03, 0.01, 0.1, -0.1, 0.1])
    _, states, _ = fly(6, 60, FixedLagConfig(), bias=bias, tilt=0.06)
    s = states[-1]
    assert abs(states[0].tilt[0]) > 0.03
    assert np.abs(s.tilt).max() < 0.006
    assert np.abs(s.bias[:3] - bias[:3]).max() < 1e-3
    assert np.abs(s.bias[3:] - bias[3:]).max() < 0.06


def test_a_map_that_is_too_long_turns_the_vertical_less_once_its_lengths_count_as_uncertain() -> None:
    longer, tilts = 1.04, dict[float, list[float]]()
    for length_error in (0.0, longer - 1.0):
        for seed in range(6):
            rng = np.random.default_rng([seed, 2])
            flight = make_flight(seed, 60)
            # Accelerations that the IMU measures are shorter than those in the map; gravity is not. All points are far.
            down = np.einsum("nji,j->ni", flight.T[:, :3, :3], GRAVITY)
            flight = replace(flight, accel=(flight.accel + down) / longer - down, points=5.0 * flight.points)
            smoother = FixedLagSmoother(CAMERA, CALIBRATION, FixedLagConfig())
            smoother.start(flight.pose(0), flight.velocity[0], np.zeros(6), GRAVITY, StartDeviations())
            for k in range(60):
                state = smoother.add(flight.samples(k), see(flight, k + 1, rng, 0.3), length_error=length_error)
                assert state is not None
            tilts.setdefault(length_error, []).append(float(np.abs(state.tilt).max()))
    assert np.mean(tilts[longer - 1.0]) < 0.6 * np.mean(tilts[0.0])


def test_in_dead_reckoning_the_imu_carries_and_the_covariance_grows() -> None:
    flight, states, _ = fly(
        8, 80, FixedLagConfig(), bias=np.array([0.01, 0.0, 0.0, 0.05, 0.0, 0.0]), blind=range(41, 81)
    )
    before, after = states[39], states[-1]
    e = error_of(after, flight.pose(80))
    assert np.linalg.norm(e[3:]) < 0.15
    assert np.trace(after.cov[3:6, 3:6]) > 20.0 * np.trace(before.cov[3:6, 3:6])
    assert e[3:] @ np.linalg.solve(after.cov[3:6, 3:6], e[3:]) < 16.3  # 99.9 % of 3 degrees of freedom


BLIND = range(21, 141)  # 6 s


def test_an_odometer_bounds_dead_reckoning() -> None:
    bias = np.array([0.01, 0.0, 0.0, 0.05, 0.0, 0.0])
    off, plain = [], []
    for seed in (8, 9, 10):
        flight, states, _ = fly(seed, 140, FixedLagConfig(), bias=bias, blind=BLIND, driven=np.zeros(3))
        _, without, _ = fly(seed, 140, FixedLagConfig(), bias=bias, blind=BLIND)
        e = error_of(states[-1], flight.pose(140))
        off.append(np.linalg.norm(e[3:]))
        plain.append(np.linalg.norm(error_of(without[-1], flight.pose(140))[3:]))
        assert e[3:] @ np.linalg.solve(states[-1].cov[3:6, 3:6], e[3:]) < 16.3
        assert np.trace(states[-1].cov[3:6, 3:6]) < np.trace(without[-1].cov[3:6, 3:6])
    assert max(off) < 0.15
    assert np.mean(off) < 0.4 * np.mean(plain)


def test_what_an_odometer_says_against_the_imu_is_passed_over() -> None:
    """A slip of 1.5 m/s from the start on: the flight is the one without, to the last bit."""
    _, states, _ = fly(8, 30, FixedLagConfig(), driven=np.array([1.5, 0.0, 0.0]))
    _, without, _ = fly(8, 30, FixedLagConfig(), driven=np.array([9.0, 0.0, 0.0]))
    np.testing.assert_array_equal(states[-1].T_m_b, without[-1].T_m_b)


def test_an_older_velocity_is_brought_to_the_frame() -> None:
    """Told 40 ms late on a flight that accelerates by 4 m/s^2: with its age known it errs by millimetres a second."""
    flight = make_flight(11, 12)
    smoother = FixedLagSmoother(CAMERA, CALIBRATION, replace(EXACT, velocity_gate=1e9))
    errors = []
    for age_s in (0.04, 0.0):
        smoother.start(flight.pose(0), flight.velocity[0], np.zeros(6), GRAVITY, StartDeviations())
        for k in range(12):
            late = (k + 1) * FRAME_STEPS - round(0.04 / STEP_S)
            value = flight.T[late, :3, :3].T @ flight.velocity[late]
            state = smoother.add(
                flight.samples(k), None, BodyVelocity(value, 1e-8 * np.eye(3), 1e-8 * np.eye(3), age_s)
            )
            assert state is not None
        errors.append(float(np.linalg.norm(state.velocity - flight.velocity[12 * FRAME_STEPS])))
    assert errors[0] < 0.01
    assert errors[1] > 4.0 * errors[0]


def test_a_moved_map_moves_everything() -> None:
    """A flight in a map that is moved on the way ends where the same flight in the unmoved map ends."""
    shift = se3.exp(np.array([0.3, -0.2, 0.1, 0.03, -0.05, 0.4]))
    flight = make_flight(9, 20)
    ends = []
    for move in (False, True):
        rng = np.random.default_rng(5)
        smoother = FixedLagSmoother(CAMERA, CALIBRATION, replace(EXACT, tilt_walk_rad=1e-3, iterations=5))
        smoother.start(flight.pose(0), flight.velocity[0], np.zeros(6), GRAVITY, StartDeviations())
        state = None
        for k in range(20):
            if move and k == 10:
                smoother.move_map(shift)
            points = see(flight, k + 1, rng, 0.3)
            if move and k >= 10:
                points = replace(points, xyz=se3.transform(shift, points.xyz))
            state = smoother.add(flight.samples(k), points)
            assert state is not None
        if move:
            smoother.move_map(se3.inverse(shift))
            state = smoother.state
        assert state is not None
        ends.append(state)
    sigma = np.sqrt(np.diag(ends[0].cov))
    assert np.all(np.abs(error_of(ends[1], ends[0].T_m_b)) < 0.05 * sigma[:6])
    assert np.all(np.abs(ends[1].velocity - ends[0].velocity) < 0.05 * sigma[6:9])
    assert np.all(np.abs(ends[1].bias - ends[0].bias) < 0.05 * sigma[9:15])
    assert np.all(np.abs(ends[1].tilt - ends[0].tilt) < 0.05 * sigma[15:])
    np.testing.assert_allclose(np.sqrt(np.diag(ends[1].cov)), sigma, rtol=0.02)


def test_a_shifted_bias_goes_with_shifted_samples() -> None:
    """Samples that are corrected by a constant from now on change nothing if the bias is shifted by it."""
    change = np.array([0.2, -0.1, 0.3])
    results = []
    for shift in (np.zeros(3), change):
        flight, rng = make_flight(3, 24), np.random.default_rng(4)
        smoother = FixedLagSmoother(CAMERA, CALIBRATION, FixedLagConfig())
        smoother.start(flight.pose(0), flight.velocity[0], np.zeros(6), GRAVITY, StartDeviations())
        for k in range(1, 24):
            samples = flight.samples(k - 1)
            if k == 12:
                smoother.shift_accel_bias(shift)
            if k >= 12:
                samples = Samples(samples.t_s, samples.gyro, samples.accel + shift)
            smoother.add(samples, see(flight, k, rng, 0.3))
        results.append(smoother.state)
    np.testing.assert_allclose(results[1].T_m_b, results[0].T_m_b, atol=1e-7)
    np.testing.assert_allclose(results[1].bias[3:], results[0].bias[3:] + change, atol=1e-6)


def test_outliers_do_not_pull() -> None:
    rng = np.random.default_rng(2)
    flight = make_flight(2, 10)
    smoother = FixedLagSmoother(CAMERA, CALIBRATION, FixedLagConfig())
    smoother.start(flight.pose(0), flight.velocity[0], np.zeros(6), GRAVITY, StartDeviations())
    state = None
    for k in range(10):
        points = see(flight, k + 1, rng, 0.3)
        points.observed[:9, :2] += 40.0
        state = smoother.add(flight.samples(k), points)
    assert state is not None
    assert np.linalg.norm(error_of(state, flight.pose(10))[3:]) < 0.006


def test_nonsense_stops_it() -> None:
    flight = make_flight(2, 2)
    smoother = FixedLagSmoother(CAMERA, CALIBRATION, FixedLagConfig())
    smoother.start(flight.pose(0), flight.velocity[0], np.zeros(6), GRAVITY, StartDeviations())
    samples = flight.samples(0)
    assert smoother.add(Samples(samples.t_s, samples.gyro * np.nan, samples.accel), None) is None
    assert not smoother.running


def test_a_new_map_takes_along_what_is_known() -> None:
    """After 1.5 s blind a map begins: the pose is exact in it, velocity and gravity err as their covariance says."""
    nees = []
    at = se3.from_rt(se3.so3_exp(np.array([0.1, -0.2, 1.0])), np.array([1.0, 2.0, 3.0]))
    for seed in range(16):
        rng = np.random.default_rng([seed, 9])
        bias = np.concatenate([0.01 * rng.normal(size=3), 0.1 * rng.normal(size=3)])
        flight, _, smoother = fly(seed, 40, EXACT, bias=bias, blind=range(11, 41))
        smoother.begin_map(at)
        s = smoother.state
        np.testing.assert_allclose(s.T_m_b, at, atol=1e-9)
        turn = at[:3, :3] @ flight.pose(40)[:3, :3].T  # the new map as the truth sees it
        tilt = tilt_of(turn @ GRAVITY)
        e = np.concatenate([turn @ flight.velocity[400] - s.velocity, bias - s.bias, tilt - s.tilt])
        nees.append(e @ np.linalg.solve(s.cov[6:, 6:], e))
        assert smoother.add(flight.samples(38), None) is not None
    assert 8.0 < np.mean(nees) < 15.0  # 11 degrees of freedom, 99.9 % of the mean of 16


@pytest.mark.parametrize("gravity", [(-9.8, 0.3, 0.2), (0.1, -0.2, -9.8), (0.0, 9.7, 1.0), (0.5, -0.7, 9.7)])
def test_turns_of_gravity_are_told_as_changes_of_the_tilt(gravity: tuple[float, float, float]) -> None:
    down = np.array(gravity) / np.linalg.norm(gravity)
    across = tangent(down)
    by_direction = tilt_by_direction(np.array(gravity), across)
    for k in range(2):
        turned = [tilt_of(down + sign * 1e-5 * across[:, k]) for sign in (-1.0, 1.0)]
        np.testing.assert_allclose(by_direction[:, k], (turned[1] - turned[0]) / 2e-5, rtol=1e-3, atol=1e-3)
