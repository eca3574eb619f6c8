"""How far corrections move the map at the camera: by the landmarks that the last frame tracked.

Keyframe and landmarks do not move alike: a refined landmark moves relative to its keyframe, and the landmarks in view
hang on many keyframes. The camera moves with what it sees, so that the next frame is where odometry expects it.
"""

from typing import NamedTuple

import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.tracking.track import Track
from kiteline_core.arrays import F64, Bool
from kiteline_core.geometry import se3
from kiteline_core.ids import KeyframeId
from kiteline_core.order_statistics import median
from kiteline_core.pose import pose_kernels

_LEAST_DEPTH_M = 1e-3  # m


class MapMotion(NamedTuple):
    """Motion of the map under a camera: p_new = T_new_old p_old, (4,4). growth: factor of the depths that it sees."""

    T_new_old: F64
    growth: float


class MapAnchor:
    """The landmarks of a frame before corrections are applied; `motion` compares them with those afterwards."""

    def __init__(self, local_map: LocalMap, track: Track, config: AgentConfig, *, inertial: bool) -> None:
        """inertial: the track was fused with an IMU."""
        self._map = local_map
        self._least_px = config.local_map.inertial_px if inertial else config.local_map.camera_px
        self._config = config
        self._track = track
        self._rows = track.rows[track.inlier]
        self._keyframes = local_map.keyframe[self._rows // local_map.slot_size]
        self._xyz, self._ray = local_map.positions(self._rows)
        self.posed_points = 0  # landmarks that were compared, for the cost model

    @property
    def keyframes(self) -> set[KeyframeId]:
        """The keyframes of the landmarks."""
        return set(self._keyframes.tolist())

    def matters(self) -> bool:
        """True if the map moved the camera by enough pixels, or if too few landmarks are left to say by how many."""
        moved = self.motion()
        if moved is None:
            return True
        T_c_m = self._track.T_c_m
        change = T_c_m @ moved.T_new_old @ se3.inverse(T_c_m)
        depth = median(self._track.depth_m[self._track.inlier])
        shift_m, turn = se3.shift_and_turn(change)
        return self._map.camera.fx * (shift_m / depth + turn) >= self._least_px

    def motion(self) -> MapMotion | None:
        """How the map moved under the camera. None with too few landmarks left."""
        m = self._map
        left = m.usable.reshape(-1)[self._rows] & (m.keyframe[self._rows // m.slot_size] == self._keyframes)
        if np.count_nonzero(left) < self._config.pose.min_inliers:
            return None
        before, (after, _) = self._xyz[left], m.positions(self._rows[left])
        self.posed_points += len(after)
        T_c_old, T_c_new = self._pose(before, left), self._pose(after, left)
        depth_before, depth_after = (
            np.maximum(xyz @ T[2, :3] + T[2, 3], _LEAST_DEPTH_M) for T, xyz in ((T_c_old, before), (T_c_new, after))
        )
        return MapMotion(se3.orthonormalise(se3.inverse(T_c_new) @ T_c_old), median(depth_after / depth_before))

    def _pose(self, xyz: F64, left: Bool) -> F64:
        """T_c_m (4,4) from the frame's observations of landmarks at xyz (n,3)."""
        track, config = self._track, self._config.pose
        T = track.T_c_m.copy()
        inlier = np.ones(len(xyz), np.bool_)
        pose_kernels.optimise_pose(
            T, xyz, self._ray[left], track.observed[track.inlier][left], track.sigma_px[track.inlier][left],
            self._map.intrinsics, 1, config.iterations, config.chi2, inlier,
        )  # fmt: skip
        return se3.orthonormalise(T)
