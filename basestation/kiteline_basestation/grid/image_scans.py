"""Scans of agents that send images: one job at a time for each agent, as each needs the ground that others saw."""

from collections import deque
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from kiteline_basestation.grid.scan_job import SCAN, ScanInputs, ScanResult
from kiteline_basestation.jobs import Job, JobDone
from kiteline_basestation.map.map_tables import LANDMARK
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_codec.schema import Key, KeyframeScan, ScanImages, WireError, messages
from kiteline_core.arrays import F64, I64
from kiteline_core.geometry import disparity_offset
from kiteline_core.ground.brightness import Brightness
from kiteline_core.ground.config import GroundConfig
from kiteline_core.ground.ground_height import GroundHeight, Seen
from kiteline_core.ids import (
    SEQUENCE_BITS,
    SUBMAP_BITS,
    AgentId,
    KeyframeId,
    SubmapId,
    agent_of_keyframe,
    submap_of_keyframe,
)

_WAITING = 64  # images of an agent, 1.6 MB: the oldest are dropped
_STRETCHES = 8  # of flights whose ground is followed: the oldest are forgotten


@dataclass(frozen=True, slots=True)
class MadeScan:
    """The code of a scan, in hexadecimal digits."""

    code: str


@dataclass(frozen=True, slots=True)
class _Pending:
    """A job. index: (n,) keypoints of the keyframe that it labels."""

    record: ScanImages
    index: I64


class ImageScans:
    """Makes scans of images. made: their codes by keyframe and part, to be saved."""

    def __init__(self, config: GroundConfig, sparse_map: SparseMap, job_ids: Iterator[int]) -> None:
        self._config = config
        self._map = sparse_map
        self._job_ids = job_ids
        self._waiting: dict[AgentId, deque[ScanImages]] = {}
        self._pending: dict[int, _Pending] = {}
        self._ground: dict[tuple[int, int], GroundHeight[KeyframeScan]] = {}  # by start of an agent, and stretch
        self._brightness: dict[AgentId, Brightness] = {}  # of the agents' rigs, by the images so far
        self.made: dict[tuple[int, int], MadeScan] = {}
        self.unreadable = 0  # images that were none

    @property
    def idle(self) -> bool:
        """True if no images wait whose keyframe is here, and no job is pending."""
        return not (self._pending or any(r.keyframe in self._map for images in self._waiting.values() for r in images))

    @property
    def pending(self) -> int:
        """Number of pending jobs."""
        return len(self._pending)

    def add(self, record: ScanImages) -> None:
        """Queue images."""
        self._waiting.setdefault(agent_of_keyframe(record.keyframe), deque(maxlen=_WAITING)).append(record)

    def jobs(self) -> list[Job]:
        """Scans to make now: the next one of each agent without a pending one whose camera is known.

        Images wait for their keyframe, which is sent before them, but may be lost.
        """
        busy = {agent_of_keyframe(pending.record.keyframe) for pending in self._pending.values()}
        jobs = []
        for agent, waiting in sorted(self._waiting.items()):
            camera = self._map.cameras.get(agent)
            # Scans are kept: of keyframes that nobody has seen, there could be any number.
            at = next((n for n, record in enumerate(waiting) if record.keyframe in self._map), None)
            if at is None or agent in busy or camera is None:
                continue
            record = waiting[at]
            del waiting[at]
            if not camera.stereo:
                continue
            index, uv = self._landmarks(record)
            offset_px = self._map.disparity_offset_px.get(agent, disparity_offset.none())
            expected = self._ground_of(record).expected(record.T_o_c, record.up_c)
            brightness = self._brightness.get(agent, Brightness())
            inputs = ScanInputs(record.images, camera, self._config, record.up_c, offset_px, expected, uv, brightness)
            job = Job(next(self._job_ids), SCAN.name, inputs)
            jobs.append(job)
            self._pending[job.id] = _Pending(record, index)
        return jobs

    def forget(self, job: int) -> None:
        """Forget a job without a result, if it is one of these."""
        self._pending.pop(job, None)

    def finish(self, done: JobDone) -> list[KeyframeScan]:
        """Scans to draw: those that are believed now, and those that are not any more, without their ground."""
        pending, result = self._pending.pop(done.id, None), done.result
        if pending is None:
            return []
        if not isinstance(result, ScanResult):
            self.unreadable += 1
            return []
        record, seen = pending.record, result.seen
        self._brightness[agent_of_keyframe(record.keyframe)] = result.brightness
        labels = np.zeros(int(pending.index.max(initial=-1)) + 1, np.uint8)
        labels[pending.index] = result.labels
        scan = KeyframeScan(record.keyframe, seen.scan, labels, record.part, record.T_k_s)
        verdict = self._ground_of(record).note(scan, Seen(record.T_o_c, *seen))
        blank = [wrong.without_ground() for wrong in verdict.withdrawn]
        return [self._keep(made) for made in (*blank, *verdict.believed)]

    def delete(self, submaps: Collection[SubmapId]) -> None:
        """Drop all that concerns deleted submaps."""
        for waiting in self._waiting.values():
            left = [record for record in waiting if submap_of_keyframe(record.keyframe) not in submaps]
            waiting.clear()
            waiting.extend(left)
        self._pending = {
            job: pending
            for job, pending in self._pending.items()
            if submap_of_keyframe(pending.record.keyframe) not in submaps
        }
        self.made = {
            key: made for key, made in self.made.items() if submap_of_keyframe(KeyframeId(key[0])) not in submaps
        }

    def restore(self, made: Mapping[tuple[int, int], MadeScan]) -> list[KeyframeScan]:
        """Scans that an earlier process made. Raises ValueError if one cannot be read."""
        scans = []
        for (keyframe, part), scan in sorted(made.items()):
            try:
                record = messages.decode(Key(KeyframeScan.KIND, keyframe, part), bytes.fromhex(scan.code))
            except WireError as error:
                raise ValueError(f"the scan of keyframe {keyframe} cannot be read: {error}") from error
            assert isinstance(record, KeyframeScan)
            scans.append(record)
        self.made.update(made)
        return scans

    def _keep(self, scan: KeyframeScan) -> KeyframeScan:
        """The scan as it is decoded: what is saved, and what is drawn."""
        code = messages.encode(scan)
        self.made[int(scan.keyframe), scan.part] = MadeScan(code.hex())
        read = messages.decode(scan.key(), code)
        assert isinstance(read, KeyframeScan)
        return read

    def _ground_of(self, record: ScanImages) -> GroundHeight[KeyframeScan]:
        """The ground of a record's stretch of flight."""
        key = int(record.keyframe) >> SEQUENCE_BITS + SUBMAP_BITS, record.stretch
        if key not in self._ground:
            self._ground[key] = GroundHeight()
            if len(self._ground) > _STRETCHES * max(1, len(self._waiting)):
                del self._ground[next(iter(self._ground))]
        return self._ground[key]

    def _landmarks(self, record: ScanImages) -> tuple[I64, F64]:
        """Keypoints (n,) of a keyframe that are new landmarks, and their pixels (n,2); none of a later frame."""
        if record.part:
            return np.zeros(0, np.int64), np.zeros((0, 2))
        slots, table = self._map.slots_of(record.keyframe), self._map.keypoints
        index = np.flatnonzero(table.kind[slots] == LANDMARK)
        return index, table.uv[slots[index]].astype(np.float64)
