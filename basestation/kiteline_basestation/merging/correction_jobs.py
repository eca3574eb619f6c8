"""Which maps are due for a pose graph or a full bundle, and which of these jobs are pending."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.inertial.chain import segments_of
from kiteline_basestation.inertial.map_scale import tells_scale
from kiteline_basestation.jobs import Job
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.merging.correction import essential_graph_of, full_bundle_window, keyframes_of, part_spans
from kiteline_basestation.merging.graph_job import POSE_GRAPH
from kiteline_basestation.merging.loop_edges import LoopEdge
from kiteline_basestation.refinement import disparity_calibration as disparity
from kiteline_basestation.refinement.bundle_job import FULL_BUNDLE, BundleInputs
from kiteline_basestation.refinement.bundle_window import BundleWindow
from kiteline_basestation.refinement.full_bundle_schedule import FullBundleSchedule, Part
from kiteline_basestation.refinement.odometry_factors import with_odometry_factors
from kiteline_core.ids import AgentId, SubmapId

_RETRY_GROWTH = 1.1  # growth of the map after which an insignificant offset is estimated again
_FIRST_FULL = 3  # keyframes of a map at its first full bundle: a worn rig is seen in it
_ROBUST_TRIALS = 6  # trial steps of a full bundle before the outlier test
_FINAL_TRIALS = 6  # trial steps of a full bundle after the outlier test


@dataclass(frozen=True, slots=True)
class FullBundle:
    """A pending full bundle. calibrated: agents whose disparity offsets it estimates too."""

    map_id: SubmapId
    window: BundleWindow
    calibrated: tuple[AgentId, ...]
    part: Part | None = None  # of a large map


class CorrectionJobs:
    """Pose graphs and full bundles of whole maps: due, and pending at the worker."""

    def __init__(self, config: BaseConfig, sparse_map: SparseMap, job_ids: Iterator[int]) -> None:
        self._config = config
        self._map = sparse_map
        self._job_ids = job_ids
        self._schedule = FullBundleSchedule(config.graph)
        self._graphs_due: set[SubmapId] = set()
        self._bundles_due: dict[SubmapId, Part | None] = {}  # maps, and which part if it is not all, or around a loop
        self._part_sizes: dict[SubmapId, tuple[int, list[int]]] = {}  # of submaps, and the size at which they were so
        self._uncalibrated: set[SubmapId] = set()  # of the bundles due, those that take disparities as they are
        self._deleted: set[SubmapId] = set()  # submaps that the map forgets in the next step
        self._graphs: dict[int, SubmapId] = {}
        self._bundles: dict[int, FullBundle] = {}
        self.uncertain_at: dict[SubmapId, int] = {}  # keyframes of a map when its disparity offsets were too uncertain

    @property
    def idle(self) -> bool:
        """True if nothing is due or pending."""
        due = self._graphs_due or self._bundles_due or self._schedule.waiting(self._sizes())
        return not (due or self.pending)

    @property
    def pending(self) -> int:
        """Number of pending jobs."""
        return len(self._graphs) + len(self._bundles)

    @property
    def graphs_due(self) -> tuple[SubmapId, ...]:
        """Maps with a pose graph due or pending."""
        return tuple(sorted(self._graphs_due.union(self._graphs.values())))

    @property
    def bundles_due(self) -> tuple[SubmapId, ...]:
        """Maps with a full bundle due or pending."""
        return tuple(sorted(self._bundles_due.keys() | {bundle.map_id for bundle in self._bundles.values()}))

    @property
    def bundled_sizes(self) -> dict[SubmapId, int]:
        """Size of each map when its full bundle was last scheduled; of a large one, that of its first part."""
        return {submap: size for (submap, part), size in self._schedule.bundled.items() if not part}

    def restore(
        self, graphs: Collection[SubmapId], bundles: Collection[SubmapId], bundled: Mapping[SubmapId, int]
    ) -> None:  # fmt: skip
        """Make jobs of an earlier process due again. bundled: see `bundled_sizes`."""
        self._schedule.bundled.update({(submap, 0): size for submap, size in bundled.items()})
        self._graphs_due = {s for s in graphs if s in self._map.submaps}
        self._bundles_due = {s: None for s in bundles if s in self._map.submaps}

    def is_busy(self, map_id: SubmapId) -> bool:
        """True if a correction of a map is due or pending."""
        return map_id in self.graphs_due or map_id in self.bundles_due

    def fits(self, map_id: SubmapId) -> bool:
        """True if one bundle can hold a whole map."""
        return len(self._map.rows_of_map(map_id)) <= self._config.graph.max_full

    def request_graph(self, map_id: SubmapId) -> None:
        """Make a pose graph of a map due."""
        self._graphs_due.add(map_id)

    def request_bundle(self, map_id: SubmapId, *, calibrate: bool = True) -> None:
        """Make a full bundle of a map due. calibrate: estimate disparity offsets as well, if that may succeed."""
        self._bundles_due[map_id] = None
        if not calibrate:
            self._uncalibrated.add(map_id)

    def request_parts(self, map_id: SubmapId) -> None:
        """Make full bundles of all parts of a large map due, one after the other."""
        if not self.fits(map_id):
            self._schedule.forget(self._map.submaps_of_map(map_id))

    def cancel_pending(self, map_id: SubmapId) -> None:
        """Ignore the results of pending jobs of a map: they are out of date."""
        self._graphs = {job: m for job, m in self._graphs.items() if m != map_id}
        self._bundles = {job: bundle for job, bundle in self._bundles.items() if bundle.map_id != map_id}

    def cancel(self, map_id: SubmapId) -> None:
        """Cancel all corrections of a map that is no more."""
        self.cancel_pending(map_id)
        self._graphs_due.discard(map_id)
        self._bundles_due.pop(map_id, None)
        self._uncalibrated.discard(map_id)

    def forget(self, submaps: Collection[SubmapId]) -> None:
        """Drop what is known of deleted submaps."""
        self._schedule.forget(submaps)
        self._deleted.update(submaps)
        for submap in submaps:
            self._part_sizes.pop(submap, None)
            self.uncertain_at.pop(submap, None)

    def take_graph(self, job: int) -> SubmapId | None:
        """The map of a finished pose graph; None if it was cancelled."""
        return self._graphs.pop(job, None)

    def take_bundle(self, job: int, cost_ops: int, now_ns: int) -> FullBundle | None:
        """The finished full bundle; None if it was cancelled."""
        bundle = self._bundles.pop(job, None)
        if bundle is not None:
            self._schedule.done(cost_ops, now_ns)
        return bundle

    def jobs(self, edges: Sequence[LoopEdge], now_ns: int) -> list[Job]:
        """Start pose graphs that are due, then full bundles of maps without a pending graph."""
        sizes = self._sizes()
        self._deleted.intersection_update(self._map.submaps)
        busy = {*self.graphs_due, *self.bundles_due}
        grown = self._schedule.next(sizes, [p for p in sizes if self._map.map_id(p[0]) in busy], now_ns)
        if grown is not None:
            map_id = self._map.map_id(grown[0])
            self._bundles_due[map_id] = None if self.fits(map_id) else grown
        out: list[Job] = []
        for map_id in sorted(self._graphs_due):
            graph = essential_graph_of(self._map, map_id, edges, self._config.graph)
            if graph is not None:
                out.append(Job(next(self._job_ids), POSE_GRAPH.name, graph))
                self._graphs[out[-1].id] = map_id
        self._graphs_due.clear()
        for map_id in sorted(self._bundles_due.keys() - set(self._graphs.values())):
            part = self._bundles_due.pop(map_id)
            window = full_bundle_window(self._map, map_id, edges, self._config, part)
            if window is not None:
                bundle = self._with_calibration(FullBundle(map_id, window, (), part=part))
                problem = with_odometry_factors(self._map, bundle.window, self._config.odometry_factors)
                trials = _ROBUST_TRIALS, _FINAL_TRIALS
                solver = replace(self._config.bundle, robust_trials=trials[0], final_trials=trials[1])
                chain = segments_of(self._map, bundle.window.rows, bundle.window.problem) if self.fits(map_id) else ()
                chain = chain if tells_scale(chain) else ()
                held = int(np.flatnonzero(~bundle.window.problem.free)[0])
                inputs = BundleInputs(problem, solver, chain, held, self._config.inertial_scale)
                out.append(Job(next(self._job_ids), FULL_BUNDLE.name, inputs))
                self._bundles[out[-1].id] = bundle
            self._uncalibrated.discard(map_id)
        return out

    def _with_calibration(self, bundle: FullBundle) -> FullBundle:
        """Add disparity offsets to the unknowns, unless they were too uncertain in a map hardly smaller than now."""
        size = len(keyframes_of(self._map, bundle.map_id))
        enough = _RETRY_GROWTH * self.uncertain_at.get(bundle.map_id, 0)
        if not self.fits(bundle.map_id) or bundle.map_id in self._uncalibrated or size < enough:
            return bundle
        window = bundle.window
        problem, agents = disparity.with_border(self._map, window.slots, window.problem, self._config.disparity)
        return FullBundle(bundle.map_id, replace(window, problem=problem), agents)

    def _sizes(self) -> dict[Part, int]:
        """Keyframes and keypoints that have arrived of each map that has enough keyframes, or of its parts."""
        maps: dict[SubmapId, list[SubmapId]] = {}
        for submap in [s for s in self._map.submaps if s not in self._deleted]:
            maps.setdefault(self._map.map_id(submap), []).append(submap)
        sizes: dict[Part, int] = {}
        for map_id, submaps in maps.items():
            count = sum(len(self._map.submaps[s]) for s in submaps)
            if _FIRST_FULL <= count <= self._config.graph.max_full:
                sizes[map_id, 0] = count + sum(self._map.keypoints_of.get(s, 0) for s in submaps)
            elif count > self._config.graph.max_full:
                sizes |= {(s, part): size for s in submaps for part, size in enumerate(self._sizes_of_parts(s))}
        return sizes

    def _sizes_of_parts(self, submap: SubmapId) -> list[int]:
        """Keyframes and keypoints that have arrived of each part of a submap."""
        rows = self._map.rows_of(submap)
        size = len(rows) + self._map.keypoints_of.get(submap, 0)
        known, sizes = self._part_sizes.get(submap, (-1, []))
        if known != size:
            arrived = self._map.keyframes.filled[rows]
            spans = part_spans(len(rows), self._config.graph.max_full)
            sizes = [end - begin + int(arrived[begin:end].sum()) for begin, end in spans]
            self._part_sizes[submap] = size, sizes
        return sizes
