"""Delayed initialisation: points by rays, their covariance, and what is refused."""

from functools import cache

import numpy as np

from kiteline_agent.ekf.ekf_slam import _RESIDUAL_GATE
from kiteline_agent.ekf.filter_state import FilterState
from kiteline_agent.ekf.ray_initialisation import (
    Rays,
    RayTrack,
    distance_share,
    linearised,
    new_landmark,
    project,
    rays_meet,
)
from kiteline_agent.ekf.ray_kernels import position_by_rays, supporting_views
from kiteline_agent.ekf.ray_update import update_by_rays
from kiteline_agent.ekf_config import EkfConfig
from kiteline_bench.papers import simulated_vehicle as vehicle
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3

_POINT = np.array([5.0, 2.0, 1.0])
_SIGMA = 0.7 / 400.0


@cache
def _loop(planar: bool) -> F64:
    return vehicle.loop(planar)[:21]


def _cameras() -> F64:
    return _loop(planar=False)[0:20:4] @ vehicle.camera().T_b_c


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
    seen, agrees = np.ones((1, len(xy)), np.bool_), np.empty((1, len(xy)), np.bool_)
    supporting_views(np.ascontiguousarray(cameras[:, :3, 3]), rays[None], seen, 0.02, agrees)
    assert agrees[0].tolist() == [True, True, False, True, True]


def test_supporting_views_are_those_of_plain_numpy() -> None:
    rng, cameras = np.random.default_rng(0), _cameras()
    centres, v = np.ascontiguousarray(cameras[:, :3, 3]), len(cameras)
    points = _POINT + rng.uniform(-2.0, 2.0, (30, 3))
    rays = points[:, None] - centres + rng.choice([0.02, 0.4], (30, v, 1)) * rng.standard_normal((30, v, 3))
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    seen = rng.random((30, v)) < 0.8
    agrees = np.empty((30, v), np.bool_)
    supporting_views(centres, rays, seen, 0.02, agrees)
    for k in range(30):
        best = np.zeros(v, np.bool_)
        for other in np.flatnonzero(seen[k, :-1]).tolist():
            across = np.eye(3) - rays[k, [other, -1], :, None] * rays[k, [other, -1], None, :]
            point = np.linalg.solve(across.sum(axis=0), np.einsum("vij,vj->i", across, centres[[other, -1]]))
            along = ((point - centres) * rays[k]).sum(axis=1)
            off = np.linalg.norm(point - centres - along[:, None] * rays[k], axis=1)
            near = seen[k] & (along > 0.0) & (off < 0.02 * along)
            if near[-1] and near.sum() > best.sum():
                best = near
        np.testing.assert_array_equal(agrees[k], best)


def _drawn(
    model: vehicle.VehicleModel, rng: np.random.Generator, points: F64 = _POINT[None]
) -> tuple[FilterState, list[RayTrack]]:
    """A state whose four views and pose drifted by odometry, and the tracks of points (n,3) that all five saw."""
    cam = vehicle.camera()
    poses = _loop(model.planar)
    state = FilterState(cam.T_b_c, EkfConfig(scale_sigma=model.scale_sigma))
    scale = 1.0 + model.scale_sigma * rng.standard_normal()
    seen = []
    for k in range(13):
        if k > 0:
            state.propagate(vehicle.odometry(model, poses[k - 1], poses[k], scale, k, cam.T_b_c, rng)[1])
        if k % 3 == 0:
            seen.append([_seen(poses[k : k + 1] @ cam.T_b_c, point)[0] for point in points])
            if k < 12:
                state.add_view(k // 3)
    observations = np.array(seen).swapaxes(0, 1) + _SIGMA * rng.standard_normal((len(points), 5, 2))
    return state, [RayTrack(np.arange(4), xy, _SIGMA) for xy in observations]


def _rays(state: FilterState, track: RayTrack) -> Rays:
    rays = linearised(state, track, state.T_o_c, state.view_T_o_c)
    assert rays is not None
    return rays


def test_errors_of_new_landmarks_are_as_their_covariance_says() -> None:
    """Mean normalised error of landmarks by poses that drift, over 150 draws."""
    model, rng, nees = vehicle.VehicleModel(planar=False, turn_noise=0.003), np.random.default_rng(0), []
    for _ in range(150):
        state, (track,) = _drawn(model, rng)
        new = new_landmark(state, _rays(state, track))
        state.add_landmark(0, *new, walk=0.0)
        error = new.point - _POINT
        rows = np.array([3, 4, 5, *(int(state.landmark_row(0)) + np.arange(3))])
        to_error = np.concatenate([-se3.skew(state.points[0]), np.eye(3)], axis=1)
        cov = to_error @ state.rows(rows)[:, rows] @ to_error.T
        nees.append(error @ np.linalg.solve(cov, error))
    assert 2.4 < np.mean(nees) < 3.7


def test_distance_that_rays_do_not_tell_and_rays_that_do_not_meet_are_known() -> None:
    model, rng = vehicle.VehicleModel(planar=True, turn_noise=0.001), np.random.default_rng(0)
    state, (track,) = _drawn(model, rng)
    assert rays_meet(state, _rays(state, track), _RESIDUAL_GATE)
    assert 0.001 < distance_share(state, _rays(state, track)) < 0.1
    track.xy[1, 1] += 10.0 * _SIGMA
    assert not rays_meet(state, _rays(state, track), _RESIDUAL_GATE)


def _direction_errors(wrong: int, noisy: bool) -> tuple[float, float, float]:
    """RMS error of the direction of motion in rad, before and after tracks correct it, and the NEES of the pose after.

    wrong: of eight tracks are wrong matches.
    """
    model = vehicle.VehicleModel(planar=False, path_noise=0.1 if noisy else 0.03, turn_noise=0.01)
    rng, cam, before, after, nees = np.random.default_rng(1), vehicle.camera(), [], [], []
    points = _POINT + rng.uniform([-2.0, -1.5, -1.0], [2.0, 1.5, 1.0], (8, 3))
    truth = _loop(planar=False)[12] @ cam.T_b_c
    for _ in range(40):
        state, tracks = _drawn(model, rng, points)
        for track in tracks[:wrong]:
            track.xy[2:] += 0.02
        before.append(_angle(state.T_o_c, truth))
        update_by_rays(state, tracks)
        after.append(_angle(state.T_o_c, truth))
        T = state.T_o_c
        error = np.concatenate([truth[:3, 3] - T[:3, 3], se3.so3_log(T[:3, :3].T @ truth[:3, :3])])
        nees.append(error @ np.linalg.solve(state.pose_covariance(np.eye(4)), error))
    return float(np.sqrt(np.mean(np.square(before)))), float(np.sqrt(np.mean(np.square(after)))), float(np.mean(nees))


def _angle(T_o_c: F64, truth: F64) -> float:
    start = _loop(planar=False)[0] @ vehicle.camera().T_b_c
    a, b = T_o_c[:3, 3] - start[:3, 3], truth[:3, 3] - start[:3, 3]
    return float(np.linalg.norm(np.cross(a, b)) / (np.linalg.norm(a) * np.linalg.norm(b)))


def test_tracks_that_are_no_landmarks_tell_where_the_vehicle_went() -> None:
    """Over 40 draws, as sure as its covariance says, by good odometry and by one that is a tenth off."""
    for noisy, share in ((False, 0.65), (True, 0.3)):
        before, after, nees = _direction_errors(0, noisy)
        assert after < share * before
        assert 4.0 < nees < 8.0


def test_wrong_matches_are_outvoted() -> None:
    before, after, _ = _direction_errors(2, noisy=True)
    assert after < 0.65 * before
