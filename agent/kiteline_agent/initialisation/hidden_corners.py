"""Corners that something hides for a while, before there is a map: found again where the gyro says that they are.

A hand, a bird or a tree that passes close by covers the view for a third of a second; images may also be dark for as
long. Without these corners the window of a start would be cut in two, and lengths on both sides of the cut would be
unrelated.
"""

import numpy as np

from kiteline_agent.imaging.features import Pyramid
from kiteline_agent.imaging.optical_flow import Flow, follow
from kiteline_agent.initialisation.frame_flow import motion_beside
from kiteline_agent.initialisation.two_view_models import fundamental
from kiteline_core.arrays import F64, I64, Bool
from kiteline_core.geometry.cameras import RectifiedCamera

_LEVELS = 3  # of the flow above the finest one: parallax is not known
_SIGMA_PX = 0.7  # px, deviation from the epipolar line: windows drift where the camera has moved on
_LEAST, _LEAST_SHARE = 16, 0.5  # corners that fit one motion, and their share: fewer are chance
_MOST = 0.75  # share of the corners: with as many found the others are not searched again
_DRAWS, _SEED = 150, 0  # of eight corners, each of which tells a motion


class HiddenView:
    """A view and its corners, some of which the next views do not show. ids: (n,), increasing. uv: (n,2) px."""

    def __init__(self, t_ns: int, left: Pyramid, ids: I64, uv: F64, camera: RectifiedCamera) -> None:
        self.t_ns = t_ns
        self.ids = ids
        self._image = left[0]
        self._uv = uv
        self._camera = camera

    def find(self, left: Pyramid, known: I64, turn: F64, flow: Flow) -> tuple[I64, F64]:
        """Ids (m,), increasing, and pixels (m,2) in a later image of corners that are not known there.

        known: ids of the corners there. turn: (3,3) rotation of the later camera in this one, by the gyro.
        """
        lost = np.flatnonzero(~np.isin(self.ids, known))
        before = self._uv[lost]
        guess = turned(before, turn, self._camera)
        uv, found = follow(self._image, left[0], before, flow, _LEVELS, guess)
        found = _consistent(before, uv, found)
        if 0 < np.count_nonzero(found) < _MOST * len(found):  # their motion tells where to look for the others
            others = np.flatnonzero(~found)
            guess[others] += motion_beside(before[found], (uv - guess)[found], before[others])
            uv[others], found[others] = follow(self._image, left[0], before[others], flow, _LEVELS, guess[others])
            found = _consistent(before, uv, found)
        return self.ids[lost[found]], uv[found]


def turned(uv: F64, turn: F64, camera: RectifiedCamera) -> F64:
    """Pixels (n,2) of corners after a rotation (3,3) of the camera alone; those behind it are far outside."""
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    ray = np.column_stack([(uv - centre) / focal, np.ones(len(uv))]) @ turn
    return np.asarray(ray[:, :2] / np.maximum(ray[:, 2:], 0.1) * focal + centre)


def _consistent(before: F64, after: F64, found: Bool) -> Bool:
    """Of the corners found (n,) at `after` (n,2), those that one motion of the camera explains.

    The bias of a gyro is not known yet, so that its turn does not tell epipolar lines.
    """
    kept, rows = np.zeros(len(found), np.bool_), np.flatnonzero(found)
    if len(rows) >= _LEAST:
        fits = fundamental(before[rows], after[rows], _DRAWS, _SIGMA_PX, _SEED)[2]
        if np.count_nonzero(fits) >= max(_LEAST, _LEAST_SHARE * len(rows)):
            kept[rows[fits]] = True
    return kept
