"""Local bundle adjustments: around which keyframe the next one is, and what becomes of its result."""

from collections.abc import Collection, Iterator, Mapping

import numpy as np

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.exchange.publisher import Publisher
from kiteline_basestation.jobs import Job, JobDone
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.refinement.apply_bundle import apply_bundle
from kiteline_basestation.refinement.bundle_job import LOCAL_BUNDLE, BundleInputs
from kiteline_basestation.refinement.bundle_window import BundleWindow, bundle_window, local_keyframes
from kiteline_basestation.refinement.odometry_factors import with_odometry_factors, without_odometry_factors
from kiteline_core.ids import KeyframeId, SubmapId, submap_of_keyframe


class LocalBundles:
    """At most one local bundle at a time for each region of a map; submaps take turns."""

    def __init__(
        self, config: BaseConfig, sparse_map: SparseMap, publisher: Publisher, job_ids: Iterator[int]
    ) -> None:  # fmt: skip
        self._config = config
        self._map = sparse_map
        self._publisher = publisher
        self._job_ids = job_ids
        self._waiting: dict[SubmapId, list[KeyframeId]] = {}  # keyframes that no bundle has moved yet
        self._pending: dict[int, tuple[SubmapId, BundleWindow]] = {}
        self._last_job: dict[SubmapId, int] = {}  # newest job of each submap
        self._blocked: set[SubmapId] = set()  # submaps whose next bundle has to wait for one that is pending

    @property
    def idle(self) -> bool:
        """True if no keyframe waits and no bundle is pending."""
        return not (self._waiting or self._pending)

    @property
    def pending(self) -> int:
        """Number of pending jobs."""
        return len(self._pending)

    @property
    def waiting(self) -> dict[SubmapId, tuple[KeyframeId, ...]]:
        """Keyframes that wait for a bundle, by submap; of a pending bundle, the newest keyframe of its submap."""
        out = {submap: set(keyframes) for submap, keyframes in self._waiting.items()}
        for submap, _ in self._pending.values():
            out.setdefault(submap, set()).add(self._map.submaps[submap][-1])
        return {submap: tuple(sorted(out[submap])) for submap in sorted(out)}

    def restore(self, waiting: Mapping[SubmapId, Collection[KeyframeId]]) -> None:
        """Queue the keyframes that waited in an earlier process."""
        for submap, keyframes in waiting.items():
            if here := [k for k in keyframes if k in self._map]:
                self._waiting[submap] = here

    def add(self, keyframe: KeyframeId) -> None:
        """Queue a keyframe for a bundle around it."""
        submap = submap_of_keyframe(keyframe)
        self._waiting.setdefault(submap, []).append(keyframe)
        self._blocked.discard(submap)

    def void(self, maps: Collection[SubmapId], rows: Collection[int]) -> None:
        """Ignore the results of pending bundles of maps or with keyframes that have moved; they are due again.

        rows: of such keyframes in the table.
        """
        if not (maps or rows):
            return
        gone = set(rows)
        void = [job for job, (submap, window) in self._pending.items()
                if self._map.map_id(submap) in maps or not gone.isdisjoint(window.rows.tolist())]  # fmt: skip
        for job in void:
            submap, _ = self._pending.pop(job)
            self.add(self._map.submaps[submap][-1])
        self._blocked.clear()

    def delete(self, submaps: Collection[SubmapId]) -> None:
        """Drop all that concerns deleted submaps."""
        for submap in submaps:
            self._waiting.pop(submap, None)
            self._last_job.pop(submap, None)
        self._pending = {job: bundle for job, bundle in self._pending.items() if bundle[0] not in submaps}
        self._blocked.clear()

    def jobs(self) -> list[Job]:
        """Bundles to start now: around the newest keyframe of a submap, or of a backlog from its oldest on."""
        jobs: list[Job] = []
        for submap in sorted(self._waiting.keys() - self._blocked, key=lambda s: (self._last_job.get(s, 0), s)):
            config, waiting = self._config.bundle_window, self._waiting[submap]
            # Of a backlog half a window at a time.
            keyframe = waiting[-1] if len(waiting) <= config.max_free else waiting[config.max_free // 2]
            free = local_keyframes(self._map, keyframe, config)
            if self._meets({self._map.rows[k] for k in free}, free_only=False):
                self._blocked.add(submap)
                continue
            window = bundle_window(self._map, free, config, self._config.measurement)
            if window is not None and (
                self._meets(set(window.rows.tolist()), free_only=True) or self._adjusts_too(window)
            ):
                self._blocked.add(submap)
                continue
            del self._waiting[submap]
            moved = set() if window is None else set(self._map.keyframes.id[window.rows[window.problem.free]].tolist())
            left = [k for k in waiting if k != keyframe and k not in moved]
            if left:
                self._waiting[submap] = left
            if window is not None:
                problem = with_odometry_factors(self._map, window, self._config.odometry_factors)
                job = Job(next(self._job_ids), LOCAL_BUNDLE.name, BundleInputs(problem, self._config.bundle))
                jobs.append(job)
                self._pending[job.id] = (submap, window)
                self._last_job[submap] = job.id
        return jobs

    def _meets(self, rows: Collection[int], *, free_only: bool) -> bool:
        """True if keyframes are in a pending bundle; free_only: only where they are free in it."""
        pending = (window for _, window in self._pending.values())
        return any(
            not set(rows).isdisjoint((w.rows[w.problem.free] if free_only else w.rows).tolist()) for w in pending
        )  # fmt: skip

    def _adjusts_too(self, window: BundleWindow) -> bool:
        """True if a pending bundle adjusts landmarks of a window: they may be seen by more keyframes than it fixes."""
        return any(bool(np.isin(window.points, other.points).any()) for _, other in self._pending.values())

    def forget(self, job: int) -> None:
        """Forget a job without a result, if it is one of these."""
        self._pending.pop(job, None)
        self._blocked.clear()

    def finish(self, done: JobDone) -> bool:
        """Apply a finished bundle. Returns False if it was cancelled."""
        pending = self._pending.pop(done.id, None)
        self._blocked.clear()
        if pending is None:
            return False
        window = pending[1]
        result = without_odometry_factors(window, done.result)
        apply_bundle(self._map, window, result, self._publisher, self._config.publish)
        return True
