"""Flights of separate processes over a real link: agreement, repetition, killed processes, no orphans."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from kiteline_bench.harness.contract import check_contract
from kiteline_hw.ports import LinkError, SourceError
from kiteline_lab.flights.children import ChildProcesses, Event
from kiteline_lab.flights.flight_report import without_timing
from kiteline_lab.flights.fly import fly
from kiteline_lab.flights.plan import Options
from kiteline_lab.flights.processes import free_endpoint
from kiteline_lab.replay.replay import main as replay


def children_of(folder: Path) -> list[int]:
    """Processes of a flight: their stderr is in its folder."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal() and int(entry.name) != os.getpid():
            try:
                stderr = (entry / "fd" / "2").readlink()
            except OSError:
                continue
            if stderr.is_relative_to(folder):
                found.append(int(entry.name))
    return found


def test_two_flights_over_a_lossy_link_are_identical_and_agree(
    recording: Path, tmp_path: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The processes of the first are started as users start them; those of the second are forked, as in tests below."""
    running: list[int] = []
    next_event = ChildProcesses.next_event

    def watched(children: ChildProcesses, timeout_s: float) -> Event | None:
        running.append(len(children_of(tmp_path)))
        return next_event(children, timeout_s)

    monkeypatch.setattr(ChildProcesses, "next_event", watched)
    for run in "ab":
        if run == "b":
            request.getfixturevalue("forked")
        report, outcome = fly(Options((str(recording),), tmp_path / run, loss=0.2, seed=1), quiet=True)
        assert max(running) == 2
        running.clear()
        assert not outcome.failed
        assert report["base"]["digest_equal"] is True
        assert check_contract(tmp_path / run) == []
        assert children_of(tmp_path / run) == []
    for name in ("agent0/live.tum", "agent0/odometry.tum", "base/agent0.tum", "base/map.ply", "agent0/log.mcap"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name
    a, b = (json.loads((tmp_path / run / "report.json").read_text()) for run in "ab")
    assert without_timing(a) == without_timing(b)
    assert replay([str(tmp_path / "a" / "base" / "log.mcap"), "--verify"]) == 0


@pytest.mark.usefixtures("forked")
def test_the_flight_survives_a_killed_base_and_the_next_one_catches_up(recording: Path, tmp_path: Path) -> None:
    o = Options((str(recording),), tmp_path, kill_base_at_s=0.5, restart_base_at_s=0.9)
    report, outcome = fly(o, quiet=True)
    agent = report["agents"][0]
    assert (agent["frames"], agent["tracked"]) == (30, 30)
    assert report["base"]["digest_equal"] is True
    assert report["base"]["keyframes"] == agent["keyframes"]
    assert any("went on alone" in note for note in report["notes"])
    assert check_contract(tmp_path) == []
    assert not outcome.failed


@pytest.mark.usefixtures("forked")
def test_without_a_new_base_the_agent_flies_to_the_end(recording: Path, tmp_path: Path) -> None:
    report, _ = fly(Options((str(recording),), tmp_path, kill_base_at_s=0.5), quiet=True)
    assert report["agents"][0]["tracked"] == 30
    assert report["base"] is None
    assert check_contract(tmp_path) == []


@pytest.mark.usefixtures("forked")
def test_the_base_keeps_the_map_of_a_killed_agent(recording: Path, tmp_path: Path) -> None:
    o = Options((str(recording), str(recording)), tmp_path, kill_agent_at_s=0.8)
    report, outcome = fly(o, quiet=True)
    assert report["agents"][1]["tracked"] == 30
    assert 14 <= report["agents"][0]["tracked"] <= 16
    assert report["base"]["agents_lost"] == [0]
    assert report["base"]["keyframes"] > report["agents"][1]["keyframes"]
    assert check_contract(tmp_path) == []
    assert not outcome.failed


@pytest.mark.usefixtures("forked")
def test_a_base_that_cannot_listen_is_reported_at_once(recording: Path, tmp_path: Path) -> None:
    endpoint = free_endpoint()
    from kiteline_hw.lockstep.zenoh_lockstep import LockstepServer

    with LockstepServer(endpoint), pytest.raises(LinkError, match="listen"):
        fly(Options((str(recording),), tmp_path, link=f"zenoh:{endpoint}"), quiet=True)
    assert children_of(tmp_path) == []


def test_a_bad_source_is_reported_before_anything_starts(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no such"):
        fly(Options((str(tmp_path / "nothing"),), tmp_path / "out"), quiet=True)
    assert not (tmp_path / "out").exists()


def test_a_link_that_fly_cannot_use_is_refused(recording: Path, tmp_path: Path) -> None:
    with pytest.raises(LinkError, match="zenoh:tcp"):
        fly(Options((str(recording),), tmp_path, link="serial:/dev/null:57600"), quiet=True)


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_an_interrupted_flight_leaves_no_process(recording: Path, tmp_path: Path, how: signal.Signals) -> None:
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in a shell's background job; children would inherit it
        signal.signal(signal.SIGINT, signal.default_int_handler)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    # Processes that have just begun take longer to load than to fly: they are surely there when it is interrupted.
    command = [sys.executable, "-m", "kiteline_cli", "fly", str(recording), "--out", str(tmp_path), "--realtime"]
    with subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as flight:
        deadline_s = time.monotonic() + 60.0
        while len(children_of(tmp_path)) < 2:
            assert time.monotonic() < deadline_s, "the flight did not begin"
            time.sleep(0.02)
        flight.send_signal(how)
        flight.communicate(timeout=30.0)
    while children_of(tmp_path):
        assert time.monotonic() < deadline_s, "a child is left"
        time.sleep(0.02)
    assert flight.returncode == (130 if how is signal.SIGINT else -9)
