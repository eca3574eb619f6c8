"""Own CPU times of stages: they add up to the whole, every stage is found and public, the table lists all."""

import time
from pathlib import Path

from kiteline_bench.agent.stages import STAGES, profile, table
from kiteline_bench.harness.profiler import Profiler, locate
from kiteline_lab.flights.fly import fly
from kiteline_lab.flights.plan import Options


def spin(ms: float) -> None:
    end_ns = time.thread_time_ns() + round(ms * 1e6)
    while time.thread_time_ns() < end_ns:
        pass


def test_own_time_is_without_that_of_stages_inside() -> None:
    profiler = Profiler(())
    inner = profiler.timed(lambda: spin(4.0), "inner")

    def whole() -> None:
        spin(2.0)
        inner()
        inner()

    begin_ns = time.thread_time_ns()
    profiler.timed(whole, "outer")()
    spent_ns = time.thread_time_ns() - begin_ns
    assert 2.0e6 <= profiler.own_ns["outer"] < 4.0e6 < 8.0e6 <= profiler.own_ns["inner"]
    assert 0 <= spent_ns - sum(profiler.own_ns.values()) < 1_000_000
    profiler.clear()
    assert not profiler.own_ns


def test_stages_are_public_and_as_before_after_a_run() -> None:
    owners = [locate(path) for path, _ in STAGES]
    assert len(owners) > 10 and not any(name.startswith("_") for _, name in owners)
    before = [getattr(owner, name) for owner, name in owners]
    with Profiler(STAGES).running():
        assert all(getattr(owner, name) is not was for (owner, name), was in zip(owners, before, strict=True))
    assert [getattr(owner, name) for owner, name in owners] == before


def test_every_stage_of_a_stereo_flight_takes_time(recording: Path, tmp_path: Path) -> None:
    fly(Options((str(recording),), tmp_path, "local"), quiet=True)
    found = profile(tmp_path / "agent0" / "log.mcap")
    assert found["frame"] and found["keyframe"]
    timed = {stage for own in [*found["frame"], *found["keyframe"]] for stage, ns in own.items() if ns > 0}
    assert {stage for _, stage in STAGES} - timed == {"rectification"}  # the recording's images are rectified


def test_table_has_a_line_a_stage() -> None:
    lines = table({"frame": [{"pose": 500_000}, {"pose": 300_000, "corners": 200_000}], "keyframe": []}).splitlines()
    assert any(line.startswith("| pose | 0.40 |") for line in lines) and lines[-1].startswith(
        "| **together** | **0.50**"
    )
    assert len(lines) == len(STAGES) + 3
