"""A short run of the fuzzer over the kept corpus; `kiteline bench fuzz` makes a long one."""

import json
from pathlib import Path

import pytest

from kiteline_bench.trust import fuzz
from kiteline_bench.trust.fuzz_targets import FuzzTarget, fuzz_targets
from kiteline_codec.schema import Key, messages

HERE = Path(__file__).parent


def values() -> list[tuple[Key, bytes]]:
    entries = json.loads((HERE / "golden" / "records.json").read_text())
    return [(Key(*e["key"]), bytes.fromhex(e["code"])) for e in entries]


def test_nothing_but_refusals(tmp_path: Path) -> None:
    corpus = fuzz.read_corpus(HERE / "corpus")
    assert len(corpus) > 20
    found = fuzz.fuzz(corpus, values(), 5_000, seed=1, others=fuzz_targets(tmp_path))
    assert found.failures == []
    assert found.refused > 1_400
    assert found.accepted > 40
    assert found.slowest_s < 1.0
    assert found.grown_mib < 100


def test_it_would_find_a_crash(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(key: Key, code: bytes) -> None:
        raise IndexError("beyond the end")

    monkeypatch.setattr(messages, "decode", broken)
    found = fuzz.fuzz(fuzz.read_corpus(HERE / "corpus"), values(), 700, seed=1)
    assert len(found.failures) == 20
    assert "IndexError" in found.failures[0]


def test_targets_that_cost_less_are_fed_more_often() -> None:
    taken: list[str] = []

    def target(name: str) -> FuzzTarget:
        return FuzzTarget(name, lambda data, draw: taken.append(name), (b"1",))

    others = [target("slow"), target("fast")]
    fuzz.fuzz([b"1"], values(), 2 * (7 + 1 + 4), seed=1, others=others, turns={"fast": 4})
    assert (taken.count("slow"), taken.count("fast")) == (30 + 2, 30 + 8)  # 30 before memory is measured
