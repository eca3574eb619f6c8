"""A landmark's position by its rays against 100 particles along the first one, at the same instant."""

import time
from dataclasses import dataclass

import numpy as np

from kiteline_agent.ekf.ray_kernels import position_by_rays
from kiteline_bench.papers import simulated_vehicle as vehicle
from kiteline_bench.papers.particle_kernels import position_by_particles
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3

PARTICLES = 100
_DRAWS = 300
_REPEATS = 20  # of each position while CPU time is taken: one call is shorter than the clock is fine
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
    """Mean errors in m, and CPU of one position in us."""

    setting: Setting
    rays_m: float
    particles_m: float
    rays_us: float
    particles_us: float


def compare(setting: Setting) -> Outcome:
    """Both, on the same observations."""
    rng, cam = np.random.default_rng(0), vehicle.camera()
    model = vehicle.VehicleModel(setting.planar)
    poses, sigma = vehicle.loop(setting.planar), model.sigma_px / cam.fx
    errors, cpu = np.zeros((_DRAWS, 2)), np.zeros(2)
    rays, particles = np.empty(3), np.empty(3)
    for n in range(_DRAWS):
        true, told = _way(setting, model, poses, rng)
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
        # A position that the rays refuse is no landmark; the particles are spared there, too.
        errors[n] = [np.linalg.norm(at - point) for at in (rays, particles)] if found else np.nan
    mean = np.nanmean(errors, axis=0)
    us = cpu * 1e-3 / (_DRAWS * _REPEATS)
    return Outcome(setting, float(mean[0]), float(mean[1]), float(us[0]), float(us[1]))


def _way(setting: Setting, model: vehicle.VehicleModel, poses: F64, rng: np.random.Generator) -> tuple[F64, F64]:
    """Camera poses (n,4,4) along a part of the loop, true and as they are told."""
    count = round(setting.way_m / _STEP_M) + 1
    begin = int(rng.integers(0, len(poses) - count))
    part = se3.inverse(poses[begin]) @ poses[begin : begin + count]
    T_b_c = vehicle.camera().T_b_c
    true = part @ T_b_c
    if not setting.odometry:
        return true, true
    told = [np.eye(4)]
    for k in range(1, count):
        told.append(told[-1] @ vehicle.odometry(model, part[k - 1], part[k], 1.0, k, T_b_c, rng)[0])
    return true, np.array(told) @ T_b_c


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
