"""Agents that were recorded without images: the records that one flight shares, given again in other names.

Descriptors of a copy are turned by a mask: distances within it stay, and places of different copies do not look alike.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from kiteline_agent.step import Identity
from kiteline_bench.harness.recording import items_of
from kiteline_bench.harness.run import FlyingAgent
from kiteline_codec.channel import CodedChannel, coded_channel
from kiteline_codec.schema import (
    CameraIntrinsics,
    Key,
    KeyframeHeader,
    NewLandmarks,
    Observations,
    Record,
    StereoAlignment,
    messages,
)
from kiteline_codec.sync.resumption import agent_session
from kiteline_core.arrays import F64, U8
from kiteline_core.geometry import se3
from kiteline_core.ids import (
    KEYPOINT_BITS,
    NO_KEYFRAME,
    SEQUENCE_BITS,
    AgentId,
    KeyframeId,
    SubmapId,
    keyframe_id,
    submap_id,
)
from kiteline_hw.sources.open import open_source

_AGENT_FIELDS, _SUBMAP_FIELDS, _KEYFRAME_FIELDS = ("agent",), ("submap",), ("keyframe", "since", "parent")
_AFTER_NS = 1_000_000_000  # between the last keyframe of a round and the first one of the next


@dataclass(frozen=True, slots=True)
class RecordedFlight:
    """The records of one flight in one submap, of agent 0, boot 0.

    about: camera and its alignment. keyframes: the records from each header on, until the next one. T_m_k: (n,4,4)
    poses of the keyframes as their parents compose them.
    """

    about: tuple[Record, ...]
    keyframes: tuple[tuple[Record, ...], ...]
    T_m_k: F64

    @property
    def headers(self) -> list[KeyframeHeader]:
        """The header of each keyframe."""
        return [header for group in self.keyframes for header in group if isinstance(header, KeyframeHeader)]

    @property
    def period_ns(self) -> int:
        """From the begin of one round to that of the next."""
        headers = self.headers
        return headers[-1].t_ns - headers[0].t_ns + _AFTER_NS


@dataclass(frozen=True, slots=True)
class Name:
    """Who a copy of a flight is of. first: sequence number of its first keyframe. mask: (32,) of its descriptors."""

    agent: AgentId
    boot: int
    first: int
    mask: U8

    @property
    def submap(self) -> SubmapId:
        """The submap of all its keyframes."""
        return submap_id(self.agent, self.boot, 0)

    def keyframe(self, number: int) -> KeyframeId:
        """The id of a keyframe of the copy."""
        return keyframe_id(self.submap, self.first + number)


def mask_of(number: int) -> U8:
    """A random mask (32,); that of number 0 changes nothing."""
    if number == 0:
        return np.zeros(32, np.uint8)
    return np.random.default_rng([number, 9]).integers(0, 256, 32, np.uint8)


def record_flight(source: str, most: int) -> RecordedFlight:
    """Fly a recording over a perfect link without a base, until it has `most` keyframes or ends. Raises SourceError."""
    opened = open_source(source)
    number = AgentId(0)
    ours, theirs = coded_channel(agent_session(1, 0), 0, "wifi"), coded_channel(1, 0, "wifi", peer=number)
    ours.noting = True
    flying = FlyingAgent(opened.rig, opened.imu, channel=ours, identity=Identity(number, 0), vocabulary=False)
    codes: list[tuple[Key, bytes]] = list(ours.take_noted().items())
    down: list[bytes] = []
    count = 0
    for item in items_of(opened):
        up = flying.step(item, down, item.frame.t_ns)
        theirs.receive(up, item.frame.t_ns)
        down = theirs.poll(item.frame.t_ns)
        noted = ours.take_noted()
        codes += noted.items()
        count += sum(key.kind == KeyframeHeader.KIND for key in noted)
        if count > most:
            break
    opened.close()
    return _flight([messages.decode(key, code) for key, code in codes], most)


def _flight(records: list[Record], most: int) -> RecordedFlight:
    about: dict[type[Record], Record] = {}
    groups: list[list[Record]] = []
    poses: dict[KeyframeId, F64] = {}
    submap: SubmapId | None = None
    for record in records:
        if isinstance(record, CameraIntrinsics | StereoAlignment):
            about[type(record)] = record
            continue
        if isinstance(record, KeyframeHeader):
            if submap is None:
                submap = SubmapId(record.keyframe >> SEQUENCE_BITS)
            if len(groups) == most or record.keyframe >> SEQUENCE_BITS != submap:
                break
            above = np.eye(4) if record.parent == NO_KEYFRAME else poses[record.parent]
            poses[record.keyframe] = above @ record.T_p_k
            groups.append([])
        if groups:
            groups[-1].append(record)
    return RecordedFlight(tuple(about.values()), tuple(map(tuple, groups)), np.array(list(poses.values())))


def renamed(record: Record, name: Name, later_ns: int = 0) -> Record:
    """A record of agent 0, boot 0, submap 0 as one of a copy, later by `later_ns`."""
    shift = name.keyframe(0) - keyframe_id(submap_id(0, 0, 0), 0)
    changed: dict[str, object] = {}
    held: Any = record  # of whatever class
    for field in fields(held):
        value = getattr(record, field.name)
        if field.name in _AGENT_FIELDS:
            changed[field.name] = name.agent
        elif field.name in _SUBMAP_FIELDS:
            changed[field.name] = name.submap
        elif field.name in _KEYFRAME_FIELDS and value != NO_KEYFRAME:
            changed[field.name] = KeyframeId(value + shift)
        elif field.name == "t_ns":
            changed[field.name] = value + later_ns
    if isinstance(record, Observations):
        changed["point"] = record.point + (shift << KEYPOINT_BITS)
    if isinstance(record, NewLandmarks):
        changed["descriptor"] = record.descriptor ^ name.mask
    made: Record = replace(held, **changed)
    return made


def rounds(
    flight: RecordedFlight, agent: AgentId, boot: int, count: int, shift_m: F64, error: F64
) -> Iterator[tuple[Record, ...]]:
    """The records of each keyframe of a flight through `count` places, which look the same but for descriptors.

    shift_m: (count,3) of the places in m. The last place is the first one again. error: (4,4) motion by which the agent
    errs between two places.
    """
    n = len(flight.keyframes)
    for number in range(count):
        last = number == count - 1
        name = Name(agent, boot, number * n, mask_of(0 if last else number))
        later_ns = number * flight.period_ns
        for k, group in enumerate(flight.keyframes):
            given = [renamed(record, name, later_ns) for record in group]
            if k == 0 and number:
                T = se3.from_rt(np.eye(3), shift_m[number] - shift_m[number - 1])
                seam = se3.inverse(flight.T_m_k[-1]) @ T @ flight.T_m_k[0] @ error
                parent = KeyframeId(name.keyframe(0) - 1)
                given = [
                    replace(r, parent=parent, T_p_k=seam) if isinstance(r, KeyframeHeader) else r for r in given
                ]  # fmt: skip
            yield tuple(given)


@dataclass(slots=True)
class Link:
    """One agent's end of a link to a station in the same process; real packets, no time on the way."""

    agent: AgentId
    end: CodedChannel
    down: Sequence[bytes] = ()

    def exchange(self, records: Sequence[Record], now_ns: int) -> list[bytes]:
        """Take in packets, share records, and give the packets for the base."""
        self.end.receive(self.down, now_ns)
        self.down = ()
        for record in records:
            self.end.put(record)
        return self.end.poll(now_ns)
