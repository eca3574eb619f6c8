"""Flights of a fixed-lag smoother among points, with images and samples made of the truth."""

from dataclasses import dataclass

import numpy as np

from kiteline_agent.inertial.fixed_lag import VisualPoints
from kiteline_agent.inertial.preintegration import Samples
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera

CALIBRATION = ImuCalibration()
T_B_C = se3.from_rt(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.1, 0.03, -0.02]))
CAMERA = RectifiedCamera(752, 480, 450.0, 450.0, 375.5, 239.5, 0.11, True, T_B_C)
GRAVITY = np.array([0.0, 0.0, -9.81])
STEP_S, FRAME_STEPS = 0.005, 10


@dataclass
class Flight:
    """Truth at 200 Hz along sines, and points around it."""

    T: F64
    velocity: F64
    gyro: F64
    accel: F64
    points: F64

    def samples(self, k: int) -> Samples:
        """True samples from frame k to k + 1."""
        part = slice(k * FRAME_STEPS, (k + 1) * FRAME_STEPS + 1)
        return Samples(np.arange(FRAME_STEPS + 1) * STEP_S, self.gyro[part], self.accel[part])

    def pose(self, k: int) -> F64:
        """True pose at frame k."""
        return np.asarray(self.T[k * FRAME_STEPS])


def make_flight(seed: int, frames: int) -> Flight:
    rng = np.random.default_rng(seed)
    t = np.arange(frames * FRAME_STEPS + 1) * STEP_S
    w, phase = rng.uniform(0.5, 2.0, (2, 3)), rng.uniform(0, 6.28, (2, 3))
    size = np.array([1.0, 1.0, 0.4])
    p = size * np.sin(t[:, None] * w[0] + phase[0])
    v = size * w[0] * np.cos(t[:, None] * w[0] + phase[0])
    a = -size * w[0] ** 2 * np.sin(t[:, None] * w[0] + phase[0])

    def turn(x: float) -> F64:
        return se3.so3_exp(np.array([0.4, 0.4, 1.0]) * np.sin(x * w[1] + phase[1]))

    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, :3, 3] = p
    gyro = np.empty((len(t), 3))
    for k, x in enumerate(t):
        T[k, :3, :3] = turn(x)
        gyro[k] = se3.so3_log(turn(x - 1e-4).T @ turn(x + 1e-4)) / 2e-4
    accel = np.einsum("nji,nj->ni", T[:, :3, :3], a - GRAVITY)
    return Flight(T, v, gyro, accel, rng.uniform(-6.0, 6.0, (3000, 3)))


def see(flight: Flight, k: int, rng: np.random.Generator, noise_px: float, most: int = 60) -> VisualPoints:
    """What the camera sees at frame k."""
    c = CAMERA
    T_c_m = se3.inverse(flight.pose(k) @ T_B_C)
    p = se3.transform(T_c_m, flight.points)
    z = np.maximum(p[:, 2], 1e-3)
    uvd = np.column_stack([c.fx * p[:, 0] / z + c.cx, c.fy * p[:, 1] / z + c.cy, c.bf / z])
    good = (p[:, 2] > 0.5) & (uvd[:, 0] > 0) & (uvd[:, 0] < c.width) & (uvd[:, 1] > 0) & (uvd[:, 1] < c.height)
    chosen = rng.permutation(np.flatnonzero(good))[:most]
    observed = uvd[chosen] + noise_px * rng.normal(size=(len(chosen), 3))
    observed[::4, 2] = -1.0
    n = len(chosen)
    return VisualPoints(
        flight.points[chosen], np.zeros((n, 3)), observed, np.full(n, max(noise_px, 0.05)), np.ones(n, np.bool_)
    )
