"""The table of stages: every stage is there to be timed, and own times add up to the whole."""

from __future__ import annotations

import time

from kiteline_bench.agent.stages import STAGES, Clocks, table


def spin(ms: float) -> None:
    end_ns = time.thread_time_ns() + round(ms * 1e6)
    while time.thread_time_ns() < end_ns:
        pass


def test_own_time_is_without_that_of_stages_inside() -> None:
    clocks = Clocks()
    inner = clocks.timed(lambda: spin(4.0), "inner")

    def whole() -> None:
        spin(2.0)
        inner()
        inner()

    begin_ns = time.thread_time_ns()
    clocks.timed(whole, "outer")()
    spent_ns = time.thread_time_ns() - begin_ns
    assert 2.0e6 <= clocks.own_ns["outer"] < 4.0e6 < 8.0e6 <= clocks.own_ns["inner"]
    assert 0 <= spent_ns - sum(clocks.own_ns.values()) < 1_000_000
    clocks.clear()
    assert not clocks.own_ns


def test_stages_are_put_back_and_told_in_the_table() -> None:
    before = [getattr(owner, name) for owner, name, _ in STAGES]
    with Clocks().running():
        assert all(getattr(owner, name) is not was for (owner, name, _), was in zip(STAGES, before))
    assert [getattr(owner, name) for owner, name, _ in STAGES] == before
    lines = table({"frame": [{"pose": 500_000}, {"pose": 300_000, "corners": 200_000}], "keyframe": []}).splitlines()
    assert any(line.startswith("| pose | 0.40 |") for line in lines) and lines[-1].startswith(
        "| **together** | **0.50**"
    )
    assert len(lines) == len(STAGES) + 3
