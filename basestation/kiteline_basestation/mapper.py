"""The base's algorithm box: what the agents saw goes in, a better map of it comes out.

Method: "DS-PTAM: a distributed stereo PTAM", the mapper of chapter 3, with the point culling of ORB-SLAM2.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation import management
from kiteline_basestation.config import BaseConfig
from kiteline_basestation.exchange.publisher import Published, Publisher, apply_record
from kiteline_basestation.grid.grid import Grid, GridMap
from kiteline_basestation.grid.grid_job import GRID, GridInputs
from kiteline_basestation.grid.placed_map import placed_map
from kiteline_basestation.intake.intake import Intake
from kiteline_basestation.intake.placements import World
from kiteline_basestation.jobs import Job, JobDone
from kiteline_basestation.management import Answer, Command
from kiteline_basestation.map.map_tables import CULLED, LANDMARK
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.merging.map_merger import MapMerger
from kiteline_basestation.refinement import culling, landmark_matching, triangulation
from kiteline_basestation.refinement.apply_bundle import apply_bundle
from kiteline_basestation.refinement.bundle_job import LOCAL_BUNDLE, BundleInputs
from kiteline_basestation.refinement.bundle_window import BundleWindow, local_bundle_window
from kiteline_basestation.refinement.full_bundle_schedule import FullBundleSchedule
from kiteline_basestation.refinement.odometry_factors import with_odometry_factors, without_odometry_factors
from kiteline_basestation.store.state import Json, Memory, matrix, parsed, plain, similarity_of
from kiteline_codec.schema import CulledLandmarks, DisparityCalibration, Key, LivePose, Record
from kiteline_core.geometry import sim3
from kiteline_core.ids import AgentId, KeyframeId, SubmapId, agent_of_keyframe, agent_of_submap, submap_of_keyframe
from kiteline_core.optimisation.bundle import BundleResult
from kiteline_core.places.place_index import Vocabulary

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class MapperInput:
    """What has come since the last step: records by agent, in order of agent id, finished jobs, and commands."""

    arrivals: tuple[tuple[AgentId, tuple[Record, ...]], ...]
    done: tuple[JobDone, ...] = ()
    commands: tuple[Command, ...] = ()


@dataclass(frozen=True, slots=True)
class MapperOutput:
    """What is to be shared with each agent, the work to be done elsewhere, answers to the commands, and what was shared
    and is true no more.
    """

    publish: Published
    jobs: tuple[Job, ...]
    answers: tuple[Answer, ...] = ()
    withdrawn: tuple[tuple[AgentId, Key], ...] = ()


@dataclass(slots=True)
class MapperCounts:
    """What was done so far."""

    keyframes: int = 0
    found: int = 0  # births recognised as older points
    triangulated: int = 0  # points that got their first depth here
    culled: int = 0
    keyframes_culled: int = 0
    bundles: int = 0
    grids: int = 0


class Mapper:
    """A state machine without clock, threads or links: the same inputs give the same outputs."""

    def __init__(self, config: BaseConfig | None = None, words: Vocabulary | None = None) -> None:
        """words: by which places are recognised; without them no loops are closed and no maps joined."""
        self.config = config or BaseConfig()
        self.map = SparseMap()
        self.grid = Grid(self.config.grid)
        self.names: dict[SubmapId, str] = {}  # what people call maps, by their eldest submap
        self.counts = MapperCounts()
        self._intake = Intake(self.config.intake, self.map)
        self._publisher = Publisher(self.map)
        self.world = World(self.config.intake, self.map, self._intake, self._publisher)
        self._last_job = 0
        self._windows: dict[int, tuple[SubmapId, BundleWindow]] = {}  # open bundle jobs
        self._stale: dict[SubmapId, list[KeyframeId]] = {}  # keyframes that no bundle has moved yet, in order
        self._served: dict[SubmapId, int] = {}  # the last bundle of each submap, by its number
        self._told: dict[AgentId, F64] = {}  # offsets of disparities as agents have them
        self._whole = FullBundleSchedule(self.config.graph)
        self._grid_job = 0  # id of the open grid job, 0 none
        self._grid_due = 0  # keyframes since the last grid
        self.merger: MapMerger | None = None
        if words is not None and self.config.loops.enabled:
            self.merger = MapMerger(self.config, self.map, self._publisher, words, self._next_job)

    def step(self, given: MapperInput, now_ns: int) -> MapperOutput:
        """Take in what came, and say what is to be published and worked on."""
        for agent, records in given.arrivals:
            self._intake.take(agent, records, now_ns)  # sections -> map, whatever their order
        if self.world.set_upright() or self.world.set_metric():  # where an agent has learnt what is up, or a metre
            self._grid_due = max(self._grid_due, len(self.map.rows))  # the grid is made anew
        for done in given.done:
            self._finish(done, now_ns)  # refined poses and points, outliers, grid
        answers = tuple(management.answer(self, command, now_ns) for command in given.commands)
        for keyframe in self._intake.ready(now_ns):
            self.world.begin(keyframe)  # the first submap is the world
            self.counts.found += landmark_matching.match_landmarks(
                self.map, keyframe, self.config.refind, self._publisher
            )
            self.counts.triangulated += triangulation.triangulate_landmarks(
                self.map, keyframe, self.config.new_points, self.config.measurement, self._publisher
            )
            self.counts.culled += culling.cull_weak(self.map, keyframe, self.config.cull, self._publisher)
            self._cull_keyframes(keyframe)
            self._stale.setdefault(submap_of_keyframe(keyframe), []).append(keyframe)
            if self.merger is not None:
                self.merger.consider(keyframe)  # seen before, here or by others?
            self._grid_due += 1
            self.counts.keyframes += 1
        self._go_on_with_atlas()
        self._bundle_whole_maps(now_ns)
        self._send_calibrations()
        jobs = self._bundle_jobs() + self._grid_jobs()
        if self.merger is not None:
            jobs += self.merger.jobs()
        withdrawn = self.world.withdrawn()
        return MapperOutput(self._publisher.collect(), tuple(jobs), answers, withdrawn)

    def adopt(self, record: Record) -> None:
        """Compute on with a published record as the other side will hold it."""
        apply_record(self.map, record)

    def restore(
        self, agent: AgentId, received: tuple[Record, ...], own: tuple[Record, ...], now_ns: int
    ) -> None:  # fmt: skip
        """Begin with what an earlier base had received from an agent and had written for it; nothing is done anew."""
        self._intake.take(agent, received, now_ns)
        self._intake.last_seen_ns.pop(agent, None)  # it was not heard: a forerunner heard it
        for record in own:
            self.adopt(record)

    def memory(self) -> Memory:
        """What a successor needs to go on from here, beside the shared values."""
        submaps = self.map.submaps.keys() | self.placements.keys()
        out: Memory = {f"submap/{s}": plain(self._submap_memory(s)) for s in sorted(submaps - self.deleted)}
        for agent in sorted(self.map.cameras):
            offset = self.map.disparity_offset_px.get(agent)
            known = agent in self.map.disparity_calibrated
            out[f"agent/{agent}"] = plain({"offset_px": None if offset is None else offset.tolist(), "known": known})
        stale = {s: list(waiting) for s, waiting in self._stale.items()}
        for submap, _ in self._windows.values():
            stale.setdefault(submap, []).append(self.map.submaps[submap][-1])
        out["base"] = plain(
            {
                "counts": asdict(self.counts),
                "placed": [int(s) for s in self.placements],
                "stale": [[int(s), sorted({int(k) for k in waiting})] for s, waiting in sorted(stale.items())],
                "unused": [int(k) for k in self._intake.unused],
                "bundled": [[int(s), size] for s, size in sorted(self._whole.bundled.items())],
                "carried": [[int(s), matrix(T)] for s, T in self.world.carried.items()],
                "deleted": sorted(int(s) for s in self.deleted),
            }
        )
        return out | (self.merger.memory() if self.merger is not None else {})

    def _submap_memory(self, submap: SubmapId) -> Json:
        joined = self.map.root_submaps.get(submap)
        return {
            "frame": matrix(self.map.submap_poses.get(submap)),
            "island": None if joined is None else int(joined),
            "T_w_m": matrix(self.placements.get(submap)),
            "name": self.names.get(submap),
            **self._intake.memory(submap),
        }

    def recall(self, texts: Mapping[str, str]) -> None:
        """Go on from what a forerunner remembered, when all values are here again."""
        submaps = {SubmapId(int(number)): value for (number,), value in parsed(texts, "submap")}
        for submap, value in submaps.items():
            if value["island"] is not None:
                self.map.root_submaps[submap] = SubmapId(value["island"])
            if value["frame"] is not None:
                self.map.move_submap(submap, similarity_of(value["frame"]))
            if value["name"] is not None:
                self.names[submap] = value["name"]
            self._intake.recall(submap, value)
        for (number,), value in parsed(texts, "agent"):
            if value["offset_px"] is not None:
                self.map.disparity_offset_px[AgentId(int(number))] = np.array(value["offset_px"], np.float64)
            if value["known"]:
                self.map.disparity_calibrated.add(AgentId(int(number)))
        unused: set[KeyframeId] = set()
        for _, value in parsed(texts, "base"):
            self.counts = MapperCounts(**value["counts"])
            for submap in map(SubmapId, value["placed"]):
                self.placements[submap] = similarity_of(submaps[submap]["T_w_m"])
            for submap, waiting in value["stale"]:
                if here := [KeyframeId(k) for k in waiting if k in self.map]:
                    self._stale[SubmapId(submap)] = here
            unused = {KeyframeId(k) for k in value["unused"]}
            self._whole.bundled = {SubmapId(s): size for s, size in value.get("bundled", [])}
            self.world.carried = {SubmapId(s): similarity_of(S) for s, S in value["carried"]}
            self._intake.deleted = {SubmapId(s) for s in value["deleted"]}
        self._intake.keep_unused(unused)
        self._grid_due = len(self.map)  # the grid is made anew
        if self.merger is not None:
            self.merger.recall(texts)

    def last_contact_ns(self, submap: SubmapId) -> int | None:
        """When the agent that flies in a submap now was last heard; None where nobody flies."""
        agent = agent_of_submap(submap)
        live = self._intake.live.get(agent)
        flies = live is not None and submap_of_keyframe(live.keyframe) == submap
        return self._intake.last_seen_ns.get(agent) if flies else None

    def delete(self, submaps: Sequence[SubmapId]) -> None:
        """Drop submaps: their agents are told, their places are forgotten, what comes of them is passed over."""
        self.deleted.update(submaps)
        for submap in submaps:
            for keyframe in self.map.submaps.get(submap, []):
                slots = self.map.slots_of(keyframe)
                self.map.set_flags(slots[self.map.keypoints.kind[slots] == LANDMARK], CULLED)
                self.map.cull_keyframe(keyframe)
                self._publisher.mark_changed(CulledLandmarks.KIND, keyframe)
            self._stale.pop(submap, None)
            self.placements.pop(submap, None)
            self.names.pop(submap, None)
            self.map.root_submaps.pop(submap, None)
        self._windows = {job: w for job, w in self._windows.items() if w[0] not in submaps}
        if self.merger is not None:
            self.merger.forget(submaps)
        self._grid_due = max(self._grid_due, len(self.map))  # the grid is made anew

    @property
    def placements(self) -> dict[SubmapId, F64]:
        """S_w_m of placed submaps, the first one of all first: a similarity where w has another unit of length."""
        return self.world.placements

    @property
    def deleted(self) -> set[SubmapId]:
        """Submaps of which nothing is kept."""
        return self._intake.deleted

    @property
    def idle(self) -> bool:
        """Whether no job is open and nothing is left to be done with what came."""
        settled = self.merger is None or (self.merger.idle and not self._whole.waiting(self._sizes()))
        return settled and not (self._intake.backlog or self._windows or self._stale or self._grid_job)

    def summary(self) -> dict[str, object]:
        """Numbers for people: what the base knows of each agent, and the size of the map."""
        agents = {}
        for agent in sorted(self.map.cameras.keys() | self._intake.last_seen_ns.keys()):
            live = self._intake.live.get(agent)
            agents[int(agent)] = {
                "keyframes": sum(len(ks) for s, ks in self.map.submaps.items() if agent_of_keyframe(ks[0]) == agent),
                "submaps": sum(1 for ks in self.map.submaps.values() if agent_of_keyframe(ks[0]) == agent),
                "last_seen_ns": self._intake.last_seen_ns.get(agent),
                "live_t_ns": live.t_ns if live else None,
                "quality": live.quality if live else None,
                "T_w_c": self._live_pose(agent),
            }
        return {
            "keyframes": len(self.map),
            "points": len(self.map.live_landmarks()),
            "observations": int(np.count_nonzero(self.map.keypoints.usable[: self.map.slots])),
            "map_bytes": self.map.nbytes(),
            "agents": agents,
            "submaps_placed": len(self.placements),
            "refused_records": self._intake.refused,
            "found": self.counts.found,
            "triangulated": self.counts.triangulated,
            "culled": self.counts.culled,
            "keyframes_culled": self.counts.keyframes_culled,
            "bundles": self.counts.bundles,
            "grids": self.counts.grids,
            "loops": self.merger.loops if self.merger else 0,
            "merges": len(self.merger.merges) if self.merger else 0,
            "merges_undone": self.merger.undone if self.merger else 0,
            "maps": len({self.map.map_id(s) for s in self.map.submaps}),
            "jobs_open": len(self._windows) + (self._grid_job != 0) + (self.merger.jobs_open if self.merger else 0),
        }

    def live(self, agent: AgentId) -> LivePose | None:
        """The newest pose that an agent told."""
        return self._intake.live.get(agent)

    # -- inside ------------------------------------------------------------------------------------------------------

    def _finish(self, done: JobDone, now_ns: int) -> None:
        if self.merger is not None and self.merger.finish(done):
            if isinstance(done.result, BundleResult):
                self._whole.done(done.cost_ops, now_ns)
            return
        if isinstance(done.result, BundleResult):
            opened = self._windows.pop(done.id, None)
            if opened is not None:  # else superseded
                result = without_odometry_factors(opened[1], done.result)
                apply_bundle(self.map, opened[1], result, self._publisher, self.config.cull, self.config.publish)
                self.counts.bundles += 1
        elif isinstance(done.result, GridMap) and done.id == self._grid_job:
            self._grid_job = 0
            self.counts.grids += 1
            tiles = self.grid.adopt(done.result)
            for agent in sorted({agent_of_keyframe(self.map.submaps[s][0]) for s in self.placements}):
                for tile in tiles:
                    self._publisher.send(agent, tile)

    def _cull_keyframes(self, keyframe: KeyframeId) -> None:
        for other in culling.cull_redundant(self.map, keyframe, self.config.cull, self._publisher):
            self.counts.keyframes_culled += 1
            if self.merger is not None:
                self.merger.detector.forget(other)

    def _go_on_with_atlas(self) -> None:
        """Joined maps look around in each other; where a map moved as a whole, windows are void and places change."""
        if self.merger is None:
            return
        for keyframe in self.merger.revisit():
            self._stale.setdefault(submap_of_keyframe(keyframe), []).append(keyframe)
        self.world.part(self.merger.parted)
        self.merger.parted.clear()
        self.world.grow(self.merger.grown)
        self.merger.grown.clear()
        for map_id in sorted(self.merger.moved):
            for job, (submap, _) in list(self._windows.items()):
                if self.map.map_id(submap) == map_id:
                    del self._windows[job]
                    waiting = self._stale.setdefault(submap, [])
                    waiting.append(self.map.submaps[submap][-1])
            self.world.lay_out(map_id)
            self._grid_due = max(self._grid_due, len(self.map))  # the grid is made anew
        self.merger.moved.clear()

    def _bundle_whole_maps(self, now_ns: int) -> None:
        """Bundle a whole map that has grown, when there is time for it."""
        if self.merger is not None:
            sizes = self._sizes()
            chosen = self._whole.next(sizes, [m for m in sizes if self.merger.busy_with(m)], now_ns)
            if chosen is not None:
                self.merger.bundle_all(chosen)

    def _sizes(self) -> dict[SubmapId, int]:
        """The number of keyframes of each map that one bundle can hold."""
        out: dict[SubmapId, int] = {}
        for submap, keyframes in self.map.submaps.items():
            map_id = self.map.map_id(submap)
            out[map_id] = out.get(map_id, 0) + len(keyframes)
        return {map_id: size for map_id, size in out.items() if size <= self.config.graph.max_full}

    def _send_calibrations(self) -> None:
        """Agents track better on disparities without the offset that was found."""
        for agent, offset in sorted(self.map.disparity_offset_px.items(), key=lambda item: item[0]):
            if not np.array_equal(self._told.get(agent, 0.0), offset):
                self._told[agent] = offset
                self._publisher.send(agent, DisparityCalibration(agent, offset))

    def _next_job(self) -> int:
        self._last_job += 1
        return self._last_job

    def _bundle_jobs(self) -> list[Job]:
        """One bundle at a time for each map, around the newest keyframe of a submap; submaps take turns."""
        busy = {self.map.map_id(submap) for submap, _ in self._windows.values()}
        jobs = []
        for submap in sorted(self._stale, key=lambda s: (self._served.get(s, 0), s)):
            if self.map.map_id(submap) in busy:
                continue
            # Around the newest keyframe; where many came at once, from the oldest on, half a window at a time.
            waiting, size = self._stale.pop(submap), self.config.window.free
            keyframe = waiting[-1] if len(waiting) <= size else waiting[size // 2]
            part = local_bundle_window(self.map, keyframe, self.config.window, self.config.measurement)
            moved = set() if part is None else set(self.map.keyframes.id[part.rows[part.problem.free]].tolist())
            left = [k for k in waiting if k != keyframe and k not in moved]
            if left:
                self._stale[submap] = left
            if part is not None:
                problem = with_odometry_factors(self.map, part, self.config.links)
                job = Job(self._next_job(), LOCAL_BUNDLE.name, BundleInputs(problem, self.config.bundle))
                jobs.append(job)
                self._windows[job.id] = (submap, part)
                self._served[submap] = job.id
                busy.add(self.map.map_id(submap))
        return jobs

    def _grid_jobs(self) -> list[Job]:
        pause = max(self.config.publish.grid_every, len(self.map) // self.config.publish.grid_share)
        if self._grid_job or self._grid_due < pause:
            return []
        self._grid_due = 0
        view = placed_map(self.map, self.placements)
        self._grid_job = self._next_job()
        return [Job(self._grid_job, GRID.name, GridInputs(self.config.grid, view.positions, view.points, view.rays))]

    def _live_pose(self, agent: AgentId) -> list[list[float]] | None:
        live = self._intake.live.get(agent)
        pose = self.map.pose(live.keyframe) if live else None
        S_w_m = self.placements.get(submap_of_keyframe(live.keyframe)) if live else None
        if live is None or pose is None or S_w_m is None:
            return None
        out: list[list[float]] = sim3.place(S_w_m, pose @ live.T_k_c).tolist()
        return out
