"""The base's algorithm box: what the agents saw goes in, a better map of it comes out.

Method: "DS-PTAM: a distributed stereo PTAM", the mapper of chapter 3, with the point culling of ORB-SLAM2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation import culling, newpoints, refind
from kiteline_basestation.atlas import Atlas
from kiteline_basestation.config import BaseConfig
from kiteline_basestation.covisibility import Window, local_window
from kiteline_basestation.grid import Grid, GridMap
from kiteline_basestation.intake import Intake
from kiteline_basestation.jobs import BundleInputs, GridInputs, Job, JobDone
from kiteline_basestation.odometry_links import with_links, without_links
from kiteline_basestation.publisher import Published, Publisher, adopt
from kiteline_basestation.refinement import apply_bundle
from kiteline_codec.schema import Calibration, Live, Placement, Record
from kiteline_core import se3
from kiteline_core.bundle import BundleResult
from kiteline_core.ids import (
    KEYPOINT_BITS,
    SEQUENCE_BITS,
    AgentId,
    KeyframeId,
    SubmapId,
    agent_of_keyframe,
    submap_of_keyframe,
)
from kiteline_core.place_index import Vocabulary
from kiteline_core.sparse_map import SparseMap

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class MapperInput:
    """What has come since the last step: records by agent, in order of agent id, and finished jobs."""

    arrivals: tuple[tuple[AgentId, tuple[Record, ...]], ...]
    done: tuple[JobDone, ...] = ()


@dataclass(frozen=True, slots=True)
class MapperOutput:
    """What is to be shared with each agent, and the work to be done elsewhere."""

    publish: Published
    jobs: tuple[Job, ...]


@dataclass(frozen=True, slots=True)
class GridView:
    """The placed part of the map as `grid.build` takes it, and what its rows mean.

    keyframes: (n,) ids of the rows of positions. point_ids: (m,). observations: (k,2) rows of positions and of points.
    """

    keyframes: I64
    positions: F64
    point_ids: I64
    points: F64
    observations: I64


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
        self.placements: dict[SubmapId, F64] = {}  # T_w_m of placed submaps
        self.counts = MapperCounts()
        self._intake = Intake(self.config.intake, self.map)
        self._publisher = Publisher(self.map)
        self._last_job = 0
        self._windows: dict[int, tuple[SubmapId, Window]] = {}  # open bundle jobs
        self._stale: dict[SubmapId, list[KeyframeId]] = {}  # keyframes that no bundle has moved yet, in order
        self._served: dict[SubmapId, int] = {}  # the last bundle of each submap, by its number
        self._told: dict[AgentId, F64] = {}  # offsets of disparities as agents have them
        self._calibrate_at = self.config.disparity.first  # keyframes, when offsets of disparities are next looked at
        self._grid_job = 0  # id of the open grid job, 0 none
        self._grid_due = 0  # keyframes since the last grid
        self.atlas: Atlas | None = None
        if words is not None and self.config.loops.enabled:
            self.atlas = Atlas(self.config, self.map, self._publisher, words, self._next_job)

    def step(self, given: MapperInput, now_ns: int) -> MapperOutput:
        """Take in what came, and say what is to be published and worked on."""
        for agent, records in given.arrivals:
            self._intake.take(agent, records, now_ns)  # sections -> map, whatever their order
        self._set_upright()  # where an agent has learnt which way is up
        for done in given.done:
            self._finish(done)  # refined poses and points, outliers, grid
        for keyframe in self._intake.ready(now_ns):
            self._place(keyframe)  # the first submap is the world
            self.counts.found += refind.refind(self.map, keyframe, self.config.refind, self._publisher)
            self.counts.triangulated += newpoints.triangulate(
                self.map, keyframe, self.config.new_points, self.config.measurement, self._publisher
            )
            self.counts.culled += culling.cull_weak(self.map, keyframe, self.config.cull, self._publisher)
            self._cull_keyframes(keyframe)
            self._stale.setdefault(submap_of_keyframe(keyframe), []).append(keyframe)
            if self.atlas is not None:
                self.atlas.consider(keyframe)  # seen before, here or by others?
            self._grid_due += 1
            self.counts.keyframes += 1
        self._go_on_with_atlas()
        self._calibrate()
        self._tell_calibrations()
        jobs = self._bundle_jobs() + self._grid_jobs()
        if self.atlas is not None:
            jobs += self.atlas.jobs()
        return MapperOutput(self._publisher.collect(), tuple(jobs))

    def adopt(self, record: Record) -> None:
        """Compute on with a published record as the other side will hold it."""
        adopt(self.map, record)

    def restore(
        self, agent: AgentId, received: tuple[Record, ...], own: tuple[Record, ...], now_ns: int
    ) -> None:  # fmt: skip
        """Begin with what an earlier base had received from an agent and had written for it; nothing is done anew."""
        self._intake.take(agent, received, now_ns)
        self._intake.use_all()
        for record in own:
            if isinstance(record, Placement):
                self.placements[record.submap] = record.T_w_m
            self.adopt(record)

    def rejoin(self) -> None:
        """After all was restored: maps that shared points are one again, and every keyframe is a known place."""
        if self.atlas is not None:
            self.atlas.rejoin(self.placements)

    @property
    def idle(self) -> bool:
        """Whether no job is open and nothing is left to be done with what came."""
        settled = self.atlas is None or self.atlas.idle
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
            "points": len(self.map.roots()),
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
            "loops": self.atlas.loops if self.atlas else 0,
            "merges": len(self.atlas.merges) if self.atlas else 0,
            "merges_undone": self.atlas.undone if self.atlas else 0,
            "maps": len({self.map.island_of(s) for s in self.map.submaps}),
            "jobs_open": len(self._windows) + (self._grid_job != 0) + (self.atlas.jobs_open if self.atlas else 0),
        }

    def live(self, agent: AgentId) -> Live | None:
        """The newest pose that an agent told."""
        return self._intake.live.get(agent)

    def world_view(self) -> GridView:
        """Keyframes, live points seen at least twice, and observations of all placed submaps, in w."""
        rows, positions = [], []
        for submap in sorted(self.placements):
            T_w_m = self.placements[submap]
            for keyframe in self.map.submaps.get(submap, []):
                pose = self.map.pose(keyframe)
                if pose is not None:
                    rows.append(self.map.rows[keyframe])
                    positions.append((T_w_m @ pose)[:3, 3])
        number = np.full(len(self.map), -1, np.int64)
        number[rows] = np.arange(len(rows))
        points = self.map.roots()
        xyz, known = self.map.positions(points)
        known &= number[self.map.keypoints.row[points]] >= 0
        points, xyz = points[known], xyz[known]
        starts, slots = self.map.observations(points)
        seen = np.diff(starts)
        which = np.repeat(np.arange(len(points)), seen)
        keep = (seen >= 2)[which] & (number[self.map.keypoints.row[slots]] >= 0)
        renumber = np.cumsum(seen >= 2) - 1
        pairs = np.stack([number[self.map.keypoints.row[slots[keep]]], renumber[which[keep]]], 1).astype(np.int64)
        points, xyz = points[seen >= 2], xyz[seen >= 2]
        for submap in sorted(self.placements):
            inside = self.map.point_ids(points) >> (SEQUENCE_BITS + KEYPOINT_BITS) == submap
            T = self.placements[submap] @ se3.inverse(self.map.frame(submap))
            xyz[inside] = xyz[inside] @ T[:3, :3].T + T[:3, 3]
        return GridView(
            self.map.keyframes.id[rows].copy(),
            np.array(positions).reshape(-1, 3),
            self.map.point_ids(points),
            xyz,
            pairs,
        )

    # -- inside ------------------------------------------------------------------------------------------------------

    def _set_upright(self) -> None:
        """Turn the world when the agent of its first submap says which way is up; all that is placed moves along."""
        first = next(iter(self.placements), None)
        level = None if first is None else self._intake.levels.get(first)
        if first is None or level is None or np.array_equal(level.T_l_m, self.placements[first]):
            return
        T_new_old = level.T_l_m @ se3.inverse(self.placements[first])
        for submap, T_w_m in self.placements.items():
            upright = level.T_l_m if submap == first else se3.orthonormalise(T_new_old @ T_w_m)
            self.placements[submap] = upright
            self._publisher.place(submap, upright)
        self._grid_due = max(self._grid_due, len(self.map.rows))  # the grid is made anew

    def _place(self, keyframe: KeyframeId) -> None:
        """The first submap of all is the world. A later one of the same flight begins where the last was left."""
        submap = submap_of_keyframe(keyframe)
        if submap in self.placements:
            return
        if not self.placements:
            level = self._intake.levels.get(submap)
            T_w_m = np.eye(4) if level is None else level.T_l_m
        else:
            before = SubmapId(submap - 1)
            live, T_w_before = self._intake.last_of.get(before), self.placements.get(before)
            first = self.map.submaps[submap][0]
            begin = self.map.pose(first)
            left = self.map.pose(live.keyframe) if live else None
            if live is None or T_w_before is None or left is None or begin is None:
                return
            tracked_ns = self._intake.tracked_ns.get(before, live.t_ns)
            if self.map.keyframes.t_ns[self.map.rows[first]] - tracked_ns > self.config.intake.carry_s * 1e9:
                return  # a place that it reached unseen: it is found when it is recognised
            T_w_m = se3.orthonormalise(T_w_before @ left @ live.T_k_c @ se3.inverse(begin))
        self.placements[submap] = T_w_m
        self._publisher.place(submap, T_w_m)

    def _finish(self, done: JobDone) -> None:
        if self.atlas is not None and self.atlas.finish(done):
            return
        if isinstance(done.result, BundleResult):
            opened = self._windows.pop(done.id, None)
            if opened is not None:  # else superseded
                result = without_links(opened[1], done.result)
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
            if self.atlas is not None:
                self.atlas.finder.forget(other)

    def _go_on_with_atlas(self) -> None:
        """Joined maps look around in each other; where a map moved as a whole, windows are void and places change."""
        if self.atlas is None:
            return
        for keyframe in self.atlas.revisit():
            self._stale.setdefault(submap_of_keyframe(keyframe), []).append(keyframe)
        for island in sorted(self.atlas.moved):
            for job, (submap, _) in list(self._windows.items()):
                if self.map.island_of(submap) == island:
                    del self._windows[job]
                    waiting = self._stale.setdefault(submap, [])
                    waiting.append(self.map.submaps[submap][-1])
            self._place_island(island)
            self._grid_due = max(self._grid_due, len(self.map))  # the grid is made anew
        self.atlas.moved.clear()

    def _calibrate(self) -> None:
        """Now and then, bundle whole maps, in which the offsets of disparities show."""
        if self.atlas is None or self.counts.keyframes < self._calibrate_at:
            return
        self._calibrate_at = round(self._calibrate_at * self.config.disparity.growth)
        for island in sorted({self.map.island_of(s) for s in self.map.submaps}):
            if self.atlas.fits(island) and not self.atlas.busy_with(island):
                self.atlas.bundle_all(island)

    def _tell_calibrations(self) -> None:
        """Agents track better on disparities without the offset that was found."""
        for agent, offset in sorted(self.map.disparity_offset_px.items(), key=lambda item: item[0]):
            if not np.array_equal(self._told.get(agent, 0.0), offset):
                self._told[agent] = offset
                self._publisher.send(agent, Calibration(agent, offset))

    def _place_island(self, island: SubmapId) -> None:
        """Submaps of one map lie in the world as they lie to each other, as soon as one of them has a place."""
        submaps = self.map.island(island)
        anchor = next((s for s in [self.map.island_of(island), *submaps] if s in self.placements), None)
        if anchor is None:
            return
        T_w_i = self.placements[anchor] @ se3.inverse(self.map.frame(anchor))
        for submap in submaps:
            T_w_m = se3.orthonormalise(T_w_i @ self.map.frame(submap))
            held = self.placements.get(submap)
            if submap != anchor and (held is None or not np.allclose(held, T_w_m, rtol=0.0, atol=1e-5)):
                self.placements[submap] = T_w_m
                self._publisher.place(submap, T_w_m)

    def _next_job(self) -> int:
        self._last_job += 1
        return self._last_job

    def _bundle_jobs(self) -> list[Job]:
        """One bundle at a time for each map, around the newest keyframe of a submap; submaps take turns."""
        busy = {self.map.island_of(submap) for submap, _ in self._windows.values()}
        jobs = []
        for submap in sorted(self._stale, key=lambda s: (self._served.get(s, 0), s)):
            if self.map.island_of(submap) in busy:
                continue
            # Around the newest keyframe; where many came at once, from the oldest on, half a window at a time.
            waiting, size = self._stale.pop(submap), self.config.window.free
            keyframe = waiting[-1] if len(waiting) <= size else waiting[size // 2]
            part = local_window(self.map, keyframe, self.config.window, self.config.measurement)
            moved = set() if part is None else set(self.map.keyframes.id[part.rows[part.problem.free]].tolist())
            left = [k for k in waiting if k != keyframe and k not in moved]
            if left:
                self._stale[submap] = left
            if part is not None:
                problem = with_links(self.map, part, self.config.links)
                job = Job(self._next_job(), "bundle", BundleInputs(problem, self.config.bundle))
                jobs.append(job)
                self._windows[job.id] = (submap, part)
                self._served[submap] = job.id
                busy.add(self.map.island_of(submap))
        return jobs

    def _grid_jobs(self) -> list[Job]:
        pause = max(self.config.publish.grid_every, len(self.map) // self.config.publish.grid_share)
        if self._grid_job or self._grid_due < pause:
            return []
        self._grid_due = 0
        view = self.world_view()
        self._grid_job = self._next_job()
        return [
            Job(self._grid_job, "grid", GridInputs(self.config.grid, view.positions, view.points, view.observations))
        ]

    def _live_pose(self, agent: AgentId) -> list[list[float]] | None:
        live = self._intake.live.get(agent)
        pose = self.map.pose(live.keyframe) if live else None
        T_w_m = self.placements.get(submap_of_keyframe(live.keyframe)) if live else None
        if live is None or pose is None or T_w_m is None:
            return None
        out: list[list[float]] = (T_w_m @ pose @ live.T_k_c).tolist()
        return out
