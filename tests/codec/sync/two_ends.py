"""Two endpoints and the link between them, with faults, and what may be done to them."""

from collections.abc import Callable
from dataclasses import replace
from random import Random

from kiteline_codec.schema import Key
from kiteline_codec.sync.config import SyncConfig
from kiteline_codec.sync.endpoint import Endpoint
from tests.codec.sync.spill_memory import Memory

MS = 1_000_000
CONFIG = SyncConfig(packet_bytes=160, overhead_bytes=10, budget_bytes=1500, window_packets=16, ack_packets=4)
PAUSES_MS = (None, 0, 120)


class TwoEnds:
    """`held[i]` is what end i has put since its start, `history[i]` the order in which it put each (key, code)."""

    def __init__(self, random: Random) -> None:
        self.random = random
        self.now_ns = 0
        self.ends = [self.begin(1), self.begin(1)]
        self.held: list[dict[Key, bytes]] = [{}, {}]
        self.history: list[dict[bytes, int]] = [{}, {}]
        self.known: list[dict[Key, int]] = [{}, {}]  # place in the other end's history of what end i holds
        self.shown: list[dict[Key, bytes]] = [{}, {}]  # what the updates said
        self.wire: list[tuple[int, bytes]] = []
        self.spent: list[list[tuple[int, int]]] = [[], []]
        self.writes = 0

    def begin(self, session: int) -> Endpoint:
        return Endpoint(CONFIG, session)

    def key(self, key: Key) -> Key:
        return key

    def steps(self) -> list[Callable[[], None]]:
        """What may happen now; all is equally likely."""
        wire = [self.deliver, self.lose, self.corrupt] if self.wire else []
        several = [self.deliver_newest_first, self.shuffle] if len(self.wire) > 1 else []
        held = [self.remove] if self.held[0] or self.held[1] else []
        return [self.put, self.send, self.deliver_in_order, self.restart, self.settle_sometimes, *wire, *several, *held]

    def end(self) -> int:
        return self.random.randrange(2)

    def put(self) -> None:
        end, ms = self.end(), self.random.choice(PAUSES_MS)
        for _ in range(self.random.randint(1, 4)):
            key = self.key(Key(self.random.choice((2, 22)), self.random.randrange(2), self.random.randrange(2)))
            self.writes += 1
            code = self.writes.to_bytes(3, "big") + bytes(self.random.choice((0, 1, 10, 60, 300)))
            self.history[end][code] = self.writes
            self.held[end][key] = code
            self.ends[end].put(key, code)
            if ms is not None:
                self.pass_time(ms)

    def remove(self) -> None:
        end, key = self.random.choice([(i, key) for i in (0, 1) for key in sorted(self.held[i])])
        del self.held[end][key]
        self.ends[end].remove(key)
        if (ms := self.random.choice(PAUSES_MS)) is not None:
            self.pass_time(ms)

    def send(self) -> None:
        self.pass_time(self.random.choice((0, 20, 100, 150, 700, 3000)))

    def pass_time(self, ms: int) -> None:
        """Both ends send what they may send at the end of it."""
        self.now_ns += ms * MS
        for i, end in enumerate(self.ends):
            while (packet := end.poll(self.now_ns)) is not None:
                self.wire.append((1 - i, packet))
                self.spent[i].append((self.now_ns, len(packet) + CONFIG.overhead_bytes))

    def deliver(self) -> None:
        """Any packet, early or late; kept, it will come again."""
        i = self.random.randrange(len(self.wire))
        to, packet = self.wire[i] if self.random.random() < 0.5 else self.wire.pop(i)
        self.arrive(to, packet)

    def deliver_in_order(self) -> None:
        self.deliver_oldest(self.random.randint(1, 12))

    def deliver_oldest(self, n: int) -> None:
        for to, packet in self.wire[:n]:
            self.arrive(to, packet)
        del self.wire[:n]

    def deliver_newest_first(self) -> None:
        wire, self.wire = self.wire, []
        for to, packet in reversed(wire):
            self.arrive(to, packet)

    def shuffle(self) -> None:
        first = self.wire[:8]
        self.random.shuffle(first)
        self.wire[:8] = first

    def lose(self) -> None:
        del self.wire[self.random.randrange(len(self.wire))]

    def corrupt(self) -> None:
        to, packet = self.random.choice(self.wire)
        damaged = bytearray(packet)
        damaged[self.random.randrange(len(damaged))] ^= self.random.randint(1, 255)
        before = self.ends[to].stats.rejected
        assert self.ends[to].receive(bytes(damaged), self.now_ns) == []
        assert self.ends[to].stats.rejected == before + 1

    def restart(self) -> None:
        if self.random.randrange(4):
            return
        end = self.end()
        self.ends[end] = self.begin(self.ends[end].session + 1)
        self.held[end] = {}
        self.history[end] = {}
        self.shown[end] = {}
        self.spent[end] = []

    def settle_sometimes(self) -> None:
        if not self.random.randrange(4):
            self.settle()

    def settle(self) -> None:
        """With a good link both sides come to agree, late packets notwithstanding."""
        for _ in range(4000):
            if all(e.digest_equal for e in self.ends) and not self.wire:
                break
            self.deliver_oldest(1000)
            self.pass_time(10)
        else:
            raise AssertionError(f"no agreement: {[e.stats for e in self.ends]}")
        a, b = self.ends
        assert a.digests == b.digests[::-1]
        for i, end in enumerate(self.ends):
            assert end.peer_values() == self.held[1 - i]
            assert {k: v for k, v in self.shown[i].items() if k not in end.earlier_values()} == self.held[1 - i]
            assert not end.received.present._removed
            assert end.stats.dirty == 0

    def arrive(self, to: int, packet: bytes) -> None:
        for update in self.ends[to].receive(packet, self.now_ns):
            if update.code is None:
                self.shown[to].pop(update.key, None)
            else:
                self.shown[to][update.key] = update.code

    def check(self) -> None:
        """What holds after every step."""
        self.values_are_whole_and_no_older_than_before()
        self.the_budget_holds()

    def values_are_whole_and_no_older_than_before(self) -> None:
        for i, end in enumerate(self.ends):
            history, last = self.history[1 - i], self.known[i]
            now = {}
            for key, code in end.peer_values().items():
                if code in history:  # else of a session that has ended unnoticed
                    now[key] = history[code]
                    assert now[key] >= last.get(key, 0)
            self.known[i] = now

    def the_budget_holds(self) -> None:
        for spent in self.spent:
            if spent:
                end_ns = spent[-1][0]
                assert sum(n for t, n in spent if end_ns - t <= 1_000 * MS) <= CONFIG.budget_bytes

    def finish(self) -> None:
        self.settle()
        for end in self.ends:
            assert end.stats.mismatches == 0


class FarApart(TwoEnds):
    """The same with the faults of radio: long delays, bursts, dead directions, turns, hours of silence."""

    def steps(self) -> list[Callable[[], None]]:
        wire = [self.delay] if self.wire else []
        return [*super().steps(), self.one_way, self.half_duplex, self.silence, *wire]

    def delay(self) -> None:
        """What is on the wire arrives so much later, after all that follows it."""
        late, self.wire = self.wire, []
        for _ in range(self.random.choice((4, 20))):
            self.pass_time(250)
            self.deliver_oldest(1000)
        for to, packet in late:
            self.arrive(to, packet)

    def one_way(self) -> None:
        """For a while nothing reaches one end: a burst, or a direction that is dead."""
        end = self.end()
        for _ in range(self.random.randint(1, 20)):
            self.pass_time(100)
            self.wire = [(to, packet) for to, packet in self.wire if to != end]
            self.deliver_oldest(1000)

    def half_duplex(self) -> None:
        """The ends take turns; what is sent out of turn is lost, or waits."""
        first, overlap = self.end(), self.random.random() < 0.5
        for turn in range(self.random.randint(1, 6)):
            self.pass_time(60)
            speaker = (first + turn) % 2
            for to, packet in self.wire:
                if to != speaker:
                    self.arrive(to, packet)
            self.wire = [(to, packet) for to, packet in self.wire if to == speaker and overlap]

    def silence(self) -> None:
        """Nobody hears anybody for hours, while both go on trying now and then."""
        hours = self.random.choice((1, 24))
        if self.random.random() < 0.5:
            self.wire = []
        for _ in range(3):
            self.pass_time(hours * 1_200_000)
            self.wire = []


class OutOfMemory(TwoEnds):
    """The same with values of keyframes, of which only a few fit into memory."""

    def begin(self, session: int) -> Endpoint:
        return Endpoint(replace(CONFIG, resident_bytes=3000), session, spill=Memory())

    def key(self, key: Key) -> Key:
        return Key({2: 3, 22: 4}[key.kind], 3 * key.id + (self.writes % 3), key.part)

    def check(self) -> None:
        super().check()
        for end in self.ends:
            on_its_way = sum(1000 for f in end._out.packets._packets.values() for _ in f.carried)
            assert end.stats.resident_bytes <= 3000 + 16 * 1300 + on_its_way


class ManyCorrections(TwoEnds):
    """The same with what is said of keyframes, of which only a few fit into the inbox."""

    def begin(self, session: int) -> Endpoint:
        return Endpoint(replace(CONFIG, resident_inbox_bytes=1500), session, spill=Memory())

    def key(self, key: Key) -> Key:
        return Key({2: 16, 22: 17}[key.kind], 3 * key.id + (self.writes % 3), key.part)

    def check(self) -> None:
        super().check()
        for end in self.ends:
            newest = 4 * (350 + 300)  # of one keyframe
            assert end.received.present.resident_bytes <= 1500 + newest + 6 * 300 + 24 * 20
