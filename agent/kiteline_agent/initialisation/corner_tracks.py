"""Corners followed by optical flow over a window of monocular keyframes, before there is a map."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple

import numpy as np

from kiteline_agent.imaging import features
from kiteline_agent.imaging.features import DetectorConfig, Pyramid
from kiteline_agent.imaging.optical_flow import Flow, follow
from kiteline_agent.inertial_start_config import CornerTracksConfig
from kiteline_agent.initialisation.frame_flow import BadImages, FrameFlow
from kiteline_agent.initialisation.hidden_corners import HiddenView, turned
from kiteline_core.arrays import F64, I64, Bool
from kiteline_core.geometry.cameras import RectifiedCamera

_LEVELS, _NEAR_LEVELS = 3, 1  # of the flow above the finest one; where a corner is known to be near
_REPLENISH = 0.85  # share of the corners below which a keyframe adds new ones
_FLOW = Flow(window_px=15, return_px=0.5)  # the smallest window that keeps hold of corners
_DRIFT_PX = 2.0  # px between flow over frames and flow from the last keyframe
KEYFRAME_S = 0.24  # s between two keyframes: short enough for flow, long enough for parallax
_THINNED_S = 0.6  # s; longest time between two keyframes after one was left out
_HIDDEN = 0.5  # share of a keyframe's corners: with fewer left in the next one something hides the others
_MANY = 60  # corners of a keyframe that shows enough to be found again
_HIDDEN_S = 1.5  # s for which they are searched: after that flow hardly finds them, and the view may be another one
_VIEWS = 3  # keyframes that see a corner, at least
_LEAST_TIED = 8  # corners that tie a keyframe to those before it
_NEAR_PX = 4.0  # px between two corners that are one
CORNERS = 200  # followed at once, beside hidden ones; a bundle of 100 long tracks is as accurate as one of 300


@dataclass(frozen=True, slots=True)
class TrackedKeyframe:
    """Corners in one keyframe. left: its pyramid. uv: (n,2) px of the corners with these ids (n,), increasing."""

    t_ns: int
    left: Pyramid
    ids: I64
    uv: F64


@dataclass(frozen=True, slots=True)
class CornerObservations:
    """Corners seen by K keyframes. xy: (K,P,2) x/z, y/z in the camera. seen: (K,P). ids: (P,)."""

    xy: F64
    seen: Bool
    ids: I64

    def part(self, keep: Bool | I64) -> "CornerObservations":
        """The corners in these columns."""
        return CornerObservations(
            np.ascontiguousarray(self.xy[:, keep]), np.ascontiguousarray(self.seen[:, keep]), self.ids[keep]
        )


class _Part(NamedTuple):
    """Keyframes that corners with these ids connect."""

    keyframes: list[TrackedKeyframe]
    ids: set[int]


class CornerTracks:
    """Follows corners from keyframe to keyframe. Frames between tell where to look or, with little CPU, the gyro.

    An image that shows hardly any of the corners is left out, so that it does not cut all tracks in two. So is one of
    which a part jumps, as flow follows it there.
    """

    def __init__(self, camera: RectifiedCamera, detector: DetectorConfig, config: CornerTracksConfig) -> None:
        self._camera = camera
        self._detector = detector
        self._config = config
        self.keyframes: list[TrackedKeyframe] = []
        self.clear()

    def clear(self) -> None:
        """Forget all."""
        self.keyframes = []
        self._next_id = 0
        self._ids: I64 = np.zeros(0, np.int64)
        self._uv = np.zeros((0, 2))  # in the last keyframe
        self._frames = FrameFlow(_FLOW)  # where they are in the last frame
        self._bad_keyframes = BadImages(1)
        self.searched = False  # whether hidden corners were searched in the last frame, for the cost model
        self._hidden: HiddenView | None = None  # the last keyframe that shows corners which something hides now

    @property
    def span_s(self) -> float:
        """Time from the oldest keyframe to the newest."""
        return (self.keyframes[-1].t_ns - self.keyframes[0].t_ns) * 1e-9

    def is_due(self, t_ns: int) -> bool:
        """True if a frame is to become a keyframe."""
        return not self.keyframes or (t_ns - self.keyframes[-1].t_ns) * 1e-9 >= KEYFRAME_S

    def follow(self, left: Pyramid) -> bool:
        """Follow the corners into the frame after the one before; the next keyframe looks for them where they are.

        False if the image is left out.
        """
        good = self._frames.follow(left[0])
        if good is None:
            return False
        self._uv, self._ids = self._uv[good], self._ids[good]
        return True

    def add(self, t_ns: int, left: Pyramid, turn_since: Callable[[int], F64 | None] = lambda t_ns: None) -> bool:
        """Follow the corners from the last keyframe into a new one, and find more. False if the image is left out.

        turn_since: (3,3) rotation of this camera in that at a stamp; None: unknown. It tells where corners are that
        were not followed into this frame.
        """
        self.searched = False
        near = self._frames.image is left[0]
        good = np.zeros(len(self._uv), np.bool_)
        if self.keyframes and len(self._uv):
            before = self.keyframes[-1].left[0]
            if near:
                uv, good = follow(before, left[0], self._uv, _FLOW, _NEAR_LEVELS, self._frames.uv)
                good &= np.linalg.norm(uv - self._frames.uv, axis=1) < _DRIFT_PX
            else:
                turn = turn_since(self.keyframes[-1].t_ns)
                guess = None if turn is None else turned(self._uv, turn, self._camera)
                uv, good = follow(before, left[0], self._uv, _FLOW, _LEVELS, guess)
                if self._bad_keyframes.leaves_out(good):
                    return False
            self._uv, self._ids = uv[good], self._ids[good]
        followed = self._ids
        self._find_hidden(t_ns, left, turn_since)
        self._replenish(left)
        if near:
            self._frames.replace(good, self._uv, np.searchsorted(self._ids, followed))
        else:
            self._frames.begin(left[0], self._uv)
        self.keyframes.append(TrackedKeyframe(t_ns, left, self._ids.copy(), self._uv.copy()))
        return True

    def drop_before(self, t_ns: int) -> None:
        """Forget keyframes that are older than this; of too many, the oldest that lie close to their neighbours."""
        kept, config = [k for k in self.keyframes if k.t_ns >= t_ns], self._config
        while len(kept) > config.keyframes:
            apart_s = [(after.t_ns - before.t_ns) * 1e-9 for before, after in zip(kept, kept[2:], strict=False)]
            close = [k for k, s in enumerate(apart_s, 1) if s < _THINNED_S]
            del kept[close[0] if close else 0]
        self.keyframes = kept

    def keep_connected(self, least_s: float) -> bool:
        """Forget keyframes that too few corners connect to others, before a solution from nothing.

        The part of the newest one is kept alone if it is this long; else all parts of three keyframes and more. False
        if no solution should begin now: corners that are hidden may come back, or too few keyframes are left.
        """
        parts = list[_Part]()
        for keyframe in self.keyframes:
            ids = set(keyframe.ids.tolist())
            connected, others = _Part([keyframe], ids), list[_Part]()
            for part in parts:
                if len(part.ids & ids) >= _LEAST_TIED:
                    connected = _Part([*part.keyframes, *connected.keyframes], part.ids | connected.ids)
                else:
                    others.append(part)
            parts = [*others, connected]
        last, apart = parts[-1].keyframes, chain.from_iterable(part.keyframes for part in parts[:-1])
        if self._hidden is not None and any(keyframe.t_ns == self._hidden.t_ns for keyframe in apart):
            return False  # what hides the corners that would connect them may go
        if last[-1].t_ns - min(keyframe.t_ns for keyframe in last) >= least_s * 1e9:
            parts = parts[-1:]
        kept = [part.keyframes for part in parts if len(part.keyframes) >= _VIEWS or part is parts[-1]]
        self.keyframes = sorted(chain.from_iterable(kept), key=lambda keyframe: keyframe.t_ns)
        return len(last) >= _VIEWS and self.span_s >= least_s

    def flow_px(self) -> float:
        """Median motion of corners since the oldest keyframe that has half of the newest one's; inf without one."""
        newest = self.keyframes[-1]
        for keyframe in self.keyframes[:-1]:
            _, a, b = np.intersect1d(keyframe.ids, newest.ids, assume_unique=True, return_indices=True)
            if 2 * len(a) >= len(newest.ids) > 0:
                return float(np.median(np.linalg.norm(keyframe.uv[a] - newest.uv[b], axis=1)))
        return np.inf

    def observations(self) -> CornerObservations:
        """Corners that at least three of the keyframes see, longest tracks first."""
        camera = self._camera
        ids = np.unique(np.concatenate([k.ids for k in self.keyframes]))
        xy, seen = np.zeros((len(self.keyframes), len(ids), 2)), np.zeros((len(self.keyframes), len(ids)), np.bool_)
        for row, keyframe in enumerate(self.keyframes):
            column = np.searchsorted(ids, keyframe.ids)
            xy[row, column] = (keyframe.uv - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
            seen[row, column] = True
        length = seen.sum(axis=0)
        order = np.argsort(-length, kind="stable")
        return CornerObservations(xy, seen, ids).part(order[length[order] >= _VIEWS])

    def _find_hidden(self, t_ns: int, left: Pyramid, turn_since: Callable[[int], F64 | None]) -> None:
        """Search the corners that something hides since a keyframe, as far as the gyro tells where they are."""
        last = self.keyframes[-1] if self.keyframes else None
        if self._hidden is None and last is not None and len(last.ids) >= _MANY:
            if len(self._ids) < _HIDDEN * len(last.ids):
                self._hidden = HiddenView(last.t_ns, last.left, last.ids, last.uv, self._camera)
        if self._hidden is None:
            return
        if (t_ns - self._hidden.t_ns) * 1e-9 > _HIDDEN_S:
            self._hidden = None
            return
        turn = turn_since(self._hidden.t_ns)
        if turn is None:
            return
        found, uv = self._hidden.find(left, self._ids, turn, _FLOW)
        self.searched = True
        new = ~_near(uv, self._uv)  # not those that were found as new corners meanwhile
        found, uv = found[new], uv[new]
        ids = np.concatenate([self._ids, found])
        order = np.argsort(ids, kind="stable")
        self._ids, self._uv = ids[order], np.concatenate([self._uv, uv])[order]
        if np.count_nonzero(np.isin(self._hidden.ids, ids)) >= _HIDDEN * len(self._hidden.ids):
            self._hidden = None

    def _replenish(self, left: Pyramid) -> None:
        """Find new corners where none is followed."""
        if len(self._uv) >= _REPLENISH * CORNERS:
            return
        found = features.detect(left, self._uv, self._detector).uv[: CORNERS - len(self._uv)]
        self._uv = np.concatenate([self._uv, found])
        self._ids = np.concatenate([self._ids, self._next_id + np.arange(len(found))])
        self._next_id += len(found)


def covering(corners: CornerObservations, longest: int, each: int) -> I64:
    """Columns of the longest tracks, and of the `each` longest ones of every keyframe."""
    chosen = np.arange(len(corners.ids)) < longest
    for seen in corners.seen:
        chosen[np.flatnonzero(seen)[:each]] = True
    return np.flatnonzero(chosen)


def with_found(corners: CornerObservations, columns: I64, aligned: CornerObservations) -> CornerObservations:
    """The corners, and where alignment found those in `columns` in keyframes in which they were not followed."""
    xy, seen = corners.xy.copy(), corners.seen.copy()
    found = aligned.seen & ~seen[:, columns]
    row, column = np.nonzero(found)
    xy[row, columns[column]], seen[row, columns[column]] = aligned.xy[found], True
    return CornerObservations(xy, seen, corners.ids)


def _near(uv: F64, others: F64) -> Bool:
    """Which of the pixels uv (n,2) are next to another one, of (m,2)."""
    apart = np.linalg.norm(uv[:, None] - others[None], axis=2)
    return np.asarray((apart < _NEAR_PX).any(axis=1))
