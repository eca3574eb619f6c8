"""Finding the old map again: the reference keyframe by descriptors, then the place index, then P3P, then the tracker.

How a young submap is *joined* to an old one: in the frame in which the old map is found again, the agent makes one
keyframe in the young submap (where it is tracked there) and one in the old submap, with the same stamp. Both are the
same camera at the same instant, so T_old_young = T_old_k1 @ inverse(T_young_k2). The agent flies on in the old submap;
the young keyframes stay where they are, for the base to move.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.config import AgentConfig
from kiteline_agent.imaging import features
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.relocalisation.map_cache import FrameFeatures, MapCache
from kiteline_agent.tracking.tracker import FrameImages, Track, Tracker, without_points
from kiteline_core.geometry import se3
from kiteline_core.ids import NO_KEYFRAME, KeyframeId, SubmapId, submap_of_keyframe
from kiteline_core.imaging import matching
from kiteline_core.places.place_index import PlaceIndex, Vocabulary
from kiteline_core.pose.pnp import PoseFit, solve_pnp

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Relocalisation:
    """Where the old map was found. T_c_m: (4,4) in the submap of `keyframe`, from which to go on. track: its proof,
    without points where it is `lent`: corners met the base's copies. depth_m: of the points in view, median.
    """

    T_c_m: F64
    keyframe: KeyframeId
    track: Track
    depth_m: float
    lent: bool = False

    @property
    def submap(self) -> SubmapId:
        """The submap in which the pose lies."""
        return submap_of_keyframe(self.keyframe)


class Relocaliser:
    """Knows the places of all remembered keyframes, and searches them for a frame: a few keyframes a call, no more."""

    def __init__(
        self, local_map: LocalMap, tracker: Tracker, config: AgentConfig, words: Vocabulary | None, window: MapCache,
        believes: Callable[[F64, SubmapId], bool],
    ) -> None:  # fmt: skip
        """believes: whether the vehicle can be at T_c_m (4,4) in a submap, by what else is known of its way."""
        self._map = local_map
        self._believes = believes
        self._tracker = tracker
        self._window = window
        self._config = config
        self._detector = replace(
            config.detector, cell_px=config.recovery.cell_px, max_corners=config.recovery.max_corners
        )
        self._index = None if words is None else PlaceIndex(words)
        self._search_until = -1  # number of the last frame of the search beside a young submap
        self._suspect: F64 | None = None  # T_old_young as the last success beside a young submap had it
        self._suspect_submap = SubmapId(-1)
        self.textured = True  # whether the last frame that was searched for had enough to see

    def remember(self, keyframe: KeyframeId) -> None:
        """Enter a keyframe of the local map into the place index; those that the map forgot leave."""
        if self._index is None:
            return
        for key in self._index.keys:
            if self._map.slot_of(key) < 0:
                self._index.remove(key)
        slot = self._map.slot_of(keyframe)
        first = slot * self._map.births
        born = np.arange(first, first + int(self._map.counts[slot]))
        view = self._map.candidates(
            se3.inverse(self._map.T_m_k[slot]), 0.0, self._config.align.max_scale, submap=submap_of_keyframe(keyframe)
        )
        self._index.add(keyframe, self._map.descriptor[np.union1d(born, view.rows)])

    def search_beside(self, frame_number: int) -> None:
        """A young submap has opened at this frame: the search for the old ones goes on for a while."""
        self._search_until = frame_number + self._config.recovery.beside_frames
        self._suspect = None

    def attempt(self, view: FrameImages, frame_number: int, reference: KeyframeId) -> Relocalisation | None:
        """One try for a lost frame, over all submaps, the reference keyframe first."""
        seen = self._look(view)
        if seen is None:
            return None
        return self._search(view, seen, frame_number, reference, exclude=None)

    def beside(self, view: FrameImages, frame_number: int, T_m_c: F64) -> Relocalisation | None:
        """One try for a frame that is tracked at T_m_c (4,4) in a young submap, over the other submaps.

        A pose that would leave the young submap has to be found twice, the same.
        """
        if frame_number > self._search_until or self._index is None:
            return None
        seen = self._look(view)
        if seen is None:
            return None
        found = self._search(view, seen, frame_number, NO_KEYFRAME, exclude=self._map.active)
        if found is None:
            return None
        T_old_young = se3.inverse(found.T_c_m) @ se3.inverse(T_m_c)
        before, submap = self._suspect, self._suspect_submap
        self._suspect, self._suspect_submap = T_old_young, found.submap
        if before is None or submap != found.submap:
            return None
        limits = self._config.recovery
        change = found.T_c_m @ T_old_young @ se3.inverse(before) @ se3.inverse(found.T_c_m)  # felt where the camera is
        turned = float(np.linalg.norm(se3.so3_log(change[:3, :3])))
        if np.linalg.norm(change[:3, 3]) > limits.agree_ratio * found.depth_m or turned > limits.agree_rad:
            return None
        self._search_until = -1
        return found

    def _look(self, view: FrameImages) -> FrameFeatures | None:
        """Corners and descriptors; None where there is no texture."""
        detector = replace(self._detector, first=max(self._detector.first, view.first))
        corners = features.detect(view.left, np.zeros((0, 2)), detector)
        self.textured = len(corners.uv) >= self._config.recovery.min_corners
        if not self.textured:
            return None
        angle, descriptor = features.describe(view.left, corners.uv, corners.octave)
        return FrameFeatures(corners.uv, np.full(len(corners.uv), -1.0), corners.octave, angle, descriptor)

    def _search(
        self, view: FrameImages, seen: FrameFeatures, frame_number: int, reference: KeyframeId, exclude: SubmapId | None
    ) -> Relocalisation | None:
        """Try the reference keyframe and the most alike places, in this order."""
        tried = [reference] if self._map.slot_of(reference) >= 0 and reference != NO_KEYFRAME else []
        if self._index is not None:
            out = [k for k in self._index.keys if k == reference or submap_of_keyframe(KeyframeId(k)) == exclude]
            places = self._index.query(seen.descriptor, out, self._config.recovery.candidates)
            tried += [KeyframeId(k) for k in places.keys.tolist() if self._map.slot_of(k) >= 0]
        for keyframe in tried:
            fit = self._pose_by(keyframe, seen, frame_number)
            if fit is None:
                continue
            track = self._confirm(view, fit.T_c_m, frame_number, submap_of_keyframe(keyframe))
            if track is None or not self._believes(track.T_c_m, submap_of_keyframe(keyframe)):
                continue
            depth_m = float(np.median(track.depth_m[track.inlier]))
            found = Relocalisation(track.T_c_m, keyframe, track, depth_m)
            if self._has_twin(found, fit.inliers, seen, frame_number):
                return None
            return found
        return self._search_window(seen, frame_number, exclude)

    def _has_twin(self, found: Relocalisation, inliers: int, seen: FrameFeatures, frame_number: int) -> bool:
        """Whether the same submap shows all this at another place too: then nobody knows which of them it is."""
        if self._index is None:
            return False
        limits = self._config.recovery
        near = self._map.keyframe[np.unique(found.track.rows[found.track.inlier] // self._map.births)].tolist()
        out = [k for k in self._index.keys if k in near or submap_of_keyframe(KeyframeId(k)) != found.submap]
        for key in self._index.query(seen.descriptor, out, limits.twins).keys.tolist():
            fit = self._pose_by(KeyframeId(key), seen, frame_number)
            if fit is None or fit.inliers < limits.twin_share * inliers:
                continue
            apart = fit.T_c_m @ se3.inverse(found.T_c_m)
            turned = float(np.linalg.norm(se3.so3_log(se3.orthonormalise(apart)[:3, :3])))
            if np.linalg.norm(apart[:3, 3]) > limits.twin_ratio * found.depth_m or turned > limits.twin_rad:
                return True
        return False

    def _search_window(self, seen: FrameFeatures, frame_number: int, exclude: SubmapId | None) -> Relocalisation | None:
        """Try the base's copies, in every submap of which a keyframe is remembered: from that one it goes on."""
        known = self._map.keyframe[self._map.keyframe != NO_KEYFRAME]
        submaps = {int(submap_of_keyframe(KeyframeId(k))) for k in known.tolist()} - {exclude}
        found = self._window.find(seen, submaps, frame_number)
        if found is None or not self._believes(found[1].T_c_m, SubmapId(found[0])):
            return None
        submap, met = found
        newest = KeyframeId(max(k for k in known.tolist() if submap_of_keyframe(KeyframeId(k)) == submap))
        proof = without_points(met.T_c_m, len(met.corner))
        return Relocalisation(met.T_c_m, newest, proof, float(np.median(met.depth_m)), lent=True)

    def _pose_by(self, keyframe: KeyframeId, seen: FrameFeatures, frame_number: int) -> PoseFit | None:
        """Match with all that a keyframe should see, also a little beyond its border, and solve for the pose."""
        limits = self._config.recovery
        T_m_k = self._map.T_m_k[self._map.slot_of(keyframe)]
        around = self._map.candidates(
            se3.inverse(T_m_k),
            -limits.beyond_px,
            self._config.align.max_scale,
            submap=submap_of_keyframe(keyframe),
        )
        rows = around.rows
        matches = matching.match(
            self._map.descriptor[rows], self._map.angle[rows], seen.descriptor, seen.angle, self._config.matching
        )
        if len(matches.a) < limits.min_pnp_inliers:
            return None
        observed = np.column_stack([seen.uv[matches.b], np.full(len(matches.b), -1.0)])
        fit = solve_pnp(
            around.xyz[matches.a], around.ray[matches.a], observed, seen.octave[matches.b], self._map.intrinsics,
            frame_number, self._config.ransac,
        )  # fmt: skip
        if fit is None or fit.inliers < limits.min_pnp_inliers:
            return None
        return fit

    def _confirm(self, view: FrameImages, T_c_m: F64, frame_number: int, submap: SubmapId) -> Track | None:
        """The tracker's own templates must agree with a pose."""
        limits = self._config.recovery
        active = self._map.active
        self._map.activate(submap)
        track = self._tracker.track(view, T_c_m, frame_number)
        self._map.activate(active)
        if track.inliers < limits.min_inliers or track.inliers < limits.min_share * track.tried:
            return None
        return track
