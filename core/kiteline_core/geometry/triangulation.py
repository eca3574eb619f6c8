"""Triangulation of points from rays of cameras with known poses."""

import numpy as np

from kiteline_core.arrays import F64, Bool


def rays(pixels: F64, camera: F64, T_m_k: F64) -> tuple[F64, F64]:
    """Origins and unit directions (n,3) in m of pixels (n,2). camera: (n,4) fx fy cx cy; T_m_k: (n,4,4)."""
    local = np.ones((len(pixels), 3))
    local[:, 0] = (pixels[:, 0] - camera[:, 2]) / camera[:, 0]
    local[:, 1] = (pixels[:, 1] - camera[:, 3]) / camera[:, 1]
    direction = np.einsum("nij,nj->ni", T_m_k[:, :3, :3], local)
    return T_m_k[:, :3, 3].copy(), direction / np.linalg.norm(direction, axis=1, keepdims=True)


def nearest_point(origins: F64, directions: F64) -> tuple[F64, Bool]:
    """Least-squares intersection of k rays, for n points. origins, unit directions: (n,k,3).

    Returns points (n,3) and whether each is well defined (n,). Source: "Monocular EKF-SLAM with delayed landmark
    initialisation", the analytical initialisation by linear least squares; one 3x3 system a point.
    """
    eye = np.eye(3)
    across = eye - directions[..., :, None] * directions[..., None, :]  # (n,k,3,3): projection perpendicular to a ray
    a = across.sum(axis=1)
    b = np.einsum("nkij,nkj->ni", across, origins)
    good = np.abs(np.linalg.det(a)) > 1e-9
    a[~good] = eye
    return np.asarray(np.linalg.solve(a, b[..., None])[..., 0]), good


def parallax(origins_a: F64, origins_b: F64, points: F64) -> F64:
    """Cosine (n,) of the parallax angle of points (n,3) between two origins (n,3)."""
    a, b = points - origins_a, points - origins_b
    norm = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    return np.asarray(np.einsum("ni,ni->n", a, b) / np.maximum(norm, 1e-12))


def project(points: F64, camera: F64, T_m_k: F64) -> tuple[F64, F64]:
    """Pixels (n,2) and depths (n,) of points (n,3) in cameras (n,4) at T_m_k (n,4,4)."""
    local = np.einsum("nji,nj->ni", T_m_k[:, :3, :3], points - T_m_k[:, :3, 3])
    z = np.where(local[:, 2] > 1e-6, local[:, 2], 1.0)
    pixels = np.stack([camera[:, 0] * local[:, 0] / z + camera[:, 2], camera[:, 1] * local[:, 1] / z + camera[:, 3]], 1)
    return pixels, local[:, 2]
