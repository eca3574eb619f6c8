"""Ten million random and mutated inputs for everything that reads bytes from a link: only WireError may come of it."""

from __future__ import annotations

import json
import random
import resource
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from zlib import crc32

from kiteline_bench.harness.bars import Bar, Bench, at_most
from kiteline_codec.residuals.residual_coding import ResidualCoder
from kiteline_codec.schema import RECORD_TYPES, Key, WireError, messages
from kiteline_codec.sync.config import SyncConfig
from kiteline_codec.sync.endpoint import Endpoint
from kiteline_codec.transport.framing import Deframer, frame
from kiteline_codec.transport.packet import parse
from kiteline_codec.transport.seal import Direction, Opener, Sealer, Suite
from kiteline_hw.ports import SourceError

TITLE = "Fuzzing"
INPUTS = 10_000_000
_TESTS = Path(__file__).resolve().parents[3] / "tests" / "codec"

_MAX_BYTES = 1400  # of an input
_SLOW_S = 0.25  # s of CPU that one input may take; a hang would take more
_KEY = bytes(32)
_KINDS = tuple(sorted(RECORD_TYPES))

Target = Callable[[bytes, random.Random], None]


@dataclass(slots=True)
class FuzzResult:
    """Outcome of a run. failures: a line for each input that raised anything but WireError, with its bytes in hex."""

    inputs: int
    accepted: int
    refused: int
    failures: list[str]
    slowest_s: float
    grown_mib: float


def read_corpus(folder: Path) -> list[bytes]:
    """The inputs in the .bin files of a folder, in order of name."""
    return [path.read_bytes() for path in sorted(folder.glob("*.bin"))]


class Targets:
    """The decoders under test, with the state of a long-running process."""

    def __init__(self, values: Sequence[tuple[Key, bytes]]) -> None:
        self.accepted = 0
        self._held = {key: (i + 1, code) for i, (key, code) in enumerate(values)}
        self._coder = ResidualCoder()
        self._renew()

    def _renew(self) -> None:
        config = SyncConfig(max_inbox_bytes=1 << 20, max_assembly_bytes=1 << 20)
        self._endpoint = Endpoint(config, 5, coder=ResidualCoder())
        self._deframer = Deframer(2000)
        self._opener = Opener({3: _KEY}, Direction.UP)
        self._age = 0

    def all(self) -> tuple[Target, ...]:
        """All decoders; each takes bytes and raises WireError or nothing."""
        return (self.record, self.packet, self.endpoint, self.residual, self.stream, self.sealed)

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


def mutate(data: bytes, draw: random.Random) -> bytes:
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
    return bytes(out[:_MAX_BYTES])


def fuzz(
    corpus: Sequence[bytes], values: Sequence[tuple[Key, bytes]], inputs: int, seed: int,
    say: Callable[[int], None] | None = None,
) -> FuzzResult:  # fmt: skip
    """Feed inputs drawn from a corpus to each decoder in turn."""
    draw = random.Random(seed)
    targets = Targets(values)
    todo = targets.all()
    for target in todo:  # compile
        for data in corpus[:20]:
            _one(target, data, draw)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    targets.accepted = refused = 0
    failures: list[str] = []
    slowest = 0.0
    sealer = Sealer(_KEY, 3, 1, Direction.UP, Suite.TAGGED)
    for i in range(inputs):
        kind = draw.random()
        data = draw.randbytes(draw.randrange(80)) if kind < 0.1 or not corpus else mutate(draw.choice(corpus), draw)
        target = todo[i % len(todo)]
        if target == targets.sealed and kind > 0.5:
            data = mutate(sealer.seal(data[:64]), draw)
        begin = time.thread_time()
        outcome = _one(target, data, draw)
        took = time.thread_time() - begin
        if took > slowest:
            slowest = took
        if outcome == "refused":
            refused += 1
        elif outcome:
            failures.append(f"{target.__name__}: {outcome}: {data.hex()}")
            if len(failures) == 20:
                break
        if say is not None and i % 100_000 == 0:
            say(i)
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    return FuzzResult(inputs, targets.accepted, refused, failures, slowest, grown)


def _one(target: Target, data: bytes, draw: random.Random) -> str:
    try:
        target(data, draw)
    except WireError:
        return "refused"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return ""


def run(bench: Bench) -> list[Bar]:
    """Feed all decoders in turn; the corpus is that of the tests."""
    if not _TESTS.is_dir():
        raise SourceError(f"no corpus in {_TESTS}: run this benchmark in a checkout of the sources")
    entries = json.loads((_TESTS / "golden" / "records.json").read_text())
    values = [(Key(*e["key"]), bytes.fromhex(e["code"])) for e in entries]
    found = fuzz(
        read_corpus(_TESTS / "corpus"), values, INPUTS, seed=1, say=lambda n: bench.say(f"fuzz: {n:,} of {INPUTS:,}")
    )
    for failure in found.failures:
        bench.say(failure)
    return [
        at_most("inputs that were neither read nor refused", len(found.failures), 0, "", 0),
        at_most("memory grown", found.grown_mib, 64, "MiB", 1),
        at_most("slowest input", found.slowest_s * 1e3, 1000, "ms", 1),
        Bar("read and refused", f"{INPUTS:,} inputs", f"{found.accepted:,} read, {found.refused:,} refused", True),
    ]
