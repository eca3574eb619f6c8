"""Delayed initialisation: points by rays, their covariance, and what is refused."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.ekf.filter_state import FilterState
from kiteline_agent.ekf.ray_initialisation import initialise, project, supporting_views
from kiteline_agent.ekf.ray_kernels import position_by_rays
from kiteline_agent.ekf_config import EkfConfig
from kiteline_bench.papers import simulated_vehicle as vehicle

F64 = NDArray[np.float64]

_POINT = np.array([5.0, 2.0, 1.0])
_SIGMA = 0.7 / 400.0


def _cameras() -> F64:
    return vehicle.loop(planar=False)[0:20:4] @ vehicle.camera().T_b_c


def _seen(cameras: F64, point: F64 = _POINT) -> F64:
    return -project(np.zeros((len(cameras), 2)), cameras, point)[0]


def test_jacobian_is_that_of_the_projection() -> None:
    cameras = _cameras()
    xy = _seen(cameras)
    _, jacobian, _ = project(xy, cameras, _POINT)
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        by_difference = -(project(xy, cameras, _POINT + step)[0] - project(xy, cameras, _POINT - step)[0]) / 2e-6
        np.testing.assert_allclose(jacobian[:, :, axis], by_difference, atol=1e-8)


def test_exact_rays_meet_in_the_point() -> None:
    for point in (_POINT, np.array([50.0, 15.0, 3.0])):
        found = np.empty(3)
        assert position_by_rays(_seen(_cameras(), point), _cameras(), found)
        np.testing.assert_allclose(found, point, rtol=1e-6)


def test_position_has_the_least_reprojection_error() -> None:
    cameras, rng = _cameras(), np.random.default_rng(0)
    xy = _seen(cameras) + _SIGMA * rng.standard_normal((len(cameras), 2))
    found = np.empty(3)
    assert position_by_rays(xy, cameras, found)
    residual, jacobian, _ = project(xy, cameras, found)
    gradient = jacobian.reshape(-1, 3).T @ residual.ravel()
    scale = np.linalg.norm(jacobian.reshape(-1, 3), axis=0) * np.linalg.norm(residual)
    assert (np.abs(gradient) < 1e-3 * scale).all()


def test_parallel_rays_and_points_behind_are_refused() -> None:
    cameras, found = _cameras(), np.empty(3)
    same = np.repeat(cameras[:1], 5, axis=0)
    assert not position_by_rays(_seen(same), same, found)
    behind = cameras[0, :3, 3] - 4.0 * cameras[0, :3, 2]
    assert not position_by_rays(_seen(cameras, behind), cameras, found)


def test_wrong_match_does_not_support_the_point() -> None:
    cameras = _cameras()
    xy = _seen(cameras)
    xy[2] += 0.3
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    rays = np.einsum("vij,vj->vi", cameras[:, :3, :3], rays)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    seen = np.ones((1, len(xy)), np.bool_)
    assert supporting_views(cameras[:, :3, 3], rays[None], seen, 0.02)[0].tolist() == [True, True, False, True, True]


def _drawn(model: vehicle.VehicleModel, rng: np.random.Generator) -> tuple[FilterState, F64]:
    """A state whose five views and pose drifted by odometry, and the sightings of the point in them."""
    cam = vehicle.camera()
    poses = vehicle.loop(model.planar)
    state = FilterState(cam.T_b_c, EkfConfig(scale_sigma=model.scale_sigma))
    scale = 1.0 + model.scale_sigma * rng.standard_normal()
    seen = []
    for k in range(13):
        if k > 0:
            state.propagate(vehicle.odometry(model, poses[k - 1], poses[k], scale, k, cam.T_b_c, rng)[1])
        if k % 3 == 0:
            seen.append(_seen(poses[k : k + 1] @ cam.T_b_c)[0])
            if k < 12:
                state.add_view(k // 3)
    return state, np.array(seen) + _SIGMA * rng.standard_normal((5, 2))


def test_errors_of_new_landmarks_are_as_their_covariance_says() -> None:
    """Mean normalised error of landmarks by poses that drift, over 150 draws."""
    model, config = vehicle.VehicleModel(planar=False, turn_noise=0.003), EkfConfig(depth_share=1.0, residual_gate=9.0)
    rng, nees = np.random.default_rng(0), []
    for _ in range(150):
        state, xy = _drawn(model, rng)
        new = initialise(state, np.arange(4), xy, _SIGMA, config)
        assert new is not None
        state.add_landmark(0, new.point, new.across, new.cov)
        error = new.point - _POINT
        nees.append(error @ np.linalg.solve(state.landmark_covariance(0), error))
    assert 2.4 < np.mean(nees) < 3.7


def test_distance_that_rays_do_not_tell_and_rays_that_do_not_meet_are_refused() -> None:
    model, rng = vehicle.VehicleModel(planar=True, turn_noise=0.001), np.random.default_rng(0)
    state, xy = _drawn(model, rng)
    assert initialise(state, np.arange(4), xy, _SIGMA, EkfConfig()) is not None
    assert initialise(state, np.arange(4), xy, _SIGMA, EkfConfig(depth_share=0.001)) is None
    xy[1, 1] += 10.0 * _SIGMA
    assert initialise(state, np.arange(4), xy, _SIGMA, EkfConfig()) is None
