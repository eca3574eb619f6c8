"""The filter along simulated loops: accuracy, honesty, wrong matches, determinism, and the limits of its state."""

from copy import deepcopy
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from kiteline_agent.ekf import landmark_update
from kiteline_agent.ekf.ekf_slam import EkfSlam
from kiteline_agent.ekf.filter_state import FilterState, OdometryMotion
from kiteline_agent.ekf.odometer_motion import OdometerMotion, camera_motion
from kiteline_agent.ekf_config import EkfConfig
from kiteline_bench.papers import ekf
from kiteline_bench.papers import simulated_vehicle as vehicle
from kiteline_core.frame import OdometryBatch
from kiteline_core.geometry import se3


@pytest.mark.parametrize(("planar", "wrong", "seed"), [(True, 0.3, 1), (False, 0.3, 1)])
def test_loop_is_closer_than_odometry_and_errs_as_it_says(planar: bool, wrong: float, seed: int) -> None:
    model = vehicle.VehicleModel(planar, wrong=wrong)
    flown = ekf.fly(model, seed)
    assert flown.rmse_m < 0.35 * flown.odometry_m
    assert flown.nees < 2.5 * (3 if planar else 6)


def _flown(frames: list[vehicle.SimulatedFrame], config: EkfConfig) -> EkfSlam:
    slam = EkfSlam(vehicle.camera(), config)
    for frame in frames:
        if frame.motion is not None:
            slam.predict(frame.motion)
        slam.update(frame.ids, frame.uv)
    return slam


@cache
def _full_state() -> FilterState:
    """A state whose covariance takes more than one panel."""
    config = replace(EkfConfig(scale_sigma=0.0, walk_px=0.0), landmarks=40)
    return _flown(vehicle.flight(vehicle.VehicleModel(planar=False), 0, laps=0.4), config).state


def test_observations_correct_the_whole_state_as_dense_matrices_do() -> None:
    state = deepcopy(_full_state())
    before, slots = state.covariance(np.arange(state.size)), np.flatnonzero(state.used)
    assert state.size > 140
    local = (state.points[slots] - state.T_o_c[:3, 3]) @ state.T_o_c[:3, :3]
    slots = slots[local[:, 2] > 0.1][:9]
    xy = np.random.default_rng(0).standard_normal((len(slots), 2))
    found, ahead = landmark_update.innovation(state, slots, xy, np.linspace(1.0, 2.0, len(slots)), 0.002)
    assert ahead.all()
    H = np.zeros((2 * len(slots), state.size))
    for k, slot in enumerate(slots.tolist()):
        first = int(state.landmark_row(slot))
        H[2 * k : 2 * k + 2, :3], H[2 * k : 2 * k + 2, first : first + 3] = -found.M[k], found.M[k]
    S = H @ before @ H.T + 0.002**2 * np.eye(len(H))
    np.testing.assert_allclose(found.S, S, atol=1e-12)
    chosen = np.array([1, 3, 4, 7, 8])
    landmark_update.update(state, found.part(chosen))
    rows = (2 * chosen[:, None] + [0, 1]).ravel()
    gain = np.linalg.solve(S[np.ix_(rows, rows)], H[rows] @ before).T
    np.testing.assert_allclose(state.covariance(np.arange(state.size)), before - gain @ H[rows] @ before, atol=1e-10)


def test_white_errors_of_a_motion_move_camera_and_map_as_dense_matrices_do() -> None:
    state = deepcopy(_full_state())
    before = state.covariance(np.arange(state.size))
    a = 0.01 * np.random.default_rng(1).standard_normal((6, 6))
    step = np.array([0.3, -0.1, 0.2])
    R0 = state.T_o_c[:3, :3]
    state.propagate(OdometryMotion(se3.exp(np.append(step, [0.1, -0.2, 0.05])), step, a @ a.T))
    R1, p1 = state.T_o_c[:3, :3], state.T_o_c[:3, 3]
    by_error = np.zeros((state.size, 6))
    by_error[:3, :3], by_error[:3, 3:], by_error[3:6, 3:] = R0, se3.skew(p1) @ R1, R1
    for slot in np.flatnonzero(state.used).tolist():
        first = int(state.landmark_row(slot))
        by_error[first : first + 3, 3:] = se3.skew(state.points[slot]) @ R1
    after = state.covariance(np.arange(state.size))
    np.testing.assert_allclose(after, before + by_error @ a @ a.T @ by_error.T, atol=1e-12)


def test_full_state_lets_go_of_what_is_out_of_view() -> None:
    config = replace(EkfConfig(), landmarks=30)
    slam = _flown(vehicle.flight(vehicle.VehicleModel(planar=True), 0, laps=0.4), config)
    assert 20 <= int(slam.state.used.sum()) <= 30
    assert sorted(slam.slot_of.values()) == np.flatnonzero(slam.state.used).tolist()
    assert (np.diagonal(slam.state.P) >= 0.0).all()
    assert np.linalg.eigvalsh(slam.state.covariance(np.arange(slam.state.size))).min() > -1e-12


def test_vehicle_that_sees_nothing_follows_its_odometry() -> None:
    slam, poses, none = EkfSlam(vehicle.camera(), EkfConfig()), vehicle.loop(planar=True), np.zeros(0, np.int64)
    cam = vehicle.camera()
    for before, after in pairwise(poses[:41]):
        motion = camera_motion(se3.inverse(before) @ after, 1e-6 * np.eye(6), cam.T_b_c)
        slam.predict(motion)
        slam.update(none, np.zeros((0, 2)))
    np.testing.assert_allclose(slam.state.T_o_c @ se3.inverse(cam.T_b_c), poses[40], atol=1e-9)


def test_an_odometer_whose_covariance_is_none_does_not_end_the_flight() -> None:
    """Correlations of -0.9 between each two axes pass for themselves; all three together cannot be."""
    t_ns = np.arange(20) * 20_000_000
    cov = 0.04 * np.array([[1.0, -0.9, -0.9], [-0.9, 1.0, -0.9], [-0.9, -0.9, 1.0]])
    odometer = OdometerMotion(np.eye(4), EkfConfig(), keep_s=5.0, max_gap_s=0.5)
    odometer.add(
        OdometryBatch(t_ns, np.full((20, 3), 0.5), np.zeros((20, 3)), np.tile(cov, (20, 1, 1)), np.zeros((20, 3, 3)))
    )
    state = FilterState(np.eye(4), EkfConfig())
    state.propagate(odometer.between(100_000_000, 200_000_000))
    assert odometer.measured
    assert np.linalg.eigvalsh(state.covariance(np.arange(6)))[0] > -1e-12
    assert 1e-4 < state.covariance(np.arange(3))[0, 0] < 1e-3


def test_prediction_moves_the_covariance_as_perturbed_motions_do() -> None:
    """Against draws: pose and landmark relative to it, after white errors and an error of the scale."""
    rng, config = np.random.default_rng(0), EkfConfig(scale_sigma=0.02)
    motion = OdometryMotion(
        se3.exp(np.array([0.3, -0.1, 0.2, 0.1, -0.2, 0.05])), np.array([0.3, -0.1, 0.2]),
        np.diag([1e-4, 2e-4, 3e-4, 1e-4, 2e-4, 1e-4]),
    )  # fmt: skip
    start = se3.exp(np.array([1.0, 2.0, 0.5, 0.3, 0.1, 0.6]))
    state = FilterState(start, config)
    state.propagate(motion)
    draws = []
    for _ in range(20_000):
        error = np.sqrt(np.diagonal(motion.cov)) * rng.standard_normal(6)
        moved = motion.T_c0_c1.copy()
        moved[:3, 3] += 0.02 * rng.standard_normal() * motion.scaled + error[:3]
        moved[:3, :3] = moved[:3, :3] @ se3.so3_exp(error[3:])
        draws.append(ekf.pose_error(start @ moved, state.T_o_c))
    np.testing.assert_allclose(state.pose_covariance(np.eye(4)), np.cov(np.array(draws).T), atol=2e-5)
