"""Ten million random and mutated inputs for everything that reads bytes from a link."""

from __future__ import annotations

import json
from pathlib import Path

from kiteline_bench.benchmark import Bar, Bench, at_most
from kiteline_bench.link.fuzz import fuzz, read_corpus
from kiteline_codec.schema import Key
from kiteline_hw.ports import SourceError

TITLE = "Fuzzing"
INPUTS = 10_000_000
_TESTS = Path(__file__).resolve().parents[2] / "tests" / "codec"


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
        at_most("inputs that did anything but be read or refused", len(found.failures), 0, "", 0),
        at_most("memory grown", found.grown_mib, 64, "MiB", 1),
        at_most("slowest input", found.slowest_s * 1e3, 1000, "ms", 1),
        Bar("read and refused", f"{INPUTS:,} inputs", f"{found.accepted:,} read, {found.refused:,} refused", True),
    ]
