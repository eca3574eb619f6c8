"""Lenses: which ray a pixel sees, and where a point falls; cameras like EuRoC's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, CameraRig, Lens

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]

_UP_BODY_X = np.array([[0.0149, -0.9999, 0.0041], [0.9996, 0.0150, 0.0257], [-0.0258, 0.0038, 0.9997]])
_UP_BODY_X_RIGHT = np.array([[0.0126, -0.9998, 0.0182], [0.9996, 0.0130, 0.0252], [-0.0254, 0.0179, 0.9995]])
_RADTAN = ((-0.2831, 0.0739, 1.9e-4, 1.8e-5), (-0.2839, 0.0746, -1.0e-4, -3.6e-5))
_EQUIDISTANT = ((-0.0036, 0.0012, -0.0013, 0.0002), (-0.0041, 0.0016, -0.0014, 0.0003))


def distort(camera: CameraModel, points: F64) -> F64:
    """Image plane points (n, 2) (x/z, y/z) after the lens, (n, 2)."""
    x, y = points[:, 0], points[:, 1]
    k = np.zeros(8)
    k[: len(camera.distortion)] = camera.distortion
    r2 = x * x + y * y
    if camera.lens is Lens.EQUIDISTANT:
        r = np.sqrt(r2)
        theta = np.arctan(r)
        bent = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6 + k[3] * theta**8)
        scale = np.where(r > 1e-9, bent / np.maximum(r, 1e-9), 1.0)
        return np.stack([x * scale, y * scale], 1)
    if camera.lens is Lens.NONE:
        return points.copy()
    radial = (1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / (1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))
    dx = 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x)
    dy = k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y
    return np.stack([x * radial + dx, y * radial + dy], 1)


def project(camera: CameraModel, points: F64) -> F64:
    """Pixels (n, 2) of points (n, 3) in the camera frame with z > 0."""
    bent = distort(camera, points[:, :2] / points[:, 2:])
    return np.asarray(bent * [camera.fx, camera.fy] + [camera.cx, camera.cy])


def rays(camera: CameraModel) -> F32:
    """Unit directions (h+2, w+2, 3) that the pixels see, with a border of one pixel all around.

    Radial-tangential lenses are inverted by Gauss-Newton with the numeric Jacobian; equidistant ones by Newton in the
    angle. Both are iterated to below a thousandth of a pixel.
    """
    v, u = np.mgrid[-1 : camera.height + 1, -1 : camera.width + 1].astype(np.float64)
    target = np.stack([(u.ravel() - camera.cx) / camera.fx, (v.ravel() - camera.cy) / camera.fy], 1)
    if camera.lens is Lens.EQUIDISTANT:
        r = np.linalg.norm(target, axis=1)
        k = np.zeros(4)
        k[: len(camera.distortion)] = camera.distortion
        theta = r.copy()
        for _ in range(10):
            t2 = theta * theta
            f = theta * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))) - r
            slope = 1 + t2 * (3 * k[0] + t2 * (5 * k[1] + t2 * (7 * k[2] + t2 * 9 * k[3])))
            theta = theta - f / slope
        xy = target * (np.sin(theta) / np.maximum(r, 1e-12))[:, None]
        out = np.concatenate([xy, np.cos(theta)[:, None]], 1)
    else:
        p = target.copy()
        step = 1e-5
        for _ in range(8):
            error = distort(camera, p) - target
            jx = (distort(camera, p + [step, 0.0]) - distort(camera, p - [step, 0.0])) / (2 * step)
            jy = (distort(camera, p + [0.0, step]) - distort(camera, p - [0.0, step])) / (2 * step)
            det = jx[:, 0] * jy[:, 1] - jx[:, 1] * jy[:, 0]
            det = np.where(np.abs(det) < 1e-3, 1e-3, det)
            p[:, 0] -= (error[:, 0] * jy[:, 1] - error[:, 1] * jy[:, 0]) / det
            p[:, 1] -= (error[:, 1] * jx[:, 0] - error[:, 0] * jx[:, 1]) / det
        out = np.concatenate([p, np.ones((p.shape[0], 1))], 1)
        out /= np.linalg.norm(out, axis=1, keepdims=True)
    return np.ascontiguousarray(out.reshape(camera.height + 2, camera.width + 2, 3), np.float32)


def fall_off(directions: F32) -> F32:
    """Vignette (h, w) of the inner pixels: cos^2.2 of the angle to the axis, 1 in the middle."""
    return np.ascontiguousarray(directions[1:-1, 1:-1, 2] ** 2.2, np.float32)


def imperfect(rig: CameraRig, rng: np.random.Generator, amount: float) -> CameraRig:
    """The cameras as they truly are where `rig` is what a good calibration says: off by about a tenth of a pixel."""

    def camera(c: CameraModel) -> CameraModel:
        e = amount * rng.standard_normal(4 + len(c.distortion))
        centre = 0.1 * c.width / 752  # px
        k = tuple(value * (1.0 + 1e-3 * error) for value, error in zip(c.distortion, e[4:], strict=True))
        fx, fy = c.fx * (1.0 + 2e-4 * e[0]), c.fy * (1.0 + 2e-4 * e[1])
        return replace(c, fx=fx, fy=fy, cx=c.cx + centre * e[2], cy=c.cy + centre * e[3], distortion=k)

    def turn(t: F64, angle_rad: float, shift_m: float) -> F64:
        e = amount * rng.standard_normal(6)
        return t @ se3.exp(np.concatenate([shift_m * e[:3], angle_rad * e[3:]]))

    left, t_b_c = camera(rig.left), turn(rig.T_b_c, 4e-4, 5e-4)
    if rig.right is None or rig.T_c_r is None:
        return replace(rig, left=left, T_b_c=t_b_c)
    return replace(rig, left=left, right=camera(rig.right), T_b_c=t_b_c, T_c_r=turn(rig.T_c_r, 1e-4, 1e-5))


def make_rig(
    lens: Lens = Lens.RADTAN, stereo: bool = True, depth: bool = False, baseline_m: float = 0.11, scale: float = 1.0
) -> CameraRig:
    """Cameras like EuRoC's: 752x480, body x up and z forward; `scale` shrinks images and focal lengths for tests."""
    coefficients = {Lens.RADTAN: _RADTAN, Lens.EQUIDISTANT: _EQUIDISTANT, Lens.NONE: ((), ())}[lens]
    size = round(752 * scale), round(480 * scale)
    left = CameraModel(*size, 458.2 * scale, 457.0 * scale, 367.0 * scale, 248.5 * scale, lens, coefficients[0])
    right = CameraModel(*size, 457.4 * scale, 456.2 * scale, 379.5 * scale, 254.8 * scale, lens, coefficients[1])
    t_b_c = se3.orthonormalise(se3.from_rt(_UP_BODY_X, np.array([-0.0216, -0.0647, 0.0098])))
    t_b_r = se3.orthonormalise(se3.from_rt(_UP_BODY_X_RIGHT, np.array([-0.0198, 0.0454, 0.0079])))
    t_c_r = se3.inverse(t_b_c) @ t_b_r
    t_c_r[:3, 3] *= baseline_m / np.linalg.norm(t_c_r[:3, 3])
    return CameraRig(left, right if stereo else None, t_b_c, t_c_r if stereo else None, depth, True)
