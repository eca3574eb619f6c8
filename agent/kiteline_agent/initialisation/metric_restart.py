"""A map in metres out of one in a unit of its own: what is tracked at this moment is born anew.

What was shared keeps its unit, so a scale that becomes known begins a new submap instead of changing the old one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.imaging import features
from kiteline_agent.imaging.feature_kernels import BORDER
from kiteline_agent.keyframes.policy import NewPoints
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.tracking.tracker import FrameImages, Track
from kiteline_core.ids import KeyframeId

F64 = NDArray[np.float64]

_LEAST_SIGMA_PX = 0.06  # virtual disparity error, of depths that many frames have sharpened


@dataclass(frozen=True, slots=True)
class MetricPoints:
    """Births of the first keyframe in metres, in the order in which they are shared. sigma_rho: (n,) 1/m."""

    points: NewPoints
    sigma_rho: F64

    def sharpen(self, local_map: LocalMap, keyframe: KeyframeId) -> None:
        """Say in the local map how well they are known."""
        slot = local_map.slot_of(keyframe)
        n = int(local_map.counts[slot])
        local_map.sigma_rho[slot, :n] = self.sigma_rho[:n]


def metric_points(view: FrameImages, track: Track, local_map: LocalMap, metres: float, cell_px: int) -> MetricPoints:
    """The points of a track as births of its frame. metres: in one unit of the map. cell_px: of the detector."""
    camera = local_map.camera
    octave = local_map.octave[track.rows]
    uv = track.observed[:, :2]
    margin = (BORDER + 1.0) * (1 << octave.astype(np.int64))[:, None]
    inside = (uv >= margin).all(axis=1) & (uv < np.array([camera.width, camera.height]) - margin).all(axis=1)
    keep = np.flatnonzero(track.inlier & inside)
    blur = np.linalg.norm(track.ray[keep], axis=1) / track.depth_m[keep]  # relative deviation of depth
    keep = keep[np.argsort(blur, kind="stable")[: local_map.births]]
    keep = keep[np.lexsort((uv[keep, 0], uv[keep, 1] // cell_px))]
    rho = 1.0 / (metres * track.depth_m[keep])
    blur = np.linalg.norm(track.ray[keep], axis=1) / track.depth_m[keep]
    angle, descriptor = features.describe(view.left, uv[keep], octave[keep])
    points = NewPoints(uv[keep], camera.bf * rho, octave[keep], angle, descriptor)
    return MetricPoints(points, np.maximum(blur * rho, _LEAST_SIGMA_PX / camera.bf))
