"""Local bundle adjustments: around which keyframe the next one is, and what becomes of its result."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.exchange.publisher import Publisher
from kiteline_basestation.jobs import Job, JobDone
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.refinement.apply_bundle import apply_bundle
from kiteline_basestation.refinement.bundle_job import LOCAL_BUNDLE, BundleInputs
from kiteline_basestation.refinement.bundle_window import BundleWindow, local_bundle_window
from kiteline_basestation.refinement.odometry_factors import with_odometry_factors, without_odometry_factors
from kiteline_core.ids import KeyframeId, SubmapId, submap_of_keyframe


class LocalBundles:
    """At most one local bundle at a time for each map; submaps take turns."""

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
        self._waiting.setdefault(submap_of_keyframe(keyframe), []).append(keyframe)

    def cancel(self, map_id: SubmapId) -> None:
        """Ignore the results of pending bundles of a map that has moved; they are due again."""
        for job, (submap, _) in list(self._pending.items()):
            if self._map.map_id(submap) == map_id:
                del self._pending[job]
                self.add(self._map.submaps[submap][-1])

    def delete(self, submaps: Collection[SubmapId]) -> None:
        """Drop all that concerns deleted submaps."""
        for submap in submaps:
            self._waiting.pop(submap, None)
        self._pending = {job: bundle for job, bundle in self._pending.items() if bundle[0] not in submaps}

    def jobs(self) -> list[Job]:
        """Bundles to start now: around the newest keyframe of a submap, or of a backlog from its oldest on."""
        busy = {self._map.map_id(submap) for submap, _ in self._pending.values()}
        jobs = []
        for submap in sorted(self._waiting, key=lambda s: (self._last_job.get(s, 0), s)):
            if self._map.map_id(submap) in busy:
                continue
            waiting, size = self._waiting.pop(submap), self._config.bundle_window.max_free
            keyframe = waiting[-1] if len(waiting) <= size else waiting[size // 2]  # half a window at a time
            window = local_bundle_window(self._map, keyframe, self._config.bundle_window, self._config.measurement)
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
                busy.add(self._map.map_id(submap))
        return jobs

    def forget(self, job: int) -> None:
        """Forget a job without a result, if it is one of these."""
        self._pending.pop(job, None)

    def finish(self, done: JobDone) -> bool:
        """Apply a finished bundle. Returns False if it was cancelled."""
        pending = self._pending.pop(done.id, None)
        if pending is None:
            return False
        window = pending[1]
        result = without_odometry_factors(window, done.result)
        apply_bundle(self._map, window, result, self._publisher, self._config.cull, self._config.publish)
        return True
