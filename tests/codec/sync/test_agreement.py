"""Two endpoints under any sequence of writes, faults and restarts: what one wrote is what the other holds.

That the machine would notice a defect is tested too: with each of a few defects planted it must fail.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import Phase, seed, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from kiteline_codec.pacing.budget import SlidingBudget
from kiteline_codec.schema import Key
from kiteline_codec.sync.config import SyncConfig
from kiteline_codec.sync.endpoint import Endpoint
from kiteline_codec.sync.in_flight import SentPacket
from kiteline_codec.sync.inbox import Inbox, Update
from kiteline_codec.sync.outbox import Outbox
from kiteline_codec.sync.round_trip import RoundTrip
from kiteline_codec.transport.packet import Item
from kiteline_codec.transport.sequence_window import SequenceWindow
from tests.codec.sync.spill_memory import Memory

MS = 1_000_000
CONFIG = SyncConfig(packet_bytes=160, overhead_bytes=10, budget_bytes=1500, window_packets=16, ack_packets=4)
END = st.integers(0, 1)
KEY = st.builds(Key, st.sampled_from([2, 22]), st.integers(0, 1), st.integers(0, 1))
LENGTH = st.sampled_from([0, 1, 10, 60, 300])


class TwoEnds(RuleBasedStateMachine):
    """`held[i]` is what end i has put since its start, `history[i]` the order in which it put each (key, code)."""

    def __init__(self) -> None:
        super().__init__()
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

    @initialize(greeted=st.booleans())
    def greet(self, greeted: bool) -> None:
        if greeted:
            self.settle()

    @rule(end=END, values=st.lists(st.tuples(KEY, LENGTH), min_size=1, max_size=4), ms=st.sampled_from([None, 0, 120]))
    def put(self, end: int, values: list[tuple[Key, int]], ms: int | None) -> None:
        for key, length in values:
            key = self.key(key)
            self.writes += 1
            code = self.writes.to_bytes(3, "big") + bytes(length)
            self.history[end][code] = self.writes
            self.held[end][key] = code
            self.ends[end].put(key, code)
            if ms is not None:
                self.send(ms)

    @precondition(lambda self: self.held[0] or self.held[1])
    @rule(data=st.data(), ms=st.sampled_from([None, 0, 120]))
    def remove(self, data: st.DataObject, ms: int | None) -> None:
        end, key = data.draw(st.sampled_from([(i, key) for i in (0, 1) for key in sorted(self.held[i])]))
        del self.held[end][key]
        self.ends[end].remove(key)
        if ms is not None:
            self.send(ms)

    @rule(ms=st.sampled_from([0, 20, 100, 150, 700, 3000]))
    def send(self, ms: int) -> None:
        self.now_ns += ms * MS
        for i, end in enumerate(self.ends):
            while (packet := end.poll(self.now_ns)) is not None:
                self.wire.append((1 - i, packet))
                self.spent[i].append((self.now_ns, len(packet) + CONFIG.overhead_bytes))

    @precondition(lambda self: self.wire)
    @rule(data=st.data(), keep=st.booleans())
    def deliver(self, data: st.DataObject, keep: bool) -> None:
        """Any packet, early or late; kept, it will come again."""
        i = data.draw(st.integers(0, len(self.wire) - 1))
        to, packet = self.wire[i] if keep else self.wire.pop(i)
        self.arrive(to, packet)

    @rule(n=st.integers(1, 12))
    def deliver_in_order(self, n: int) -> None:
        for to, packet in self.wire[:n]:
            self.arrive(to, packet)
        del self.wire[:n]

    @precondition(lambda self: len(self.wire) > 1)
    @rule()
    def deliver_newest_first(self) -> None:
        wire, self.wire = self.wire, []
        for to, packet in reversed(wire):
            self.arrive(to, packet)

    @precondition(lambda self: len(self.wire) > 1)
    @rule(data=st.data())
    def shuffle(self, data: st.DataObject) -> None:
        self.wire = data.draw(st.permutations(self.wire[:8])) + self.wire[8:]

    @precondition(lambda self: self.wire)
    @rule(data=st.data())
    def lose(self, data: st.DataObject) -> None:
        del self.wire[data.draw(st.integers(0, len(self.wire) - 1))]

    @precondition(lambda self: self.wire)
    @rule(data=st.data())
    def corrupt(self, data: st.DataObject) -> None:
        to, packet = data.draw(st.sampled_from(self.wire))
        damaged = bytearray(packet)
        damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= data.draw(st.integers(1, 255))
        before = self.ends[to].stats.rejected
        assert self.ends[to].receive(bytes(damaged), self.now_ns) == []
        assert self.ends[to].stats.rejected == before + 1

    @rule(end=END, chance=st.integers(0, 3))
    def restart(self, end: int, chance: int) -> None:
        if chance:
            return
        self.ends[end] = self.begin(self.ends[end].session + 1)
        self.held[end] = {}
        self.history[end] = {}
        self.shown[end] = {}
        self.spent[end] = []

    @rule(chance=st.integers(0, 3))
    def settle_sometimes(self, chance: int) -> None:
        if not chance:
            self.settle()

    def settle(self) -> None:
        """With a good link both sides come to agree, late packets notwithstanding."""
        for _ in range(4000):
            if all(e.digest_equal for e in self.ends) and not self.wire:
                break
            self.deliver_in_order(1000)
            self.send(10)
        else:
            raise AssertionError(f"no agreement: {[e.stats for e in self.ends]}")
        a, b = self.ends
        assert a.digests == b.digests[::-1]
        for i, end in enumerate(self.ends):
            assert end.peer_values() == self.held[1 - i]
            assert {k: v for k, v in self.shown[i].items() if k not in end.earlier_values()} == self.held[1 - i]
            assert not end._in._removed
            assert end.stats.dirty == 0

    def arrive(self, to: int, packet: bytes) -> None:
        for update in self.ends[to].receive(packet, self.now_ns):
            if update.code is None:
                self.shown[to].pop(update.key, None)
            else:
                self.shown[to][update.key] = update.code

    @invariant()
    def values_are_whole_and_no_older_than_before(self) -> None:
        for i, end in enumerate(self.ends):
            history, last = self.history[1 - i], self.known[i]
            now = {}
            for key, code in end.peer_values().items():
                if code in history:  # else of a session that has ended unnoticed
                    now[key] = history[code]
                    assert now[key] >= last.get(key, 0)
            self.known[i] = now

    @invariant()
    def the_budget_holds(self) -> None:
        for spent in self.spent:
            if spent:
                end_ns = spent[-1][0]
                assert sum(n for t, n in spent if end_ns - t <= 1_000 * MS) <= CONFIG.budget_bytes

    def teardown(self) -> None:
        self.settle()
        for end in self.ends:
            assert end.stats.mismatches == 0


class FarApart(TwoEnds):
    """The same with the faults of radio: long delays, bursts, dead directions, turns, hours of silence."""

    @precondition(lambda self: self.wire)
    @rule(seconds=st.sampled_from([1, 5]))
    def delay(self, seconds: int) -> None:
        """What is on the wire arrives so much later, after all that follows it."""
        late, self.wire = self.wire, []
        for _ in range(seconds * 4):
            self.send(250)
            self.deliver_in_order(1000)
        for to, packet in late:
            self.arrive(to, packet)

    @rule(end=END, n=st.integers(1, 20))
    def one_way(self, end: int, n: int) -> None:
        """For a while nothing reaches one end: a burst, or a direction that is dead."""
        for _ in range(n):
            self.send(100)
            self.wire = [(to, packet) for to, packet in self.wire if to != end]
            self.deliver_in_order(1000)

    @rule(first=END, turns=st.integers(1, 6), overlap=st.booleans())
    def half_duplex(self, first: int, turns: int, overlap: bool) -> None:
        """The ends take turns; what is sent out of turn is lost, or waits."""
        for turn in range(turns):
            self.send(60)
            speaker = (first + turn) % 2
            for to, packet in self.wire:
                if to != speaker:
                    self.arrive(to, packet)
            self.wire = [(to, packet) for to, packet in self.wire if to == speaker and overlap]

    @rule(hours=st.sampled_from([1, 24]), heard=st.booleans())
    def silence(self, hours: int, heard: bool) -> None:
        """Nobody hears anybody for hours, while both go on trying now and then."""
        if not heard:
            self.wire = []
        for _ in range(3):
            self.send(hours * 1_200_000)
            self.wire = []


class OutOfMemory(TwoEnds):
    """The same with values of keyframes, of which only a few fit into memory."""

    def begin(self, session: int) -> Endpoint:
        return Endpoint(replace(CONFIG, resident_bytes=3000), session, spill=Memory())

    def key(self, key: Key) -> Key:
        return Key({2: 3, 22: 4}[key.kind], 3 * key.id + (self.writes % 3), key.part)

    @invariant()
    def memory_is_bounded(self) -> None:
        for end in self.ends:
            on_its_way = sum(1000 for f in end._out.packets._packets.values() for _ in f.carried)
            assert end.stats.resident_bytes <= 3000 + 16 * 1300 + on_its_way


class ManyCorrections(TwoEnds):
    """The same with what is said of keyframes, of which only a few fit into the inbox."""

    def begin(self, session: int) -> Endpoint:
        return Endpoint(replace(CONFIG, resident_inbox_bytes=1500), session, spill=Memory())

    def key(self, key: Key) -> Key:
        return Key({2: 16, 22: 17}[key.kind], 3 * key.id + (self.writes % 3), key.part)

    @invariant()
    def memory_is_bounded(self) -> None:
        for end in self.ends:
            newest = 4 * (350 + 300)  # of one keyframe
            assert end._in.resident_bytes <= 1500 + newest + 6 * 300 + 24 * 20


TwoEnds.TestCase.settings = settings(max_examples=300, stateful_step_count=40)
TestAgreement = TwoEnds.TestCase
OutOfMemory.TestCase.settings = settings(max_examples=150, stateful_step_count=40)
TestOutOfMemory = OutOfMemory.TestCase
ManyCorrections.TestCase.settings = settings(max_examples=100, stateful_step_count=40)
TestManyCorrections = ManyCorrections.TestCase
FarApart.TestCase.settings = settings(max_examples=150, stateful_step_count=30)
TestFarApart = FarApart.TestCase


def older_versions_win(monkeypatch: pytest.MonkeyPatch) -> None:
    apply = Inbox.apply

    def planted(self: Inbox, item: Item) -> Update | None:
        if item.whole and item.key in self._values:
            self._drop_value(item.key)
        return apply(self, item)

    monkeypatch.setattr(Inbox, "apply", planted)


def losses_are_not_repaired(monkeypatch: pytest.MonkeyPatch) -> None:
    def planted(self: Outbox, packet: SentPacket) -> None:
        return

    monkeypatch.setattr(Outbox, "_lose", planted)


def removals_are_forgotten_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    apply = Inbox.apply

    def planted(self: Inbox, item: Item) -> Update | None:
        update = apply(self, item)
        self._removed.clear()
        return update

    monkeypatch.setattr(Inbox, "apply", planted)


def acknowledgements_clear_newer_versions(monkeypatch: pytest.MonkeyPatch) -> None:
    arrived = Outbox._arrived

    def planted(self: Outbox, key: Key, version: int, start: int, stop: int) -> None:
        entry = self._entries.get(key)
        arrived(self, key, entry.version if entry is not None else version, start, stop)

    monkeypatch.setattr(Outbox, "_arrived", planted)


def a_restart_goes_unnoticed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Outbox, "restart", lambda self, gone: None)


def the_last_fragment_completes_a_value(monkeypatch: pytest.MonkeyPatch) -> None:
    assemble = Inbox._assemble

    def planted(self: Inbox, item: Item) -> bytes | None:
        data = assemble(self, item)
        part = self._assemblies.get(item.key)
        if data is None and part is not None and item.offset + len(item.data) == item.total:
            return bytes(part.data)
        return data

    monkeypatch.setattr(Inbox, "_assemble", planted)


def the_budget_forgets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SlidingBudget, "spend", lambda self, now_ns, n: None)


def silence_is_forever(monkeypatch: pytest.MonkeyPatch) -> None:
    rto = RoundTrip.timeout_ns.fget

    def planted(self: RoundTrip) -> int:
        return 1 << 62 if self.doublings >= 4 else int(rto(self))  # type: ignore[misc]

    monkeypatch.setattr(RoundTrip, "timeout_ns", property(planted))


def late_packets_count_as_new(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SequenceWindow, "is_new", lambda self, number: True)

    def planted(self: Inbox, item: Item) -> Update | None:
        self._values.pop(item.key, None) if item.whole and item.version > self.watermark else None
        return apply(self, item)

    apply = Inbox.apply
    monkeypatch.setattr(Inbox, "apply", planted)


DEFECTS: list[Callable[[pytest.MonkeyPatch], Any]] = [
    older_versions_win,
    losses_are_not_repaired,
    removals_are_forgotten_at_once,
    acknowledgements_clear_newer_versions,
    a_restart_goes_unnoticed,
    the_last_fragment_completes_a_value,
    the_budget_forgets,
]
# Seeds of hypothesis: with this one the rarest defect shows within 60 runs.
SEEDS = {removals_are_forgotten_at_once: 1}
FAR_DEFECTS: list[Callable[[pytest.MonkeyPatch], Any]] = [silence_is_forever, late_packets_count_as_new]


@pytest.mark.parametrize(
    ("plant", "machine"),
    [(d, TwoEnds) for d in DEFECTS] + [(d, FarApart) for d in FAR_DEFECTS],
    ids=lambda f: f.__name__,
)
def test_a_planted_defect_is_found(
    plant: Callable[[pytest.MonkeyPatch], Any], machine: type[TwoEnds], monkeypatch: pytest.MonkeyPatch
) -> None:
    plant(monkeypatch)
    quick = settings(
        max_examples=1500,
        stateful_step_count=40,
        phases=[Phase.generate],
        derandomize=plant not in SEEDS,
        database=None,
        deadline=None,
    )
    if plant in SEEDS:
        machine = seed(SEEDS[plant])(type(machine.__name__, (machine,), {}))
    with pytest.raises(AssertionError):  # a timeout of the test is none
        run_state_machine_as_test(machine, settings=quick)
