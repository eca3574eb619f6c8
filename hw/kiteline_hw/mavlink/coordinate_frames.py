"""Converts poses, rates and covariances from kiteline's coordinate frames to MAVLink's. Pure.

kiteline: o is continuous and right-handed with z up; b is the body frame of the source, in any orientation in the
vehicle. MAVLink: l = MAV_FRAME_LOCAL_FRD, x as in o, z down; f = MAV_FRAME_BODY_FRD, x forward, y right, z down.
"""

import math
from collections.abc import Sequence

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.geometry import se3

# Rotates vectors from o to l: x stays, left becomes right, up becomes down.
R_L_O: F64 = np.diag([1.0, -1.0, -1.0])
_TWICE_R_L_O: F64 = np.asarray(np.kron(np.eye(2), R_L_O), np.float64)
_UPPER = np.triu_indices(6)

# Unit vectors in FRD of the six directions of a vehicle.
_DIRECTIONS = {
    "f": (1.0, 0.0, 0.0),
    "b": (-1.0, 0.0, 0.0),
    "r": (0.0, 1.0, 0.0),
    "l": (0.0, -1.0, 0.0),
    "d": (0.0, 0.0, 1.0),
    "u": (0.0, 0.0, -1.0),
}


def mounting(axes: str, offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> F64:
    """T_b_f (4,4) from the directions of the body's x, y, z axes: f(orward) b(ack) l(eft) r(ight) u(p) d(own).

    "flu": a ROS body; "rdf": a camera looking forward; "urf": EuRoC's vehicle. offset_m: the flight controller's origin
    in b. Raises ValueError if the axes form no right-handed frame.
    """
    rows = [_DIRECTIONS.get(letter) for letter in axes.lower()]
    if len(rows) != 3 or any(row is None for row in rows):
        raise ValueError(f"body axes {axes!r}: expected three letters out of f b l r u d, for instance flu")
    r_b_f = np.array(rows)  # row i: body axis i in FRD
    if not np.isclose(np.linalg.det(r_b_f), 1.0):
        raise ValueError(f"body axes {axes!r} are not right-handed and perpendicular; flu, frd, rdf and urf are")
    return se3.from_rt(r_b_f, np.array(offset_m, dtype=np.float64))


def local_pose(T_o_b: F64, T_b_f: F64) -> tuple[F64, F64]:
    """Position (3,) m in l of the flight controller, and its attitude [w, x, y, z] from f to l."""
    t_o_f = T_o_b @ T_b_f
    return R_L_O @ t_o_f[:3, 3], se3.quaternion_from_rotation(R_L_O @ t_o_f[:3, :3])


def controller_rates(T_o_b: F64, velocity: F64, rate: F64, T_b_f: F64) -> tuple[F64, F64]:
    """Velocity (3,) m/s of the flight controller's origin and angular rate (3,) rad/s, both in f.

    velocity: (3,) m/s of the body's origin in o. rate: (3,) rad/s in b.
    """
    r_f_b = T_b_f[:3, :3].T
    (p, q, r), (x, y, z) = rate.tolist(), T_b_f[:3, 3].tolist()
    lever = np.array((q * z - r * y, r * x - p * z, p * y - q * x))  # rate x T_b_f[:3, 3]
    at_origin = T_o_b[:3, :3].T @ velocity + lever
    return np.asarray(r_f_b @ at_origin), np.asarray(r_f_b @ rate)


def rotated(q: Sequence[float], v: Sequence[float]) -> list[float]:
    """A vector (3,) in f rotated by the quaternion [w, x, y, z]."""
    return [float(a) for a in se3.rotation_from_quaternion(np.asarray(q, np.float64)) @ np.asarray(v, np.float64)]


def euler_angles(q: Sequence[float]) -> list[float]:
    """Roll, pitch and yaw (rad; yaw first, about z, y', x'') of a quaternion [w, x, y, z]."""
    r = se3.rotation_from_quaternion(np.asarray(q, np.float64))
    pitch = -math.asin(min(1.0, max(-1.0, float(r[2, 0]))))
    return [math.atan2(r[2, 1], r[2, 2]), pitch, math.atan2(r[1, 0], r[0, 0])]


def upper_triangle(covariance: F64) -> list[float]:
    """The upper right triangle of a (6,6) matrix by rows: the 21 numbers of a covariance in MAVLink."""
    values: list[float] = covariance[_UPPER].tolist()
    return values


def local_covariance(covariance_o: F64) -> F64:
    """Rotate a (6,6) covariance [position, rotation vector] from the axes of o to those of l."""
    return np.asarray(_TWICE_R_L_O @ covariance_o @ _TWICE_R_L_O.T)


def controller_covariance(covariance: F64, T_o_b: F64, T_b_f: F64) -> F64:
    """Covariance (6,6) of the flight controller's pose in the axes of l, [position, rotation vector].

    covariance: of T_o_b, [translation in o, rotation about the body's axes].
    """
    r = T_o_b[:3, :3]
    j = np.eye(6)
    j[:3, 3:] = -r @ se3.skew(T_b_f[:3, 3])  # a rotation of the body moves the controller by its lever arm
    j[3:, 3:] = r
    return local_covariance(j @ covariance @ j.T)
