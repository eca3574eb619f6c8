"""Cuts a log at any byte, and reads what is left."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kiteline_hw.logs.mcap_log import LogReader, LogWriter
from kiteline_hw.ports import SourceError

_SECOND_NS = 1_000_000_000
_RATE_HZ = 20.0  # steps a second


@dataclass(frozen=True, slots=True)
class WrittenLog:
    """A log, and what of it the operating system had when. head_bytes: of the file before the first message.

    flushed: (size of the file in bytes, messages in it) whenever it grew. late_s: longest flight time from a message to
    the flush that wrote it.
    """

    path: Path
    head_bytes: int
    flushed: tuple[tuple[int, int], ...]
    late_s: float


@dataclass(frozen=True, slots=True)
class Cuts:
    """What cuts came to. unreadable: behind the head, but no log. wrong: gave other messages than those written first.
    short: gave fewer than were flushed before the cut. more: messages of an unfinished chunk that were read, at most.
    """

    tried: int
    unreadable: int
    wrong: int
    short: int
    more: int


def write_log(path: Path, seconds: float, most_bytes: int) -> WrittenLog:
    """Write steps with packets of random sizes up to most_bytes."""
    random, flushed, waiting_ns, late_ns = np.random.default_rng(5), list[tuple[int, int]](), list[int](), 0
    with LogWriter(path, {"role": "agent"}) as log:
        for k in range(round(seconds * _RATE_HZ)):
            t_ns = round(k * _SECOND_NS / _RATE_HZ)
            log.json("/step", t_ns, {"k": k})
            late_ns = _note_flush(path, 2 * k + 1, t_ns, waiting_ns, flushed, late_ns)
            log.blob("/packets/out", t_ns, random.bytes(int(random.integers(1, most_bytes))))
            late_ns = _note_flush(path, 2 * k + 2, t_ns, waiting_ns, flushed, late_ns)
    whole = path.read_bytes()
    return WrittenLog(path, whole.index(b"kiteline.Json"), tuple(flushed), late_ns / _SECOND_NS)


def _note_flush(
    path: Path, count: int, t_ns: int, waiting_ns: list[int], flushed: list[tuple[int, int]], late_ns: int
) -> int:
    """Note the file's size if it grew; the longest time that a message waited."""
    waiting_ns.append(t_ns)
    late_ns = max(late_ns, t_ns - waiting_ns[0])
    size = path.stat().st_size
    if size > (flushed[-1][0] if flushed else 0):
        flushed.append((size, count))
        waiting_ns.clear()
    return late_ns


def try_cuts(log: WrittenLog, scratch: Path, cuts: Sequence[int]) -> Cuts:
    """Read the log cut after each of these numbers of bytes."""
    whole = log.path.read_bytes()
    with LogReader(log.path) as reader:
        written = [(m.topic, m.t_ns, m.data) for m in reader.messages()]
    sizes = np.array([size for size, _ in log.flushed])
    counts = [0, *(count for _, count in log.flushed)]
    file = scratch / "cut.mcap"
    unreadable = wrong = short = more = 0
    for cut in cuts:
        file.write_bytes(whole[:cut])
        due = counts[int(np.searchsorted(sizes, cut, side="right"))]
        try:
            with LogReader(file) as reader:
                read = [(m.topic, m.t_ns, m.data) for m in reader.messages()]
        except SourceError:
            unreadable += cut >= log.head_bytes
            short += due > 0
            continue
        wrong += read != written[: len(read)]
        short += len(read) < due
        more = max(more, len(read) - due)
    return Cuts(len(cuts), unreadable, wrong, short, more)
