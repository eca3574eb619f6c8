"""How certain the pose is: noise that adds up from keyframe to keyframe, errors of the calibration, time flown blind.

A pose errs in three ways. *Noise*: it errs as the keyframes at whose points it was measured, and on top as that
measurement; a vehicle that comes back to old points is as certain as they are. *Calibration*: what a good calibration
leaves is the same error in every frame, so it does not average out but bends and stretches the whole map; its few
parameters are not estimated, only what they do to each keyframe is carried along (S. F. Schmidt's consider filter,
1966; as in J. Civera et al., "Drift-free real-time sequential mosaicing", for maps). *Blindness*: without images the
IMU's own covariance, or accelerations that nobody knows.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.certainty_kernels import DISPARITY_SHAPES, SHAPES, sensitivity
from kiteline_agent.config import CertaintyConfig
from kiteline_agent.local_map import LocalMap
from kiteline_agent.pose_state import PoseState
from kiteline_agent.tracker import Track
from kiteline_core import se3
from kiteline_core.ids import KeyframeId, SubmapId

F64 = NDArray[np.float64]

_MET_PX = 1.0  # px, of a corner at full size that met a copy of another keyframe's
_MET_DEPTH_M = 4.0  # of such corners


class Certainty:
    """Once a frame `measured` or `blind`; `remember` for each keyframe; `carry` before the map changes under the pose.

    Perturbations stand on the left of poses in m (or o), [translation, rotation].
    """

    def __init__(self, local_map: LocalMap, T_b_c: F64, config: CertaintyConfig, *, has_body: bool, has_depth: bool):
        """has_body: the camera's place in the body is a calibration. has_depth: stereo or a depth camera."""
        self._map = local_map
        self._T_b_c = T_b_c
        self._config = config
        slots = len(local_map.keyframe)
        self._noise_k, self._shift_k = np.zeros((slots, 6, 6)), np.zeros((slots, 6, SHAPES))  # of each keyframe
        self._by_base = np.zeros(slots, np.bool_)
        self._calibration = np.full(SHAPES, config.calibration_px**2)
        self._calibration[:DISPARITY_SHAPES] *= 2.0 if has_depth else 0.0  # two cameras make a disparity
        extrinsic = np.repeat([config.extrinsic_m, config.extrinsic_rad], 3) if has_body else np.zeros(6)
        a = adjoint(T_b_c)
        self._extrinsic = a @ np.diag(extrinsic**2) @ a.T
        self._noise, self._shift = np.zeros((6, 6)), np.zeros((6, SHAPES))  # of the camera in m
        self._way: dict[SubmapId, F64] = {}  # T_o_m of the submaps that were left since all motion was last measured
        self._guided = False  # an IMU measures all motion
        self._blind_s = 0.0
        self._blind = np.zeros((6, 6))  # [translation in m, rotation about the body's axes], since images were lost
        self._carried = np.zeros((6, 6))  # of the submap in o
        self._T_m_b0: F64 = np.eye(4)  # where the submap began
        self._T_o_b0: F64 | None = None  # where the flight began
        self._h, self._g = np.zeros((6, 6)), np.zeros((6, SHAPES))

    # what happens

    def begin(self, T_m_b: F64) -> None:
        """A submap begins with the keyframe that follows, at T_m_b (4,4)."""
        self._noise, self._shift, self._blind = np.zeros((6, 6)), np.zeros((6, SHAPES)), np.zeros((6, 6))
        self._blind_s = 0.0
        self._T_m_b0 = T_m_b
        if self._T_o_b0 is None:
            self._T_o_b0 = T_m_b

    def measured(self, track: Track) -> None:
        """The images gave the camera's pose, from points of the local map."""
        m = self._map
        sensitivity(
            track.T_c_m, m.intrinsics, 0.5 * m.camera.width, track.rows, track.inlier, track.xyz, track.ray,
            track.observed, track.sigma_px, m.births, m.T_m_k, m.uv.reshape(-1, 2), m.rho.reshape(-1), self._shift_k,
            self._h, self._g,
        )  # fmt: skip
        inverse = np.linalg.inv(self._h + 1e-6 * np.eye(6))
        a = adjoint(se3.inverse(track.T_c_m))
        noise = max(track.rms, self._config.least_rms) ** 2 * self._config.inflation * inverse
        seen = np.bincount(track.rows[track.inlier] // m.births, minlength=len(self._noise_k))
        share = seen / max(int(seen.sum()), 1)
        self._noise = a @ noise @ a.T + np.tensordot(share, self._noise_k, 1)
        self._shift = a @ inverse @ self._g
        self._blind, self._blind_s = np.zeros((6, 6)), 0.0

    def remember(self, keyframe: KeyframeId) -> None:
        """This frame became a keyframe."""
        slot = self._map.slot_of(keyframe)
        self._noise_k[slot], self._shift_k[slot], self._by_base[slot] = self._noise, self._shift, False

    def blind(self, dt_s: float, inertial: F64 | None) -> None:
        """No image for another dt_s. inertial: (6,6) of the pose by the IMU, [translation in m, rotation about the
        body's axes]; None where nothing measures motion.
        """
        if inertial is not None:
            self._blind = inertial
            return
        c = self._config
        before, self._blind_s = self._blind_s, self._blind_s + dt_s
        moved, turned = (
            (v * s + 0.5 * a * s * s for s in (before, self._blind_s))
            for v, a in ((c.blind_velocity_m_s, c.blind_accel_m_s2), (c.blind_rate_rad_s, c.blind_turn_rad_s2))
        )
        (m0, m1), (t0, t1) = moved, turned
        grown = np.repeat([m1 * m1 - m0 * m0, min(t1 * t1 - t0 * t0, 10.0)], 3)
        self._blind = self._blind + np.diag(grown)

    def met(self, keyframe: KeyframeId, T_c_m: F64, points: int) -> None:
        """The pose is T_c_m (4,4) by so many points that are not in the local map, beside this keyframe."""
        slot = self._map.slot_of(keyframe)
        depth_m, focal_px = _MET_DEPTH_M, self._map.camera.fx
        turn = _MET_PX / focal_px / math.sqrt(max(points, 4))
        own = np.diag(np.repeat([turn * depth_m, turn], 3) ** 2)
        a = adjoint(se3.inverse(T_c_m))
        self._noise, self._shift = self._noise_k[slot] + a @ own @ a.T, self._shift_k[slot].copy()
        self._blind, self._blind_s = np.zeros((6, 6)), 0.0

    def carry(self, pose: PoseState, T_c_b: F64, submap: SubmapId) -> None:
        """The map of this submap is about to change under the camera, the odometry frame goes on as it is."""
        if self._guided:
            self._way[submap] = pose.T_o_m
        T_m_b = pose.T_m_c @ T_c_b
        back = np.linalg.inv(_to_body(pose.T_o_m @ T_m_b))
        self._carried = back @ self._in_o(pose.T_o_m, T_m_b) @ back.T

    def corrected(self, pose: PoseState) -> None:
        """The base has optimised keyframes: those that it placed for the first time are better known."""
        m = self._map
        new = m.from_base & ~self._by_base & (self._noise_k[:, 0, 0] > 0.0)
        if not new.any():
            return
        self._by_base |= new
        lost = 1.0 - self._config.refined_share
        self._noise_k[new] *= self._config.refined_share
        # what the map gains, the odometry frame keeps
        a = adjoint(pose.T_o_m)
        self._carried = self._carried + lost * a @ self._noise @ a.T
        self._noise = self._noise * self._config.refined_share

    # what is known

    def of_map_pose(self, T_m_b: F64) -> F64:
        """(6,6) of T_m_b against where its submap began, [translation in m, rotation about the body's axes]."""
        j = _to_body(T_m_b)
        return np.asarray(j @ self._in_m() @ j.T + self._blind + self._of_extrinsic(self._T_m_b0, T_m_b))

    def of_odometry(self, pose: PoseState, T_c_b: F64) -> F64:
        """(6,6) of T_o_b against where the flight began, [translation in o, rotation about the body's axes]."""
        T_m_b = pose.T_m_c @ T_c_b
        T_o_b0 = pose.T_o_m @ T_m_b if self._T_o_b0 is None else self._T_o_b0
        return self._in_o(pose.T_o_m, T_m_b) + self._of_extrinsic(T_o_b0, pose.T_o_m @ T_m_b)

    def guide(self, guided: bool) -> None:
        """Whether an IMU has measured the motion since the last frame."""
        self._guided = guided
        if not guided:
            self._way = {}

    def believes(
        self, T_c_m: F64, submap: SubmapId, predicted_T_m_c: F64, pose: PoseState, T_c_b: F64, active: SubmapId
    ) -> bool:
        """Whether the camera may be at T_c_m (4,4) in a submap, by the way that an IMU measured since it was there."""
        T_o_m = pose.T_o_m if submap == active else self._way.get(submap)
        if T_o_m is None or not self._guided:
            return True
        c = self._config
        here, there = pose.T_o_m @ predicted_T_m_c @ T_c_b, T_o_m @ se3.inverse(T_c_m) @ T_c_b
        e = np.concatenate([there[:3, 3] - here[:3, 3], se3.so3_log(here[:3, :3].T @ there[:3, :3])])
        cov = self.of_odometry(pose, T_c_b) + np.diag(np.repeat([c.surprise_m, c.surprise_rad], 3) ** 2)
        return float(e @ np.linalg.solve(cov, e)) < c.surprise**2

    def quality(self, cov: F64, inliers: int | None) -> int:
        """How likely, in percent and at least 1, a pose of covariance cov (6,6) is good, as the configuration says.
        inliers: None where images had no part in it.
        """
        c = self._config
        trust = 1.0
        if inliers is not None:
            trust = min(max((inliers - c.few_inliers) / (c.many_inliers - c.few_inliers), 0.0), 1.0)
        return max(1, round(100.0 * trust * probability_good(cov, c.good_m, c.good_rad)))

    def _in_m(self) -> F64:
        return np.asarray(self._noise + (self._shift * self._calibration) @ self._shift.T)

    def _in_o(self, T_o_m: F64, T_m_b: F64) -> F64:
        a, j = adjoint(T_o_m), _to_body(T_o_m @ T_m_b)
        turn = np.eye(6)
        turn[:3, :3] = T_o_m[:3, :3]
        return np.asarray(j @ (self._carried + a @ self._in_m() @ a.T) @ j.T + turn @ self._blind @ turn.T)

    def _of_extrinsic(self, T_a_b0: F64, T_a_b: F64) -> F64:
        """What a wrong place of the camera in the body makes of a motion of the body from T_a_b0 to T_a_b."""
        T_b0_b = se3.inverse(T_a_b0) @ T_a_b
        j = _to_body(T_a_b) @ adjoint(T_a_b0) @ (np.eye(6) - adjoint(T_b0_b))
        return np.asarray(j @ self._extrinsic @ j.T)


def probability_good(cov: F64, good_m: float, good_rad: float) -> float:
    """How likely an error of covariance cov (6,6) stays within both limits, as if they were independent of each other.

    The length of a Gaussian vector, by the cube root of its square (E. Wilson, M. Hilferty, 1931; for unequal axes
    D. Jensen, H. Solomon, 1972).
    """
    both = 1.0
    for block, limit in ((cov[:3, :3], good_m), (cov[3:, 3:], good_rad)):
        mean, square = float(np.trace(block)), float(np.sum(block * block))
        if mean > 1e-18:
            k = mean * mean / square
            z = ((limit * limit / mean) ** (1.0 / 3.0) - 1.0 + 2.0 / (9.0 * k)) / math.sqrt(2.0 / (9.0 * k))
            both *= 0.5 * math.erfc(-z / math.sqrt(2.0))
    return both


def adjoint(T: F64) -> F64:
    """(6,6): Exp(adjoint @ x) T = T Exp(x) for x [translation, rotation]."""
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = T[:3, :3]
    out[:3, 3:] = se3.skew(T[:3, 3]) @ T[:3, :3]
    return out


def _to_body(T_a_b: F64) -> F64:
    """(6,6): of [translation in a, rotation about the body's axes] by a perturbation on the left of T_a_b."""
    j = np.zeros((6, 6))
    j[:3, :3], j[:3, 3:], j[3:, 3:] = np.eye(3), -se3.skew(T_a_b[:3, 3]), T_a_b[:3, :3].T
    return j
