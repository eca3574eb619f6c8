"""Rigid motions as 4x4 float64 arrays. `T_a_b` maps points of frame b into frame a: p_a = T_a_b @ p_b.

Tangent vectors are [translation (3), rotation (3)] in metres and radians. Quaternions are [w, x, y, z] with w >= 0.
Source: J. Sola, J. Deray, D. Atchuthan, "A micro Lie theory for state estimation in robotics", appendix D.

What is called many times a frame computes with Python's floats: on so few numbers, a call of numpy costs more than all
of the arithmetic. The results are the same on every machine, as no library's order of summation enters.
"""

import math
from typing import TypeVar

import numpy as np

from kiteline_core.arrays import F64

_Number = TypeVar("_Number", float, F64)

_SMALL_RAD = 1e-7  # below this angle the series is exact to double precision
_NEARLY = 1e-7  # deviation from orthonormal whose square is below double precision


def skew(v: F64) -> F64:
    """The 3x3 matrix with skew(v) @ x == cross(v, x)."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def so3_exp(w: F64) -> F64:
    """Rotation matrix (3,3) of a rotation vector (3,) in radians (Rodrigues' formula)."""
    angle = math.hypot(*w.tolist())
    if angle < _SMALL_RAD:
        return _polynomial(w, 1.0, 0.5)
    return _polynomial(w, math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle**2)


def _polynomial(w: F64, a: float, b: float) -> F64:
    """I + a K + b K^2 with K = skew(w)."""
    x, y, z = w.tolist()
    ax, ay, az, bx, by, bz = a * x, a * y, a * z, b * x, b * y, b * z
    return np.array((
        1.0 - by * y - bz * z, bx * y - az, bx * z + ay,
        bx * y + az, 1.0 - bx * x - bz * z, by * z - ax,
        bx * z - ay, by * z + ax, 1.0 - bx * x - by * y,
    )).reshape(3, 3)  # fmt: skip


def so3_log(r: F64) -> F64:
    """Rotation vector (3,) in radians, of length at most pi, of a rotation matrix (3,3)."""
    w, x, y, z = quaternion_numbers(r)
    n = math.sqrt(x * x + y * y + z * z)
    share = 2.0 / w if n < _SMALL_RAD else 2.0 * math.atan2(n, w) / n
    return np.array((share * x, share * y, share * z))


def _left_jacobian(w: F64) -> F64:
    angle = math.hypot(*w.tolist())
    if angle < 1e-4:
        return _polynomial(w, 0.5, 1.0 / 6.0)
    return _polynomial(w, (1.0 - math.cos(angle)) / angle**2, (angle - math.sin(angle)) / angle**3)


def exp(xi: F64) -> F64:
    """T (4,4) of a tangent vector (6,) [translation, rotation]."""
    return from_rt(so3_exp(xi[3:]), _left_jacobian(xi[3:]) @ xi[:3])


def log(t: F64) -> F64:
    """Tangent vector (6,) [translation, rotation] of T (4,4)."""
    w = so3_log(t[:3, :3])
    return np.concatenate([np.linalg.solve(_left_jacobian(w), t[:3, 3]), w])


def inverse(t: F64) -> F64:
    """T_b_a of T_a_b."""
    (a, b, c, x), (d, e, f, y), (g, h, k, z), _ = t.tolist()
    return np.array((
        a, d, g, -(a * x + d * y + g * z),
        b, e, h, -(b * x + e * y + h * z),
        c, f, k, -(c * x + f * y + k * z),
        0.0, 0.0, 0.0, 1.0,
    )).reshape(4, 4)  # fmt: skip


def from_rt(r: F64, t: F64) -> F64:
    """T (4,4) of a rotation (3,3) and a translation (3,) in metres."""
    out = np.zeros((4, 4))
    out[:3, :3] = r
    out[:3, 3] = t
    out[3, 3] = 1.0
    return out


def shift_and_turn(t: F64) -> tuple[float, float]:
    """Length of T's translation, and the chord of its rotation: the angle in radians when small."""
    (a, b, c, x), (d, e, f, y), (g, h, k, z), _ = t.tolist()
    square = (a - 1.0) ** 2 + b * b + c * c + d * d + (e - 1.0) ** 2 + f * f + g * g + h * h + (k - 1.0) ** 2
    return math.sqrt(x * x + y * y + z * z), math.sqrt(0.5 * square)


def transform(t: F64, points: F64) -> F64:
    """Apply T (4,4) to points (n,3)."""
    return points @ t[:3, :3].T + t[:3, 3]


def orthonormalise(t: F64) -> F64:
    """The rigid motion nearest to T, since products of rotations lose orthonormality."""
    (a, b, c, x), (d, e, f, y), (g, h, k, z), _ = t.tolist()
    xx, xy, xz = 0.5 * (a * a + d * d + g * g - 1.0), 0.5 * (a * b + d * e + g * h), 0.5 * (a * c + d * f + g * k)
    yy, yz = 0.5 * (b * b + e * e + h * h - 1.0), 0.5 * (b * c + e * f + h * k)
    zz = 0.5 * (c * c + f * f + k * k - 1.0)  # half the error of R^T R
    if not abs(xx) + abs(yy) + abs(zz) + abs(xy) + abs(xz) + abs(yz) < _NEARLY:
        u, _, vt = np.linalg.svd(t[:3, :3])
        return from_rt(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt, t[:3, 3])
    # one step of Newton's polar iteration leaves the square of the error
    return np.array((
        a - (a * xx + b * xy + c * xz), b - (a * xy + b * yy + c * yz), c - (a * xz + b * yz + c * zz), x,
        d - (d * xx + e * xy + f * xz), e - (d * xy + e * yy + f * yz), f - (d * xz + e * yz + f * zz), y,
        g - (g * xx + h * xy + k * xz), h - (g * xy + h * yy + k * yz), k - (g * xz + h * yz + k * zz), z,
        0.0, 0.0, 0.0, 1.0,
    )).reshape(4, 4)  # fmt: skip


def is_rotation(r: F64, tolerance: float) -> bool:
    """True if no element of R R^T - I reaches the tolerance; R (3,3), of finite numbers, may be a reflection."""
    (a, b, c), (d, e, f), (g, h, k) = r.tolist()
    worst: float = max(
        abs(a * a + b * b + c * c - 1.0), abs(d * d + e * e + f * f - 1.0), abs(g * g + h * h + k * k - 1.0),
        abs(a * d + b * e + c * f), abs(a * g + b * h + c * k), abs(d * g + e * h + f * k),
    )  # fmt: skip
    return worst < tolerance


def quaternion_from_rotation(r: F64) -> F64:
    """Unit quaternion [w, x, y, z], w >= 0, of a rotation matrix (3,3) (Shepperd's method)."""
    return np.array(quaternion_numbers(r))


def quaternion_numbers(r: F64) -> tuple[float, float, float, float]:
    """`quaternion_from_rotation` as four numbers."""
    (a, b, c), (d, e, f), (g, h, k) = r.tolist()
    trace = a + e + k
    largest = max(trace, a, e, k)
    if trace == largest:
        w, x, y, z = 1.0 + trace, h - f, c - g, d - b
    elif a == largest:
        w, x, y, z = h - f, 1.0 + a - e - k, b + d, c + g
    elif e == largest:
        w, x, y, z = c - g, b + d, 1.0 - a + e - k, f + h
    else:
        w, x, y, z = d - b, c + g, f + h, 1.0 - a - e + k
    n = math.sqrt(w * w + x * x + y * y + z * z)
    if w < 0.0:
        n = -n
    return w / n, x / n, y / n, z / n


def rotation_from_quaternion(q: F64) -> F64:
    """Rotation matrix (3,3) of a quaternion [w, x, y, z]; it is normalised first."""
    w, x, y, z = (q / np.sqrt(q @ q)).tolist()
    return np.array(_rotation_numbers(w, x, y, z)).reshape(3, 3)


def _rotation_numbers(w: _Number, x: _Number, y: _Number, z: _Number) -> tuple[_Number, ...]:
    """Rows of the rotation matrix of a unit quaternion, one after the other."""
    return (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip


def from_quaternion(q: F64, t: F64) -> F64:
    """T (4,4) of a quaternion [w, x, y, z] and a translation (3,) in metres."""
    return from_rt(rotation_from_quaternion(q), t)


def from_quaternions(q: F64, t: F64) -> F64:
    """`from_quaternion` of many: T (n,4,4) of quaternions (n,4) and translations (n,3), to the same bits."""
    lengths = np.sqrt([one @ one for one in np.ascontiguousarray(q)])
    out = np.tile(np.eye(4), (len(q), 1, 1))
    out[:, :3, :3] = np.stack(_rotation_numbers(*(q / lengths[:, None]).T), 1).reshape(-1, 3, 3)
    out[:, :3, 3] = t
    return out
