"""How certain the pose is: noise that adds up from keyframe to keyframe, errors of the calibration, time flown blind.

A pose errs in four ways. *Noise*: it errs as the keyframes at whose points it was measured, and on top as that
measurement; a vehicle that comes back to old points is as certain as they are. *Calibration*: what a good calibration
leaves is the same error in every frame, so it does not average out but bends and stretches the whole map; its few
parameters are not estimated, only what they do to each keyframe is carried along (S. F. Schmidt's consider filter,
1966; as in J. Civera et al., "Drift-free real-time sequential mosaicing", for maps). *Pull*: what an IMU moves poses by
from where the images see them; either may be right. *Blindness*: without images the IMU's own covariance, or
accelerations that nobody knows.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.config import CovarianceConfig
from kiteline_agent.covariance.calibration_error_kernels import (
    CALIBRATION,
    DISPARITY_SHAPES,
    SHAPES,
    adjoint_into,
    pose_covariance,
    sensitivity,
)
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.tracking.pose_state import PoseState
from kiteline_agent.tracking.track import Track
from kiteline_core.geometry import se3
from kiteline_core.ids import KeyframeId, SubmapId

F64 = NDArray[np.float64]

_MET_PX = 1.0  # px, of a corner at full size that met a copy of another keyframe's
_MET_DEPTH_M = 4.0  # of such corners
_EVERY = 4  # frames between two that are weighed
_FEWER = 0.7  # share of the inliers of the last weighed frame below which another is at once


class Certainty:
    """Once a frame `measured` or `blind`; `remember` for each keyframe; `carry` before the map changes under the pose.

    Perturbations stand on the left of poses in m (or o), [translation, rotation].
    """

    def __init__(self, local_map: LocalMap, T_b_c: F64, config: CovarianceConfig, *, has_body: bool, has_depth: bool):
        """has_body: the camera's place in the body is a calibration. has_depth: stereo or a depth camera."""
        self._map = local_map
        self._T_b_c = T_b_c
        self._config = config
        slots = len(local_map.keyframe)
        self._noise_k, self._shift_k = np.zeros((slots, 6, 6)), np.zeros((slots, 6, SHAPES))  # of each keyframe
        self._by_base = np.zeros(slots, np.bool_)
        self._calibration = np.full(SHAPES, config.calibration_px**2)
        self._calibration[CALIBRATION] = config.pull_share**2
        self._calibration[:DISPARITY_SHAPES] *= 2.0 if has_depth else 0.0  # two cameras make a disparity
        extrinsic = np.repeat([config.extrinsic_m, config.extrinsic_rad], 3) if has_body else np.zeros(6)
        a = adjoint(T_b_c)
        self._extrinsic = a @ np.diag(extrinsic**2) @ a.T
        self._noise, self._shift = np.zeros((6, 6)), np.zeros((6, SHAPES))  # of the camera in m
        self._way: dict[SubmapId, F64] = {}  # T_o_m of the submaps that were left since all motion was last measured
        self._guided = False  # an IMU measures all motion
        self._metric = has_depth
        self._strange = False  # the place that was found last is far from where the vehicle could be expected
        self._doubt = 0  # frames for which such a place is doubted yet
        self._pull = np.zeros(6)  # what an IMU lately moves poses by from where images say, on the left of T_c_m
        self._dispute = np.zeros((6, 6))  # covariance of that
        self._blind_s: float | None = 0.0  # that nothing measured motion; None: the last frame was measured
        self._blind = np.zeros((6, 6))  # [translation in m, rotation about the body's axes], since images were lost
        self._carried = np.zeros((6, 6))  # of the submap in o
        self._nothing = np.zeros((6, 6))
        self._in_one = True  # o is the submap's own frame
        self._age = 0  # frames since the last was weighed
        self._inliers = 0  # of that one
        self._track: Track | None = None  # of this frame, where it was not weighed
        self._T_m_b0: F64 = np.eye(4)  # where the submap began
        self._T_o_b0: F64 | None = None  # where the flight began
        self._h, self._g = np.zeros((6, 6)), np.zeros((6, SHAPES))

    # what happens

    def begin(self, T_m_b: F64) -> None:
        """A submap begins with the keyframe that follows, at T_m_b (4,4)."""
        self._noise, self._shift = np.zeros((6, 6)), np.zeros((6, SHAPES))
        self._seen(0)
        self._blind_s = 0.0
        self._T_m_b0 = T_m_b
        if self._T_o_b0 is None:
            self._T_o_b0 = T_m_b

    def measured(self, track: Track) -> None:
        """The images gave the camera's pose, from points of the local map.

        What that is worth changes slowly from frame to frame, told as errors on the left: it is worked out for every
        keyframe, after what was no such frame, and now and then between.
        """
        self._doubt = max(self._doubt - 1, 0)
        if self._blind_s is None and self._age < _EVERY and track.inliers >= _FEWER * self._inliers:
            self._age += 1
            self._track = track
            return
        self._weigh(track)

    def fused(self, seen_T_c_m: F64, T_c_m: F64) -> None:
        """The images alone said seen_T_c_m (4,4), with the IMU it became T_c_m (4,4).

        Were both as good as they claim, the two would hardly differ. What the IMU pulls the pose off the images, no
        covariance of either tells, but it is seen here (as noise is in R. Mehra, "On the identification of variances
        and adaptive Kalman filtering", 1970): its mean goes the same way in all keyframes and adds up, as an error of
        the calibration does; the rest is noise.
        """
        X = T_c_m @ se3.inverse(seen_T_c_m)
        d = np.array([X[0, 3], X[1, 3], X[2, 3], X[2, 1], X[0, 2], X[1, 0]])
        share = 1.0 / self._config.dispute_frames
        self._pull += share * (d - self._pull)
        d -= self._pull
        self._dispute += share * (np.outer(d, d) - self._dispute)

    def _weigh(self, track: Track) -> None:
        m = self._map
        sensitivity(
            track.T_c_m, m.intrinsics, 0.5 * m.camera.width, track.rows, track.inlier, track.xyz, track.ray,
            track.observed, track.sigma_px, m.births, m.T_m_k, m.uv.reshape(-1, 2), m.rho.reshape(-1), self._shift_k,
            self._h, self._g,
        )  # fmt: skip
        inverse = np.linalg.inv(self._h + 1e-6 * np.eye(6))
        a = adjoint(se3.inverse(track.T_c_m))
        noise = max(track.rms, self._config.least_rms) ** 2 * self._config.inflation * inverse
        seen = np.bincount(track.rows[track.inlier] // m.births)
        slots = np.flatnonzero(seen)
        share = seen[slots] / max(int(seen.sum()), 1)
        self._noise = a @ (noise + self._dispute) @ a.T + np.tensordot(share, self._noise_k[slots], 1)
        self._shift = a @ (inverse @ self._g)
        self._shift[:, CALIBRATION] -= a @ self._pull
        self._seen(track.inliers)

    def _seen(self, inliers: int) -> None:
        """The pose is measured now."""
        self._blind, self._blind_s = np.zeros((6, 6)), None
        self._age, self._inliers, self._track = 0, inliers, None

    def remember(self, keyframe: KeyframeId) -> None:
        """This frame became a keyframe."""
        if self._track is not None:
            self._weigh(self._track)
        slot = self._map.slot_of(keyframe)
        self._noise_k[slot], self._shift_k[slot], self._by_base[slot] = self._noise, self._shift, False

    def blind(self, dt_s: float, inertial: F64 | None, *, moves: bool = True) -> None:
        """No image for another dt_s. inertial: (6,6) of the pose by the IMU, [translation in m, rotation about the
        body's axes]; None where nothing measures motion. moves: whether it was known when images were lost.
        """
        c = self._config
        before = self._blind_s or 0.0
        self._blind_s = before
        if inertial is not None:
            self._blind = inertial
            return
        self._blind_s = before + dt_s
        speed = (c.blind_velocity_m_s, c.blind_rate_rad_s) if moves else (c.blind_speed_m_s, c.blind_speed_rad_s)
        (m0, m1), (t0, t1) = (
            tuple(v * s + 0.5 * a * s * s for s in (before, self._blind_s))
            for v, a in zip(speed, (c.blind_accel_m_s2, c.blind_turn_rad_s2), strict=True)
        )
        grown = np.repeat([m1 * m1 - m0 * m0, min(t1 * t1 - t0 * t0, 10.0)], 3)
        self._blind = self._blind + np.diag(grown)

    def blind_within(self, m: float, rad: float) -> bool:
        """Whether what was flown blind has a deviation of no more than m, in any direction, and rad, about any axis."""
        largest = (float(np.linalg.eigvalsh(block)[-1]) for block in (self._blind[:3, :3], self._blind[3:, 3:]))
        return all(value <= limit**2 for value, limit in zip(largest, (m, rad), strict=True))

    def bridge(self, T_m_b: F64) -> None:
        """The map goes on with a keyframe at T_m_b (4,4), which was come by blindly."""
        back = np.eye(6)
        back[:3, 3:], back[3:, 3:] = se3.skew(T_m_b[:3, 3]) @ T_m_b[:3, :3], T_m_b[:3, :3]
        self._noise = self._noise + back @ self._blind @ back.T
        self._seen(0)
        self._blind_s = 0.0

    def met(self, keyframe: KeyframeId, T_c_m: F64, points: int) -> None:
        """The pose is T_c_m (4,4) by so many points that are not in the local map, beside this keyframe."""
        slot = self._map.slot_of(keyframe)
        depth_m, focal_px = _MET_DEPTH_M, self._map.camera.fx
        turn = _MET_PX / focal_px / math.sqrt(max(points, 4))
        own = np.diag(np.repeat([turn * depth_m, turn], 3) ** 2)
        a = adjoint(se3.inverse(T_c_m))
        self._noise, self._shift = self._noise_k[slot] + a @ own @ a.T, self._shift_k[slot].copy()
        self._seen(0)
        self._blind_s = 0.0

    def carry(self, pose: PoseState, T_c_b: F64, submap: SubmapId) -> None:
        """The map of this submap is about to change under the camera, the odometry frame goes on as it is."""
        if self._guided or self._metric:
            self._way[submap] = pose.T_o_m
        T_m_b = pose.T_m_c @ T_c_b
        left, out = np.empty((6, 6)), np.empty((6, 6))
        self._tell(pose.T_o_m, T_m_b, np.eye(4), left, out)
        # what was flown blind is told about the body, the rest on the left
        T_o_b = pose.T_o_m @ T_m_b
        back = np.eye(6)
        back[:3, 3:], back[3:, 3:] = se3.skew(T_o_b[:3, 3]) @ T_o_b[:3, :3], T_o_b[:3, :3]
        turn = np.eye(6)
        turn[:3, :3] = pose.T_o_m[:3, :3]
        blind = back @ turn @ self._blind @ turn.T @ back.T
        self._carried, self._in_one = left + blind, False

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
        self._in_one = False
        a = adjoint(pose.T_o_m)
        self._carried = self._carried + lost * a @ self._noise @ a.T
        self._noise = self._noise * self._config.refined_share

    # what is known

    def of_poses(self, pose: PoseState, T_m_b: F64) -> tuple[F64, F64]:
        """(6,6) of T_m_b against where its submap began and of T_o_b against where the flight began, each [translation
        in m or o, rotation about the body's axes].
        """
        left, cov_m = np.empty((6, 6)), np.empty((6, 6))
        kept, self._carried = self._carried, self._nothing
        self._tell(np.eye(4), T_m_b, self._T_m_b0, left, cov_m)
        self._carried = kept
        if self._in_one:  # o and m have been one so far
            return cov_m, cov_m
        cov_o = np.empty((6, 6))
        self._tell(pose.T_o_m, T_m_b, self._T_m_b0 if self._T_o_b0 is None else self._T_o_b0, left, cov_o)
        return cov_m, cov_o

    def _tell(self, T_a_m: F64, T_m_b: F64, T_a_b0: F64, left: F64, out: F64) -> None:
        pose_covariance(
            self._noise, self._shift, self._calibration, self._carried, self._blind, self._extrinsic,
            np.ascontiguousarray(T_a_m), np.ascontiguousarray(T_m_b), np.ascontiguousarray(T_a_b0), left, out,
        )  # fmt: skip

    def guide(self, guided: bool) -> None:
        """Whether an IMU has measured the motion since the last frame."""
        self._guided = guided
        if not guided and not self._metric:
            self._way = {}  # maps of one eye differ in scale

    def believes(
        self, T_c_m: F64, submap: SubmapId, predicted_T_m_c: F64, pose: PoseState, T_c_b: F64, active: SubmapId,
        *, found: bool,
    ) -> bool:  # fmt: skip
        """Whether the camera may be at T_c_m (4,4) in a submap, by the way that was measured since it was there, or,
        where nothing measured it, by what a vehicle can fly meanwhile. found: by its looks, not where it was expected.
        """
        T_o_m = pose.T_o_m if submap == active else self._way.get(submap)
        if T_o_m is None or not (self._guided or (found and self._metric)):
            return True
        self._strange = False
        c = self._config
        here, there = pose.T_o_m @ predicted_T_m_c, T_o_m @ se3.inverse(T_c_m)
        away_m = float(np.abs(there[:3, 3] - here[:3, 3]).sum())
        turned = 0.5 * (3.0 - float(np.vdot(here[:3, :3], there[:3, :3])))  # 1 - cos
        if away_m < c.surprise_m and turned < 0.5 * c.surprise_rad**2:
            return True
        if not self._guided and submap == active and self._blind_s is None:
            return True  # nothing is known yet of how it was lost
        here, there = here @ T_c_b, there @ T_c_b
        e = np.concatenate([there[:3, 3] - here[:3, 3], se3.so3_log(here[:3, :3].T @ there[:3, :3])])
        cov = self.of_poses(pose, pose.T_m_c @ T_c_b)[1] + np.diag(np.repeat([c.surprise_m, c.surprise_rad], 3) ** 2)
        apart = math.sqrt(float(e @ np.linalg.solve(cov, e)))
        if self._guided:
            return apart < c.surprise
        self._strange = apart >= c.strange
        return apart < c.surprise_blind

    def returned(self) -> None:
        """The camera is where it was last believed to be found. If it came there strangely, that has to be seen for a
        while.
        """
        self._doubt = self._config.doubt_frames if self._strange else 0

    def quality(self, cov: F64, inliers: int | None) -> int:
        """How likely, in percent and at least 1, a pose of covariance cov (6,6) is good, as the configuration says.
        inliers: None where images had no part in it.
        """
        c = self._config
        trust = 1.0
        if inliers is not None:
            trust = min(max((inliers - c.few_inliers) / (c.many_inliers - c.few_inliers), 0.0), 1.0)
        most = 100 if self._doubt == 0 else c.flagged_below - 1
        return min(max(1, round(100.0 * trust * probability_good(cov, c.good_m, c.good_rad))), most)


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
    out = np.empty((6, 6))
    adjoint_into(np.ascontiguousarray(T), out)
    return out
