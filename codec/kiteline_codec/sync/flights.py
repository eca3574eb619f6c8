"""Packets on their way: what each carried, what an acknowledgement tells of them, which are taken for lost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from kiteline_codec.schema import Key
from kiteline_codec.transport.packet import MASK_BITS

Carried = tuple[Key, int, int, int]  # key, version, first byte, last byte + 1

_MAX_LATE = 2 * MASK_BITS  # packets taken for lost that are remembered in case their acknowledgement comes late


@dataclass(slots=True)
class Flight:
    """A packet on its way."""

    sent_ns: int
    n_bytes: int
    carried: list[Carried]
    lost: bool = False


class Flights:
    """The packets with values of one session, by number."""

    def __init__(self) -> None:
        self.number = 0  # of the last packet
        self.in_flight = 0
        self.lost = 0  # taken for lost, over all sessions
        self.acked_bytes = 0  # of packets with values, over all sessions
        self._flights: dict[int, Flight] = {}  # in order of numbers

    @property
    def next_number(self) -> int:
        """The number of the next packet."""
        return self.number + 1

    def __len__(self) -> int:
        return len(self._flights)

    def clear(self) -> None:
        """What is on its way does not count any more."""
        self._flights.clear()
        self.in_flight = 0

    def restart(self) -> None:
        """A new session: numbers begin again."""
        self.clear()
        self.number = 0

    def add(self, now_ns: int, n_bytes: int, carried: list[Carried]) -> None:
        """The packet that has just been numbered leaves."""
        self._flights[self.number] = Flight(now_ns, n_bytes, carried)
        self.in_flight += 1

    def window_open(self, packets: int) -> bool:
        """Whether another packet may leave: few are on their way, and the first can still be acknowledged."""
        if self.in_flight >= packets:
            return False
        oldest = next((n for n, f in self._flights.items() if not f.lost), None)
        return oldest is None or self.number + 1 - oldest <= MASK_BITS

    def acknowledge(self, last: int, missing: int, arrived: Callable[[Key, int, int, int], None]) -> tuple[int, int]:
        """The peer has packet `last`, and those of the 64 before it whose bit in `missing` is not set.

        Of the packets that were waited for and are told of first now, returns when the oldest was sent, so that a
        round trip is not taken for shorter than it is, and the number of the newest; (0, 0) where there are none.
        """
        if last > self.number:
            return 0, 0
        oldest_ns = newest = 0
        for number in list(self._flights):
            behind = last - number
            if behind < 0:
                break
            if behind > MASK_BITS or (behind and missing >> (behind - 1) & 1):
                continue
            flight = self._flights.pop(number)
            self.acked_bytes += flight.n_bytes
            if not flight.lost:
                self.in_flight -= 1
                if not newest:
                    oldest_ns = flight.sent_ns
                newest = number
            for carried in flight.carried:
                arrived(*carried)
        return oldest_ns, newest

    def give_up(self, sent_ns: int, before: int = 1 << 62) -> list[Flight]:
        """Packets sent before a time, numbered below `before`, are taken for lost; those that were not yet."""
        late = []
        for number, flight in self._flights.items():
            if number >= before or flight.sent_ns >= sent_ns:
                break
            if not flight.lost:
                late.append(flight)
        for flight in late:
            flight.lost = True
        self.lost += len(late)
        self.in_flight -= len(late)
        if late:
            old = [n for n, f in self._flights.items() if f.lost]
            for n in old[: max(0, len(old) - _MAX_LATE)]:
                del self._flights[n]
        return late
