"""Which way is up: a first guess, what motion and IMU say a few frames later, and who is told.

The accelerometer alone is good at rest and a guess in motion. Four intervals later the images know how the vehicle
accelerated, so that what else was felt is gravity: flights that begin in motion then know up to half a degree. What was
shared of the first submap keeps its axes; the base is told how they lie, and a flight controller gets its first pose
when that is known.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.inertial.inertial_tracker import InertialTracker
from kiteline_codec.schema import GravityAlignment
from kiteline_core.frame import ImuBatch
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import SubmapId

F64 = NDArray[np.float64]

_AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # R_m_c of a level camera


def level_rotation(accel: F64) -> F64:
    """R_m_b (3,3) with z up and yaw zero, from the mean specific force (3,) in the body, which points up at rest."""
    up = accel / np.linalg.norm(accel)
    z = np.array([0.0, 0.0, 1.0])
    axis = np.cross(up, z)
    s, c = float(np.linalg.norm(axis)), float(up @ z)
    if s < 1e-9:
        return np.eye(3) if c > 0 else np.diag([1.0, -1.0, -1.0])
    return se3.so3_exp(axis / s * np.arctan2(s, c))


class Levelling:
    """Once: `first_pose`. Once a frame: `look`."""

    def __init__(self, camera: RectifiedCamera, inertial: InertialTracker | None, askew_rad: float, patience_s: float):
        """askew_rad: a submap that leans by less is left as it is. patience_s: after which nobody waits any longer."""
        self._camera = camera
        self._inertial = inertial
        self._askew_rad = askew_rad
        self._patience_ns = round(1e9 * patience_s)
        self._began_ns: int | None = None
        self._R_l_o: F64 | None = None if inertial is not None else np.eye(3)
        self.askew_rad = 0.0  # how far the first submap was found to lean

    @property
    def R_l_o(self) -> F64 | None:
        """(3,3): sets the odometry frame upright, the same for good; None until it is known, or need not be."""
        return self._R_l_o

    def first_pose(self, imu: ImuBatch | None) -> F64:
        """T_m_c of the first keyframe: body at the origin, z up by gravity, else as if the camera stood level."""
        if self._inertial is not None and imu is not None and len(imu.t_ns):
            R_m_b = level_rotation(imu.accel.mean(axis=0))
        else:
            R_m_b = _AHEAD @ self._camera.T_b_c[:3, :3].T
        return se3.from_rt(R_m_b, np.zeros(3)) @ self._camera.T_b_c

    def look(self, t_ns: int, T_m_b: F64, R_o_m: F64, submap: SubmapId, *, first: bool) -> GravityAlignment | None:
        """A frame was measured at T_m_b (4,4) in a submap, the first one or not, whose axes R_o_m (3,3) turns into
        those of o. What to tell the base, once.
        """
        if self._R_l_o is not None or self._inertial is None:
            return None
        if self._began_ns is None:
            self._began_ns = t_ns
        R_l_m = self._inertial.level_R()
        if R_l_m is None:
            if t_ns - self._began_ns > self._patience_ns:
                self._R_l_o = np.eye(3)
            return None
        self._R_l_o = level_rotation(R_o_m @ R_l_m[2])
        self.askew_rad = float(np.linalg.norm(se3.so3_log(R_l_m)))
        if not first or self.askew_rad < self._askew_rad:
            return None
        # Turned about where the vehicle is now, so that its place in the world does not jump.
        here = T_m_b[:3, 3]
        return GravityAlignment(submap, se3.from_rt(R_l_m, here - R_l_m @ here))
