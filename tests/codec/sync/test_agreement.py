"""Two endpoints under any sequence of writes, faults and restarts: what one wrote is what the other holds.

That the machine would notice a defect is tested too: with each of a few defects planted it must fail. Steps are
drawn by `random`: hypothesis took three quarters of the time for itself. A failure names the run that repeats it.
"""

from collections.abc import Callable
from random import Random
from typing import Any

import pytest

from kiteline_codec.pacing.budget import SlidingBudget
from kiteline_codec.schema import Key
from kiteline_codec.sync.in_flight import SentPacket
from kiteline_codec.sync.inbox import Inbox, Update
from kiteline_codec.sync.outbox import Outbox
from kiteline_codec.sync.round_trip import RoundTrip
from kiteline_codec.transport.packet import Item
from kiteline_codec.transport.sequence_window import SequenceWindow
from tests.codec.sync.two_ends import FarApart, ManyCorrections, OutOfMemory, TwoEnds

STEPS = 60  # at most in one run


def run(machine: type[TwoEnds], number: int) -> None:
    """One run; its number is its seed."""
    random = Random(number)
    ends = machine(random)
    if random.random() < 0.5:
        ends.settle()
    for _ in range(random.randint(1, STEPS)):
        random.choice(ends.steps())()
        ends.check()
    ends.finish()


def run_all(machine: type[TwoEnds], runs: int) -> None:
    for number in range(runs):
        try:
            run(machine, number)
        except BaseException as error:
            error.add_note(f"run({machine.__name__}, {number})")
            raise


RUNS = {TwoEnds: 300, OutOfMemory: 150, ManyCorrections: 100, FarApart: 150}


@pytest.mark.parametrize("machine", RUNS)
def test_both_ends_agree_whatever_happens(machine: type[TwoEnds]) -> None:
    run_all(machine, RUNS[machine])


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
    timeout: Any = RoundTrip.timeout_ns
    rto = timeout.fget

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
    with pytest.raises((AssertionError, ValueError)):  # a timeout of the test is none
        run_all(machine, RUNS[machine])
