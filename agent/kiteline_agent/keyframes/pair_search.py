"""Compares both images of a stereo pair by descriptors, where hardly a corner is matched along the rows."""

from enum import Enum

import numpy as np

from kiteline_agent.governor.cost_model import Work
from kiteline_agent.imaging import features
from kiteline_agent.imaging.row_alignment import RowAlignment
from kiteline_agent.keyframes.new_landmarks import NewPoints
from kiteline_agent.tracking.frame_context import FrameContext
from kiteline_core.arrays import F64
from kiteline_core.imaging import matching

_AGAIN_S, _MOST_AGAIN_S = 0.5, 30.0  # s between two searches, 20 ms each: twice as long after each that finds nothing
_LEAST = 20  # matches that agree, and
_SHARE = 0.5  # their share of all: of two images that show one scene most are right, else they scatter over all rows
_AGREE_PX = 2.0  # px; slopes of the rows across the image, and corners of whole pixels
_MOST_ROWS = 0.05  # of the image's height, by which rows may be off: a mount bent by 1.5 degrees at 480 rows


class Fault(Enum):
    """Why no map can begin with a frame."""

    CORNERS = "images: too few corners to begin a map: dark, blurred, or of something plain"
    DEPTH = "images: too few corners have a depth: no right image comes, or depth images have another scale or view"
    PAIR = (
        "images: the right one shows hardly anything of what the left one shows: check that they are not exchanged "
        "or upside down, of one instant and of one pair of cameras, the lenses, and the calibration"
    )
    PARALLAX = (
        "images: no two views of one camera tell depths, and there is no pose before: move it sideways, do not only "
        "turn it; or there are too few corners: dark, blurred, or of something plain"
    )


class PairSearch:
    """Searches for the rows of the right image."""

    def __init__(self, rows: RowAlignment, work: Work) -> None:
        self._rows = rows
        self._work = work
        self._next_ns: int | None = None  # when the next search may be
        self._again_s = _AGAIN_S

    def find_rows(self, ctx: FrameContext, points: NewPoints) -> bool:
        """Search by the corners of the left image; True if the right one is read at other rows from now on."""
        right, config = ctx.images.right, ctx.config
        if right is None or (self._next_ns is not None and ctx.t_ns < self._next_ns):
            return False
        pyramid = right.rectified()
        corners = features.detect(pyramid, np.zeros((0, 2)), config.detector)
        angle, descriptor = features.describe(pyramid, corners.uv, corners.octave)
        pairs = matching.match(points.descriptor, points.angle, descriptor, angle)
        self._work.rectified_px += pyramid[0].size
        self._work.detected_px += pyramid[0].size
        self._work.new_landmarks += len(corners.uv)
        left_uv, right_uv = points.uv[pairs.a], corners.uv[pairs.b]
        off_px = rows_of(left_uv, right_uv, self._rows.at(right_uv), _MOST_ROWS * pyramid[0].shape[0])
        found = off_px is not None and self._rows.read_lower(off_px)
        self._again_s = _AGAIN_S if found else min(2.0 * self._again_s, _MOST_AGAIN_S)
        self._next_ns = ctx.t_ns + round(self._again_s * 1e9)
        if found:
            right.rows_changed()
        return found


def rows_of(left_uv: F64, right_uv: F64, expected_px: F64, most_px: float) -> float | None:
    """By how much more rows are off than expected, in px, by matched corners (n,2) px; None where they do not agree.

    expected_px: (n,) by how much the right corners are known to be lower.
    """
    disparity, lower = left_uv[:, 0] - right_uv[:, 0], right_uv[:, 1] - left_uv[:, 1] - expected_px
    off = lower[(disparity >= 0.0) & (np.abs(lower) <= most_px)]
    level = float(np.median(off)) if len(off) else 0.0
    agreeing = np.count_nonzero(np.abs(off - level) < _AGREE_PX)
    return level if agreeing >= max(_LEAST, _SHARE * len(disparity)) else None
