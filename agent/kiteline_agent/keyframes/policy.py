"""When a frame becomes a keyframe, and what a keyframe is made of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.config import AgentConfig, KeyframeConfig
from kiteline_agent.imaging import features
from kiteline_agent.tracking.tracker import FrameImages, Track, depth_at
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.imaging import stereo_kernels

F64 = NDArray[np.float64]

_SEARCH_PX = 2.5  # px of the level: how far sub-pixel stereo may lie from the coarse search, whose step is 2 px
_COVER_CELL_PX = 96  # about 8 x 5 cells at 752x480: coarse enough that an even track fills nearly all


@dataclass(frozen=True, slots=True)
class Situation:
    """What the rules look at."""

    frames_since: int
    seconds_since: float
    inliers: int
    reference_inliers: int  # of the first frame that was tracked after the newest keyframe
    cover: float  # share of coarse image cells with a tracked point
    moved_ratio: float  # translation since the nearest keyframe over median depth
    turned_rad: float  # rotation since the nearest keyframe


@dataclass(frozen=True, slots=True)
class Rule:
    """One row of the policy: its name and the condition under which it asks for a keyframe."""

    name: str
    asks: Callable[[Situation, KeyframeConfig], bool]
    pressing: bool = False  # the tracker itself needs it: it does not wait for a thin link


# The policy. A frame becomes a keyframe when min_gap_frames have passed and any row asks for it.
RULES = (
    Rule("few points left", lambda s, c: s.inliers < c.min_inliers, True),
    Rule("share of the reference", lambda s, c: s.inliers < c.min_share * s.reference_inliers, True),
    Rule("bare image regions", lambda s, c: s.cover < c.min_cover, True),
    Rule("new viewpoint", lambda s, c: s.moved_ratio > c.baseline_ratio),
    Rule("new direction", lambda s, c: s.turned_rad > c.rotation_rad),
    Rule("heartbeat", lambda s, c: s.seconds_since > c.max_gap_s),
)


@dataclass(frozen=True, slots=True)
class Wish:
    """A keyframe is asked for. why: the rule. urgent: the track is thin. waits: the link cannot carry it yet."""

    why: str
    urgent: bool
    waits: bool


def why_keyframe(situation: Situation, config: KeyframeConfig) -> str | None:
    """The name of the first rule that asks for a keyframe, or None."""
    if situation.frames_since < config.min_gap_frames:
        return None
    return next((rule.name for rule in RULES if rule.asks(situation, config)), None)


def may_wait(situation: Situation, config: KeyframeConfig) -> bool:
    """Whether no rule that asks for a keyframe is pressing."""
    return not any(rule.pressing and rule.asks(situation, config) for rule in RULES)


def situation(
    track: Track, camera: RectifiedCamera, T_m_k: F64, frames_since: int, seconds_since: float, reference_inliers: int
) -> Situation:
    """Measure what the rules look at. T_m_k: (4,4) of the keyframe nearest in view."""
    uv = track.observed[track.inlier, :2]
    columns = -(-camera.width // _COVER_CELL_PX)
    rows = -(-camera.height // _COVER_CELL_PX)
    row, column = (uv[:, 1] // _COVER_CELL_PX).astype(np.int64), (uv[:, 0] // _COVER_CELL_PX).astype(np.int64)
    covered = np.zeros((rows, columns), np.bool_)
    covered[row, column] = True
    T_c_k = track.T_c_m @ T_m_k
    depth = float(np.median(track.depth_m[track.inlier])) if len(uv) else 1.0
    return Situation(
        frames_since,
        seconds_since,
        track.inliers,
        reference_inliers,
        np.count_nonzero(covered) / covered.size,
        float(np.linalg.norm(T_c_k[:3, 3])) / max(depth, 0.1),
        float(np.linalg.norm(se3.so3_log(T_c_k[:3, :3]))),
    )


@dataclass(frozen=True, slots=True)
class NewPoints:
    """Births of a keyframe, strongest first. uv: (n,2) px. disparity: (n,) px, -1 unknown. octave: (n,).
    angle: (n,). descriptor: (n,32). lent_rho: (n,) 1/m, depths that the base's copies know, 0 none; or None.
    """

    uv: F64
    disparity: F64
    octave: NDArray[np.uint8]
    angle: NDArray[np.uint8]
    descriptor: NDArray[np.uint8]
    lent_rho: F64 | None = None


def new_points(view: FrameImages, taken: F64, camera: RectifiedCamera, config: AgentConfig) -> NewPoints:
    """Corners where no point is tracked, with depth where the row or the depth image gives one."""
    detector = config.detector
    if view.first > detector.first:
        detector = replace(detector, first=view.first)
    corners = features.detect(view.left, taken, detector)
    disparity = np.full(len(corners.uv), -1.0)
    if view.right is not None:
        stereo = config.stereo
        widest = min(camera.bf / stereo.min_depth_m, 0.45 * camera.width)
        stereo_kernels.search_rows(
            view.left, view.right.coarse(), corners.uv, corners.octave, widest, stereo.uniqueness, disparity
        )
        found = np.zeros(len(disparity), np.bool_)
        view.right.refine(view.left, corners.uv, corners.octave, found.copy(), stereo, _SEARCH_PX, disparity, found)
        disparity[~found] = -1.0
        disparity[disparity < camera.fx / config.local_map.max_far_ratio] = -1.0
    elif view.depth_m is not None:
        depth = depth_at(view.depth_m, corners.uv)
        disparity = np.where(depth > 0.0, camera.bf / np.maximum(depth, 1e-3), -1.0)
    # Points with depth first: they are what a tracker lives on.
    order = np.argsort(disparity < 0.0, kind="stable")[: config.local_map.births]
    uv, octave = corners.uv[order], corners.octave[order]
    angle, descriptor = features.describe(view.left, uv, octave)
    return NewPoints(uv, disparity[order], octave, angle, descriptor)
