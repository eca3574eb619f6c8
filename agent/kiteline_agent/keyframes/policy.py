"""Decides when a frame becomes a keyframe."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kiteline_agent.config import KeyframeConfig
from kiteline_agent.imaging.feature_kernels import occupy
from kiteline_agent.tracking.track import Track
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.order_statistics import median

_COVER_KEPT = 0.8  # share of the reference's cover: a keyframe that regains a fifth of the landmarks is worth its bytes
_COVER_CELLS = 39  # of the image, 8 x 5 at 752x480: coarse enough that an even track fills nearly all


@dataclass(frozen=True, slots=True)
class Situation:
    """What the rules read."""

    frames_since: int
    seconds_since: float
    inliers: int
    reference_inliers: int  # of the first frame that was tracked after the newest keyframe
    cover: float  # share of coarse image cells with a tracked landmark
    moved_ratio: float  # translation since the reference keyframe over median depth
    turned_rad: float  # rotation since the reference keyframe
    reference_cover: float = 1.0  # cover of the first frame that was tracked after the newest keyframe


@dataclass(frozen=True, slots=True)
class Rule:
    """One row of the policy. needs: whether a situation needs a keyframe. pressing: it does not wait for the link."""

    name: str
    needs: Callable[[Situation, KeyframeConfig], bool]
    pressing: bool = False


def _is_bare(now: Situation, config: KeyframeConfig) -> bool:
    """True if few cells hold a landmark, and fewer than after the newest keyframe.

    Another keyframe fills no more cells where the image shows nothing: sky, plain walls, the dark rim of a fisheye.
    """
    return now.cover < min(config.min_cover, _COVER_KEPT * now.reference_cover)


# A frame becomes a keyframe if any row needs one; the frame after a keyframe never does.
RULES = (
    Rule("few points left", lambda s, c: s.inliers < c.min_inliers, True),
    Rule("share of the reference", lambda s, c: s.inliers < c.min_share * s.reference_inliers, True),
    Rule("bare image regions", _is_bare, True),
    Rule("new viewpoint", lambda s, c: s.moved_ratio > c.baseline_ratio),
    Rule("new direction", lambda s, c: s.turned_rad > c.rotation_rad),
    Rule("heartbeat", lambda s, c: s.seconds_since > c.max_gap_s),
)


@dataclass(frozen=True, slots=True)
class KeyframeNeed:
    """A keyframe is needed. rule: the first row that needs it. pressing: some row is."""

    rule: str
    pressing: bool


def keyframe_need(situation: Situation, config: KeyframeConfig) -> KeyframeNeed | None:
    """The rules that need a keyframe; None if none does."""
    if situation.frames_since < 2:
        return None  # the tracker uses a keyframe before the next one is made
    rows = [rule for rule in RULES if rule.needs(situation, config)]
    return KeyframeNeed(rows[0].name, any(rule.pressing for rule in rows)) if rows else None


def situation(
    track: Track, T_m_k: F64, frames_since: int, seconds_since: float, reference_inliers: int,
    cover: float, reference_cover: float,
) -> Situation:  # fmt: skip
    """Measure what the rules read. T_m_k: (4,4) of the reference keyframe. cover, reference_cover: see Situation."""
    uv = track.observed[track.inlier, :2]
    T_c_k = track.T_c_m @ T_m_k
    depth = median(track.depth_m[track.inlier]) if len(uv) else 1.0
    return Situation(
        frames_since,
        seconds_since,
        track.inliers,
        reference_inliers,
        cover,
        math.hypot(*T_c_k[:3, 3].tolist()) / max(depth, 0.1),
        math.hypot(*se3.so3_log(T_c_k[:3, :3]).tolist()),
        reference_cover,
    )


def coverage(uv: F64, camera: RectifiedCamera) -> float:
    """Share of the coarse cells of an image that hold one of the pixels uv (n,2)."""
    side_px = round(math.sqrt(camera.width * camera.height / _COVER_CELLS))
    columns = -(-camera.width // side_px)
    rows = -(-camera.height // side_px)
    covered = np.zeros((rows, columns), np.bool_)
    occupy(np.ascontiguousarray(uv, np.float64), float(side_px), covered)
    return float(np.count_nonzero(covered) / covered.size)
