"""Corners followed by optical flow over a window of monocular keyframes, before there is a map."""

from dataclasses import dataclass

import cv2
import numpy as np

from kiteline_agent.imaging import features
from kiteline_agent.imaging.features import DetectorConfig, Pyramid
from kiteline_agent.inertial_start_config import CornerTracksConfig
from kiteline_core.arrays import F64, I64, U8, Bool
from kiteline_core.geometry.cameras import RectifiedCamera

_LEVELS, _NEAR_LEVELS = 3, 1  # of the flow above the finest one; where a corner is known to be near
_BORDER_PX = 8.0  # a window of the flow and its gradients lie inside
_REPLENISH = 0.85  # share of the corners below which a keyframe adds new ones
_WINDOW_PX = 15  # px; window of the optical flow: the smallest that keeps hold of corners
_BACKWARD_PX = 0.5  # px between a corner and its image followed back
_DRIFT_PX = 2.0  # px between flow over frames and flow from the last keyframe
KEYFRAME_S = 0.24  # s between two keyframes: short enough for flow, long enough for parallax
_THINNED_S = 0.6  # s; longest time between two keyframes after one was left out
CORNERS = 200  # followed at once; a bundle of 100 long tracks is as accurate as one of 300


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


class CornerTracks:
    """Follows corners from keyframe to keyframe. Frames between tell where to look or, with little CPU, the gyro."""

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
        self._last: U8 | None = None  # frame into which they were followed, and where they are there
        self._last_uv = np.zeros((0, 2))

    def is_due(self, t_ns: int) -> bool:
        """True if a frame is to become a keyframe."""
        return not self.keyframes or (t_ns - self.keyframes[-1].t_ns) * 1e-9 >= KEYFRAME_S

    def follow(self, left: Pyramid) -> None:
        """Follow the corners into the frame after the one before; the next keyframe looks for them where they are."""
        if self._last is not None and len(self._last_uv):
            uv, good = self._followed(self._last, left[0], self._last_uv, None, _LEVELS)
            self._last_uv, self._uv, self._ids = uv[good], self._uv[good], self._ids[good]
        self._last = left[0]

    def add(self, t_ns: int, left: Pyramid, turn: F64 | None = None) -> None:
        """Follow the corners from the last keyframe into a new one, and find more.

        turn: (3,3) rotation of this camera in that of the last keyframe; None: unknown. It counts if the corners were
        not followed into this frame.
        """
        if self.keyframes and len(self._uv):
            before, near = self.keyframes[-1].left[0], self._last is left[0]
            if near:
                uv, good = self._followed(before, left[0], self._uv, self._last_uv, _NEAR_LEVELS)
                good &= np.linalg.norm(uv - self._last_uv, axis=1) < _DRIFT_PX
            else:
                guess = None if turn is None else self._turned(turn)
                uv, good = self._followed(before, left[0], self._uv, guess, _LEVELS)
            self._uv, self._ids = uv[good], self._ids[good]
        self._replenish(left)
        self._last_uv = self._uv
        self.keyframes.append(TrackedKeyframe(t_ns, left, self._ids.copy(), self._uv.copy()))

    def drop_before(self, t_ns: int) -> None:
        """Forget keyframes that are older than this; of too many, the oldest that lie close to their neighbours."""
        kept, config = [k for k in self.keyframes if k.t_ns >= t_ns], self._config
        while len(kept) > config.keyframes:
            apart_s = [(after.t_ns - before.t_ns) * 1e-9 for before, after in zip(kept, kept[2:], strict=False)]
            close = [k for k, s in enumerate(apart_s, 1) if s < _THINNED_S]
            del kept[close[0] if close else 0]
        self.keyframes = kept

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
        return CornerObservations(xy, seen, ids).part(order[length[order] >= 3])

    def _followed(self, before: U8, after: U8, uv: F64, guess: F64 | None, levels: int) -> tuple[F64, Bool]:
        """Pixels (n,2) of corners in the next image, and which of them are found, forward and backward."""
        size = {"winSize": (_WINDOW_PX, _WINDOW_PX), "maxLevel": levels}
        flags = 0 if guess is None else cv2.OPTFLOW_USE_INITIAL_FLOW
        start = uv.astype(np.float32)
        there = None if guess is None else guess.astype(np.float32)
        found, ok, _ = cv2.calcOpticalFlowPyrLK(before, after, start, there, flags=flags, **size)  # type: ignore[call-overload]
        back, ok_back, _ = cv2.calcOpticalFlowPyrLK(after, before, found, start.copy(), flags=flags, **size)  # type: ignore[call-overload]
        limit = np.array([after.shape[1], after.shape[0]]) - _BORDER_PX
        inside = (found >= _BORDER_PX).all(axis=1) & (found < limit).all(axis=1)
        same = np.linalg.norm(back - start, axis=1) < _BACKWARD_PX
        return found.astype(np.float64), (ok.ravel() == 1) & (ok_back.ravel() == 1) & inside & same

    def _turned(self, turn: F64) -> F64:
        """Pixels (n,2) of the corners after a rotation of the camera alone."""
        focal, centre = np.array([self._camera.fx, self._camera.fy]), np.array([self._camera.cx, self._camera.cy])
        ray = np.column_stack([(self._uv - centre) / focal, np.ones(len(self._uv))]) @ turn
        return np.asarray(ray[:, :2] / np.maximum(ray[:, 2:], 0.1) * focal + centre)

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
