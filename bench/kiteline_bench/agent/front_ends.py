"""Two other ways of following points, for comparison with the agent's templates. Nothing in flight uses them.

DescriptorTracker finds and describes corners in every frame and matches the map to them by projection, like ORB-SLAM2's
tracking (R. Mur-Artal, J. D. Tardos, 2017, section III). FlowTracker lets pyramidal Lucas-Kanade flow carry the points
of the last frame (J.-Y. Bouguet, 2000), and uses descriptors only after a keyframe, or when it is lost. Both take the
map's points, stereo, pose optimisation and keyframes as they are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from kiteline_agent.config import AgentConfig
from kiteline_agent.governor.cost_model import Work
from kiteline_agent.imaging import features
from kiteline_agent.local_map import projection_kernels as local_map_kernels
from kiteline_agent.local_map.local_map import Candidates, LocalMap
from kiteline_agent.tracking.tracker import Track, Tracker, View
from kiteline_core.geometry import se3
from kiteline_core.ids import SEQUENCE_BITS
from kiteline_core.imaging import matching

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

_MARGIN_PX = 8.0  # as the agent's tracker


@dataclass(frozen=True, slots=True)
class CornerConfig:
    """How corners are found, described and matched with the map."""

    cell_px: int = 16  # one corner a cell: as many as must be there for the map's own to be among them
    max_corners: int = 1200  # of a frame
    wide_px: float = 28.0  # px at level 0 around a prediction; what the agent's coarse pass reaches
    near_px: float = 5.0  # px at the corner's level, once the pose is mended
    octave_gap: float = 0.8  # levels between what is foreseen and what is seen
    sigma_px: float = 0.6  # one deviation of a corner's coordinate at octave 0: whitens the inliers' errors


@dataclass(frozen=True, slots=True)
class FlowConfig:
    """How flow carries points."""

    window_px: int = 13  # the cheapest that holds on to corners; 21 is no better
    levels: int = 2  # above the finest; with the prediction they reach far enough
    iterations: int = 10
    epsilon_px: float = 0.03
    sigma_px: float = 0.5  # one deviation of a coordinate: whitens the inliers' errors


class _Follower(Tracker):
    """What both share: from seen pixels to a pose."""

    def __init__(self, local_map: LocalMap, config: AgentConfig, work: Work, corners: CornerConfig) -> None:
        super().__init__(local_map, config, work)
        self._corners = corners
        self._detector = replace(config.detector, cell_px=corners.cell_px, max_corners=corners.max_corners)

    def _seen(self, view: View, taken: F64) -> tuple[F64, U8, U8]:
        """Corners (n,2) px in cells where none of `taken` (m,2) lies, their octaves (n,) and descriptors (n,32)."""
        found = features.detect(view.left, taken, self._detector)
        _, descriptor = features.describe(view.left, found.uv, found.octave)
        return found.uv, found.octave, descriptor

    def _matched(
        self, candidates: Candidates, radius_px: float, scaled: bool, seen: tuple[F64, U8, U8]
    ) -> tuple[I64, I64]:
        """Candidates and seen corners (n,), (n,) that show the same."""
        rows = candidates.rows
        # A point that is nearer than when it was born is seen on a coarser level.
        area = np.linalg.det(candidates.warp) if len(rows) else np.zeros(0)
        octave = self._map.octave[rows] + 0.5 * np.log2(np.maximum(area, 1e-6))
        radius = radius_px * np.exp2(octave) if scaled else np.full(len(rows), radius_px)
        camera = self._map.camera
        matches = matching.match_near(
            candidates.uv, radius, octave, self._map.descriptor[rows], seen[0], seen[1], seen[2],
            (camera.width, camera.height), self._corners.octave_gap, self._config.matching,
        )  # fmt: skip
        return matches.a.astype(np.int64), matches.b.astype(np.int64)

    def _by_descriptors(self, view: View, T_c_m: F64, seen: tuple[F64, U8, U8]) -> Track:
        """A wide search mends the prediction, a narrow one measures the pose."""
        for radius_px, scaled in ((self._corners.wide_px, False), (self._corners.near_px, True)):
            candidates = self._map.candidates(T_c_m, _MARGIN_PX, self._config.align.max_scale)
            a, b = self._matched(candidates, radius_px, scaled, seen)
            sigma_px = self._corners.sigma_px * np.exp2(seen[1][b].astype(np.float64))
            track = self._solve(
                view, candidates, a, seen[0][b], seen[1][b], sigma_px, T_c_m, tried=len(a), stereo=scaled
            )
            if track.inliers >= self._config.pose.min_inliers // 2:
                T_c_m = track.T_c_m
        return track


class DescriptorTracker(_Follower):
    """Descriptors throughout."""

    def __init__(
        self, local_map: LocalMap, config: AgentConfig, work: Work, corners: CornerConfig | None = None
    ) -> None:
        super().__init__(local_map, config, work, corners or CornerConfig())

    def track(self, view: View, predicted_T_c_m: F64, frame_number: int) -> Track:
        """One frame: corners, descriptors, guided matches, pose."""
        return self._by_descriptors(view, predicted_T_c_m, self._seen(view, np.zeros((0, 2))))


class FlowTracker(_Follower):
    """Flow from frame to frame; descriptors where a keyframe has changed what is worth following, or all is lost."""

    def __init__(
        self, local_map: LocalMap, config: AgentConfig, work: Work, corners: CornerConfig | None = None,
        flow: FlowConfig | None = None,
    ) -> None:  # fmt: skip
        super().__init__(local_map, config, work, corners or CornerConfig())
        self._flow = flow or FlowConfig()
        self._last: View | None = None
        self._keyframe = -1  # the newest of the map when the last frame was tracked
        self._rows = np.zeros(0, np.int64)  # points that the last frame held, and where
        self._ids = np.zeros(0, np.int64)
        self._uv = np.zeros((0, 2))

    def track(self, view: View, predicted_T_c_m: F64, frame_number: int) -> Track:
        """One frame: carry the points of the last one along, and look for their disparity."""
        track = None
        if self._last is not None and view is not self._last:
            self._after_keyframe(self._last)
            track = self._carried(view, self._last, predicted_T_c_m)
        if track is None or track.inliers < self._config.pose.min_inliers:
            track = self._by_descriptors(view, predicted_T_c_m, self._seen(view, np.zeros((0, 2))))
        self._last = view
        newest = self._newest()
        self._keyframe = int(self._map.keyframe[newest]) if newest >= 0 else -1
        self._rows, self._uv = track.rows[track.inlier], track.observed[track.inlier, :2]
        self._ids = self._map.point_ids(self._rows)
        return track

    def _carried(self, view: View, last: View, T_c_m: F64) -> Track | None:
        """Flow from where the prediction says; a rough pose, then stereo from it and the pose."""
        candidates = self._map.candidates(T_c_m, _MARGIN_PX, self._config.align.max_scale)
        held, chosen = self._among(candidates)
        if len(held) < self._config.pose.min_inliers:
            return None
        before = self._uv[held]
        uv, found = self._moved(last.left[0], view.left[0], before, candidates.uv[chosen])
        camera = self._map.camera
        found &= (uv >= _MARGIN_PX).all(axis=1) & (uv < [camera.width - _MARGIN_PX, camera.height - _MARGIN_PX]).all(1)
        self._rows, self._ids, self._uv = self._rows[held[found]], self._ids[held[found]], uv[found]
        octave = np.zeros(len(self._uv), np.uint8)
        sigma_px = np.full(len(self._uv), self._flow.sigma_px)
        n = len(self._uv)
        rough = self._solve(view, candidates, chosen[found], self._uv, octave, sigma_px, T_c_m, tried=n, stereo=False)
        if rough.inliers < self._config.pose.min_inliers:
            return None
        candidates = self._map.candidates(rough.T_c_m, _MARGIN_PX, self._config.align.max_scale)
        held, chosen = self._among(candidates)
        uv, octave = self._uv[held], self._map.octave[self._rows[held]]
        return self._solve(
            view, candidates, chosen, uv, octave, sigma_px[held], rough.T_c_m, tried=len(held), stereo=True
        )

    def _among(self, candidates: Candidates) -> tuple[I64, I64]:
        """Which held points are among the candidates, and where there."""
        place = np.full(len(self._map.octave), -1, np.int64)
        place[candidates.rows] = np.arange(len(candidates.rows))
        at = np.where(self._map.point_ids(self._rows) == self._ids, place[self._rows], -1)
        held = np.flatnonzero(at >= 0)
        return held, at[held]

    def _moved(self, last: U8, now: U8, before: F64, guess: F64) -> tuple[F64, NDArray[np.bool_]]:
        """Where pixels (n,2) of the last image are now, and which were followed."""
        flow = self._flow
        a, b = before.astype(np.float32).reshape(-1, 1, 2), guess.astype(np.float32).reshape(-1, 1, 2)
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, flow.iterations, flow.epsilon_px)
        now_at, status, _ = cv2.calcOpticalFlowPyrLK(
            last, now, a, b, winSize=(flow.window_px, flow.window_px), maxLevel=flow.levels,
            criteria=stop, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )  # fmt: skip
        return np.asarray(now_at[:, 0], np.float64), status[:, 0] > 0

    def _newest(self) -> int:
        """The slot of the active submap's newest keyframe; -1 without one."""
        mine = np.flatnonzero(self._map.keyframe >> SEQUENCE_BITS == self._map.active)
        return int(mine[np.argmax(self._map.keyframe[mine])]) if len(mine) else -1

    def _after_keyframe(self, last: View) -> None:
        """Where the last frame became a keyframe: its births, and points of the map that come back into view."""
        slot = self._newest()
        if slot < 0 or self._map.keyframe[slot] == self._keyframe:
            return
        born = np.flatnonzero(self._map.usable[slot]) + slot * self._map.births
        rows = np.concatenate([self._rows, born])
        uv = np.concatenate([self._uv, self._map.uv[slot].reshape(-1, 2)[born % self._map.births]])
        seen = self._seen(last, uv)
        T_c_m = se3.inverse(self._map.T_m_k[slot])
        candidates = self._map.candidates(T_c_m, _MARGIN_PX, self._config.align.max_scale)
        a, b = self._matched(candidates, self._corners.near_px, True, seen)
        new = ~np.isin(candidates.rows[a], rows)
        rows = np.concatenate([rows, candidates.rows[a[new]]])
        uv = np.concatenate([uv, seen[0][b[new]]])
        # As many as the agent's tracker looks for, spread over the image.
        cell = self._config.align.cell_px
        camera = self._map.camera
        cells = np.zeros((-(-camera.height // cell), -(-camera.width // cell)), np.int32)
        chosen = np.empty(self._config.align.points, np.int64)
        n = local_map_kernels.select(
            np.arange(len(rows)), uv, float(cell), self._config.align.points, 2, cells, chosen
        )  # fmt: skip
        self._rows, self._uv = rows[chosen[:n]], uv[chosen[:n]]
        self._ids = self._map.point_ids(self._rows)
