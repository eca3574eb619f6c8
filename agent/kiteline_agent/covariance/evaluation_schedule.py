"""When the covariance of the pose is evaluated again."""

import math

from kiteline_agent.tracking.track import Track
from kiteline_core.arrays import F64

_EVERY = 4  # frames between two evaluations
_FEWER = 0.7  # share of the inliers of the last evaluation below which the next one is due at once
_LEAST_M = 5e-3  # m of motion below which noise is larger than what changes: a worn rig errs by a tenth of it
_GROWN = 0.25  # share of the distance from the start after which the next one is due


class EvaluationSchedule:
    """Every few frames; near the start, where errors grow with the distance from there, after a share of it."""

    def __init__(self) -> None:
        self._frames = 0  # since the last evaluation
        self._inliers = 0  # of the last evaluation
        self._start_m = self._last_m = [0.0, 0.0, 0.0]  # camera in m: first of the submap, and of the last evaluation

    def begin(self, camera_m: F64) -> None:
        """Begin a submap with the camera at camera_m (3,)."""
        self._start_m = self._last_m = camera_m.tolist()
        self._frames = self._inliers = 0

    def is_due(self, track: Track) -> bool:
        """Count a frame; True if the covariance is to be evaluated at it."""
        self._frames += 1
        if self._frames > _EVERY or track.inliers < _FEWER * self._inliers:
            return True
        near_m = max(_LEAST_M, _GROWN * math.dist(self._last_m, self._start_m))
        return math.dist(_camera_m(track), self._last_m) > near_m

    def evaluated(self, track: Track) -> None:
        """The covariance was evaluated at this frame."""
        self._frames, self._inliers, self._last_m = 0, track.inliers, _camera_m(track)


def _camera_m(track: Track) -> list[float]:
    T_c_m = track.T_c_m
    return list((-T_c_m[:3, 3] @ T_c_m[:3, :3]).tolist())
