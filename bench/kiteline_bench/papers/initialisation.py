"""A landmark's position by its rays against 100 particles along the first one, at the same instant.

Where odometry tells the poses, rays and poses correct each other, as in the filter when it lets a landmark in. Beside
both stands the Cramer-Rao bound of these observations, which no unbiased estimator of the landmark is below.
"""

import time
from dataclasses import dataclass

import numpy as np

from kiteline_agent.ekf.filter_state import FilterState, OdometryMotion
from kiteline_agent.ekf.ray_initialisation import RayTrack, linearised
from kiteline_agent.ekf.ray_kernels import position_by_rays
from kiteline_agent.ekf.ray_update import update_by_rays
from kiteline_agent.ekf_config import EkfConfig
from kiteline_bench.papers import simulated_vehicle as vehicle
from kiteline_bench.papers.particle_kernels import position_by_particles
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3

PARTICLES = 100
_DRAWS = 300
_REPEATS = 20  # of each position while CPU time is taken: one call is shorter than the clock is fine
_NORMALS = 500  # draws of an error with a given covariance
_STEP_M = 0.1
_LEAST_PARALLAX = 0.05  # rad, as the filter wants it


@dataclass(frozen=True, slots=True)
class Setting:
    """Landmarks at near_m to far_m, seen over way_m; particles up to range_m. odometry: poses are told by it."""

    name: str
    planar: bool
    near_m: float
    far_m: float
    way_m: float
    range_m: float
    odometry: bool


@dataclass(frozen=True, slots=True)
class Outcome:
    """Mean errors in m, and CPU in us of one position with poses that are taken as known.

    bound_m: mean error of an estimator that reaches the Cramer-Rao bound.
    """

    setting: Setting
    rays_m: float
    particles_m: float
    bound_m: float
    rays_us: float
    particles_us: float


def compare(setting: Setting) -> Outcome:
    """Both, on the same observations."""
    rng, cam = np.random.default_rng(0), vehicle.camera()
    model = vehicle.VehicleModel(setting.planar)
    poses, sigma = vehicle.loop(setting.planar), model.sigma_px / cam.fx
    errors, cpu = np.zeros((_DRAWS, 3)), np.zeros(2)
    unit = np.random.default_rng(1).standard_normal((_NORMALS, 3))
    rays, particles = np.empty(3), np.empty(3)
    for n in range(_DRAWS):
        true, told, motions = _way(setting, model, poses, rng)
        point, xy = _landmark(setting, true, sigma, rng)
        if n == 0:  # compiles
            position_by_rays(xy, told, rays)
            position_by_particles(xy, told, sigma, setting.range_m, PARTICLES, particles)
        begin = time.process_time_ns()
        for _ in range(_REPEATS):
            found = position_by_rays(xy, told, rays)
        middle = time.process_time_ns()
        for _ in range(_REPEATS):
            position_by_particles(xy, told, sigma, setting.range_m, PARTICLES, particles)
        cpu += middle - begin, time.process_time_ns() - middle
        if found and setting.odometry:
            found = _enters(motions, xy, sigma, rays)
        # A position that the rays refuse is no landmark; the particles are spared there, too.
        errors[n] = np.nan
        if found:
            least = unit @ np.linalg.cholesky(bound(model, true, point, sigma, odometry=setting.odometry)).T
            errors[n] = [np.linalg.norm(at, axis=-1).mean() for at in (rays - point, particles - point, least)]
    mean = np.nanmean(errors, axis=0)
    us = cpu * 1e-3 / (_DRAWS * _REPEATS)
    return Outcome(setting, float(mean[0]), float(mean[1]), float(mean[2]), float(us[0]), float(us[1]))


def bound(model: vehicle.VehicleModel, T_o_c: F64, point: F64, sigma: float, *, odometry: bool) -> F64:
    """Cramer-Rao bound (3,3) in m^2 of a point (3,) seen from cameras T_o_c (n,4,4) with a deviation sigma.

    odometry: the poses after the first one are known by the odometry of the model, else exactly.
    """
    n = len(T_o_c)
    local = np.einsum("kji,kj->ki", T_o_c[:, :3, :3], point - T_o_c[:, :3, 3])
    of_local = np.zeros((n, 2, 3))  # derivatives of x/z, y/z
    of_local[:, 0, 0] = of_local[:, 1, 1] = 1.0 / local[:, 2]
    of_local[:, :, 2] = -local[:, :2] / local[:, 2:] ** 2
    of_point = of_local @ T_o_c[:, :3, :3].transpose(0, 2, 1)
    noise = sigma**2 * np.eye(2 * n)
    if odometry:
        T_o_b = T_o_c @ se3.inverse(vehicle.camera().T_b_c)
        for k in range(1, n):  # the error of a motion moves all later cameras beside the point
            way = float(np.linalg.norm(T_o_b[k, :3, 3] - T_o_b[k - 1, :3, 3]))
            moved = np.concatenate([T_o_b[k - 1, :3, :3], se3.skew(point - T_o_b[k, :3, 3]) @ T_o_b[k, :3, :3]], axis=1)
            of_motion = np.zeros((n, 2, 6))
            of_motion[k:] = of_point[k:] @ moved
            flat = of_motion.reshape(2 * n, 6)
            noise += flat @ vehicle.odometry_covariance(model, way) @ flat.T
    A = of_point.reshape(2 * n, 3)
    return np.asarray(np.linalg.inv(A.T @ np.linalg.solve(noise, A)))


def _way(
    setting: Setting, model: vehicle.VehicleModel, poses: F64, rng: np.random.Generator
) -> tuple[F64, F64, list[OdometryMotion]]:
    """Camera poses (n,4,4) along a part of the loop, true and as they are told; n - 1 motions if odometry tells."""
    count = round(setting.way_m / _STEP_M) + 1
    begin = int(rng.integers(0, len(poses) - count))
    part = se3.inverse(poses[begin]) @ poses[begin : begin + count]
    T_b_c = vehicle.camera().T_b_c
    true = part @ T_b_c
    if not setting.odometry:
        return true, true, []
    told, motions = [np.eye(4)], []
    for k in range(1, count):
        T_b0_b1, motion = vehicle.odometry(model, part[k - 1], part[k], 1.0, k, T_b_c, rng)
        told.append(told[-1] @ T_b0_b1)
        motions.append(motion)
    return true, np.array(told) @ T_b_c, motions


def _enters(motions: list[OdometryMotion], xy: F64, sigma: float, point: F64) -> bool:
    """Set the point (3,) with which the filter lets a landmark in; False if it does not.

    xy: (n,2) observations before, between and after n - 1 motions. Each frame is a view of the filter, whose poses the
    rays correct first.
    """
    count = len(motions)
    state = FilterState(vehicle.camera().T_b_c, EkfConfig(landmarks=1, views=count, scale_sigma=0.0))
    for view, motion in enumerate(motions):
        state.add_view(view)
        state.propagate(motion)
    track = RayTrack(np.arange(count), xy, sigma)
    update_by_rays(state, [track])
    rays = linearised(state, track, state.T_o_c, state.view_T_o_c)
    if rays is None:
        return False
    point[:] = rays.point
    return True


def _landmark(setting: Setting, T_o_c: F64, sigma: float, rng: np.random.Generator) -> tuple[F64, F64]:
    """A point (3,) that all poses see under enough parallax, and its noisy observations (n,2)."""
    cam = vehicle.camera()
    half = np.array([cam.cx / cam.fx, cam.cy / cam.fy])
    while True:
        ray = np.append(rng.uniform(-half, half), 1.0)
        ray *= rng.uniform(setting.near_m, setting.far_m) / np.linalg.norm(ray)
        point = T_o_c[0, :3, :3] @ ray + T_o_c[0, :3, 3]
        to_point = point - T_o_c[:, :3, 3]
        local = np.einsum("vji,vj->vi", T_o_c[:, :3, :3], to_point)
        xy = local[:, :2] / np.maximum(local[:, 2:], 1e-3)
        rays = to_point / np.linalg.norm(to_point, axis=1, keepdims=True)
        wide = np.arccos(np.clip((rays @ rays[-1]).min(), -1.0, 1.0)) > _LEAST_PARALLAX
        if wide and bool((local[:, 2] > 0.3).all()) and bool((np.abs(xy) < half).all()):
            return point, xy + sigma * rng.standard_normal(xy.shape)
