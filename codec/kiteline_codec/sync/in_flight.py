"""Packets in flight: what each carried, which are acknowledged, which count as lost."""

from collections.abc import Callable
from dataclasses import dataclass

from kiteline_codec.schema import Key
from kiteline_codec.sync.round_trip import RoundTrip
from kiteline_codec.transport.packet import MASK_BITS

Carried = tuple[Key, int, int, int]  # key, version, first byte, last byte + 1

_MAX_LOST = 2 * MASK_BITS  # lost packets that are kept in case their acknowledgement comes late


@dataclass(slots=True)
class SentPacket:
    """A packet that is not acknowledged."""

    sent_ns: int
    n_bytes: int
    carried: list[Carried]
    lost: bool = False


@dataclass(frozen=True, slots=True)
class Acknowledged:
    """Packets in flight that were acknowledged at once: when the oldest was sent, and the number of the newest."""

    oldest_sent_ns: int  # the oldest, so that a round trip is not measured too short
    newest: int


class PacketsInFlight:
    """The packets with values of one session, by number from 1."""

    def __init__(self) -> None:
        self.number = 0  # of the last packet
        self.in_flight = 0
        self.lost = 0  # over all sessions
        self.acked_bytes = 0  # of packets with values, over all sessions
        self._packets: dict[int, SentPacket] = {}  # in order of numbers; lost ones too
        self._probed = False  # what was last of all is sent again, and nothing was acknowledged since

    @property
    def next_number(self) -> int:
        """The number of the next packet."""
        return self.number + 1

    def __len__(self) -> int:
        return len(self._packets)

    def clear(self) -> None:
        """Forget all packets; acknowledgements of them are ignored."""
        self._packets.clear()
        self.in_flight = 0
        self._probed = False

    def restart(self) -> None:
        """Begin a session: numbers begin again."""
        self.clear()
        self.number = 0

    def add(self, now_ns: int, n_bytes: int, carried: list[Carried]) -> None:
        """Note the packet of the last number as sent."""
        self._packets[self.number] = SentPacket(now_ns, n_bytes, carried)
        self.in_flight += 1

    def window_open(self, packets: int) -> bool:
        """True if fewer than `packets` are in flight, and the oldest can still be acknowledged after one more."""
        if self.in_flight >= packets:
            return False
        oldest = next((n for n, p in self._packets.items() if not p.lost), None)
        return oldest is None or self.number + 1 - oldest <= MASK_BITS

    def acknowledge(
        self, last: int, missing: int, arrived: Callable[[Key, int, int, int], None]
    ) -> Acknowledged | None:
        """Process an acknowledgement: of packet `last`, and of those of the 64 before it whose bit in `missing` is 0.

        arrived: called for each value carried. Returns None if no packet was in flight that is acknowledged now.
        """
        if last > self.number:
            return None
        result: Acknowledged | None = None
        for number in list(self._packets):
            behind = last - number
            if behind < 0:
                break
            if behind > MASK_BITS or (behind and missing >> (behind - 1) & 1):
                continue
            packet = self._packets.pop(number)
            self.acked_bytes += packet.n_bytes
            self._probed = False
            if not packet.lost:
                self.in_flight -= 1
                result = Acknowledged(packet.sent_ns if result is None else result.oldest_sent_ns, number)
            for carried in packet.carried:
                arrived(*carried)
        return result

    def give_up_late(self, now_ns: int, round_trip: RoundTrip, overtaken_below: int, *, last: bool) -> list[SentPacket]:
        """Mark as lost what was overtaken, what is the last of all (RFC 8985: a tail loss probe) and what timed out.

        overtaken_below: packets with lower numbers have been overtaken. last: nothing waits to be sent, so that nothing
        would overtake the last packets; they are sent again early only once until one is acknowledged, so that a link
        that is down gets no more than the time-out allows. Returns the packets that were not marked before.
        """
        lost = self._give_up(now_ns - round_trip.overdue_ns, overtaken_below)
        newest, probe_ns = self._packets.get(self.number), round_trip.probe_ns
        if last and newest is not None and not newest.lost and probe_ns is not None and not self._probed:
            if now_ns - newest.sent_ns >= probe_ns:
                self._probed = True
                return lost + self._give_up(now_ns)
        timed_out = self._give_up(now_ns - round_trip.timeout_ns)
        if timed_out:
            round_trip.timed_out()
        return lost + timed_out

    def _give_up(self, sent_before_ns: int, number_below: int | None = None) -> list[SentPacket]:
        """Mark packets sent before a time as lost. Returns those that were not marked before."""
        lost = []
        for number, packet in self._packets.items():
            if packet.sent_ns >= sent_before_ns or (number_below is not None and number >= number_below):
                break
            if not packet.lost:
                lost.append(packet)
        for packet in lost:
            packet.lost = True
        self.lost += len(lost)
        self.in_flight -= len(lost)
        if lost:
            old = [n for n, p in self._packets.items() if p.lost]
            for n in old[: max(0, len(old) - _MAX_LOST)]:
                del self._packets[n]
        return lost
