"""Relocalises a frame: candidate keyframes, P3P on matched descriptors, then a check by the tracker.

Also joins a new submap to an older one: the older one is searched while the new one is tracked. In the frame where it
is found, one keyframe is made in each, with the same stamp. Both are the same camera at the same instant, so that
T_old_new = T_old_k1 @ inverse(T_new_k2). The agent continues in the old submap; the base moves the other keyframes.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_agent.governor.cost_model import Work
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.relocalisation.frame_features import FrameFeatures, frame_features
from kiteline_agent.relocalisation.map_cache import MapCache
from kiteline_agent.tracking.frame_context import FrameContext
from kiteline_agent.tracking.track import Track, track_without_landmarks
from kiteline_agent.tracking.tracker import Tracker
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.ids import NO_KEYFRAME, KeyframeId, SubmapId, submap_of_keyframe
from kiteline_core.imaging import matching
from kiteline_core.places.place_index import PlaceIndex, Vocabulary
from kiteline_core.pose.pnp import PoseFit, solve_pnp

_MIN_CORNERS = 60  # with fewer there is no texture in view, and a search would prove nothing
_MIN_PNP_INLIERS = 12  # inliers of P3P; chance matches reach 8
_JOIN_S = 1.02  # s for which older submaps are searched beside a new one
_AGREE_RATIO = 0.05  # of the depth: difference between two results beside a new submap
_AMBIGUOUS_CANDIDATES = 2  # further places of the same submap that are tried; each costs about 1 ms
_AMBIGUOUS_SHARE = 0.6  # of the inliers: with so many another place is as likely
_AMBIGUOUS_RATIO = 0.2  # of the depth: difference up to which two results are the same place
_AMBIGUOUS_RAD = 0.15  # rad: the same for the rotation
_AGREE_RAD = 0.035  # rad: rotation between two results beside a new submap, 2 degrees
_MIN_SHARE = 0.4  # of the landmarks the tracker searched for; a place that only looks similar has fewer


@dataclass(frozen=True, slots=True)
class Relocalisation:
    """Where a frame was found. T_c_m: (4,4) in the submap of `keyframe`. track: its evidence. depth_m: median depth.

    from_cache: found by landmarks of the map cache, so that the track holds none of the local map.
    """

    T_c_m: F64
    keyframe: KeyframeId
    track: Track
    depth_m: float
    from_cache: bool = False

    @property
    def submap(self) -> SubmapId:
        """The submap in which the pose lies."""
        return submap_of_keyframe(self.keyframe)


class Relocaliser:
    """Place index of the remembered keyframes, and the search for a frame among a few of them."""

    def __init__(
        self, local_map: LocalMap, tracker: Tracker, config: AgentConfig, vocabulary: Vocabulary | None,
        cache: MapCache, is_consistent: Callable[[FrameContext, F64, SubmapId], bool], work: Work,
    ) -> None:  # fmt: skip
        """vocabulary: None: only the reference keyframe is tried. is_consistent: whether T_c_m (4,4) in a submap agrees
        with the motion since the camera was last measured there.
        """
        self._map = local_map
        self._is_consistent = is_consistent
        self._tracker = tracker
        self._cache = cache
        self._config = config
        self._work = work
        self._margin_px = float(round(config.relocalisation.margin * local_map.camera.width))
        self._detector = replace(
            config.detector, cell_px=config.relocalisation.cell_px, max_corners=config.relocalisation.max_corners
        )
        self._index = None if vocabulary is None else PlaceIndex(vocabulary)
        self._waiting: list[KeyframeId] = []  # keyframes that are not in the index yet
        self._join_until_ns: int | None = None  # end of the search for an older submap
        self._unconfirmed: tuple[SubmapId, F64] | None = None  # the older submap as found once, T_old_new
        self.has_texture = True  # the last frame that was searched had enough corners

    def add_keyframe(self, keyframe: KeyframeId) -> None:
        """Note a keyframe of the local map. Searches enter it into the place index: most flights need none."""
        if self._index is not None:
            self._waiting.append(keyframe)
            if len(self._waiting) > 2 * len(self._map.keyframe):
                held = set(self._map.keyframe.tolist())
                self._waiting = [waiting for waiting in self._waiting if waiting in held]

    def enter_keyframes(self) -> None:
        """Enter keyframes that wait into the place index, the newest first, so many in a frame; evicted ones leave."""
        if self._index is None or not self._waiting:
            return
        for key in self._index.keys:
            if self._map.slot_of(key) < 0:
                self._index.remove(key)
        waiting = [k for k in self._waiting if self._map.slot_of(k) >= 0]
        most = self._config.relocalisation.indexed_per_frame
        self._waiting = waiting[:-most]
        for keyframe in waiting[-most:]:
            self._work.places += 1
            self._enter(self._index, keyframe)

    def _enter(self, index: PlaceIndex, keyframe: KeyframeId) -> None:
        slot = self._map.slot_of(keyframe)
        first = slot * self._map.slot_size
        own = np.arange(first, first + int(self._map.counts[slot]))
        in_view = self._map.candidates(se3.inverse(self._map.T_m_k[slot]), 0.0, submap=submap_of_keyframe(keyframe))
        index.add(keyframe, self._map.descriptor[np.union1d(own, in_view.rows)])

    def start_joining(self, t_ns: int) -> None:
        """A new submap was opened at t_ns: search for older ones for a while."""
        self._join_until_ns = t_ns + round(_JOIN_S * 1e9)
        self._unconfirmed = None

    def relocalise(self, ctx: FrameContext, reference: KeyframeId) -> Relocalisation | None:
        """Search all submaps for a frame, the reference keyframe first."""
        self._work.searches += 1
        return self._search(ctx, reference, exclude=None)

    def find_older_submap(self, ctx: FrameContext, T_m_c: F64) -> Relocalisation | None:
        """Search the older submaps for a frame that is tracked at T_m_c (4,4) in a new one.

        Two results in a row have to agree, since the tracked submap would be left for the old one.
        """
        if self._join_until_ns is None or ctx.t_ns > self._join_until_ns or self._index is None:
            return None
        found = self._search(ctx, NO_KEYFRAME, exclude=self._map.active)
        if found is None:
            return None
        T_old_new = se3.inverse(found.T_c_m) @ se3.inverse(T_m_c)
        before, self._unconfirmed = self._unconfirmed, (found.submap, T_old_new)
        if before is None or before[0] != found.submap:
            return None
        change = found.T_c_m @ T_old_new @ se3.inverse(before[1]) @ se3.inverse(found.T_c_m)  # at the camera
        angle = float(np.linalg.norm(se3.so3_log(change[:3, :3])))
        if np.linalg.norm(change[:3, 3]) > _AGREE_RATIO * found.depth_m or angle > _AGREE_RAD:
            return None
        self._join_until_ns = None
        return found

    def _search(self, ctx: FrameContext, reference: KeyframeId, exclude: SubmapId | None) -> Relocalisation | None:
        """Try the reference keyframe, the most similar places, and the map cache, in this order."""
        self.enter_keyframes()  # also where nothing can be seen: frames without texture are cheap
        # 1. Corners and descriptors.
        seen = frame_features(ctx.images, self._detector, _MIN_CORNERS)
        self.has_texture = seen is not None
        if seen is None:
            return None
        # 2. Candidates, each verified by P3P, by the tracker and against the motion.
        for keyframe in self._candidates(seen, reference, exclude):
            fit = self._pose_from(keyframe, seen, ctx.number)
            if fit is None:
                continue
            submap = submap_of_keyframe(keyframe)
            track = self._confirmed(ctx, fit.T_c_m, submap)
            if track is None or not self._is_consistent(ctx, track.T_c_m, submap):
                continue
            found = Relocalisation(track.T_c_m, keyframe, track, float(np.median(track.depth_m[track.inlier])))
            return None if self._is_ambiguous(found, fit.inliers, seen, ctx.number) else found
        # 3. Keyframes sent by the base.
        return self._search_cache(ctx, seen, exclude)

    def _candidates(self, seen: FrameFeatures, reference: KeyframeId, exclude: SubmapId | None) -> list[KeyframeId]:
        candidates = [reference] if self._map.slot_of(reference) >= 0 and reference != NO_KEYFRAME else []
        if self._index is not None:
            out = [k for k in self._index.keys if k == reference or submap_of_keyframe(KeyframeId(k)) == exclude]
            places = self._index.query(seen.descriptor, out, self._config.relocalisation.candidates)
            candidates += [KeyframeId(k) for k in places.keys.tolist() if self._map.slot_of(k) >= 0]
        return candidates

    def _pose_from(self, keyframe: KeyframeId, seen: FrameFeatures, seed: int) -> PoseFit | None:
        """P3P on matches with the landmarks in view of a keyframe, or a little beyond its border."""
        T_m_k = self._map.T_m_k[self._map.slot_of(keyframe)]
        around = self._map.candidates(se3.inverse(T_m_k), -self._margin_px, submap=submap_of_keyframe(keyframe))
        matches = matching.match(
            self._map.descriptor[around.rows], self._map.angle[around.rows], seen.descriptor, seen.angle,
        )  # fmt: skip
        if len(matches.a) < _MIN_PNP_INLIERS:
            return None
        observed = np.column_stack([seen.uv[matches.b], np.full(len(matches.b), -1.0)])
        fit = solve_pnp(
            around.xyz[matches.a], around.ray[matches.a], observed, seen.octave[matches.b], self._map.intrinsics,
            seed,
        )  # fmt: skip
        return None if fit is None or fit.inliers < _MIN_PNP_INLIERS else fit

    def _confirmed(self, ctx: FrameContext, T_c_m: F64, submap: SubmapId) -> Track | None:
        """Track from a pose (4,4) in a submap; None if the templates do not agree with it."""
        limits = self._config.relocalisation
        active = self._map.active
        self._map.activate(submap)
        track = self._tracker.track(ctx, T_c_m)
        self._map.activate(active)
        if track.inliers < limits.min_inliers or track.inliers < _MIN_SHARE * track.tried:
            return None
        return track

    def _is_ambiguous(self, found: Relocalisation, inliers: int, seen: FrameFeatures, seed: int) -> bool:
        """True if another place of the same submap matches about as well."""
        if self._index is None:
            return False
        near = self._map.keyframe[np.unique(found.track.rows[found.track.inlier] // self._map.slot_size)].tolist()
        out = [k for k in self._index.keys if k in near or submap_of_keyframe(KeyframeId(k)) != found.submap]
        for key in self._index.query(seen.descriptor, out, _AMBIGUOUS_CANDIDATES).keys.tolist():
            fit = self._pose_from(KeyframeId(key), seen, seed)
            if fit is None or fit.inliers < _AMBIGUOUS_SHARE * inliers:
                continue
            apart = fit.T_c_m @ se3.inverse(found.T_c_m)
            angle = float(np.linalg.norm(se3.so3_log(se3.orthonormalise(apart)[:3, :3])))
            if np.linalg.norm(apart[:3, 3]) > _AMBIGUOUS_RATIO * found.depth_m or angle > _AMBIGUOUS_RAD:
                return True
        return False

    def _search_cache(self, ctx: FrameContext, seen: FrameFeatures, exclude: SubmapId | None) -> Relocalisation | None:
        """Try cached keyframes in every submap of which a keyframe is remembered that the base knows, too.

        The newest one becomes the reference.
        """
        known = self._map.keyframe[(self._map.keyframe != NO_KEYFRAME) & (self._map.shared > 0)].tolist()
        submaps = {int(submap_of_keyframe(KeyframeId(k))) for k in known} - {exclude}
        found = self._cache.find(seen, submaps, ctx.number)
        if found is None or not self._is_consistent(ctx, found[1].T_c_m, SubmapId(found[0])):
            return None
        submap, matches = found
        newest = KeyframeId(max(k for k in known if submap_of_keyframe(KeyframeId(k)) == submap))
        track = track_without_landmarks(matches.T_c_m, len(matches.corner))
        return Relocalisation(matches.T_c_m, newest, track, float(np.median(matches.depth_m)), from_cache=True)
