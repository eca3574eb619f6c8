"""The measured pose of one frame, and the observations behind it."""

from dataclasses import dataclass

import numpy as np

from kiteline_agent.config import PoseConfig
from kiteline_core.arrays import F64, I64, Bool
from kiteline_core.geometry import se3


@dataclass(frozen=True, slots=True)
class Track:
    """A pose measured from n landmarks of the local map.

    T_c_m: (4,4). rows: (n,) of the local map. observed: (n,3) u, v, disparity px (< 0: none). sigma_px: (n,).
    depth_m: (n,) of the landmarks in the camera. inlier: (n,). inliers: how many. rms: whitened error of the inliers.
    tried: number of landmarks that were searched for. xyz: (n,3) m, landmark positions in m. ray: (n,3) m, one standard
    deviation of depth as a vector.
    """

    T_c_m: F64
    rows: I64
    observed: F64
    sigma_px: F64
    depth_m: F64
    inlier: Bool
    inliers: int
    rms: float
    tried: int
    xyz: F64
    ray: F64

    @property
    def T_m_c(self) -> F64:
        """(4,4) camera in the submap."""
        return se3.inverse(self.T_c_m)

    def holds(self, config: PoseConfig) -> bool:
        """True if enough of the landmarks that were searched for are inliers."""
        return self.inliers >= max(config.min_inliers, config.min_share * self.tried)


def track_without_landmarks(T_c_m: F64, inliers: int) -> Track:
    """A pose (4,4) from `inliers` cached landmarks, none of which is in the local map."""
    none = np.zeros(0)
    return Track(
        T_c_m, np.zeros(0, np.int64), np.zeros((0, 3)), none, none, np.zeros(0, np.bool_), inliers, 0.0,
        inliers, np.zeros((0, 3)), np.zeros((0, 3)),
    )  # fmt: skip
