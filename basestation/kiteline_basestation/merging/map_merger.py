"""What becomes of a place seen again: maps are joined or bent, their points fused, and all of it is bundled anew.

Finding (loops) -> [merge: lay the newer map into the older] -> pose graph (job) -> fuse points -> full bundle (job).
A newer finding in the same map makes the jobs under way void. A merge that the bundle or later places contradict is
undone.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.exchange.publisher import Publisher
from kiteline_basestation.jobs import Job, JobDone
from kiteline_basestation.map.map_tables import LANDMARK
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.merging.correction import graph_of, keyframes_of, move_keyframes, rescale, whole_window
from kiteline_basestation.merging.essential_graph import GraphResult
from kiteline_basestation.merging.graph_job import POSE_GRAPH
from kiteline_basestation.merging.loop_detector import LoopClosure, LoopDetector
from kiteline_basestation.merging.loop_edges import rescaled, similarity
from kiteline_basestation.merging.loop_verification import LoopMatch
from kiteline_basestation.merging.merge import Merge
from kiteline_basestation.refinement import disparity_calibration as disparity
from kiteline_basestation.refinement import landmark_matching
from kiteline_basestation.refinement.apply_bundle import apply_bundle, keep_scales
from kiteline_basestation.refinement.bundle_job import FULL_BUNDLE, BundleInputs
from kiteline_basestation.refinement.bundle_window import BundleWindow
from kiteline_basestation.refinement.odometry_factors import with_odometry_factors, without_odometry_factors
from kiteline_basestation.store import merger_state as merger_state
from kiteline_basestation.store.state import Memory
from kiteline_codec.schema import FusedLandmarks
from kiteline_core.geometry import se3, sim3
from kiteline_core.ids import SEQUENCE_BITS, AgentId, KeyframeId, SubmapId, submap_of_keyframe
from kiteline_core.optimisation.bundle import BundleConfig, BundleResult
from kiteline_core.places.place_index import Vocabulary

F64 = NDArray[np.float64]


class MapMerger:
    """Findings and their consequences. The mapper calls; nothing here waits."""

    def __init__(
        self, config: BaseConfig, sparse_map: SparseMap, publisher: Publisher, words: Vocabulary,
        next_job: Callable[[], int],
    ) -> None:  # fmt: skip
        self._config = config
        self._map = sparse_map
        self._publisher = publisher
        self._next_job = next_job
        self.detector = LoopDetector(config.loops, sparse_map, words)
        self.loops = 0
        self.merges: list[Merge] = []
        self.undone = 0
        self.moved: set[SubmapId] = set()  # maps (eldest submap) that moved as a whole since the mapper last asked
        self.grown: dict[SubmapId, float] = {}  # by what units grew in their maps since the mapper last asked
        self.parted: set[SubmapId] = set()  # submaps that were taken out of a map since the mapper last asked
        self._returned: dict[SubmapId, int] = {}  # where in each submap the way last was where it had been before
        self._edges: list[LoopMatch] = []  # proved loops, edges of the pose graph
        self._fresh: dict[SubmapId, list[LoopMatch]] = {}  # of each map, those whose points are not fused yet
        self._graph_due: set[SubmapId] = set()
        self._full_due: set[SubmapId] = set()
        self._plain: set[SubmapId] = set()  # of those, the ones whose disparities are to be taken as they are
        self._doubted: dict[SubmapId, int] = {}  # keyframes of maps at which offsets were last looked for in vain
        self._graphs: dict[int, SubmapId] = {}  # open jobs
        self._fulls: dict[
            int, tuple[SubmapId, BundleWindow, tuple[AgentId, ...]]
        ] = {}  # whose disparities are found, too
        self._revisit: list[KeyframeId] = []  # keyframes of merged maps that have not looked around in the other yet

    @property
    def idle(self) -> bool:
        """Whether nothing is under way."""
        return not (self._graph_due or self._full_due or self._graphs or self._fulls or self._revisit)

    @property
    def proved(self) -> Sequence[LoopMatch]:
        """Loops that were proved, oldest first."""
        return self._edges

    @property
    def jobs_open(self) -> int:
        """How many jobs are under way."""
        return len(self._graphs) + len(self._fulls)

    def busy_with(self, map_id: SubmapId) -> bool:
        """Whether a correction of a map is under way."""
        due = map_id in self._graph_due or map_id in self._full_due or map_id in self._graphs.values()
        return due or any(i == map_id for i, _, _ in self._fulls.values())

    def fits(self, map_id: SubmapId) -> bool:
        """Whether one bundle can hold a whole map."""
        return len(keyframes_of(self._map, map_id)) <= self._config.graph.max_full

    def _keeps_disparities(self, map_id: SubmapId) -> bool:
        """Whether offsets were looked for in vain just now, or in a map that was hardly smaller."""
        enough = self._config.disparity.again * self._doubted.get(map_id, 0)
        return map_id in self._plain or len(keyframes_of(self._map, map_id)) < enough

    def bundle_all(self, map_id: SubmapId) -> None:
        """Bundle a whole map anew."""
        self._full_due.add(map_id)

    def consider(self, keyframe: KeyframeId) -> None:
        """Ask whether a new keyframe's place is known, and remember it."""
        self.detector.add(keyframe)
        if self._old_company(keyframe) and self._is_return(keyframe):
            self.loops += 1  # so little drift that its points were found where they were foreseen
        self._ask(keyframe)

    def _old_company(self, keyframe: KeyframeId) -> bool:
        """Whether a keyframe sees points together with one that its submap left long ago."""
        shared = self._map.covisibility(self._map.landmarks_of(keyframe))
        rows = np.flatnonzero(shared >= self._config.loops.min_inliers)
        same = self._map.submaps[submap_of_keyframe(keyframe)]
        old = set(same[: max(0, same.index(keyframe) - self._config.loops.loop_gap)])
        return any(k in old for k in self._map.keyframes.id[rows].tolist())

    def _is_return(self, keyframe: KeyframeId) -> bool:
        """Whether the way comes back with this keyframe, and did not already a few keyframes ago."""
        submap = submap_of_keyframe(keyframe)
        at = self._map.submaps[submap].index(keyframe)
        before = self._returned.get(submap, -self._config.loops.loop_gap - 1)
        self._returned[submap] = at
        return at - before > self._config.loops.loop_gap

    def revisit(self) -> list[KeyframeId]:
        """A few keyframes of merged maps look for what the other map knows. Returns them: bundles are due there."""
        now, self._revisit = self._revisit[: self._config.graph.revisits], self._revisit[self._config.graph.revisits :]
        for keyframe in now:
            landmark_matching.match_landmarks(self._map, keyframe, self._config.refind, self._publisher)
            self._ask(keyframe)
        if now and not self._revisit:
            self._full_due.add(self._map.map_id(submap_of_keyframe(now[-1])))  # with all that they have in common
        return now

    def jobs(self) -> list[Job]:
        """Pose graphs first, then full bundles of maps whose graph is settled."""
        out: list[Job] = []
        for map_id in sorted(self._graph_due):
            inputs = graph_of(self._map, map_id, tuple(self._edges), self._config.graph)
            if inputs is not None:
                job = Job(self._next_job(), POSE_GRAPH.name, inputs)
                self._graphs[job.id] = map_id
                out.append(job)
        self._graph_due.clear()
        for map_id in sorted(self._full_due - set(self._graphs.values())):
            part = whole_window(self._map, map_id, self._edges, self._config)
            if part is not None:
                agents: tuple[AgentId, ...] = ()
                if self.fits(map_id) and not self._keeps_disparities(map_id):
                    problem, agents = disparity.with_border(
                        self._map, part.slots, part.problem, self._config.disparity
                    )  # fmt: skip
                    part = replace(part, problem=problem)
                linked = with_odometry_factors(self._map, part, self._config.links)
                job = Job(self._next_job(), FULL_BUNDLE.name, BundleInputs(linked, self._full_config()))
                self._fulls[job.id] = (map_id, part, agents)
                out.append(job)
            self._full_due.discard(map_id)
            self._plain.discard(map_id)
        return out

    def finish(self, done: JobDone) -> bool:
        """Take in a finished job; False when it is none of ours. One that was made void changes nothing."""
        if isinstance(done.result, GraphResult):
            map_id = self._graphs.pop(done.id, None)
            if map_id is not None:
                self._bend(map_id, done.result)
            return True
        if isinstance(done.result, BundleResult) and done.id in self._fulls:
            map_id, part, agents = self._fulls.pop(done.id)
            result = without_odometry_factors(part, done.result)
            if agents and not disparity.stands_out(result, self._config.disparity):
                disparity.forget(self._map, agents)
                self._doubted[map_id] = len(keyframes_of(self._map, map_id))
                self._plain.add(map_id)  # nothing is known to be off: the same again, with disparities as they are
                self._full_due.add(map_id)
            elif self._settle(map_id, part, result) and agents:
                self._doubted.pop(map_id, None)
                disparity.take(self._map, agents, part.problem, result, self._config.disparity)
            return True
        return False

    def memory(self) -> Memory:
        """What a successor needs to go on from here; corrections under way are due again."""
        return merger_state.memory(self)

    def recall(self, texts: Mapping[str, str]) -> None:
        """Go on from what a forerunner remembered; every keyframe is a known place."""
        merger_state.recall(self, texts)

    # -- findings ----------------------------------------------------------------------------------------------------

    def _ask(self, keyframe: KeyframeId) -> None:
        closure = self.detector.consider(keyframe)
        if closure is None:
            return
        if closure.against is not None:
            a, b = closure.against
            for merge in reversed(self.merges):
                if (a in merge.moved) != (b in merge.moved):
                    self.undo(merge)
                    return
            return
        if closure.loop:
            self.loops += self._is_return(keyframe)
        else:
            self._join(closure)
        self._edges.extend(closure.votes)
        self._fresh.setdefault(closure.older, []).extend(closure.votes)
        self._void(closure.older)
        if self._needs_graph(closure):
            self._graph_due.add(closure.older)
        else:
            self._fuse_fresh(closure.older)
            self._full_due.add(closure.older)

    def _void(self, map_id: SubmapId) -> None:
        """What is under way in a map is out of date."""
        self._graphs = {job: i for job, i in self._graphs.items() if i != map_id}
        self._fulls = {job: full for job, full in self._fulls.items() if full[0] != map_id}

    def _needs_graph(self, closure: LoopClosure) -> bool:
        """Whether fusing points and bundling would not do: the correction reaches further than they look."""
        limits = self._config.loops
        for vote in closure.votes:
            S_w_new = similarity(self._map, vote.new)
            error = sim3.inverse(S_w_new) @ similarity(self._map, vote.old) @ sim3.of(vote.scale, vote.T_old_new)
            if sim3.scale_of(S_w_new) * np.linalg.norm(error[:3, 3]) > limits.small_m:
                return True
            if np.linalg.norm(se3.so3_log(sim3.rigid(error)[:3, :3])) > limits.small_rad:
                return True
            if abs(np.log(sim3.scale_of(error))) > limits.small_scale:
                return True
        return False

    def _join(self, closure: LoopClosure) -> None:
        """Lay the newer map into the older; where it is then bent, its submaps keep their own m."""
        sparse_map = self._map
        submaps = sparse_map.submaps_of_map(closure.newer)
        self._void(closure.newer)
        for waiting in (self._graph_due, self._full_due):
            waiting.discard(closure.newer)
        self._fresh.setdefault(closure.older, []).extend(self._fresh.pop(closure.newer, []))
        merge = Merge(closure.newer, closure.older, {s: sparse_map.submap_pose(s) for s in submaps})
        for submap in submaps:
            sparse_map.move_submap(submap, sim3.normalise(closure.S_older_newer @ merge.moved[submap]))
            sparse_map.root_submaps[submap] = closure.older
        self.merges.append(merge)
        self.moved |= {closure.older, closure.newer}
        self._revisit.extend(k for s in submaps for k in sparse_map.submaps[s] if k not in self._revisit)

    # -- corrections -------------------------------------------------------------------------------------------------

    def _bend(self, map_id: SubmapId, result: GraphResult) -> None:
        targets = {KeyframeId(k): T for k, T in zip(result.keyframes.tolist(), result.T_w_k)}
        growth = {KeyframeId(k): s for k, s in zip(result.keyframes.tolist(), result.scale.tolist())}
        units, lengths = rescale(self._map, map_id, growth, self._publisher)
        self._note_growth(units)
        self._stretch(lengths)
        move_keyframes(self._map, map_id, targets, self._publisher, self._config.publish)
        self.moved.add(map_id)
        self._fuse_fresh(map_id)
        self._full_due.add(map_id)

    def _note_growth(self, units: Mapping[SubmapId, float]) -> None:
        for submap, more in units.items():
            self.grown[submap] = self.grown.get(submap, 1.0) * more

    def _stretch(self, grown: Mapping[KeyframeId, float]) -> None:
        """Lengths have grown before some keyframes: so have those of what was proved there."""
        if grown:
            self._edges = [rescaled(v, grown) for v in self._edges]
            self._fresh = {s: [rescaled(v, grown) for v in votes] for s, votes in self._fresh.items()}
            self.detector.rescale(grown)

    def _fuse_fresh(self, map_id: SubmapId) -> None:
        """Points that votes proved to be one, then what the neighbours on both sides see of each other."""
        table = self._map.keypoints
        votes = self._fresh.pop(map_id, [])
        merge = self.merges[-1] if self.merges and self.merges[-1].into == map_id else None
        for vote in votes:
            for a, b in zip(vote.mine.tolist(), vote.theirs.tolist()):
                a, b = int(table.root[a]), int(table.root[b])
                if a != b and landmark_matching.fuse_landmarks(self._map, a, b, self._publisher) and merge is not None:
                    merge.fused.append((a, b))
        seen: set[KeyframeId] = set()
        for vote in votes:
            around = self._map.covisible_keyframes(vote.new, self._config.window.min_shared)
            for keyframe in [vote.new, *around[: self._config.loops.neighbours]]:
                if keyframe not in seen:
                    seen.add(keyframe)
                    landmark_matching.match_landmarks(self._map, keyframe, self._config.refind, self._publisher)

    def _full_config(self) -> BundleConfig:
        config = self._config.graph
        return replace(self._config.bundle, robust_trials=config.robust_trials, final_trials=config.final_trials)

    def _settle(self, map_id: SubmapId, part: BundleWindow, result: BundleResult) -> bool:
        """Take a full bundle in; what came meanwhile moves along the spanning tree. Returns whether it was taken."""
        if not (np.isfinite(result.T_c_m).all() and np.isfinite(result.points).all()):
            return False
        if self._contradicted(map_id, part, result):
            return False
        if self.fits(map_id):
            result, units = keep_scales(self._map, map_id, part, result)
            self._note_growth(units)
        rows = part.rows[part.problem.free]
        poses = np.linalg.inv(result.T_c_m[part.problem.free])
        keyframes = self._map.keyframes.id[rows].tolist()
        targets = {KeyframeId(k): pose for k, pose in zip(keyframes, poses)}
        held = self._map.keyframes.id[part.rows[~part.problem.free]].tolist()
        for keyframe in map(KeyframeId, held):
            pose = self._map.world_pose(keyframe)
            assert pose is not None
            targets[keyframe] = pose
        move_keyframes(self._map, map_id, targets, self._publisher, self._config.publish)
        apply_bundle(self._map, part, result, self._publisher, self._config.cull, self._config.publish)
        self.moved.add(map_id)
        return True

    # -- orders ------------------------------------------------------------------------------------------------------

    def look_for(self, newer: SubmapId, older: SubmapId) -> None:
        """A person says that two maps overlap: every keyframe of the newer looks for it, and one proof is enough."""
        self.detector.asked.add((min(newer, older), max(newer, older)))
        self._revisit.extend(k for k in keyframes_of(self._map, newer) if k not in self._revisit)

    def join(self, newer: SubmapId, older: SubmapId, S_older_newer: F64) -> None:
        """A person says how two maps lie to each other: (4,4) moves the newer, in w, onto the older."""
        self._join(LoopClosure(newer, older, S_older_newer, ()))
        self._void(older)
        self._full_due.add(older)

    def split(self, submap: SubmapId) -> bool:
        """Take the map with which a submap came out of the one that it was laid into, for good. False: it never was."""
        merge = next((m for m in reversed(self.merges) if submap in m.moved), None)
        if merge is None:
            return False
        rest = frozenset(self._map.submaps_of_map(merge.into)) - merge.moved.keys()
        self.detector.apart.append((frozenset(merge.moved), rest))
        self.undo(merge)
        return True

    def forget(self, submaps: Collection[SubmapId]) -> None:
        """Maps are deleted: nothing is looked for in them, or made of them, any more."""
        for submap in submaps:
            for keyframe in self._map.submaps.get(submap, []):
                self.detector.forget(keyframe)
            self._void(submap)
        self._graph_due.difference_update(submaps)
        self._full_due.difference_update(submaps)
        self._revisit = [k for k in self._revisit if submap_of_keyframe(k) not in submaps]
        self.merges = [m for m in self.merges if m.eldest not in submaps and m.into not in submaps]

    # -- second thoughts ---------------------------------------------------------------------------------------------

    def _contradicted(self, map_id: SubmapId, part: BundleWindow, result: BundleResult) -> bool:
        """Undo the last merge into a map when the bundle rejects most of what it fused. Returns whether it did."""
        merge = next((m for m in reversed(self.merges) if m.into == map_id), None)
        if merge is None or not merge.fused:
            return False
        table = self._map.keypoints
        roots = np.unique(table.root[np.array(merge.fused, np.int64).ravel()])
        which = np.repeat(part.points, np.diff(part.problem.starts))
        submap = self._map.keyframes.id[table.row[part.slots]] >> SEQUENCE_BITS
        mine = np.isin(submap, sorted(merge.moved)) & np.isin(which, roots)
        if int(np.count_nonzero(mine)) < self._config.loops.min_inliers:
            return False
        if float(np.mean(result.inlier[mine])) >= self._config.graph.min_kept:
            return False
        self.undo(merge)
        return True

    def undo(self, merge: Merge) -> None:
        """Take a merged map out again: it lies where it lay, and none of its points is a point of the other."""
        sparse_map, table = self._map, self._map.keypoints
        self.merges.remove(merge)
        self.undone += 1
        self._void(merge.into)
        mine = set(merge.moved)
        self._edges = [
            v for v in self._edges if (submap_of_keyframe(v.new) in mine) == (submap_of_keyframe(v.old) in mine)
        ]
        self._fresh.pop(merge.into, None)
        self._revisit = [k for k in self._revisit if submap_of_keyframe(k) not in mine]
        inside = np.isin(sparse_map.keyframes.id[table.row[: sparse_map.slots]] >> SEQUENCE_BITS, sorted(mine))
        roots = table.root[: sparse_map.slots]
        crossing = np.flatnonzero((roots >= 0) & (inside != inside[np.maximum(roots, 0)])).astype(np.int32)
        sparse_map.unfuse(crossing[table.kind[crossing] == LANDMARK])
        self._publisher.mark_changed_slots(FusedLandmarks.KIND, crossing[table.kind[crossing] == LANDMARK])
        for submap, frame in merge.moved.items():
            sparse_map.root_submaps.pop(submap, None)
            if submap != merge.eldest:
                sparse_map.root_submaps[submap] = merge.eldest
            sparse_map.move_submap(submap, frame)
        self.parted |= mine
        self.moved |= {merge.into, merge.eldest}
