"""The channel that agent and base use to share records: through the codec and a link, or directly in one process."""

from collections.abc import Sequence
from functools import partial
from typing import Protocol

from kiteline_codec.pacing.pacer import Pacer
from kiteline_codec.pacing.profiles import EXACT, PROFILES, Profile
from kiteline_codec.residuals.residual_coding import ResidualCoder
from kiteline_codec.schema import (
    AGENT_KINDS,
    KEYFRAME_KINDS,
    PASSING_KINDS,
    CachedKeyframe,
    CachedLandmarks,
    GridTile,
    Key,
    KeyframeHeader,
    LivePose,
    Record,
    SubmapPlacement,
    WireError,
    messages,
    owners,
)
from kiteline_codec.sync.archive import Spill
from kiteline_codec.sync.config import SyncConfig, SyncStats
from kiteline_codec.sync.endpoint import Endpoint
from kiteline_codec.sync.resumption import is_of_start
from kiteline_codec.transport.link_traits import LinkTraits
from kiteline_core.ids import AgentId

_OF_AGENTS_KEYFRAMES = KEYFRAME_KINDS - AGENT_KINDS  # what a base says of an agent's own keyframes
# Kinds that their writer does not use as the other side holds them. Of what the agent writes it uses poses alone: its
# map holds what was measured.
_SENT_ALONE = AGENT_KINDS - {KeyframeHeader.KIND} | {CachedKeyframe.KIND, CachedLandmarks.KIND, GridTile.KIND}


class RecordChannel(Protocol):
    """One end of a shared set of records. Each record has one writer; a later record of the same key replaces it."""

    @property
    def profile(self) -> Profile:
        """What to share of a keyframe at present."""
        ...

    def keyframe_gap_ns(self) -> int:
        """How long to wait after a keyframe before one that is not urgent."""
        ...

    def rate_bytes_s(self) -> int | None:
        """What the link carries; None where nothing has to wait."""
        ...

    def arrived(self, key: Key) -> bool:
        """True if the other side is known to hold the newest record of a key."""
        ...

    def put(self, record: Record) -> Record:
        """Share a record. Returns it as the other side will hold it: compute on with that.

        Those with which nobody computes are returned as they are: see `_SENT_ALONE`.
        """
        ...

    def remove(self, key: Key) -> None:
        """Remove a record that was put; unknown keys are ignored."""
        ...

    def receive(self, packets: Sequence[bytes], now_ns: int) -> list[Record]:
        """Take in packets. Returns the records that are new or changed, in the order of arrival."""
        ...

    def take_removed(self) -> list[Key]:
        """The keys that the other side removed since the last call, and did not put again."""
        ...

    def poll(self, now_ns: int) -> list[bytes]:
        """The packets to send now."""
        ...


class PlainChannel:
    """One of two joined ends in one process; records pass uncoded, at the next `receive`. Made by `plain_pair`."""

    profile = EXACT

    def __init__(self) -> None:
        self._arrived: list[Record] = []
        self._removed: dict[Key, None] = {}
        self._partner: PlainChannel = self

    def keyframe_gap_ns(self) -> int:
        """0: there is no link."""
        return 0

    def rate_bytes_s(self) -> int | None:
        """None: there is no link."""
        return None

    def arrived(self, key: Key) -> bool:
        """True once the partner has received it."""
        return all(messages.key(record) != key for record in self._partner._arrived)

    def put(self, record: Record) -> Record:
        """Hand over a record."""
        self._partner._arrived.append(record)
        self._partner._removed.pop(messages.key(record), None)
        return record

    def remove(self, key: Key) -> None:
        """Remove a record."""
        self._partner._arrived = [r for r in self._partner._arrived if messages.key(r) != key]
        self._partner._removed[key] = None

    def receive(self, packets: Sequence[bytes], now_ns: int) -> list[Record]:
        """What the partner put since the last call; there are no packets."""
        arrived, self._arrived = self._arrived, []
        return arrived

    def take_removed(self) -> list[Key]:
        """What the partner removed since the last call."""
        removed, self._removed = self._removed, {}
        return list(removed)

    def poll(self, now_ns: int) -> list[bytes]:
        """Nothing."""
        return []

    @staticmethod
    def _join(a: "PlainChannel", b: "PlainChannel") -> None:
        a._partner, b._partner = b, a


def plain_pair() -> tuple[PlainChannel, PlainChannel]:
    """Two joined ends: what one puts, the other receives."""
    a, b = PlainChannel(), PlainChannel()
    PlainChannel._join(a, b)
    return a, b


class CodedChannel:
    """Records through the codec and an endpoint, over any link that carries packets."""

    def __init__(
        self, config: SyncConfig, session: int, profile: Profile | None = None, spill: Spill | None = None,
        peer: AgentId | None = None,
    ) -> None:  # fmt: skip
        """profile: what to share of a keyframe; None: chosen by the link's throughput. spill: keeps old values. peer:
        the agent at the other end, which writes nothing of others, and whose claims of memory count; None: a base.
        """
        if peer is None:
            self.endpoint = Endpoint(config, session, ResidualCoder(), spill)
        else:
            may_write = partial(owners.of_agent, peer)
            self.endpoint = Endpoint(config, session, ResidualCoder(), spill, may_write, owners.claimed_bytes)
        self._from_base = peer is None
        self._aside: dict[Key, bytes] = {}  # not shared: of keyframes of the agent's earlier starts
        self._placed_by: int | None = None  # session of the base that has placed a submap
        self.undecodable = 0  # values whose code is no valid record: the other side has another schema
        self.noting = False  # whether `take_noted` is used
        self._noted: dict[Key, bytes] = {}
        self._removed: dict[Key, None] = {}
        self._pacer = Pacer(profile, config.budget_bytes)
        self._live_t_ns: int | None = None  # of the last pose that was shared

    @property
    def profile(self) -> Profile:
        """What to share of a keyframe at present."""
        return self._pacer.share(self.endpoint.throughput_bytes_s)

    def keyframe_gap_ns(self) -> int:
        """How long to wait after a keyframe before one that is not urgent."""
        return self._pacer.keyframe_gap_ns(self.endpoint.backlog_bytes, self.endpoint.throughput_bytes_s)

    def rate_bytes_s(self) -> int | None:
        """What the link carries; None where nothing has to wait."""
        return self.endpoint.config.budget_bytes or self.endpoint.throughput_bytes_s

    def arrived(self, key: Key) -> bool:
        """True if the other side is known to hold the newest record of a key."""
        return self.endpoint.arrived(key)

    def shares(self, key: Key) -> bool:
        """True if a record of a key would be sent: not what a base says of keyframes of an agent's earlier starts."""
        return not self._is_of_another_start(key)

    @property
    def stats(self) -> SyncStats:
        """The endpoint's numbers."""
        return self.endpoint.stats

    def report(self) -> dict[str, int | str]:
        """The state of the link in a few numbers; 0 where unknown or unlimited."""
        stats = self.endpoint.stats
        return {
            "profile": self._pacer.profile.name,
            "budget_bytes_s": self.endpoint.config.budget_bytes or 0,
            "backlog_bytes": stats.backlog_bytes,
            "outbox_bytes": stats.resident_bytes,
            "archived": stats.archived,
            "given_up": stats.dropped,
            "rtt_ms": (stats.rtt_ns or 0) // 1_000_000,
            "packets_sent": stats.packets_sent,
            "packets_lost": stats.lost,
            "packets_refused": stats.rejected,
        }

    def put(self, record: Record) -> Record:
        """Code and share a record, unless it is a live pose that is not due. Raises ValueError if it has no code."""
        if isinstance(record, LivePose) and not self._live_is_due(record.t_ns):
            return record
        key = messages.key(record)
        code = messages.encode(record)
        if self._is_of_another_start(key):
            self._aside[key] = code
        else:
            self._aside.pop(key, None)  # of an earlier start whose session has the same few bits
            self.endpoint.put(key, code)
        if isinstance(record, KeyframeHeader):
            self._pacer.keyframe(record.t_ns)
        if self.noting and not isinstance(record, LivePose) and key.kind not in PASSING_KINDS:
            self._noted[key] = code
        return record if record.KIND in _SENT_ALONE else messages.decode(key, code)

    def take_noted(self) -> dict[Key, bytes]:
        """The codes that were put since the last call, without those used up at arrival: for a log, while `noting`."""
        noted, self._noted = self._noted, {}
        return noted

    def _live_is_due(self, t_ns: int) -> bool:
        """True if the profile has room for another pose; one whose time went back is always due."""
        last = self._live_t_ns
        if last is not None and 0 <= t_ns - last < self._pacer.live_gap_ns:
            return False
        self._live_t_ns = t_ns
        return True

    def remove(self, key: Key) -> None:
        """Remove a record."""
        self._aside.pop(key, None)
        self.endpoint.remove(key)

    def own_value(self, key: Key) -> bytes | None:
        """The code of a record that was put; None if there is none."""
        return self._aside.get(key) or self.endpoint.own_value(key)

    def own_values(self) -> dict[Key, bytes]:
        """The codes of all records that were put; a copy."""
        return self.endpoint.own_values() | self._aside

    def receive(self, packets: Sequence[bytes], now_ns: int) -> list[Record]:
        """Take in packets from the link. Values that cannot be decoded are counted and left out."""
        records, session = [], self.endpoint.peer_session
        for packet in packets:
            for update in self.endpoint.receive(packet, now_ns):
                if update.code is None:
                    self._removed[update.key] = None
                    continue
                try:
                    records.append(messages.decode(update.key, update.code))
                    self._removed.pop(update.key, None)  # applied after the records, it would remove this newer one
                except WireError:
                    self.undecodable += 1
        if self._from_base:
            self._end_other_world(records)
        elif self.endpoint.peer_session != session:
            self._set_aside()
        return records

    def _set_aside(self) -> None:
        """Send nothing of an agent's earlier starts to the one that began: it holds none of those keyframes."""
        for key, code in self.endpoint.own_values().items():
            if self._is_of_another_start(key):
                self.endpoint.remove(key)
                self._aside[key] = code

    def _is_of_another_start(self, key: Key) -> bool:
        """True for what a base says of a keyframe that the agent's present start did not make."""
        session = self.endpoint.peer_session
        if self._from_base or session is None or key.kind not in _OF_AGENTS_KEYFRAMES:
            return False
        return not is_of_start(key.id, session)

    def _end_other_world(self, records: Sequence[Record]) -> None:
        """Remove what an earlier base wrote once a new one has placed a submap: what that left out lies elsewhere."""
        session, earlier = self.endpoint.peer_session, self.endpoint.received.earlier
        if any(isinstance(record, SubmapPlacement) for record in records):
            self._placed_by, earlier.compared = session, False
        elif self._placed_by == session:
            self._removed |= dict.fromkeys(earlier.take_ended())

    def take_removed(self) -> list[Key]:
        """The keys that the other side removed since the last call, and did not put again."""
        removed, self._removed = self._removed, {}
        return list(removed)

    def poll(self, now_ns: int) -> list[bytes]:
        """All packets that may be sent now."""
        self._pacer.step(self.endpoint.throughput_bytes_s, now_ns)
        packets = []
        while (packet := self.endpoint.poll(now_ns)) is not None:
            packets.append(packet)
        return packets


def settled(channel: RecordChannel) -> tuple[bool, bool]:
    """Whether a channel has nothing left to send, and whether the last digests of both ends were equal."""
    if isinstance(channel, CodedChannel):
        return channel.endpoint.quiet, channel.endpoint.digest_equal
    return True, True


UNUSED_BYTES = 32 << 20  # memory of a base for an agent of whose keyframes none was of use: some 300 of them
_SPILLED_BYTES = 2 << 20  # memory for own values: some 140 keyframes, three times a local map
_SPILLED_INBOX_BYTES = 1 << 20  # memory for the peer's values: some 400 keyframes
_PEER_BYTES = 2 << 20  # memory of a base for an agent's values at hand: some 170 keyframes; older ones are packed
_UNSPILLED_BYTES = 7 << 20  # memory for own values if old ones are lost: five minutes without a link


def coded_channel(
    session: int,
    budget_bytes: int = 0,
    profile: str = "",
    seal_bytes: int = 0,
    link: LinkTraits | None = None,
    spill: Spill | None = None,
    *,
    bounded: bool = False,
    peer: AgentId | None = None,
) -> CodedChannel:
    """One end of a channel over a link. budget_bytes: on the wire in any second; 0: unlimited. profile: wifi, radio, or
    "" to choose by the link. seal_bytes: what sealing adds to a packet. bounded: whether values of keyframes may take
    only so much memory, and then go to `spill`. peer: the agent at the other end of a base's channel. Raises
    ValueError, BudgetError.
    """
    if link is not None:
        profile = profile or link.profile
    if profile and profile not in PROFILES:
        raise ValueError(f"profile {profile!r}: expected {' or '.join(PROFILES)}")
    named = PROFILES.get(profile)
    limit = budget_bytes or None
    shape = named or Pacer(None, limit).profile
    overhead_bytes = None if link is None else link.overhead_bytes
    config = SyncConfig(
        packet_bytes=shape.packet_bytes,
        overhead_bytes=seal_bytes + (shape.overhead_bytes if overhead_bytes is None else overhead_bytes),
        budget_bytes=limit,
        heartbeat_ns=shape.heartbeat_ns,
        resident_inbox_bytes=_PEER_BYTES if peer is not None else _SPILLED_INBOX_BYTES if bounded else None,
        resident_bytes=None if not bounded else _UNSPILLED_BYTES if spill is None else _SPILLED_BYTES,
        unused_inbox_bytes=None if peer is None else UNUSED_BYTES,
    )
    return CodedChannel(config, session, named, spill, peer)
