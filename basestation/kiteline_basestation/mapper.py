"""The mapper: records of the agents enter, a refined map of them leaves.

Method: "DS-PTAM: a distributed stereo PTAM", the mapper of chapter 3, with the culling of ORB-SLAM2.
"""

import math
from collections import Counter, deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.exchange.publisher import Published, Publisher
from kiteline_basestation.grid.grid_updates import GridUpdates
from kiteline_basestation.grid.grid_view import GridViews
from kiteline_basestation.grid.image_scans import ImageScans
from kiteline_basestation.grid.scan_grid import ScanGrid
from kiteline_basestation.grid.scan_job import SCAN
from kiteline_basestation.intake.confirmation import is_confirmed
from kiteline_basestation.intake.intake import Intake
from kiteline_basestation.intake.placements import SubmapPlacements
from kiteline_basestation.jobs import Job, JobDone, JobIds
from kiteline_basestation.management import Answer, Command, MapManager
from kiteline_basestation.map.map_tables import CULLED, LANDMARK
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.mapper_state import MapperCounts, MapperState, map_state, restore_map
from kiteline_basestation.merging.graph_job import POSE_GRAPH
from kiteline_basestation.merging.map_merger import NO_CLOSURES, MapMerger
from kiteline_basestation.merging.merges import NOTHING, MergeResult, MergerState
from kiteline_basestation.refinement import culling, landmark_matching, triangulation
from kiteline_basestation.refinement.bundle_job import FULL_BUNDLE, LOCAL_BUNDLE
from kiteline_basestation.refinement.local_bundles import LocalBundles
from kiteline_codec.schema import DisparityCalibration, FusedLandmarks, Key, LivePose, Record, SubmapPlacement
from kiteline_core.arrays import F64, I32, U8
from kiteline_core.geometry import sim3
from kiteline_core.ids import AgentId, KeyframeId, SubmapId, agent_of_keyframe, agent_of_submap, submap_of_keyframe
from kiteline_core.places.place_index import Vocabulary

_TIMED_UPDATES = 10_000  # newest updates of the grid whose CPU times are kept


@dataclass(frozen=True, slots=True)
class MapperInput:
    """Inputs since the last step: records by agent, in order of agent id, finished jobs, and commands of users.

    room_bytes: for corrections of an agent's map, by agent; 0: none now. Without an entry there is no limit.
    imports: records by agent that come from a log, not from the agent.
    """

    arrivals: tuple[tuple[AgentId, tuple[Record, ...]], ...]
    done: tuple[JobDone, ...] = ()
    commands: tuple[Command, ...] = ()
    room_bytes: tuple[tuple[AgentId, int], ...] = ()
    imports: tuple[tuple[AgentId, tuple[Record, ...]], ...] = ()


@dataclass(frozen=True, slots=True)
class MapperOutput:
    """Records for each agent, jobs to be run, answers to the commands, and keys of records that are void.

    unfinished: agents whose batch of corrections goes on with the next step. urgent: placements that wait for no batch.
    """

    publish: Published
    jobs: tuple[Job, ...]
    answers: tuple[Answer, ...] = ()
    withdrawn: tuple[tuple[AgentId, Key], ...] = ()
    unfinished: frozenset[AgentId] = frozenset()
    urgent: tuple[tuple[AgentId, SubmapPlacement], ...] = ()


class Mapper:
    """A state machine without clock, threads or links: the same inputs give the same outputs."""

    def __init__(self, config: BaseConfig | None = None, vocabulary: Vocabulary | None = None) -> None:
        """vocabulary: of the place index; without one no loops are closed and no maps merged."""
        self.config = config or BaseConfig()
        self.map = SparseMap()
        self.names: dict[SubmapId, str] = {}  # of maps, by map id
        self.counts = MapperCounts()
        self.jobs_failed = 0  # since the process began
        self.failures: dict[str, str] = {}  # why the last job of a kind failed, while none of it succeeded since
        self._confirmed: Counter[AgentId] = Counter()  # keyframes since `take_confirmed`
        self.cpu_ns: Callable[[], int] = lambda: 0  # clock of `grid_ns`, which no output depends on
        self.grid_ns: deque[int] = deque(maxlen=_TIMED_UPDATES)  # time of the updates of the grid
        job_ids = JobIds()
        self._intake = Intake(self.config.intake, self.map)
        self._publisher = Publisher(self.map, self.config.publish)
        self._placements = SubmapPlacements(self.map, self._intake, self._publisher)
        self._local_bundles = LocalBundles(self.config, self.map, self._publisher, job_ids)
        self.grid_updates = GridUpdates(self.config, self.map, self.placements)
        self.image_scans = ImageScans(self.config.scan, self.map, job_ids)
        self.views = GridViews(self.grid)  # of the grid, for the status page
        self._forgotten: set[SubmapId] = set()  # deleted in the step before, which told the agents
        self._sent_offsets: dict[AgentId, F64] = {}  # disparity offsets that the agents have
        self.merger: MapMerger | None = None
        if vocabulary is not None and self.config.loops.enabled:
            self.merger = MapMerger(self.config, self.map, self._publisher, vocabulary, job_ids)
        self._manager = MapManager(self.map, self.names, self.placements, self._intake, self.merger, self._delete)
        self._finish: dict[str, Callable[[JobDone, int], MergeResult]] = {
            LOCAL_BUNDLE.name: self._finish_local_bundle,
            SCAN.name: self._finish_scan,
        }
        if self.merger is not None:
            self._finish |= {POSE_GRAPH.name: self.merger.finish_graph, FULL_BUNDLE.name: self.merger.finish_bundle}

    def step(self, given: MapperInput, now_ns: int) -> MapperOutput:
        """Take inputs in; return records to publish and jobs to run."""
        self._forget_deleted()
        # 1. Put the received records into the map, and align w with gravity and metres where an agent reports them.
        for agent, records in given.arrivals:
            self._intake.take(agent, records, now_ns)
        for agent, records in given.imports:
            self._intake.take(agent, records, now_ns, in_contact=False)
        scaled, turned = self._placements.make_metric(), self._placements.align_with_gravity()
        if scaled or turned:
            self.grid_updates.rebuild()
        # 2. Apply the results of finished jobs, then carry out commands.
        changes = NOTHING
        for done in given.done:
            if done.failed:
                self._set_aside(done, now_ns)
            else:
                self.failures.pop(done.kind, None)
                changed = self._finish[done.kind](done, now_ns)
                self._local_bundles.void(changed.moved, changed.bent)  # whose results may be the next ones
                changes += changed
        tell, changed = self._manager.carry_out(given.commands, now_ns)
        changes += changed
        # 3. Refine the map with each new keyframe, and search for loop closures and merges.
        ready = self._intake.ready(now_ns)
        self._placements.tell_rooted()
        for keyframe in ready:
            changes += self._add_keyframe(keyframe)
        if self._placements.follow_ties():
            self.grid_updates.rebuild()
        if self.merger is not None:
            changes += self.merger.requery()
            while (tie := self._intake.inertial_ties.take()) is not None:
                changes += self.merger.merge_tied(tie)
        # 4. Apply what merges and corrections of whole maps changed.
        withdrawn = self._apply_merges(changes)
        # 5. Draw the grid where keyframes are new or moved.
        self._draw_grid(busy=bool(ready))
        # 6. Start jobs: local bundles, scans of images, pose graphs, full bundles.
        self._send_calibrations()
        jobs = self._local_bundles.jobs() + self.image_scans.jobs()
        if self.merger is not None:
            jobs += self.merger.jobs(now_ns)
        # 7. Publish the values that changed and for which there is room.
        urgent, published = self._publisher.take_urgent(), self._publisher.collect(dict(given.room_bytes))
        return MapperOutput(published, tuple(jobs), tell(), withdrawn, self._publisher.unfinished, urgent)

    def adopt(self, record: Record) -> None:
        """Replace a published value by its quantised code, as the agent will hold it, unless it changed meanwhile."""
        self._publisher.adopt(record)

    def take_confirmed(self) -> dict[AgentId, int]:
        """How many keyframes of each agent were found to agree with older ones since the last call."""
        confirmed, self._confirmed = self._confirmed, Counter()
        return confirmed

    # -- state and numbers -------------------------------------------------------------------------------------------

    @property
    def placements(self) -> dict[SubmapId, F64]:
        """S_w_m of placed submaps, the first one of all first: a similarity where w has another unit of length."""
        return self._placements.S_w_m

    @property
    def deleted(self) -> set[SubmapId]:
        """Submaps that a user deleted."""
        return self._intake.deleted

    def has_no_place(self, submap: SubmapId) -> bool:
        """True if a submap is deleted, or in use without a place in w. Where one lies that did not come is open."""
        return submap in self.deleted or (submap not in self.placements and self._intake.is_used(submap))

    @property
    def grid(self) -> ScanGrid:
        """The occupancy grid."""
        return self.grid_updates.grid

    def settled_grid(self) -> ScanGrid:
        """The grid with all keyframes drawn where they are now; the mapper goes on with its own."""
        return self.grid_updates.settled()

    def labels(self, landmarks: I32) -> U8:
        """Labels (n,) of landmarks: 0 unlabelled, 1 ground, 2 obstacle."""
        return self.grid_updates.labels(landmarks)

    @property
    def idle(self) -> bool:
        """True if no job is due or pending, all keyframes that arrived are used, and no change waits to be sent."""
        merged = self.merger is None or self.merger.idle
        waiting = self._intake.backlog or self._publisher.waiting
        return merged and self._local_bundles.idle and self.image_scans.idle and not waiting

    def live(self, agent: AgentId) -> LivePose | None:
        """The newest live pose of an agent."""
        return self._intake.live.get(agent)

    def silent_s(self, agent: AgentId, now_ns: int) -> float:
        """Seconds since the last record of an agent; infinite before the first one."""
        heard_ns = self._intake.last_contact_ns.get(agent)
        return math.inf if heard_ns is None else (now_ns - heard_ns) * 1e-9

    def state(self) -> MapperState:
        """State to be saved, beside the values shared with the agents."""
        return MapperState(
            replace(self.counts), dict(self.names), self._local_bundles.waiting, map_state(self.map),
            self._intake.state(), self._placements.state(),
            MergerState() if self.merger is None else self.merger.state(), dict(self.image_scans.made),
        )  # fmt: skip

    def restore(self, agent: AgentId, received: tuple[Record, ...], own: tuple[Record, ...], now_ns: int) -> None:
        """Restore an agent's values: `received` by an earlier base process, and its `own`, written for the agent."""
        self._intake.take(agent, received, now_ns, in_contact=False)
        for record in own:
            self.adopt(record)
            if isinstance(record, SubmapPlacement):
                self._placements.restore_told(record)

    def restore_state(self, state: MapperState) -> None:
        """Continue from a saved state, after `restore` for all agents."""
        self.counts = replace(state.counts)
        self.names.update(state.names)
        restore_map(self.map, state.map)
        self._intake.restore(state.intake)
        self._intake.forget(self.deleted)  # logs and copies hold values of deleted maps, too
        self.map.forget(self.deleted)
        self._placements.restore(state.placements)
        self._local_bundles.restore(state.unbundled)
        for record in (*self._intake.take_scans(), *self.image_scans.restore(state.made_scans)):
            self.grid_updates.add_scan(record)
        self.grid_updates.rebuild()
        if self.merger is not None:
            self.merger.restore(state.merger)

    def tell_fused(self, landmarks: I32) -> None:
        """Send the roots of landmarks (n,) to their agents, which hold others."""
        self._publisher.mark_changed_slots(FusedLandmarks.KIND, landmarks)

    def summary(self) -> dict[str, object]:
        """Sizes and counts for the status page, the terminal and reports, and the state of each agent."""
        merger, submaps = self.merger, self.map.submaps
        agents = {}
        for agent in sorted(self.map.cameras.keys() | self._intake.last_contact_ns.keys()):
            live = self._intake.live.get(agent)
            own = [keyframes for submap, keyframes in submaps.items() if agent_of_submap(submap) == agent]
            agents[int(agent)] = {
                "keyframes": sum(len(keyframes) for keyframes in own),
                "submaps": len(own),
                "last_seen_ns": self._intake.last_contact_ns.get(agent),
                "live_t_ns": live.t_ns if live else None,
                "quality": live.quality if live else None,
                "T_w_c": self._live_pose(agent),
            }
        pending = self._local_bundles.pending + self.image_scans.pending + (merger.pending_jobs if merger else 0)
        return {
            **asdict(self.counts),
            "keyframes": len(self.map),
            "points": self.map.count_live(),
            "observations": int(self.map.keyframes.usable[: self.map.height].sum()),
            "map_bytes": self.map.nbytes(),
            "agents": agents,
            "submaps_placed": len(self.placements),
            "refused_records": self._intake.refused + self.map.far_poses + self._placements.far,
            **(merger.counts if merger else NO_CLOSURES),
            "maps": len({self.map.map_id(s) for s in submaps}),
            "jobs_open": pending,
            "jobs_failed": self.jobs_failed,
        }

    # -- steps -------------------------------------------------------------------------------------------------------

    def _add_keyframe(self, keyframe: KeyframeId) -> MergeResult:
        """Match, triangulate and cull landmarks around a new keyframe, then search for its place in all maps."""
        config, publisher = self.config, self._publisher
        self._placements.place_new(keyframe)
        if is_confirmed(self.map, keyframe):
            self._confirmed[agent_of_keyframe(keyframe)] += 1
        self.counts.found += landmark_matching.match_landmarks(self.map, keyframe, config.landmark_matching, publisher)
        triangulated = triangulation.triangulate_landmarks(self.map, keyframe, config.triangulation, publisher)
        self.counts.triangulated += triangulated
        self.counts.culled += culling.cull_weak_landmarks(self.map, keyframe, publisher)
        culled = culling.cull_redundant_keyframes(self.map, keyframe, publisher)
        self.counts.keyframes_culled += len(culled)
        self._local_bundles.add(keyframe)
        self.grid_updates.add_keyframe(keyframe)
        self.counts.keyframes += 1
        if self.merger is None:
            return NOTHING
        for other in culled:
            self.merger.remove_keyframe(other)
        return self.merger.add_keyframe(keyframe)

    def _apply_merges(self, changes: MergeResult) -> tuple[tuple[AgentId, Key], ...]:
        """Update bundles, placements and the grid after whole maps moved or went. Returns placements that are void."""
        for keyframe in changes.requeried:
            self._local_bundles.add(keyframe)
        self._local_bundles.void(changes.moved, changes.bent)
        self._placements.separate(changes.split)
        self._placements.rescale(changes.rescaled, changes.scale_sigma)
        for map_id in sorted(changes.moved):
            self._placements.update_map(map_id)
            self.grid_updates.rebuild()
        return tuple(
            (agent_of_submap(submap), Key(SubmapPlacement.KIND, int(submap), 0))
            for submap in (*self._placements.take_withdrawn(), *sorted(self._forgotten))
            if submap not in self.placements
        )

    def _finish_local_bundle(self, done: JobDone, now_ns: int) -> MergeResult:
        self.counts.bundles += self._local_bundles.finish(done)
        return NOTHING

    def _finish_scan(self, done: JobDone, now_ns: int) -> MergeResult:
        for scan in self.image_scans.finish(done):
            self.grid_updates.add_scan(scan)
        return NOTHING

    def _set_aside(self, done: JobDone, now_ns: int) -> None:
        """Forget a job that failed: the map stays as it is until another job of its kind is due."""
        self.jobs_failed += 1
        self.failures[done.kind] = done.failed
        self._local_bundles.forget(done.id)
        self.image_scans.forget(done.id)
        if self.merger is not None:
            self.merger.forget_job(done.id, now_ns)

    def _draw_grid(self, *, busy: bool) -> None:
        begin_ns = self.cpu_ns()
        for record in self._intake.take_scans():
            self.grid_updates.add_scan(record)
        for images in self._intake.take_images():
            self.grid_updates.expect_scans(agent_of_keyframe(images.keyframe))
            self.image_scans.add(images)
        before = self.grid_updates.grid.revision
        self.grid_updates.update(busy=busy)
        if self.grid_updates.grid.revision != before:
            self.counts.grids += 1
            self.grid_ns.append(self.cpu_ns() - begin_ns)

    def _send_calibrations(self) -> None:
        """Send new disparity offsets to the agents, which track on corrected disparities."""
        for agent, offset in sorted(self.map.disparity_offset_px.items(), key=lambda item: item[0]):
            sent = self._sent_offsets.get(agent)
            if sent is not None and np.array_equal(sent, offset):
                continue
            self._sent_offsets[agent] = offset
            if self.map.is_onboard_offset(agent):
                continue  # the agent found it itself
            sigma_px = self.map.disparity_sigma_px.get(agent)
            self._publisher.send(agent, DisparityCalibration(agent, offset, sigma_px))

    def _delete(self, submaps: Collection[SubmapId]) -> None:
        """Cull submaps, publish it, and ignore later records of them."""
        self.deleted.update(submaps)
        for submap in submaps:
            keyframes: Sequence[KeyframeId] = self.map.submaps.get(submap, [])
            for keyframe in keyframes:
                slots = self.map.slots_of(keyframe)
                self.map.inertial_steps.pop(keyframe, None)
                self.map.up.pop(keyframe, None)
                self.map.set_flags(slots[self.map.keypoints.kind[slots] == LANDMARK], CULLED)
                self.map.cull_keyframe(keyframe)
                self._publisher.mark_deleted(keyframe)
            self._placements.delete(submap)
            self.grid_updates.remove(keyframes)
            self.names.pop(submap, None)
            self.map.root_submaps.pop(submap, None)
        self._forgotten.update(submaps)
        self._intake.forget(submaps)
        self._local_bundles.delete(submaps)
        self.image_scans.delete(submaps)
        if self.merger is not None:
            self.merger.delete(submaps)
        self.grid_updates.rebuild()

    def _forget_deleted(self) -> None:
        """Free the memory of what was deleted, now that it is published."""
        if self._forgotten:
            self._publisher.forget(self._forgotten)
            self.map.forget(self._forgotten)
            self._forgotten = set()

    def _live_pose(self, agent: AgentId) -> list[list[float]] | None:
        """T_w_c (4,4) of an agent's last live pose in the world; None without one or while its keyframe is unknown."""
        live = self._intake.live.get(agent)
        pose = self.map.pose(live.keyframe) if live else None
        S_w_m = self.placements.get(submap_of_keyframe(live.keyframe)) if live else None
        if live is None or pose is None or S_w_m is None:
            return None
        out: list[list[float]] = sim3.place(S_w_m, pose @ live.T_k_c).tolist()
        return out
