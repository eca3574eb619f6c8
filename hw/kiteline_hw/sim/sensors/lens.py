"""Lens models of the simulated cameras: distortion, projection, pixel rays and vignette."""

import numpy as np

from kiteline_core.arrays import F32, F64
from kiteline_core.geometry.cameras import CameraModel, Lens


def distort(camera: CameraModel, points: F64) -> F64:
    """Distort image plane points (n, 2) (x/z, y/z); returns (n, 2)."""
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


def pixel_rays(camera: CameraModel) -> F32:
    """Unit ray directions (h+2, w+2, 3) of the pixels, with a border of one pixel.

    Radial-tangential lenses are inverted by Gauss-Newton with a numeric Jacobian, equidistant ones by Newton on the
    angle, both to below a thousandth of a pixel.
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


def vignette(directions: F32) -> F32:
    """Relative brightness (h, w) of the inner pixels: cos^2.2 of the angle to the optical axis, 0 beyond 90 degrees."""
    return np.ascontiguousarray(np.maximum(directions[1:-1, 1:-1, 2], 0.0) ** 2.2, np.float32)
