"""Merges maps and corrects them at loop closures.

Loop closure -> merge of the newer map into the older one -> pose graph (job) -> fusion of matched landmarks -> full
bundle (job). A newer closure in a map cancels its pending jobs. A merge that later matches contradict is undone. Every
method that moves maps returns what the mapper has to apply.
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace

import numpy as np

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.exchange.publisher import Publisher
from kiteline_basestation.inertial.ties import InertialTie
from kiteline_basestation.jobs import Job, JobDone
from kiteline_basestation.map.map_tables import REFINED
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.merging import loop_consistency as consistency
from kiteline_basestation.merging.correction import apply_scales, keyframes_of, move_keyframes, scale_map
from kiteline_basestation.merging.correction_jobs import CorrectionJobs, FullBundle
from kiteline_basestation.merging.essential_graph import GraphResult
from kiteline_basestation.merging.loop_detector import Contradiction, LoopClosure, LoopDetector, known_matches
from kiteline_basestation.merging.loop_edges import LoopEdge, LoopMatch, rescaled, slot_pairs
from kiteline_basestation.merging.loop_verification import MAX_NEIGHBOURS
from kiteline_basestation.merging.merges import (
    NOTHING,
    MapMerge,
    MergeResult,
    MergerState,
    edges_out_of,
    fused_across,
    resting_on,
)
from kiteline_basestation.refinement import disparity_calibration as disparity
from kiteline_basestation.refinement import landmark_matching
from kiteline_basestation.refinement.apply_bundle import apply_bundle, keep_scales
from kiteline_basestation.refinement.bundle_window import MIN_SHARED
from kiteline_basestation.refinement.odometry_factors import without_odometry_factors
from kiteline_codec.schema import FusedLandmarks, RefinedLandmarks
from kiteline_core.arrays import F64
from kiteline_core.geometry import sim3
from kiteline_core.ids import SEQUENCE_BITS, KeyframeId, SubmapId, submap_of_keyframe
from kiteline_core.optimisation.bundle import BundleResult
from kiteline_core.places.place_index import Vocabulary

_LOOP_GAP = 30  # keyframes; landmarks observed again after so many count as a loop
_REQUERIES = 2  # keyframes of merged maps that are matched to the other map in one step
NO_CLOSURES = dict.fromkeys(("loops", "merges", "merges_undone", "loop_matches", "matches_refused"), 0)


class MapMerger:
    """Loop closures and merges of the maps of all agents, and the jobs that correct them."""

    def __init__(
        self, config: BaseConfig, sparse_map: SparseMap, publisher: Publisher, vocabulary: Vocabulary,
        job_ids: Iterator[int],
    ) -> None:  # fmt: skip
        self._config = config
        self._map = sparse_map
        self._publisher = publisher
        self._corrections = CorrectionJobs(config, sparse_map, job_ids)
        self.detector = LoopDetector(config.loops, sparse_map, vocabulary)
        self.loops = 0
        self.merges: list[MapMerge] = []
        self.undone = 0
        self._last_return: dict[SubmapId, int] = {}  # index in each submap of the last keyframe that closed a loop
        self._edges: list[LoopEdge] = []
        self._unfused: dict[SubmapId, list[LoopMatch]] = {}  # by map: matches whose landmarks are not fused yet
        self._requery: list[KeyframeId] = []  # keyframes of merged maps that have yet to be matched to the other map

    @property
    def idle(self) -> bool:
        """True if nothing is due or pending."""
        return self._corrections.idle and not self._requery

    @property
    def edges(self) -> Sequence[LoopEdge]:
        """Accepted loop edges, oldest first."""
        return self._edges

    @property
    def pending_jobs(self) -> int:
        """Number of pending jobs."""
        return self._corrections.pending

    @property
    def counts(self) -> dict[str, int]:
        """What was found so far, with the keys of `NO_CLOSURES`."""
        found, refused = self.detector.verified, self.detector.refused
        return dict(zip(NO_CLOSURES, (self.loops, len(self.merges), self.undone, found, refused)))

    def is_busy(self, map_id: SubmapId) -> bool:
        """True if a correction of a map is due or pending."""
        return self._corrections.is_busy(map_id)

    # -- inputs: keyframes, results of jobs, commands ------------------------------------------------------------------

    def add_keyframe(self, keyframe: KeyframeId) -> MergeResult:
        """Add a new keyframe to the place index and search for its place in all maps."""
        self.detector.add(keyframe)
        if self._observes_old_landmarks(keyframe) and self._is_return(keyframe):
            self.loops += 1  # drift was so small that landmark matching found the old landmarks
        return self._query(keyframe)

    def remove_keyframe(self, keyframe: KeyframeId) -> None:
        """Remove a culled keyframe from the place index."""
        self.detector.remove(keyframe)

    def requery(self) -> MergeResult:
        """Match a few keyframes of merged maps to the landmarks of the other map, and search their place again."""
        now, self._requery = self._requery[:_REQUERIES], self._requery[_REQUERIES:]
        result = MergeResult(requeried=tuple(now))
        for keyframe in now:
            if self._map.pose(keyframe) is None:  # its parent is still to come
                continue
            landmark_matching.match_landmarks(self._map, keyframe, self._config.landmark_matching, self._publisher)
            result += self._query(keyframe)
        if now and not self._requery:
            self._corrections.request_bundle(self._map.map_id(submap_of_keyframe(now[-1])))
        return result

    def jobs(self, now_ns: int) -> list[Job]:
        """Pose graphs and full bundles to start now."""
        return self._corrections.jobs(self._edges, now_ns)

    def finish_graph(self, done: JobDone, now_ns: int) -> MergeResult:
        """Apply a finished pose graph, unless it was cancelled, then fuse landmarks and request a full bundle."""
        map_id = self._corrections.take_graph(done.id)
        if map_id is None:
            return NOTHING
        result: GraphResult = done.result
        keyframes = [KeyframeId(k) for k in result.keyframes.tolist()]
        units, lengths = apply_scales(self._map, map_id, dict(zip(keyframes, result.scale.tolist())), self._publisher)
        if lengths:
            self._edges = [rescaled(e, lengths) for e in self._edges]
            self.detector.rescale(lengths)
        targets = dict(zip(keyframes, result.T_w_k))
        move_keyframes(self._map, map_id, targets, self._publisher, self._config.publish)
        self._fuse_matches(map_id)
        self._corrections.request_bundle(map_id)
        self._corrections.request_parts(map_id)
        return MergeResult(moved=frozenset({map_id}), rescaled=units)

    def finish_bundle(self, done: JobDone, now_ns: int) -> MergeResult:
        """Apply a finished full bundle, unless it was cancelled."""
        bundle = self._corrections.take_bundle(done.id, done.cost_ops, now_ns)
        if bundle is None:
            return NOTHING
        map_id, window, agents = bundle.map_id, bundle.window, bundle.calibrated
        result: BundleResult = without_odometry_factors(window, done.result)
        if agents and not disparity.is_significant(window.problem, result, self._config.disparity):
            disparity.reset_offsets(self._map, agents)
            self._corrections.uncertain_at[map_id] = len(keyframes_of(self._map, map_id))
            self._corrections.request_bundle(map_id, calibrate=False)
            return NOTHING
        if not (np.isfinite(result.T_c_m).all() and np.isfinite(result.points).all()):
            return NOTHING
        changed = self._apply_full_bundle(bundle, result)
        if agents:
            self._corrections.uncertain_at.pop(map_id, None)
            disparity.set_offsets(self._map, agents, window.problem, result, self._config.disparity)
        return changed

    def forget_job(self, job: int, now_ns: int) -> None:
        """Forget a job without a result, if it is one of these."""
        self._corrections.take_graph(job)
        self._corrections.take_bundle(job, 0, now_ns)

    def search_overlap(self, newer: SubmapId, older: SubmapId) -> None:
        """Search the older map for every keyframe of the newer one; one match then suffices (a user's command)."""
        self._allow(newer, older)
        self.detector.requested.add((min(newer, older), max(newer, older)))
        self._requery = list(dict.fromkeys([*self._requery, *keyframes_of(self._map, newer)]))

    def merge(self, newer: SubmapId, older: SubmapId, S_older_newer: F64) -> MergeResult:
        """Merge two maps as a user says: S_older_newer (4,4) moves the newer map in w."""
        self._allow(newer, older)
        result = self._merge(LoopClosure(newer, older, S_older_newer))
        self._corrections.cancel_pending(older)
        self._corrections.request_bundle(older)
        return result

    def _allow(self, newer: SubmapId, older: SubmapId) -> None:
        """Forget that a user has split two maps."""
        self.detector.stop_keeping_apart(self._map.submaps_of_map(newer), self._map.submaps_of_map(older))

    def merge_tied(self, tie: InertialTie) -> MergeResult:
        """Merge two maps between which inertial steps lead."""
        if self.detector.is_kept_apart(tie.newer, tie.older):
            return NOTHING
        S_new_old, units = scale_map(self._map, tie.older, tie.metre)
        S_older_newer = sim3.normalise(S_new_old @ tie.S_older_newer)
        return replace(self.merge(tie.newer, tie.older, S_older_newer), rescaled=units)

    def split(self, submap: SubmapId) -> MergeResult | None:
        """Undo the merge that brought a submap into its map, for good; None if there was none (a user's command)."""
        merge = next((m for m in reversed(self.merges) if submap in m.moved), None)
        if merge is None:
            return None
        changes = self.undo(merge)
        self.detector.kept_apart.append((frozenset(merge.moved), frozenset(self._map.submaps_of_map(merge.into))))
        return changes

    def delete(self, submaps: Collection[SubmapId]) -> None:
        """Drop all that concerns deleted submaps."""
        for submap in submaps:
            for keyframe in self._map.submaps.get(submap, []):
                self.detector.remove(keyframe)
            self._corrections.cancel(submap)
            self._unfused.pop(submap, None)
            self._last_return.pop(submap, None)
        self.detector.forget(submaps)
        self._corrections.forget(submaps)
        gone = set(submaps)
        self._edges = [e for e in self._edges if gone.isdisjoint(map(submap_of_keyframe, (e.new, e.old)))]
        self._requery = [k for k in self._requery if submap_of_keyframe(k) not in submaps]
        self.merges = [m for m in self.merges if m.map_id not in submaps and m.into not in submaps]
        for merge in self.merges:
            merge.forget(gone)

    def undo(self, merge: MapMerge) -> MergeResult:
        """Separate a merged map again: move it back, and unfuse its landmarks from those of the other map.

        Later merges that rest on it are undone as well, and searched again.
        """
        sparse_map, result, again = self._map, NOTHING, list[SubmapId]()
        while (other := resting_on(merge, self.merges[self.merges.index(merge) + 1 :], self._edges)) is not None:
            again += other.moved
            result += self.undo(other)
        at, split = self.merges.index(merge), frozenset(merge.moved)
        rest = sparse_map.map_id(merge.into)  # it may have been merged into another map since
        self.merges.remove(merge)
        for later in self.merges[at:]:  # they no longer hold what is apart from now on
            later.forget(split)
        self.undone += 1
        self.detector.requested.discard((min(merge.map_id, merge.into), max(merge.map_id, merge.into)))
        self._corrections.cancel_pending(rest)
        self._edges = [
            e for e in self._edges if (submap_of_keyframe(e.new) in split) == (submap_of_keyframe(e.old) in split)
        ]
        self._unfused.pop(rest, None)
        left = (k for k in self._requery if submap_of_keyframe(k) not in split)
        self._requery = list(dict.fromkeys([*left, *(k for s in again for k in sparse_map.submaps[s])]))
        fused = fused_across(sparse_map, split)
        sparse_map.unfuse(fused)
        self._publisher.mark_changed_slots(FusedLandmarks.KIND, fused)
        refined = fused[sparse_map.keypoints.flags[fused] & REFINED != 0]  # not sent while they had another root
        self._publisher.mark_changed_slots(RefinedLandmarks.KIND, refined)
        for submap, S_w_m in merge.moved.items():
            sparse_map.root_submaps.pop(submap, None)
            if submap != merge.map_id:
                sparse_map.root_submaps[submap] = merge.map_id
            sparse_map.move_submap(submap, S_w_m)
        return result + MergeResult(frozenset({rest, merge.map_id}), split=split.union(sparse_map.submaps_of_map(rest)))

    # -- saved state -------------------------------------------------------------------------------------------------

    def state(self) -> MergerState:
        """State to be saved."""
        jobs = self._corrections
        return MergerState(
            self.loops, self.undone, dict(self._last_return), dict(jobs.uncertain_at), dict(jobs.bundled_sizes),
            jobs.graphs_due, jobs.bundles_due, tuple(self._requery), tuple(self._edges),
            {s: tuple(matches) for s, matches in sorted(self._unfused.items())},
            tuple(replace(merge) for merge in self.merges), self.detector.state(),
        )  # fmt: skip

    def restore(self, state: MergerState) -> None:
        """Continue from a saved state, in a map whose keyframes are all there."""
        sparse_map = self._map
        for keyframe in sorted(sparse_map.rows):
            if sparse_map.pose(keyframe) is not None and not sparse_map.keyframes.culled[sparse_map.rows[keyframe]]:
                self.detector.add(keyframe)
        self.detector.restore(state.detector)
        self.loops, self.undone = state.loops, state.undone
        self._last_return = dict(state.last_return)
        self._corrections.uncertain_at.update(state.uncertain_at)
        self._corrections.restore(state.graphs_due, state.bundles_due, state.bundled_sizes)
        self._requery = [k for k in state.requery if k in sparse_map]
        known = (e for e in state.edges if sparse_map.pose(e.new) is not None and sparse_map.pose(e.old) is not None)
        self._edges = list(known)
        self._unfused = {s: known_matches(sparse_map, matches) for s, matches in state.unfused.items()}
        self.merges += map(replace, state.merges)

    # -- loop closures -----------------------------------------------------------------------------------------------

    def _query(self, keyframe: KeyframeId) -> MergeResult:
        found = self.detector.query(keyframe)
        if isinstance(found, Contradiction):
            a, b = found.submaps
            wrong = next((m for m in reversed(self.merges) if (a in m.moved) != (b in m.moved)), None)
            if wrong is None:
                return NOTHING
            self.detector.contradict(edges_out_of(wrong.moved, self._edges), found.submaps)
            return self.undo(wrong)
        return NOTHING if found is None else self._close(found, keyframe)

    def _close(self, closure: LoopClosure, keyframe: KeyframeId) -> MergeResult:
        """Apply an accepted closure: merge the maps if there are two, and request a pose graph or a full bundle."""
        is_loop, map_id = closure.newer == closure.older, closure.older
        self.loops += is_loop and self._is_return(keyframe)
        result = NOTHING if is_loop else self._merge(closure)
        self._edges.extend(match.edge for match in closure.matches)
        self._unfused.setdefault(map_id, []).extend(closure.matches)
        self._corrections.cancel_pending(map_id)
        if any(not consistency.is_fusible(self._map, match) for match in closure.matches):
            self._corrections.request_graph(map_id)
        else:
            self._fuse_matches(map_id)
            self._corrections.request_bundle(map_id)
        return result

    def _observes_old_landmarks(self, keyframe: KeyframeId) -> bool:
        """True if a keyframe shares landmarks with one that lies far back in its submap."""
        shared = self._map.covisibility(self._map.landmarks_of(keyframe))
        rows = np.flatnonzero(shared >= self._config.loops.min_inliers)
        submap = submap_of_keyframe(keyframe)
        number = self._map.number_of(keyframe) - _LOOP_GAP
        if number <= 0:
            return False
        ids = self._map.keyframes.id[rows]
        return bool(np.any((ids >> SEQUENCE_BITS == submap) & (ids < self._map.submaps[submap][number])))

    def _is_return(self, keyframe: KeyframeId) -> bool:
        """True if the path returns to an old place with this keyframe, and did not a few keyframes ago."""
        submap = submap_of_keyframe(keyframe)
        at = self._map.number_of(keyframe)
        before = self._last_return.get(submap, -_LOOP_GAP - 1)
        self._last_return[submap] = at
        return at - before > _LOOP_GAP

    def _merge(self, closure: LoopClosure) -> MergeResult:
        """Move the newer map onto the older one, and make its submaps part of it."""
        sparse_map, newer, older = self._map, closure.newer, closure.older
        submaps = sparse_map.submaps_of_map(newer)
        self._corrections.cancel(newer)
        self._unfused.setdefault(older, []).extend(self._unfused.pop(newer, []))
        merge = MapMerge(newer, older, {s: sparse_map.submap_pose(s) for s in submaps})
        for submap in submaps:
            sparse_map.move_submap(submap, sim3.normalise(closure.S_older_newer @ merge.moved[submap]))
            sparse_map.root_submaps[submap] = older
        self.merges.append(merge)
        self._requery = list(dict.fromkeys([*self._requery, *(k for s in submaps for k in sparse_map.submaps[s])]))
        return MergeResult(moved=frozenset({older, newer}))

    def _fuse_matches(self, map_id: SubmapId) -> None:
        """Fuse the landmarks of verified matches, then match landmarks around the new keyframes of these matches."""
        table, config = self._map.keypoints, self._config.landmark_matching
        matches = self._unfused.pop(map_id, [])
        for match in matches:
            slots = slot_pairs(self._map, match.new_landmarks, match.old_landmarks)
            for a, b in zip(slots[0].tolist(), slots[1].tolist()):
                a, b = int(table.root[a]), int(table.root[b])
                if {self._map.map_of(a), self._map.map_of(b)} != {map_id}:
                    continue  # a match names the roots of its time: of a map that was split off since
                landmark_matching.fuse_landmarks(self._map, a, b, self._publisher)
        seen: set[KeyframeId] = set()
        for match in matches:
            around = self._map.covisible_keyframes(match.new, MIN_SHARED)
            for keyframe in [match.new, *around[:MAX_NEIGHBOURS]]:
                if keyframe not in seen:
                    seen.add(keyframe)
                    landmark_matching.match_landmarks(self._map, keyframe, config, self._publisher)

    # -- full bundles --------------------------------------------------------------------------------------------------

    def _apply_full_bundle(self, bundle: FullBundle, result: BundleResult) -> MergeResult:
        """Move a map to the result of its full bundle; newer keyframes move along the spanning tree."""
        map_id, window = bundle.map_id, bundle.window
        units: dict[SubmapId, float] = {}
        if self._corrections.fits(map_id):
            result, units = keep_scales(self._map, map_id, window, result)
        free = window.problem.free
        ids = self._map.keyframes.id[window.rows]
        poses = np.linalg.inv(result.T_c_m[free])
        targets = {KeyframeId(k): pose for k, pose in zip(ids[free].tolist(), poses)}
        targets |= zip(map(KeyframeId, ids[~free].tolist()), self._map.keyframes.T_w_k[window.rows[~free]])
        before = self._map.keyframes.T_w_k.copy()
        moved = move_keyframes(self._map, map_id, targets, self._publisher, self._config.publish)
        apply_bundle(self._map, window, result, self._publisher, self._config.publish)
        if bundle.part is not None and not moved:  # also those that came since and were carried along
            bent = np.flatnonzero((before != self._map.keyframes.T_w_k).any(axis=(1, 2)))
            return MergeResult(bent=frozenset(bent.tolist()))
        told = {map_id: result.scale_sigma} if result.scale_sigma > 0.0 else {}
        return MergeResult(moved=frozenset({map_id}), rescaled=units, scale_sigma=told)
