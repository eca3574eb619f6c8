"""A model of a thin link: rate, queue, delay, jitter, loss, bursts, duplicates, reordering. Pure and seeded.

Burst losses follow Gilbert's two-state chain (Bell System Technical Journal 39, 1960): a good state with independent
loss, and a bad one, entered at random, in which all packets are lost.
"""

import heapq
import random
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields


@dataclass(frozen=True, slots=True)
class LinkModelConfig:
    """Properties of one direction of a link. The default is a perfect link."""

    rate_bytes_s: int = 0  # B/s on the wire; 0: unlimited
    overhead_bytes: int = 0  # B that the carrier adds to each packet
    queue_bytes: int = 65536  # B that may wait to be sent; a packet that does not fit is dropped
    delay_ns: int = 0  # ns from the last byte sent to arrival
    jitter_ns: int = 0  # ns; maximum of an additional uniform delay; order is kept
    loss: float = 0.0  # probability that a packet is lost
    burst: float = 0.0  # probability per packet that a burst of losses begins
    burst_packets: float = 8.0  # mean length of a burst
    duplicate: float = 0.0  # probability that a packet arrives twice
    reorder: float = 0.0  # probability that a packet is delayed so that later ones overtake it
    reorder_ns: int = 50_000_000  # ns; maximum of that delay, uniform
    turn_ns: int = 0  # ns; half-duplex: the directions alternate in turns of this length; 0: full duplex
    turn: int = 0  # this direction has the first (0) or the second (1) of two turns
    outages: tuple[tuple[int, int], ...] = ()  # begin, end in ns: packets sent in between are lost

    def __post_init__(self) -> None:
        for field in fields(self):
            if field.name == "outages":
                continue
            value = getattr(self, field.name)
            if field.name in ("loss", "burst", "duplicate", "reorder"):
                if not 0.0 <= value <= 1.0:
                    raise ValueError(f"link model: {field.name} is a chance, found {value}, expected 0 to 1")
            elif not value >= (1.0 if field.name == "burst_packets" else 0):
                raise ValueError(f"link model: {field.name} = {value} is too small")


@dataclass(slots=True)
class LinkModelStats:
    """Packet counts. sent = delivered + lost + overflowed + in transit - duplicated."""

    sent: int = 0
    lost: int = 0
    overflowed: int = 0
    duplicated: int = 0
    delivered: int = 0
    wire_bytes: int = 0


class LinkModel:
    """One direction of a link. Equal configuration, seed and calls give equal deliveries. Times must not decrease.

    Every packet uses the same number of random draws, so that changing one property does not change the effect of the
    others.
    """

    def __init__(self, config: LinkModelConfig, seed: int) -> None:
        self.config = config
        self.stats = LinkModelStats()
        self._random = random.Random(seed)
        self._in_burst = False
        self._wire_free_ns = 0
        self._waiting: deque[tuple[int, int]] = deque()  # (ns at which it is sent, bytes) of each queued packet
        self._waiting_bytes = 0
        self._last_arrival_ns = 0
        self._order = 0
        self._in_transit: list[tuple[int, int, bytes]] = []  # heap of (arrival ns, order, packet)

    def send(self, packet: bytes, now_ns: int) -> bool:
        """Send a packet; False if the queue is full."""
        c = self.config
        self.stats.sent += 1
        draw = [self._random.random() for _ in range(7)]
        size = len(packet) + c.overhead_bytes
        while self._waiting and self._waiting[0][0] <= now_ns:
            self._waiting_bytes -= self._waiting.popleft()[1]
        if c.rate_bytes_s and self._waiting_bytes and self._waiting_bytes + size > c.queue_bytes:
            self.stats.overflowed += 1
            return False
        takes_ns = -(-size * 1_000_000_000 // c.rate_bytes_s) if c.rate_bytes_s else 0
        self._wire_free_ns = self._end_of_sending(max(now_ns, self._wire_free_ns), takes_ns)
        self._waiting.append((self._wire_free_ns, size))
        self._waiting_bytes += size
        self.stats.wire_bytes += size
        if self._in_burst:
            self._in_burst = draw[0] >= 1.0 / c.burst_packets
        else:
            self._in_burst = draw[0] < c.burst
        out = any(begin_ns <= now_ns < end_ns for begin_ns, end_ns in c.outages)
        if out or self._in_burst or draw[1] < c.loss:
            self.stats.lost += 1
            return True
        arrival_ns = self._wire_free_ns + c.delay_ns + int(draw[2] * c.jitter_ns)
        if draw[3] < c.reorder:
            self._schedule(arrival_ns + int(draw[4] * c.reorder_ns), packet)
        else:
            self._last_arrival_ns = arrival_ns = max(arrival_ns, self._last_arrival_ns)
            self._schedule(arrival_ns, packet)
        if draw[5] < c.duplicate:
            self.stats.duplicated += 1
            self._schedule(arrival_ns + int(draw[6] * c.reorder_ns), packet)
        return True

    def _end_of_sending(self, begins_ns: int, takes_ns: int) -> int:
        """The end of a transmission that begins at begins_ns and runs only in this direction's turns."""
        turn_ns = self.config.turn_ns
        if not turn_ns:
            return begins_ns + takes_ns
        at_ns = begins_ns
        while True:
            into_ns = (at_ns - self.config.turn * turn_ns) % (2 * turn_ns)
            if into_ns >= turn_ns:
                at_ns += 2 * turn_ns - into_ns
                continue
            used_ns = min(takes_ns, turn_ns - into_ns)
            takes_ns -= used_ns
            at_ns += used_ns
            if not takes_ns:
                return at_ns

    def _schedule(self, arrival_ns: int, packet: bytes) -> None:
        self._order += 1
        heapq.heappush(self._in_transit, (arrival_ns, self._order, packet))

    def deliver(self, now_ns: int) -> list[bytes]:
        """The packets that have arrived since the last call, in order of arrival."""
        packets = []
        while self._in_transit and self._in_transit[0][0] <= now_ns:
            packets.append(heapq.heappop(self._in_transit)[2])
        self.stats.delivered += len(packets)
        return packets

    def next_ns(self) -> int | None:
        """Arrival time of the next packet, or None if none is in transit."""
        return self._in_transit[0][0] if self._in_transit else None


def link_seed(flight: int, agent: int, *, up: bool) -> int:
    """Seed of one direction of an agent's link: no two agents, directions or flights (below 2^26) share one."""
    return flight * 64 + (0 if up else 32) + agent % 32 + (agent // 32 << 32)


class LinkModels:
    """One direction of the links to any number of receivers, each created at its first packet."""

    def __init__(self, config: LinkModelConfig, seed_of: Callable[[int], int]) -> None:
        """seed_of: the seed of the link to a receiver."""
        self._config = config
        self._seed_of = seed_of
        self._links: dict[int, LinkModel] = {}

    def send(self, to: int, packets: Iterable[bytes], now_ns: int) -> None:
        """Send packets to a receiver."""
        for packet in packets:
            if to not in self._links:
                self._links[to] = LinkModel(self._config, self._seed_of(to))
            self._links[to].send(packet, now_ns)

    def deliver(self, now_ns: int) -> dict[int, tuple[bytes, ...]]:
        """The packets that have arrived since the last call, by receiver."""
        return {to: tuple(link.deliver(now_ns)) for to, link in sorted(self._links.items())}
