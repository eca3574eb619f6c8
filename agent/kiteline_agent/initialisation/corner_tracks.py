"""Corners followed by optical flow over a window of monocular keyframes, before there is a map."""

from dataclasses import dataclass

import numpy as np

from kiteline_agent.imaging import features
from kiteline_agent.imaging.features import DetectorConfig, Pyramid
from kiteline_agent.imaging.optical_flow import Flow, follow
from kiteline_agent.inertial_start_config import CornerTracksConfig
from kiteline_agent.initialisation.frame_flow import BadImages, FrameFlow
from kiteline_core.arrays import F64, I64, Bool
from kiteline_core.geometry.cameras import RectifiedCamera

_LEVELS, _NEAR_LEVELS = 3, 1  # of the flow above the finest one; where a corner is known to be near
_REPLENISH = 0.85  # share of the corners below which a keyframe adds new ones
_FLOW = Flow(window_px=15, return_px=0.5)  # the smallest window that keeps hold of corners
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

    def add(self, t_ns: int, left: Pyramid, turn: F64 | None = None) -> bool:
        """Follow the corners from the last keyframe into a new one, and find more. False if the image is left out.

        turn: (3,3) rotation of this camera in that of the last keyframe; None: unknown. It counts if the corners were
        not followed into this frame.
        """
        near = self._frames.image is left[0]
        good = np.zeros(len(self._uv), np.bool_)
        if self.keyframes and len(self._uv):
            before = self.keyframes[-1].left[0]
            if near:
                uv, good = follow(before, left[0], self._uv, _FLOW, _NEAR_LEVELS, self._frames.uv)
                good &= np.linalg.norm(uv - self._frames.uv, axis=1) < _DRIFT_PX
            else:
                guess = None if turn is None else self._turned(turn)
                uv, good = follow(before, left[0], self._uv, _FLOW, _LEVELS, guess)
                if self._bad_keyframes.leaves_out(good):
                    return False
            self._uv, self._ids = uv[good], self._ids[good]
        self._replenish(left)
        if near:
            self._frames.replace(good, self._uv)
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
