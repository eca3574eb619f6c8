"""What a person at a base's terminal is told."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import JobDone
from kiteline_basestation.management import Command
from kiteline_basestation.runtime.terminal import TerminalReporter
from kiteline_basestation.station import Station
from kiteline_codec.channel import CodedChannel
from kiteline_codec.schema import CameraIntrinsics
from kiteline_codec.sync.config import SyncConfig
from kiteline_core.geometry import se3
from tests.basestation.feeding import WITHOUT_GRID

MakeFlight = Callable[..., Any]
STEP_NS = 200_000_000
ELSEWHERE = se3.from_rt(np.eye(3), np.array([1.0, -2.0, 0.0]))


def told(flights: list[Any], words: Any, away: range, restart: int) -> tuple[list[str], Station, TerminalReporter]:
    """Flights through coded channels. away: steps at which the last agent is out of reach. restart: when the first one
    begins anew.
    """
    ends = {f.agent: CodedChannel(SyncConfig(), 1) for f in flights}
    station = Station(WITHOUT_GRID, lambda _: CodedChannel(SyncConfig(), 1), words)
    reporter, lines = TerminalReporter(station), []
    done: tuple[JobDone, ...] = ()
    for n in range(max(len(f.records) for f in flights) + 30):
        if n == restart:
            ends[flights[0].agent] = CodedChannel(SyncConfig(), 2)
        here = {f.agent for f in flights[: -1 if n in away else None]}
        packets = {}
        for f in flights:
            if n == 0:
                ends[f.agent].put(CameraIntrinsics(f.agent, f.camera))
            for record in f.records[n] if n < len(f.records) else ():
                ends[f.agent].put(record)
            packets[f.agent] = ends[f.agent].poll(n * STEP_NS)
        output = station.step(packets, done, n * STEP_NS)
        for agent, out in output.packets:
            ends[agent].receive(out, n * STEP_NS)
        done = tuple(run_job(job) for job in output.jobs)
        lines += reporter.lines(here, n * STEP_NS, 230.0, n < 55)
    return lines, station, reporter


def test_agents_merges_and_status_are_reported_once_each(make_flight: MakeFlight, words: Any) -> None:
    a = make_flight(keyframes=26, turns=0.8)
    b = make_flight(keyframes=26, turns=0.8, start=0.5, variant=1, agent=1, T_w_m=ELSEWHERE)
    lines, station, reporter = told([a, b], words, range(45, 55), 44)
    texts = [line.split("s  ", 1)[1] for line in lines]
    assert texts[:2] == ["agent 0 connected", "agent 1 connected"]
    assert sorted(texts[2:4]) == ["agent 0 starts map 0.1.0", "agent 1 starts map 1.1.0"]
    merged = [w for w in texts if " merged into " in w]
    assert len(merged) == 1 and re.fullmatch(r"map 1\.1\.0 \(\d+ keyframes\) merged into map 0\.1\.0", merged[0])
    assert "agent 1 disconnected; its map is kept" in texts
    assert "agent 1 connected again after 2.0 s" in texts
    assert [w for w in texts if "restarted" in w] == ["agent 0 restarted; its earlier map is kept"]
    status = [w for w in texts if "peak memory" in w]
    assert len(status) == 1 and lines[texts.index(status[0])].startswith("    10.0 s")
    assert re.match(
        r"1 agent connected; \d+ keyframes and \d+ landmarks in 1 map; \d+ loops?, 1 merge; \d+\.\d kB/s up", status[0]
    )
    assert status[0].endswith("peak memory 230 MiB; all stored")
    station.step({}, (), 10**12, [Command(1, "split", '{"map": "1.1.0"}')])
    assert [w.split("s  ", 1)[1] for w in reporter.lines((), 0, 0.0, None)][-1] == (
        "map 1.1.0 separated from the map that it was merged into"
    )
    assert reporter.lines((), 0, 0.0, None) == []


def test_a_loop_is_reported_with_its_length_and_error(make_flight: MakeFlight, ring: Any, words: Any) -> None:
    flight = make_flight(keyframes=50, turns=1.2, scene=ring, drift_m=0.02, seed=3, noise_px=1.0, memory=2)
    lines, _, _ = told([flight], words, range(0), -1)
    loops = [line for line in lines if re.search(r"loop \d+ closed", line)]
    found = re.search(r"loop 1 closed: error (\d+\.\d\d) m after (\d+) m", loops[0])
    path_m = np.linalg.norm(np.diff(np.array(flight.true_T_w_k)[:, :3, 3], axis=0), axis=1).sum()
    assert 0.02 < float(found[1]) < 5.0 and 0.5 * path_m < float(found[2]) < path_m


def test_an_idle_base_says_nothing_twice() -> None:
    """It repeated one line every ten seconds."""
    station = Station(BaseConfig(), lambda _: CodedChannel(SyncConfig(), 1))
    reporter = TerminalReporter(station)
    lines = [line for s in range(0, 120, 5) for line in reporter.lines((), s * 10**9, 100.0 + s, None)]
    assert len(lines) == 1 and "0 agents connected" in lines[0]
    assert "1 agent connected" in reporter.lines((2,), 130 * 10**9, 300.0, None)[-1]
    assert "0 agents connected" in reporter.lines((), 140 * 10**9, 300.0, None)[-1]
    assert reporter.lines((), 150 * 10**9, 300.0, None) == []
