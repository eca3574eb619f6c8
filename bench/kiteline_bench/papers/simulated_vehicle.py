"""A vehicle with one camera and odometry in a world of points: a ground robot or a drone, without images."""

from dataclasses import dataclass, replace

import numpy as np

from kiteline_agent.ekf.filter_state import OdometryMotion
from kiteline_agent.ekf.odometer_motion import camera_motion
from kiteline_core.arrays import F64, I64
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera

# forward, left, up -> right, down, forward
_R_B_C = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
LOOP_M = 60.0
_STEP_M = 0.1  # between two frames: 1 m/s at 10 Hz
_POINTS = 900
_NEAR_M, _FAR_M = 0.5, 60.0
_GROSS_PX = 200.0  # largest error of a wrong match along each axis; half of them fall on other landmarks


@dataclass(frozen=True, slots=True)
class VehicleModel:
    """What a simulated vehicle is like, and how its sensors err.

    planar: a ground robot. sigma_px: of a pixel. path_noise, turn_noise: m and rad per sqrt(m) of way. scale_sigma:
    relative, drawn once a run. slip: share of the way lost, in stretches of a metre. turn_bias: rad per m of way.
    wrong: share of wrong matches. focal_error: relative error of the calibrated focal length. seen: most landmarks in
    a frame.
    """

    planar: bool
    sigma_px: float = 0.7
    path_noise: float = 0.02
    turn_noise: float = 0.01
    scale_sigma: float = 0.005
    slip: float = 0.0
    turn_bias: float = 0.0
    wrong: float = 0.0
    focal_error: float = 0.0
    seen: int = 60


@dataclass(frozen=True, slots=True)
class SimulatedFrame:
    """True body pose, odometry since the frame before, and what the camera sees: ids increasing (n,), uv (n,2) px."""

    T_o_b: F64
    motion: OdometryMotion | None
    T_b0_b1: F64  # by odometry
    ids: I64
    uv: F64


def camera() -> RectifiedCamera:
    """640x480, 77 degrees wide, looking forward from 0.2 m ahead of the body's origin."""
    T_b_c = se3.from_rt(_R_B_C, np.array([0.2, 0.0, 0.3]))
    return RectifiedCamera(640, 480, 400.0, 400.0, 319.5, 239.5, 0.1, False, T_b_c)


def loop(planar: bool, laps: float = 1.0) -> F64:
    """Body poses (n,4,4) along a rounded loop of 60 m; a drone climbs, sinks and leans in it. The first is I."""
    n = round(laps * LOOP_M / _STEP_M)
    radius = LOOP_M / (2.0 * np.pi)
    out = np.tile(np.eye(4), (n + 1, 1, 1))
    for k in range(n + 1):
        angle = k * _STEP_M / radius
        lean = np.zeros(3) if planar else np.array([0.12 * np.sin(5 * angle), 0.10 * np.sin(7 * angle), 0.0])
        out[k, :3, :3] = se3.so3_exp(np.array([0.0, 0.0, angle])) @ se3.so3_exp(lean)
        height = 0.0 if planar else 1.5 * np.sin(3.0 * angle)
        out[k, :3, 3] = radius * np.sin(angle), radius * (1.0 - np.cos(angle)), height
    return np.asarray(se3.inverse(out[0]) @ out)


def world(rng: np.random.Generator) -> F64:
    """Points (n,3) on both sides of the loop, a few of them far away."""
    radius = LOOP_M / (2.0 * np.pi)
    angle = rng.uniform(0.0, 2.0 * np.pi, _POINTS)
    side = np.where(rng.random(_POINTS) < 0.5, rng.uniform(2.0, 6.0, _POINTS), -rng.uniform(2.0, 7.0, _POINTS))
    side = np.where(rng.random(_POINTS) < 0.1, rng.uniform(15.0, 45.0, _POINTS), side)
    out = radius + side
    return np.stack(
        [out * np.sin(angle), radius - out * np.cos(angle), rng.uniform(-1.5, 3.5, _POINTS)], axis=1
    )  # fmt: skip


def flight(model: VehicleModel, seed: int, laps: float = 1.0) -> list[SimulatedFrame]:
    """All frames of a run."""
    rng = np.random.default_rng(seed)
    points, poses, cam = world(rng), loop(model.planar, laps), camera()
    believed = cam
    seen_by = replace(cam, fx=cam.fx * (1.0 + model.focal_error), fy=cam.fy * (1.0 + model.focal_error))
    scale = 1.0 + model.scale_sigma * rng.standard_normal()
    frames = []
    in_view: I64 = np.zeros(0, np.int64)
    for k, T_o_b in enumerate(poses):
        motion, by_odometry = None, np.eye(4)
        if k > 0:
            by_odometry, motion = odometry(model, poses[k - 1], T_o_b, scale, k, believed.T_b_c, rng)
        ids, uv = _observations(model, points, T_o_b @ cam.T_b_c, seen_by, in_view, rng)
        in_view = ids
        frames.append(SimulatedFrame(T_o_b, motion, by_odometry, ids, uv))
    return frames


def odometry(
    model: VehicleModel, before: F64, after: F64, scale: float, k: int, T_b_c: F64, rng: np.random.Generator
) -> tuple[F64, OdometryMotion]:
    """Body motion (4,4) that the odometry tells, and the camera's with its covariance. scale: true over told."""
    true = se3.inverse(before) @ after
    way = float(np.linalg.norm(true[:3, 3]))
    cov = odometry_covariance(model, way)
    error = np.sqrt(np.diagonal(cov)) * rng.standard_normal(6)
    told = np.eye(4)
    told[:3, :3] = true[:3, :3] @ se3.so3_exp(error[3:] + model.turn_bias * way * np.array([0.0, 0.0, 1.0]))
    slips = model.slip > 0.0 and (k * _STEP_M) % 6.0 < 1.0
    told[:3, 3] = (true[:3, 3] / scale + error[:3]) * (1.0 + model.slip if slips else 1.0)
    return told, camera_motion(told, cov, T_b_c)


def odometry_covariance(model: VehicleModel, way_m: float) -> F64:
    """Covariance (6,6) of what odometry tells of a motion: translation in m and rotation in rad, in the body."""
    axes = np.array([1.0, 1.0, 0.0] if model.planar else [1.0, 1.0, 1.0])
    turn_axes = np.array([0.0, 0.0, 1.0] if model.planar else [1.0, 1.0, 1.0])
    return np.diag(np.concatenate([model.path_noise**2 * way_m * axes, model.turn_noise**2 * way_m * turn_axes]))


def _observations(
    model: VehicleModel, points: F64, T_o_c: F64, cam: RectifiedCamera, before: I64, rng: np.random.Generator
) -> tuple[I64, F64]:
    """Ids and pixels of visible points: those seen before go on, others are added up to the most in a frame."""
    local = (points - T_o_c[:3, 3]) @ T_o_c[:3, :3]
    z = np.where(local[:, 2] > 0.1, local[:, 2], 0.1)
    uv = np.stack([cam.fx * local[:, 0] / z + cam.cx, cam.fy * local[:, 1] / z + cam.cy], axis=1)
    visible = (local[:, 2] > _NEAR_M) & (local[:, 2] < _FAR_M)
    visible &= (uv > 0.0).all(axis=1) & (uv < [cam.width - 1.0, cam.height - 1.0]).all(axis=1)
    ids = np.flatnonzero(visible)
    going_on = np.intersect1d(ids, before)
    new = np.setdiff1d(ids, before)
    ids = np.sort(np.concatenate([going_on, new[: max(0, model.seen - len(going_on))]]))
    out = uv[ids] + model.sigma_px * rng.standard_normal((len(ids), 2))
    wrong = rng.random(len(ids)) < model.wrong
    other = rng.permutation(len(ids))
    gross = out + rng.uniform(-_GROSS_PX, _GROSS_PX, (len(ids), 2))
    swap = rng.random(len(ids)) < 0.5
    out = np.where((wrong & swap)[:, None], out[other], np.where((wrong & ~swap)[:, None], gross, out))
    return ids, out
