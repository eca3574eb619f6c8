"""How an endpoint uses its link, the order in which values leave, and its statistics."""

from collections.abc import Callable
from dataclasses import dataclass, field

from kiteline_codec.schema import RECORD_TYPES, Key, Priority
from kiteline_codec.sync.resumption import SUMMARY_KIND
from kiteline_codec.sync.send_queue import Order
from kiteline_codec.transport.packet import MAX_HEADER_BYTES, MAX_ITEM_BYTES
from kiteline_core.errors import KitelineError

_ORDERS = {kind: (int(t.PRIORITY), t.FIRST_PARTS) for kind, t in RECORD_TYPES.items()}
_UNKNOWN_KIND = int(Priority.GRID), 1
_REST = int(Priority.REST)
_MOST_REASONS = 64  # texts of refusals that are counted apart: they name numbers that the peer chose
MIN_PACKET_BYTES = MAX_HEADER_BYTES + MAX_ITEM_BYTES + 24


class BudgetError(KitelineError, ValueError):
    """A budget in which not even the smallest packets fit."""


def default_order(key: Key) -> Order:
    """The place of a value in the order of sending, least first: priority, then the newest keyframe, then the part."""
    if key.kind == SUMMARY_KIND:
        return (0, 0, key.part)  # it saves more bytes than it costs
    priority, first_parts = _ORDERS.get(key.kind, _UNKNOWN_KIND)
    if key.part >= first_parts:
        priority = max(priority, _REST)
    return (priority, -key.id, key.part)


@dataclass(frozen=True, slots=True)
class SyncConfig:
    """How an endpoint uses its link."""

    packet_bytes: int = 1200  # largest packet: fits an Ethernet frame inside any tunnel; a MAVLink tunnel wants 128
    overhead_bytes: int = 28  # cost of a packet on the wire beyond its own bytes: IPv4 and UDP
    budget_bytes: int | None = None  # on the wire in any one-second window; None: unlimited
    window_packets: int = 64  # in flight at once: what one acknowledgement covers
    ack_delay_ns: int = 20_000_000  # so that an acknowledgement can ride on a packet with values
    ack_packets: int = 16  # acknowledge at once after so many: well inside the window
    # A scan or a tile that fills less than half a packet waits so long for one that leaves anyway, as with a pose.
    gather_ns: int = 100_000_000
    # Overtaken by so many, a packet that took longer than a round trip and two deviations is lost (as RFC 9002).
    reorder_packets: int = 3
    first_rto_ns: int = 500_000_000  # time-out before any round trip has been measured
    min_rto_ns: int = 100_000_000  # an idle process may take so long to answer
    max_rto_ns: int = 2_000_000_000  # a link that comes back is found again within this time
    hello_ns: int = 250_000_000  # between greetings while the peer is unknown
    heartbeat_ns: int = 1_000_000_000  # longest silence while the peer is known
    digest_gap_ns: int = 1_000_000_000  # between digests of two versions: poses alone make a version ten times a second
    # In every eighth packet the value that has waited longest follows the poses, so that none starves.
    oldest_every: int = 8
    max_value_bytes: int = 1 << 20  # of one value; longer ones are refused
    max_assembly_bytes: int = 16 << 20  # of values that have arrived in part
    max_inbox_bytes: int = 2 << 30  # memory for what the peer wrote, and what that claims in the map: 40,000 keyframes
    # Of that, what the peer may claim before anything that it sent was of use (`Claims.earned`).
    unused_inbox_bytes: int | None = None  # None: all
    resident_bytes: int | None = None  # memory for own values of keyframes, archived pages apart; None: unlimited
    resident_inbox_bytes: int | None = None  # the same for the peer's values; without a spill, older ones are packed
    order: Callable[[Key], Order] = default_order

    def __post_init__(self) -> None:
        if not MIN_PACKET_BYTES <= self.packet_bytes <= 1 << 16:
            raise ValueError(f"packet_bytes is {self.packet_bytes}, expected {MIN_PACKET_BYTES}..65536")
        least = 2 * (MIN_PACKET_BYTES + self.overhead_bytes)
        if self.budget_bytes is not None and self.budget_bytes < least:
            raise BudgetError(
                f"{self.budget_bytes} B/s are too few for this link: expected 0 (no limit) or at least {least}"
            )

    @property
    def filled_bytes(self) -> int:
        """Length of full packets: at most a fifth of a tight budget, or the pose would wait."""
        if self.budget_bytes is None:
            return self.packet_bytes
        return max(MIN_PACKET_BYTES, min(self.packet_bytes, self.budget_bytes // 5 - self.overhead_bytes))

    @property
    def burst_bytes(self) -> int:
        """Bytes that may leave at once: a packet, and what adds up between two frames at 10 Hz."""
        return max(self.filled_bytes + self.overhead_bytes, (self.budget_bytes or 0) // 8)


@dataclass(slots=True)
class Traffic:
    """Packets of an endpoint, counted as they pass. Bytes are those on the wire, `overhead_bytes` a packet included."""

    overhead_bytes: int
    bytes_sent: int = 0
    packets_sent: int = 0
    bytes_received: int = 0
    duplicates: int = 0
    restarts: int = 0
    mismatches: int = 0
    reasons: dict[str, int] = field(default_factory=dict)

    def sent(self, packet: bytes) -> int:
        """Count a packet that leaves; its bytes on the wire."""
        size = len(packet) + self.overhead_bytes
        self.bytes_sent += size
        self.packets_sent += 1
        return size

    def received(self, packet: bytes) -> None:
        """Count a packet that has arrived."""
        self.bytes_received += len(packet) + self.overhead_bytes

    def refuse(self, reason: str) -> None:
        """Count a packet, or a value in it, that was refused."""
        if reason not in self.reasons and len(self.reasons) >= _MOST_REASONS:
            reason = "other reasons"
        self.reasons[reason] = self.reasons.get(reason, 0) + 1


@dataclass(frozen=True, slots=True)
class SyncStats:
    """Numbers of an endpoint since its start. Bytes are those on the wire, overhead included."""

    bytes_sent: int
    packets_sent: int
    bytes_received: int
    lost: int  # packets
    duplicates: int  # packets received again, or too late
    rejected: int
    reasons: tuple[tuple[str, int], ...]  # why packets were rejected, how many
    rtt_ns: int | None  # smoothed round trip; None before the first
    dirty: int  # own values that the peer is not known to hold
    in_flight: int  # packets
    values: int  # that the peer's session wrote
    restarts: int  # of the peer, noticed
    mismatches: int  # digests that differed: a defect, mended by sending everything again
    backlog_bytes: int = 0  # of own values that the peer is not known to hold
    resident_bytes: int = 0  # memory of values of keyframes, roughly
    archived: int = 0  # values that are kept out of memory
    dropped: int = 0  # values dropped for want of memory
