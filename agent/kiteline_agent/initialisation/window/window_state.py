"""States of a window of monocular keyframes with an IMU, and its solution, which is computed in parts."""

from collections.abc import Generator
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from kiteline_agent.inertial.preintegration import TimeOffset
from kiteline_agent.initialisation.window.lens_correction import TERMS
from kiteline_agent.initialisation.window.window_noise import NoiseEvidence
from kiteline_core.arrays import F64, I64

T = TypeVar("T")
InParts = Generator[None, None, T]  # a computation that pauses where an agent with little CPU time goes on later

_MAX_REPROJECTION_PX = 0.9  # px; rms of a solution's inliers
_MIN_COMMON = 3  # keyframes of two windows whose distances are compared
_MAX_IMU_CHI2 = 1.5  # mean squared error of its inertial factors, in deviations


@dataclass(frozen=True, slots=True)
class WindowState:
    """Unknowns of the window, in the body frame of its first keyframe, w.

    R: (K,3,3) R_w_b. p: (K,3) m. v: (K,3) m/s. accel_bias: (K,3) m/s^2. gyro_bias: (3,) rad/s. gravity: (3,) m/s^2.
    offset_s: camera stamp + offset = IMU time. m: (P,2) and rho: (P,) 1/m: landmark at origin (P,3) m + axes @ (m, 1)
    / rho. lens: (8,) see lens_correction.
    """

    R: F64
    p: F64
    v: F64
    accel_bias: F64
    gyro_bias: F64
    gravity: F64
    offset_s: float
    m: F64
    rho: F64
    origin: F64
    lens: F64 = field(default_factory=lambda: np.zeros(TERMS))


@dataclass(frozen=True, slots=True)
class WarmStart:
    """An earlier solution. state: of the first keyframes of the window, without landmarks of use. xyz: (P,3) m in w."""

    state: WindowState
    xyz: F64


@dataclass(frozen=True, slots=True)
class WindowSolution:
    """Result of a window.

    T_w_b: (4,4) of the newest keyframe; velocity: (3,) m/s; bias: (6,); gravity: (3,) m/s^2, in w. offset: of time.
    cov: (17,17) as in InertialState, of that keyframe. lens_cov: (8,8). scale_sigma: relative deviation of all lengths.
    reprojection_px: rms of inliers. cost: half the squared errors of all. converged: the solver came to an end.
    imu_chi2: mean squared error of the inertial factors in deviations. evidence: of the IMU's noise. depth_m: (P,) in
    the newest camera, and depth_sigma: (P,) its relative deviation with known poses.
    """

    state: WindowState
    T_w_b: F64
    velocity: F64
    bias: F64
    gravity: F64
    offset: TimeOffset
    cov: F64
    lens_cov: F64
    scale_sigma: float
    cost: float
    converged: bool
    reprojection_px: float
    imu_chi2: float
    evidence: NoiseEvidence
    depth_m: F64
    depth_sigma: F64

    @property
    def fits(self) -> bool:
        """True if the errors of images and IMU are as expected: the solver has converged."""
        return self.reprojection_px < _MAX_REPROJECTION_PX and self.imu_chi2 < _MAX_IMU_CHI2


@dataclass(frozen=True, slots=True)
class SolvedWindow:
    """A solution, stamps of its K keyframes, ids (P,) of its corners and their places (P,3) m."""

    t_ns: tuple[int, ...]
    ids: I64
    xyz: F64
    solution: WindowSolution

    def warm_start(self, t_ns: tuple[int, ...], ids: I64) -> WarmStart | None:
        """This solution as a start for a window of other keyframes and corners; None if no keyframe is in both."""
        rows = [self.t_ns.index(t) for t in t_ns if t in self.t_ns]
        if not rows:
            return None
        state = self.solution.state
        xyz = np.full((len(ids), 3), np.nan)
        _, new, old = np.intersect1d(ids, self.ids, return_indices=True)
        xyz[new] = self.xyz[old]
        part = replace(
            state, R=state.R[rows], p=state.p[rows], v=state.v[rows], accel_bias=state.accel_bias[rows]
        )  # fmt: skip
        return WarmStart(part, xyz)

    def lengths_apart(self, later: "SolvedWindow") -> float:
        """Relative difference of lengths between keyframes of both; infinite if too few are in both."""
        common = [t for t in later.t_ns if t in set(self.t_ns)]
        if len(common) < _MIN_COMMON:
            return np.inf
        a, b = (w.solution.state.p[[w.t_ns.index(t) for t in common]] for w in (self, later))
        return lengths_apart(a, b)


def tangent(direction: F64) -> F64:
    """(3,2) unit vectors across a direction; zero without one."""
    length = float(np.linalg.norm(direction))
    if length == 0.0:
        return np.zeros((3, 2))
    return np.asarray(np.linalg.svd(direction[None, :] / length)[2][1:].T)


def finished(parts: InParts[T]) -> T:
    """Compute all parts at once, and return the result."""
    while True:
        try:
            next(parts)
        except StopIteration as end:
            return end.value  # type: ignore[no-any-return]


def lengths_apart(a: F64, b: F64) -> float:
    """Relative difference of the lengths of two paths (n,3) of the same keyframes; infinite if either has none."""
    length_a, length_b = (float(np.linalg.norm(p - p.mean(axis=0))) for p in (a, b))
    if min(length_a, length_b) <= 0.0:  # keyframes that coincide tell no scale
        return np.inf
    return abs(float(np.log(length_b / length_a)))
