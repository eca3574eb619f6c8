"""Random histories of a vehicle's starts on modelled disks: no id and no nonce may come twice.

A disk forgets at a power cut what was not synchronised, in any part. Cards are lost and cloned, processes killed at any
operation, clocks set back, and bases ask for later sessions.
"""

import contextlib
import random
from collections.abc import Iterator
from dataclasses import dataclass, field

from kiteline_bench.harness.bars import Bar, Bench, at_most, is_true
from kiteline_codec.sync.resumption import agent_session, later_session, order_of
from kiteline_codec.transport.seal import Direction, Sealer, Suite
from kiteline_core.ids import submap_id
from kiteline_hw.system.start_numbers import StartNumbers

_HISTORIES = 10_000
_EVENTS = 12  # of a history
_SESSIONS_S = 10  # s of clock in a unit of a base's session


class Killed(Exception):
    """The process ended in the midst of an operation."""


@dataclass
class _File:
    content: bytes = b""  # as processes see it
    kept: bytes = b""  # on the disk


@dataclass
class ModelledFolder:
    """A folder whose disk keeps what was synchronised, and of the rest any part.

    unsynced: a planted bug, nothing waits for the disk. kill_in: operations until the process ends; None: never.
    """

    draw: random.Random
    unsynced: bool = False
    kill_in: int | None = None
    _names: dict[str, _File] = field(default_factory=dict)
    _kept_names: dict[str, _File] = field(default_factory=dict)

    def _operation(self) -> None:
        if self.kill_in is not None:
            self.kill_in -= 1
            if self.kill_in < 0:
                raise Killed

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """No other process is there."""
        yield

    def read(self, name: str) -> bytes | None:
        """As processes see it."""
        self._operation()
        return self._names[name].content if name in self._names else None

    def write(self, name: str, offset: int, data: bytes) -> None:
        """Not on the disk yet."""
        file = self._names.setdefault(name, _File())
        file.content = file.content[:offset].ljust(offset, b"\0") + data + file.content[offset + len(data) :]
        self._operation()

    def sync(self, name: str) -> None:
        """Content on the disk."""
        self._operation()
        if not self.unsynced:
            self._names[name].kept = self._names[name].content

    def rename(self, old: str, new: str) -> None:
        """Not on the disk yet."""
        self._names[new] = self._names.pop(old)
        self._operation()

    def sync_names(self) -> None:
        """Names on the disk."""
        self._operation()
        if not self.unsynced:
            self._kept_names = dict(self._names)

    def cut_power(self) -> None:
        """Whatever the disk has kept: of each file the old or the new content, or a torn one; old or new names."""
        if self.draw.random() < 0.5:
            self._names = dict(self._kept_names)
        for file in self._names.values():
            torn = self.draw.randrange(len(file.content) + 1)
            mixed = file.content[:torn] + file.kept[torn:]
            file.content = file.kept = self.draw.choice((file.kept, file.content, mixed))
        self._kept_names = dict(self._names)

    def copy(self) -> "ModelledFolder":
        """Another card with the same content."""
        names = {name: _File(file.content, file.kept) for name, file in self._names.items()}
        return ModelledFolder(self.draw, self.unsynced, None, names, dict(names))


@dataclass
class History:
    """One history. forgets_sync, ignores_machine: planted bugs. twice: ids and nonces that came twice."""

    seed: int
    forgets_sync: bool = False
    ignores_machine: bool = False
    starts: int = 0
    twice: list[str] = field(default_factory=list)

    def run(self, events: int = _EVENTS) -> None:
        """Let it happen."""
        draw = random.Random(self.seed)
        cards = [("machine0", self._card(draw))]
        self._used: set[object] = set()
        known = clock_s = 0
        for _ in range(events):
            k = draw.randrange(len(cards))
            machine, folders = cards[k]
            what = draw.choice(("start",) * 5 + ("cut",) * 3 + ("kill", "kill", "lose", "clone", "base", "clock"))
            if what == "lose":
                cards[k] = machine, self._card(draw)
            elif what == "clone" and len(cards) < 4:
                cards.append((f"machine{len(cards)}", (folders[0].copy(), folders[1].copy())))
            elif what == "cut":
                for folder in folders:
                    folder.cut_power()
            elif what == "clock":
                clock_s = draw.randrange(100_000)
            else:
                clock_s += draw.randrange(1000)
                identity = "any" if self.ignores_machine else machine
                for folder in folders:
                    folder.kill_in = draw.randrange(8) if what == "kill" else None
                with contextlib.suppress(Killed):
                    known = self._start_agent(folders[0], identity, draw, known if what == "base" else 0)
                with contextlib.suppress(Killed):
                    self._start_base(folders[1], identity, draw, clock_s)
                for folder in folders:
                    folder.kill_in = None

    def _card(self, draw: random.Random) -> tuple[ModelledFolder, ModelledFolder]:
        """Empty folders of an agent and of a base."""
        return ModelledFolder(draw, self.forgets_sync), ModelledFolder(draw, self.forgets_sync)

    def _start_agent(self, folder: ModelledFolder, machine: str, draw: random.Random, known: int) -> int:
        """One start of an agent. known: session that its base knows. Returns its session in the end."""
        numbers = StartNumbers(folder, machine, draw.randrange)
        start = numbers.next()
        self.starts += 1
        planted = self.forgets_sync or self.ignores_machine  # to be seen without what is drawn beside the boot
        first = 0 if planted else start.submap
        for k in range(draw.randrange(1, 4)):  # submaps of this start
            self._use("id of a submap", submap_id(3, start.boot, first + k))
        session = agent_session(start.order, start.boot)
        sealer = Sealer(bytes(32), 3, session, Direction.UP, Suite.ENCRYPTED, draw.randbytes)
        self._use("nonce", sealer.seal(b"")[:-16])
        if known > session:
            session = later_session(session, known)
            sealer.raise_to(session)
            self._use("nonce", sealer.seal(b"")[:-16])
            numbers.raise_to(order_of(session))
        return session

    def _start_base(self, folder: ModelledFolder, machine: str, draw: random.Random, clock_s: int) -> None:
        least = max(1, clock_s // _SESSIONS_S << 16 | draw.randrange(1 << 16))
        self._use("session of a base", ("base", StartNumbers(folder, machine, draw.randrange).next(least).order))

    def _use(self, what: str, value: object) -> None:
        if value in self._used:
            self.twice.append(f"history {self.seed}: {what} {value!r}")
        self._used.add(value)


def found_twice(histories: int, forgets_sync: bool = False, ignores_machine: bool = False) -> tuple[list[str], int]:
    """What came twice in so many histories, and how many starts there were."""
    twice, starts = list[str](), 0
    for seed in range(histories):
        history = History(seed, forgets_sync, ignores_machine)
        history.run()
        twice += history.twice
        starts += history.starts
    return twice, starts


def run(bench: Bench) -> list[Bar]:
    """All histories, and some with a planted bug."""
    histories = bench.starts * 100 or _HISTORIES
    twice, starts = found_twice(histories)
    for line in twice[:20]:
        bench.say(line)
    bench.more.append(f"{histories} histories with {starts} starts, of up to three submaps each.")
    some = histories // 20
    bugs = [len(found_twice(some, forgets_sync=True)[0]), len(found_twice(some, ignores_machine=True)[0])]
    return [
        at_most("ids and nonces that came twice", len(twice), 0, "", 0),
        is_true("planted: numbers are not synchronised; a cloned card is not noticed", "both caught", min(bugs) > 0,
                f"{bugs[0]} and {bugs[1]} times"),
    ]  # fmt: skip
