"""Random and mutated inputs for every reader of outside bytes: packets, seals, questions, stores and files.

Only the rooms' own errors may come of them, none may take long, and memory must not grow. `--inputs` sets how many.
"""

import contextlib
import json
import os
import random
import resource
import shutil
import time
import traceback
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from zlib import crc32

from kiteline_basestation.runtime.warm import warm
from kiteline_bench.harness.bars import Bar, Bench, at_most
from kiteline_bench.trust.fuzz_targets import ERRORS, FuzzTarget, fuzz_targets
from kiteline_bench.trust.keyed_sender import KeyedSender
from kiteline_codec import warm as codec_warm
from kiteline_codec.residuals.residual_coding import ResidualCoder
from kiteline_codec.schema import RECORD_TYPES, Key, messages
from kiteline_codec.schema.record import FIRST_BASE_KIND
from kiteline_codec.sync.config import SyncConfig
from kiteline_codec.sync.endpoint import Endpoint
from kiteline_codec.transport.framing import Deframer, frame
from kiteline_codec.transport.packet import parse
from kiteline_codec.transport.seal import Direction, Opener, Sealer, Suite
from kiteline_hw.durable_files import write_atomically
from kiteline_hw.ports import SourceError

TITLE = "Fuzzing"
INPUTS = 200_000  # some minutes
ROUND = 100_000  # inputs after which the targets begin anew; rounds run on all cores, and a run that is stopped goes on
_TESTS = Path(__file__).resolve().parents[3] / "tests" / "codec"

# Inputs of a target for each one of a target that opens files, which takes a millisecond: about the same time each.
TURNS = {"record": 16, "packet": 16, "endpoint": 16, "residual": 16, "stream": 16, "saved map": 8, "sealed": 4,
         "question": 4, "depth image": 4, "image": 4, "rig": 4, "keyed": 2}  # fmt: skip

_MAX_BYTES = 1400  # of an input
_MAX_FILE_BYTES = 1 << 16
_MOST_FAILURES = 20
_FIRST = 30  # inputs of each target before memory is measured
_KEY = bytes(32)
_KINDS = tuple(sorted(RECORD_TYPES))

Target = Callable[[bytes, random.Random], object]


@dataclass(slots=True)
class FuzzResult:
    """Outcome of a run. failures: a line for each input that raised anything but an error of its room, with its bytes.
    slowest_s: of CPU. grown_mib: over the memory after the first inputs of each target.
    """

    inputs: int
    accepted: int
    refused: int
    failures: list[str]
    slowest_s: float
    grown_mib: float
    slowest: str = ""  # the target of the slowest input


def read_corpus(folder: Path) -> list[bytes]:
    """The inputs in the .bin files of a folder, in order of name."""
    return [path.read_bytes() for path in sorted(folder.glob("*.bin"))]


class Targets:
    """The decoders under test, with the state of a long-running process."""

    def __init__(self, values: Sequence[tuple[Key, bytes]]) -> None:
        self.accepted = 0
        self._held = {key: (i + 1, code) for i, (key, code) in enumerate(values)}
        self._coder = ResidualCoder()
        self._keyed = KeyedSender([(key, code) for key, code in values if key.kind < FIRST_BASE_KIND])
        self._taken = 0
        self._renew()

    def _renew(self) -> None:
        config = SyncConfig(max_inbox_bytes=1 << 20, max_assembly_bytes=1 << 20)
        self._endpoint = Endpoint(config, 5, coder=ResidualCoder())
        self._deframer = Deframer(2000)
        self._opener = Opener({3: _KEY}, Direction.UP)
        self._age = 0

    def all(self) -> tuple[Target, ...]:
        """All decoders; each takes bytes and raises WireError or nothing."""
        return (self.record, self.packet, self.endpoint, self.residual, self.stream, self.sealed, self.keyed)

    def record(self, data: bytes, draw: random.Random) -> None:
        """A code under a key."""
        key = Key(draw.choice(_KINDS), draw.choice((0, 3, 1 << 30, 1 << 51, -1)), draw.choice((0, 0, 1, 300)))
        record = messages.decode(key, data)
        messages.encode(record)
        self.accepted += 1

    def packet(self, data: bytes, draw: random.Random) -> None:
        """A packet whose checksum is right."""
        parse(data + crc32(data).to_bytes(4, "little"), 1 << 20)
        self.accepted += 1

    def endpoint(self, data: bytes, draw: random.Random) -> None:
        """The same, given to an endpoint that keeps its state."""
        self._age += 1
        if self._age > 2000:
            self._renew()
        now_ns = self._age * 1_000_000
        refused = self._endpoint.stats.rejected if self._age % 64 == 0 else -1
        self._endpoint.receive(data + crc32(data).to_bytes(4, "little"), now_ns)
        if draw.random() < 0.02:
            self._endpoint.poll(now_ns)
        if refused == self._endpoint.stats.rejected:
            self.accepted += 1

    def residual(self, data: bytes, draw: random.Random) -> None:
        """A residual code, whatever its checksum."""
        key = draw.choice([k for k in self._held if k.kind in (4, 5)] or [Key(4, 1)])
        if draw.random() < 0.2:
            key = Key(17, key.id)
        self._coder.expand(key, data, self._held.get)
        self.accepted += 1

    def stream(self, data: bytes, draw: random.Random) -> None:
        """Bytes on a serial line."""
        for body in self._deframer.feed(frame(data) if draw.random() < 0.1 else data):
            self.accepted += 1
            parse(body, 1 << 20)

    def sealed(self, data: bytes, draw: random.Random) -> None:
        """A sealed packet."""
        if self._opener.open(data) is not None:
            self.accepted += 1

    def keyed(self, data: bytes, draw: random.Random) -> None:
        """A packet of an agent with a sound key, taken in by a station."""
        before, self._taken = self._taken, self._keyed.send(data, draw)
        self.accepted += self._taken > before


def mutate(data: bytes, draw: random.Random, most_bytes: int = _MAX_BYTES) -> bytes:
    """Valid bytes changed in a few places: flipped, cut, inserted, removed, repeated."""
    out = bytearray(data)
    for _ in range(draw.choice((1, 1, 2, 3, 8))):
        what = draw.randrange(7)
        at = draw.randrange(len(out) + 1)
        if what == 0 and out:
            out[at % len(out)] ^= 1 << draw.randrange(8)
        elif what == 1 and out:
            out[at % len(out)] = draw.choice((0, 1, 127, 128, 255, draw.randrange(256)))
        elif what == 2:
            del out[at:]
        elif what == 3:
            out[at:at] = draw.randbytes(draw.randrange(1, 9))
        elif what == 4:
            del out[at : at + draw.randrange(1, 9)]
        elif what == 5:
            out[at:at] = out[: draw.randrange(1, 40)]
        else:
            out[at:at] = b"\xff" * draw.randrange(1, 11)
    return bytes(out[:most_bytes])


def fuzz(
    corpus: Sequence[bytes], values: Sequence[tuple[Key, bytes]], inputs: int, seed: int,
    others: Sequence[FuzzTarget] = (), turns: Mapping[str, int] | None = None,
) -> FuzzResult:  # fmt: skip
    """Feed inputs drawn from a corpus to each decoder in turn, and to the other targets mutations of their samples.

    turns: inputs of a target, by name, in each round of all; 1 for those that are not named.
    """
    draw = random.Random(seed)
    targets = Targets(values)
    todo: list[tuple[str, Target, Sequence[bytes], int]] = [
        (target.__name__, target, corpus, _MAX_BYTES) for target in targets.all()
    ]
    todo += [(target.name, target.take, target.samples, _MAX_FILE_BYTES) for target in others]
    sealer = Sealer(_KEY, 3, 1, Direction.UP, Suite.TAGGED)

    names = [name for name, *_ in todo]
    order = [n for n, name in enumerate(names) for _ in range((turns or {}).get(name, 1))]
    if turns:
        random.Random(len(order)).shuffle(order)  # so that a run that is cut short has fed all

    def one(n: int) -> tuple[str, str, bytes]:
        name, target, samples, most_bytes = todo[n]
        kind = draw.random()
        data = (
            draw.randbytes(draw.randrange(80))
            if kind < 0.1 or not samples
            else mutate(draw.choice(samples), draw, most_bytes)
        )
        if name == "sealed" and kind > 0.5:
            data = mutate(sealer.seal(data[:64]), draw)
        return name, _one(target, data, draw), data

    with _quiet():
        for i in range(_FIRST * len(todo)):  # compile, load libraries
            one(i % len(todo))
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        targets.accepted = refused = 0
        failures: list[str] = []
        slowest, slowest_target = 0.0, ""
        for i in range(inputs):
            begin = time.thread_time()
            n = order[i % len(order)]
            name, outcome, data = one(n)
            took = time.thread_time() - begin
            if took > slowest:
                slowest, slowest_target = took, name
            if outcome == "refused":
                refused += 1
            elif outcome:
                failures.append(f"{name}: {outcome}: {data[:400].hex()}")
                if len(failures) == _MOST_FAILURES:
                    break
            elif n >= len(todo) - len(others):
                targets.accepted += 1
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    return FuzzResult(inputs, targets.accepted, refused, failures, slowest, grown, slowest_target)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Send what image libraries print to nowhere."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _one(target: Target, data: bytes, draw: random.Random) -> str:
    try:
        target(data, draw)
    except ERRORS:
        return "refused"
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__} at {Path(where.filename).name}:{where.lineno}: {error}"
    return ""


def joined(rounds: Collection[FuzzResult]) -> FuzzResult:
    """All rounds as one run."""
    slowest = max(rounds, key=lambda r: r.slowest_s, default=FuzzResult(0, 0, 0, [], 0.0, 0.0))
    return FuzzResult(
        sum(r.inputs for r in rounds), sum(r.accepted for r in rounds), sum(r.refused for r in rounds),
        [failure for r in rounds for failure in r.failures], slowest.slowest_s,
        max((r.grown_mib for r in rounds), default=0.0), slowest.slowest,
    )  # fmt: skip


def read_rounds(path: Path) -> dict[int, FuzzResult]:
    """The rounds that an earlier run has flown, by number; none where there is no such file. Raises SourceError."""
    try:
        kept = json.loads(path.read_text()) if path.exists() else {}
        return {int(number): FuzzResult(**found) for number, found in kept.items()}
    except (ValueError, TypeError, AttributeError) as error:
        raise SourceError(f"{path}: no rounds of a fuzzing run; delete it to begin anew") from error


class _Worker:
    """A process that fuzzes rounds, one after another."""

    def __init__(self, folder: Path) -> None:
        codec_warm.warm()  # a kernel that is compiled within a call would pass for a slow input
        warm()
        entries = json.loads((_TESTS / "golden" / "records.json").read_text())
        self._values = [(Key(*e["key"]), bytes.fromhex(e["code"])) for e in entries]
        self._corpus = read_corpus(_TESTS / "corpus")
        own = folder / str(os.getpid())
        own.mkdir()
        self._targets = fuzz_targets(own)
        self._grown_mib = 0.0

    def round(self, number: int, inputs: int) -> FuzzResult:
        """Fuzz all targets with the seed of this round. grown_mib: in all rounds of this process."""
        found = fuzz(self._corpus, self._values, inputs, seed=1 + number, others=self._targets, turns=TURNS)
        self._grown_mib += found.grown_mib
        return replace(found, grown_mib=self._grown_mib)


@cache
def _worker(folder: Path) -> _Worker:
    """The one of this process: its memory is watched over all of its rounds."""
    return _Worker(folder)


def _round(folder: Path, number: int, inputs: int) -> tuple[int, FuzzResult, float]:
    """Number and result of a round, and its CPU time in s."""
    worker, begin_s = _worker(folder), time.process_time()
    return number, worker.round(number, inputs), time.process_time() - begin_s


def run(bench: Bench) -> list[Bar]:
    """Feed all targets in turn, on all cores; the corpus of packets and codes is that of the tests. With `--keep DIR` a
    run that was stopped goes on where it was: rounds have seeds of their own.
    """
    if not _TESTS.is_dir():
        raise SourceError(f"no corpus in {_TESTS}: run this benchmark in a checkout of the sources")
    inputs, folder, state = bench.inputs or INPUTS, bench.folder / "fuzz", bench.folder / "fuzz.json"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    sizes = {n: min(ROUND, inputs - n * ROUND) for n in range(-(-inputs // ROUND))}
    rounds = {n: found for n, found in read_rounds(state).items() if sizes.get(n) == found.inputs}
    todo = [n for n in sizes if n not in rounds]
    flown, cpu_s = 0, 0.0
    bench.say(f"fuzz: {inputs:,} inputs in {len(sizes)} rounds, {len(rounds)} of them done before")
    with ProcessPoolExecutor(max(1, min(os.cpu_count() or 1, len(todo))), get_context("spawn")) as pool:
        for done in as_completed([pool.submit(_round, folder, n, sizes[n]) for n in todo]):
            number, found, took_s = done.result()
            rounds[number], flown, cpu_s = found, flown + found.inputs, cpu_s + took_s
            write_atomically(state, json.dumps({n: asdict(r) for n, r in rounds.items()}).encode())
            bench.say(f"fuzz: {sum(r.inputs for r in rounds.values()):,} of {inputs:,}")
            if len(joined(rounds.values()).failures) >= _MOST_FAILURES:
                pool.shutdown(wait=True, cancel_futures=True)
                break
    total = joined([rounds[n] for n in sorted(rounds)])
    for failure in total.failures:
        bench.say(failure)
    names = [target.__name__ for target in Targets([]).all()] + [target.name for target in fuzz_targets(folder)]
    turns = {name: TURNS.get(name, 1) for name in names}
    each = ", ".join(f"{name} {total.inputs * n // sum(turns.values()):,}" for name, n in sorted(turns.items()))
    rate = f" {flown / cpu_s:,.0f} a second of CPU." if cpu_s else ""
    bench.more.append(f"Inputs of each target, about: {each}.{rate}")
    return [
        at_most("inputs that were neither read nor refused", len(total.failures), 0, "", 0),
        at_most("memory of a process, grown", total.grown_mib, 64, "MiB", 1),
        at_most(f"slowest input ({total.slowest}), CPU", total.slowest_s * 1e3, 1000, "ms", 1),
        Bar("read and refused", f"{inputs:,} inputs",
            f"{total.inputs:,}: {total.accepted:,} read, {total.refused:,} refused", total.inputs >= inputs),
    ]  # fmt: skip
