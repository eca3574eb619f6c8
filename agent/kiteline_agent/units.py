"""Units of length: one eye's submaps are shared in the unit in which they began, whatever the agent measures in later.

The base has refined what it got in that unit, so the agent converts at its door instead of telling everything anew.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kiteline_codec.channel import RecordChannel
from kiteline_codec.profiles import Profile
from kiteline_codec.schema import Births, Depths, Head, Key, Level, Live, Pose, Record, Sightings
from kiteline_core.ids import SubmapId, submap_of_keyframe

F64 = NDArray[np.float64]


class UnitChannel:
    """A RecordChannel whose own side may measure a submap in another unit than the records do."""

    def __init__(self, channel: RecordChannel) -> None:
        self._channel = channel
        self._own: dict[SubmapId, float] = {}  # own units in one unit of the records; 1 where nothing is said

    @property
    def profile(self) -> Profile:
        """What to share of a keyframe at present."""
        return self._channel.profile

    def keyframe_gap_ns(self) -> int:
        """How long after the last keyframe the link can take another, unless it is pressing."""
        return self._channel.keyframe_gap_ns()

    def rescale(self, submap: SubmapId, factor: float) -> None:
        """From now on all lengths of a submap are larger by `factor` on this side."""
        self._own[submap] = self.unit(submap) * factor

    def unit(self, submap: SubmapId) -> float:
        """How many own units the records' unit is in a submap."""
        return self._own.get(submap, 1.0)

    def put(self, record: Record) -> Record:
        """Share a record. Returns it, in own units, as the other side will hold it."""
        own = self._of(record)
        return (
            record_in(self._channel.put(record_in(record, 1.0 / own)), own) if own != 1.0 else self._channel.put(record)
        )

    def remove(self, key: Key) -> None:
        """Take back a record that was put."""
        self._channel.remove(key)

    def receive(self, packets: Sequence[bytes], now_ns: int) -> list[Record]:
        """Take in packets. Returns the records that are new or changed, in own units."""
        return [record_in(record, self._of(record)) for record in self._channel.receive(packets, now_ns)]

    def take_removed(self) -> list[Key]:
        """The keys that the other side took back since the last call."""
        return self._channel.take_removed()

    def poll(self, now_ns: int) -> list[bytes]:
        """The packets to send now."""
        return self._channel.poll(now_ns)

    def _of(self, record: Record) -> float:
        if isinstance(record, Level):
            return self.unit(record.submap)
        if not self._own or not isinstance(record, Head | Live | Births | Sightings | Pose | Depths):
            return 1.0
        return self.unit(submap_of_keyframe(record.keyframe))


def record_in(record: Record, factor: float) -> Record:
    """A record whose lengths are larger by `factor`."""
    if factor == 1.0:
        return record
    if isinstance(record, Head):
        return replace(record, T_p_k=longer(record.T_p_k, factor))
    if isinstance(record, Live):
        return replace(record, T_k_c=longer(record.T_k_c, factor))
    if isinstance(record, Pose):
        return replace(record, T_m_k=longer(record.T_m_k, factor))
    if isinstance(record, Level):
        return replace(record, T_l_m=longer(record.T_l_m, factor))
    if isinstance(record, Births | Sightings | Depths):
        return replace(record, inv_depth=(record.inv_depth / factor).astype(np.float32))
    return record


def longer(T: F64, factor: float) -> F64:
    """T (4,4) with its translation multiplied by `factor`."""
    out = T.copy()
    out[:3, 3] *= factor
    return out
