"""Holds corrections of the base until all of their batch have arrived."""

from collections.abc import Sequence

from kiteline_codec.schema import CorrectionBatch, Key, Record, messages
from kiteline_codec.schema.batches import checksum_of_keys

_MAX_HELD = 4096  # values; a base makes a batch when the one before has arrived: more are a defect


class ReceivedBatches:
    """Corrections in, in any order; out come those that wait for no other ones, and whole batches."""

    def __init__(self) -> None:
        self._held: dict[Key, Record] = {}  # the newest value of each key, in order of arrival
        self._batch: CorrectionBatch | None = None  # the newest one of which the record has arrived
        self._applied = 0  # number of the newest batch that was applied

    def __len__(self) -> int:
        """Number of values that wait."""
        return len(self._held)

    def take(self, records: Sequence[Record], removed: Sequence[Key]) -> list[Record]:
        """The records to apply now, those of a batch in order of their keys. removed: keys of values that are void."""
        ready = []
        for record in records:
            if isinstance(record, CorrectionBatch):
                self._set_batch(record)
                continue
            waits = getattr(record, "batch", 0) > self._applied
            if waits or self._held:
                key = messages.key(record)
                self._held.pop(key, None)
            if waits:
                self._held[key] = record
            else:
                ready.append(record)
        for key in removed:
            self._held.pop(key, None)
        return ready + self._complete()

    def _set_batch(self, batch: CorrectionBatch) -> None:
        if self._batch is not None and batch.number < self._batch.number:
            self._applied = 0  # another base, which counts from the start
        self._batch = batch

    def _complete(self) -> list[Record]:
        """The values up to the newest batch if it is complete; none otherwise."""
        batch = self._batch
        if batch is None or batch.number <= self._applied:
            return self._overflow()
        keys = [key for key, record in self._held.items() if record.batch == batch.number]  # type: ignore[attr-defined]
        if batch.members and (len(keys) != batch.members or checksum_of_keys(keys) != batch.keys):
            return self._overflow()
        self._applied = batch.number
        due = sorted(key for key, record in self._held.items() if record.batch <= batch.number)  # type: ignore[attr-defined]
        return [self._held.pop(key) for key in due]

    def _overflow(self) -> list[Record]:
        """The values that have waited longest, beyond what is held at most."""
        return [self._held.pop(next(iter(self._held))) for _ in range(len(self._held) - _MAX_HELD)]
