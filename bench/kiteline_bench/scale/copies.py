"""Copies of a place that was flown and mapped: a large map without the time that its flight would take."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from kiteline_basestation.mapper_state import MapperState
from kiteline_basestation.station import Station
from kiteline_bench.scale.recorded import Link, Name
from kiteline_codec.channel import CodedChannel
from kiteline_codec.schema import (
    FusedLandmarks,
    KeyframePose,
    KeyframeScan,
    Record,
    RefinedLandmarks,
    RemovedObservations,
    messages,
)
from kiteline_codec.schema.owners import KEYFRAME_BYTES
from kiteline_core.geometry import se3
from kiteline_core.ids import KEYPOINT_BITS, KeyframeId

_OWN = (KeyframePose, RefinedLandmarks, FusedLandmarks, RemovedObservations)
_ROUNDS = 50  # exchanges for one place after which its values must have arrived


class PlaceCopies:
    """Adds copies of a place to a station that has mapped it, as restarts do with what a store holds.

    What the agent wrote goes over its channel, what the base wrote into its end of the channel; no landmark is matched
    and no bundle computed. Scans are left out: their drawing would take longer than all else.
    """

    def __init__(self, station: Station, link: Link, of: Name) -> None:
        self._station, self._link, self._of = station, link, of
        channel = station.channels[link.agent]
        assert isinstance(channel, CodedChannel)
        self._channel = channel
        codes = channel.own_values().items()
        self._own = [r for r in (messages.decode(key, code) for key, code in codes) if isinstance(r, _OWN)]
        self._state: MapperState | None = None  # before the copies that are being added

    def add(self, name: Name, groups: Iterable[Sequence[Record]], now_ns: int) -> int:
        """Add the place under another name. groups: the agent's records of it. Returns the time when it is done."""
        mapper, channel, agent = self._station.mapper, self._channel, self._link.agent
        self._state = self._state or mapper.state()
        given = [r for group in groups for r in group if not isinstance(r, KeyframeScan)]
        for _ in range(_ROUNDS):
            packets = self._link.exchange(given, now_ns)
            received = channel.receive(packets, now_ns)
            channel.endpoint.received.claims.earned += KEYFRAME_BYTES * len(received)
            mapper.restore(agent, tuple(received), (), now_ns)
            self._link.down = channel.poll(now_ns)
            if not packets and not given:
                break
            given = []
            now_ns += 10_000_000
        first, origin = mapper.map.pose(name.keyframe(0)), mapper.map.pose(self._of.keyframe(0))
        assert first is not None and origin is not None
        own = self._moved(name, first @ se3.inverse(origin))
        mapper.restore(agent, (), tuple(channel.put(record) for record in own), now_ns)
        return now_ns

    def finish(self) -> None:
        """Let the mapper go on; the copies are in the place index from now on."""
        if self._state is not None:
            self._station.mapper.restore_state(self._state)
        self._state = None

    def _moved(self, name: Name, shift: np.ndarray) -> list[Record]:
        """What the base wrote of the place, for a copy that lies elsewhere by (4,4)."""
        far = name.keyframe(0) - self._of.keyframe(0)
        out: list[Record] = []
        for record in self._own:
            held: Any = record
            changed: dict[str, object] = {"keyframe": KeyframeId(held.keyframe + far)}
            if isinstance(record, KeyframePose):
                changed["T_m_k"] = shift @ record.T_m_k
            elif isinstance(record, FusedLandmarks):
                changed["point"] = record.point + (far << KEYPOINT_BITS)
            if hasattr(held, "batch"):
                changed["batch"] = 0
            out.append(replace(held, **changed))
        return out
