"""Rigid motions as 4x4 float64 arrays. `T_a_b` maps points of frame b into frame a: p_a = T_a_b @ p_b.

Tangent vectors are [translation (3), rotation (3)] in metres and radians. Quaternions are [w, x, y, z] with w >= 0.
Source: J. Sola, J. Deray, D. Atchuthan, "A micro Lie theory for state estimation in robotics", appendix D.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

_SMALL_RAD = 1e-7  # below this angle the series is exact to double precision

_EYE = np.eye(3)
_NEARLY = 1e-7  # deviation from orthonormal whose square is below double precision


def skew(v: F64) -> F64:
    """The 3x3 matrix with skew(v) @ x == cross(v, x)."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def so3_exp(w: F64) -> F64:
    """Rotation matrix (3,3) of a rotation vector (3,) in radians (Rodrigues' formula)."""
    angle = float(np.sqrt(w @ w))
    k = skew(w)
    if angle < _SMALL_RAD:
        return np.asarray(_EYE + k + 0.5 * (k @ k))
    return np.asarray(_EYE + (np.sin(angle) / angle) * k + ((1.0 - np.cos(angle)) / angle**2) * (k @ k))


def so3_log(r: F64) -> F64:
    """Rotation vector (3,) in radians, of length at most pi, of a rotation matrix (3,3)."""
    q = quaternion_from_rotation(r)
    n = float(np.sqrt(q[1:] @ q[1:]))
    if n < _SMALL_RAD:
        return np.asarray(2.0 * q[1:] / q[0])
    return np.asarray(2.0 * np.arctan2(n, q[0]) / n * q[1:])


def _left_jacobian(w: F64) -> F64:
    angle = float(np.sqrt(w @ w))
    k = skew(w)
    if angle < 1e-4:
        return np.asarray(_EYE + 0.5 * k + (k @ k) / 6.0)
    return np.asarray(_EYE + ((1.0 - np.cos(angle)) / angle**2) * k + ((angle - np.sin(angle)) / angle**3) * (k @ k))


def exp(xi: F64) -> F64:
    """T (4,4) of a tangent vector (6,) [translation, rotation]."""
    return from_rt(so3_exp(xi[3:]), _left_jacobian(xi[3:]) @ xi[:3])


def log(t: F64) -> F64:
    """Tangent vector (6,) [translation, rotation] of T (4,4)."""
    w = so3_log(t[:3, :3])
    return np.concatenate([np.linalg.solve(_left_jacobian(w), t[:3, 3]), w])


def inverse(t: F64) -> F64:
    """T_b_a of T_a_b."""
    back = t[:3, :3].T
    return from_rt(back, -(back @ t[:3, 3]))


def from_rt(r: F64, t: F64) -> F64:
    """T (4,4) of a rotation (3,3) and a translation (3,) in metres."""
    out = np.zeros((4, 4))
    out[:3, :3] = r
    out[:3, 3] = t
    out[3, 3] = 1.0
    return out


def transform(t: F64, points: F64) -> F64:
    """Apply T (4,4) to points (n,3)."""
    return points @ t[:3, :3].T + t[:3, 3]


def orthonormalise(t: F64) -> F64:
    """The rigid motion nearest to T, since products of rotations lose orthonormality."""
    r = t[:3, :3]
    error = r.T @ r - _EYE
    if np.abs(error).max() < _NEARLY:  # one step of Newton's polar iteration leaves the square of the error
        return from_rt(r - 0.5 * (r @ error), t[:3, 3])
    u, _, vt = np.linalg.svd(r)
    r = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return from_rt(r, t[:3, 3])


def quaternion_from_rotation(r: F64) -> F64:
    """Unit quaternion [w, x, y, z], w >= 0, of a rotation matrix (3,3) (Shepperd's method)."""
    (a, b, c), (d, e, f), (g, h, k) = r.tolist()
    trace = a + e + k
    largest = max(trace, a, e, k)
    if trace == largest:
        q = np.array([1.0 + trace, h - f, c - g, d - b])
    elif a == largest:
        q = np.array([h - f, 1.0 + a - e - k, b + d, c + g])
    elif e == largest:
        q = np.array([c - g, b + d, 1.0 - a + e - k, f + h])
    else:
        q = np.array([d - b, c + g, f + h, 1.0 - a - e + k])
    q = q / np.sqrt(q @ q)
    return np.asarray(-q if q[0] < 0 else q)


def rotation_from_quaternion(q: F64) -> F64:
    """Rotation matrix (3,3) of a quaternion [w, x, y, z]; it is normalised first."""
    w, x, y, z = q / np.sqrt(q @ q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def from_quaternion(q: F64, t: F64) -> F64:
    """T (4,4) of a quaternion [w, x, y, z] and a translation (3,) in metres."""
    return from_rt(rotation_from_quaternion(q), t)
