"""An agent's process: its options, its status messages, long flights, full disks and slow logs."""

import errno
import io
import os
import signal
import threading
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from kiteline_agent.__main__ import main
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.known_rig import KnownRigConfig
from kiteline_agent.local_map.held_corrections import HeldCorrections
from kiteline_agent.runtime import agent_runtime, live
from kiteline_agent.runtime.agent_runtime import AgentRuntime
from kiteline_agent.runtime.flight_record import FlightRecord
from kiteline_agent.runtime.frame_counts import FrameCounts
from kiteline_agent.runtime.options import AgentOptions
from kiteline_agent.runtime.rig_file import RigFile
from kiteline_agent.runtime.terminal import StatusMessages, summary
from kiteline_agent.step import Estimate, StepInput, StepOutput
from kiteline_core.config import ConfigError
from kiteline_core.ids import KeyframeId, SubmapId, keyframe_id, submap_id
from kiteline_hw.lockstep.messages import Down, Phase
from kiteline_hw.logs.mcap_log import LogReader
from kiteline_hw.logs.mcap_write import McapWriter
from kiteline_hw.ports import SourceError
from kiteline_hw.sources.open import open_source
from kiteline_hw.system import kernel_cache
from kiteline_hw.system.process import StopSignal
from kiteline_hw.system.start_numbers import Start
from tests.agent.runtime.test_flight_parts import estimate
from tests.entries import entries_of


@pytest.mark.parametrize("agent", ["256", "-1"])
def test_a_number_that_no_agent_can_have_is_refused_before_anything_else(
    agent: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["nothing", f"--agent={agent}", "--link", "zenoh:tcp/10.0.0.1:7447"])
    assert "expected 0 to 255" in capsys.readouterr().err


@pytest.mark.parametrize("given", [["--obstacles"], ["--imu", "controller"], ["--grid", "base"]], ids=" ".join)
def test_what_the_filter_has_no_use_for_is_refused(given: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["nothing", "--tracker", "ekf", *given])
    assert f"--tracker ekf uses no {' '.join(given).removesuffix(' controller')}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["--cpu", "-5"], "--cpu: -5: expected 0"),
        (["--cpu", "nan"], "--cpu: nan: expected 0"),
        (["--cpu", "inf"], "--cpu: inf: expected 0"),
        (["--cpu", "1e999"], "--cpu: 1e999: expected 0"),
        (["--cpu", "half"], "--cpu: half: expected 0 (no limit) or more"),
        (["--up-bytes", "-1"], "--up-bytes: -1: expected 0"),
        (["--up-bytes", "1.5"], "--up-bytes: 1.5: expected a whole number, 0 (no limit) or more"),
        (["--obstacles"], "expected --mavlink URL"),
        (["--axes", "rdf", "--pose-messages", "vision"], "--axes and --pose-messages: of the poses"),
    ],
)
def test_what_has_no_meaning_is_refused(given: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["nothing", *given])
    assert words in capsys.readouterr().err


def output(tracked: bool, *events: str) -> StepOutput:
    pose = np.eye(4)
    estimate = Estimate(
        t_ns=0, tracked=tracked, bridged=False, T_m_b=pose if tracked else None, T_o_b=pose, keyframe=KeyframeId(0),
        T_k_c=pose, submap=SubmapId(0), inliers=0, quality=1, cov_m=np.eye(6), cov_o=np.eye(6), R_l_o=np.eye(3),
        T_w_b=None,
    )  # fmt: skip
    return StepOutput(estimate, (), events)


def test_changes_are_told_once_and_a_summary_now_and_then() -> None:
    narrator, tally, told = StatusMessages(), FrameCounts(), []
    tracked = [False] * 10 + [True] * 300 + [False] * 4 + [True] * 86  # at 20 Hz
    for k, yes in enumerate(tracked):
        step = output(yes, *(("submap: opened", "keyframe: heartbeat") if k == 10 else ()))
        tally.count(step.estimate)
        told += narrator.lines(step, tally, k * 50_000_000)
    words = [line.split("s  ", 1)[1] for line in told]
    assert words[:2] == ["submap: opened", "first pose"]
    assert words[2].startswith("201 frames: 191 tracked, 10 lost, 0 dropped; 1 keyframe in 1 submap; 0.0 kB/s up")
    assert words[3:] == ["lost: no pose from the images", "tracking again after 0.2 s"]
    assert told[4].startswith("    15.7 s")
    assert summary(tally).startswith("400 frames: 386 tracked, 14 lost")


@pytest.mark.parametrize("event", ["images: too few corners to begin a map", "camera stamps scatter by 2.1 ms"])
def test_what_is_wrong_with_the_cameras_is_shown(event: str) -> None:
    (line,) = StatusMessages().lines(output(False, event, "keyframe: heartbeat"), FrameCounts(), 0)
    assert line == f"     0.0 s  {event}"


def test_what_is_found_of_the_flight_controller_is_shown() -> None:
    (line,) = StatusMessages().lines(output(False), FrameCounts(), 2_000_000_000, ["flight controller: found: PX4"])
    assert line == "     2.0 s  flight controller: found: PX4"


def test_a_slow_log_is_no_part_of_the_tracking_time(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(agent_runtime, "warm", lambda *_: None)
    options = AgentOptions(str(recording), str(tmp_path / "agent0"))
    runtime = AgentRuntime(options, open_source(options.source), NoBaseChannel(), whole_process=False)
    runtime.begin_at(0)
    monkeypatch.setattr(FlightRecord, "step", lambda *_: time.sleep(0.1))
    whole_ms = []
    for _ in range(2):
        now_ns = runtime.next_ns
        assert now_ns is not None
        frame, imu, odometry = runtime.reader.take()
        begin_s = time.monotonic()
        runtime.step(StepInput(frame, imu, odometry=odometry), now_ns)
        whole_ms.append(1e3 * (time.monotonic() - begin_s))
    for tracking_ms, step_ms in zip(runtime.report()["timing"]["tracking_ms"], whole_ms, strict=True):
        assert 0.0 < tracking_ms < step_ms - 99.0
    runtime.close()


HELD = 48  # keyframes in the local map


def test_keyframes_are_counted_without_their_ids() -> None:
    counts, held = FrameCounts(), list[Counter[str]]()
    for n in range(200):
        submap = submap_id(0, 1, n // 100)
        for keyframe in (n % 100, max(0, n % 100 - 30)):  # an older one after a relocalisation
            counts.count(replace(estimate(keyframe=keyframe_id(submap, keyframe)), submap=submap))
        held.append(entries_of(counts))
    assert counts.keyframes == 200 and len(counts.submaps) == 2
    assert held[199] == held[100] and held[99] == held[0]


@pytest.mark.parametrize("placed", [True, False])
def test_of_keyframes_that_left_the_map_long_ago_nothing_is_known(placed: bool) -> None:
    """A changed disparity offset moves keyframes: which of them the base has set matters as long as they are held."""
    held, submap = HeldCorrections(), submap_id(0, 1, 0)
    for n in range(1, 1400):
        here = np.array([keyframe_id(submap, k) for k in range(max(1, n - HELD), n + 1)])
        parent = here - 1
        held.note_motion(submap, here[-2:], parent[-2:], np.tile(np.eye(4), (2, 1, 1)))
        if placed:
            held.set_pose(KeyframeId(int(here[-1])), np.eye(4), stored=True)
        held.forget(KeyframeId(int(here[0]) - 1))
        held.forget_evicted(here, parent)
        known = held.placed if placed else held.moved
        assert known.issuperset(here[1:].tolist())
        assert n <= HELD + 1 or int(parent[0]) in known
    assert sum(entries_of(held).values()) < 1400


def test_the_index_of_a_log_takes_bytes_not_objects() -> None:
    writer, held = McapWriter(io.BytesIO(), 100, "test"), list[Counter[str]]()
    channel = writer.register_channel("topic", "json", writer.register_schema("name", "jsonschema", b"{}"), {})
    for n in range(200):
        writer.add_message(channel, n, (bytes(200),))
        held.append(entries_of(writer))
    assert held[199] == held[100]


def fly(options: AgentOptions, full_from: int, until: int, patch: pytest.MonkeyPatch) -> tuple[AgentRuntime, list[str]]:
    """Fly a recording while nothing can be written from one frame to another; what was told."""
    pwrite, told = os.pwrite, list[str]()

    def full(fd: int, data: bytes, offset: int) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    runtime = AgentRuntime(options, open_source(options.source), NoBaseChannel(), whole_process=False)
    frames = 0
    while runtime.next_ns is not None:
        patch.setattr(os, "pwrite", full if full_from <= frames < until else pwrite)
        runtime.tick(Down(runtime.next_ns, Phase.FLY, ()))
        told += runtime.take_notices()
        frames += 1
    runtime.close()
    return runtime, told


@pytest.mark.parametrize(("full_from", "until"), [(0, 99), (10, 99), (7, 20)])
def test_a_full_disk_does_not_stop_a_flight(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, full_from: int, until: int
) -> None:
    options = AgentOptions(str(recording), str(tmp_path / "agent0"))
    runtime, told = fly(options, full_from, until, monkeypatch)
    report = runtime.report()
    assert report["frames"] == 30 and report["tracked"] > 20
    assert [line.split(":")[0] for line in told] == ["log", "trajectory"]
    assert any("messages were not written: No space" in line for line in runtime.log_notes())
    with LogReader(tmp_path / "agent0" / "log.mcap") as log:
        assert (log.cut is None) == (until < 30)
        logged = sum(log.topics.values())
        assert logged > 0
    poses = (tmp_path / "agent0" / "odometry.tum").read_text().splitlines()
    assert len(poses) == 30 - (min(until, 30) - full_from)
    assert all(len(line.split()) == 8 for line in poses)


def test_each_start_keeps_its_trajectories(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = AgentOptions(str(recording), str(tmp_path), log_name="boot.mcap")
    for number, seconds in ((7, 0.0), (8, 1.0)):
        fly(live._numbered(replace(options, seconds=seconds), Start(number, number)), 99, 99, monkeypatch)
    first, second = (
        len((tmp_path / f"boot0000{number}.odometry.tum").read_text().splitlines()) for number in (7, 8)
    )  # fmt: skip
    assert (first, second < first) == (30, True)
    assert {path.name for path in tmp_path.glob("boot*.tum")} == {
        f"boot0000{number}.{name}.tum" for number in (7, 8) for name in ("live", "odometry")
    }
    for name in ("live.tum", "odometry.tum"):
        assert (tmp_path / name).readlink() == Path(f"boot00008.{name}")
    (tmp_path / "live.tum").unlink()
    (tmp_path / "live.tum").write_text("somebody's")
    fly(live._numbered(replace(options, seconds=1.0), Start(9, 9)), 99, 99, monkeypatch)
    assert (tmp_path / "live.tum").read_text() == "somebody's"
    assert (tmp_path / "odometry.tum").readlink() == Path("boot00009.odometry.tum")


def test_a_rig_file_that_cannot_be_written_is_told_once(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(file: RigFile, known: object) -> None:
        raise ConfigError("rig.toml: cannot write the rig file (No space left on device)")

    monkeypatch.setattr(RigFile, "save", full)
    monkeypatch.setattr(agent_runtime, "SAVE_FRAMES", 10)
    options = AgentOptions(str(recording), str(tmp_path / "agent0"), rig=str(tmp_path / "rig.toml"))
    _, told = fly(options, 99, 99, monkeypatch)
    assert len(told) == 1 and "rig.toml: cannot write" in told[0]


def test_a_rig_file_that_the_disk_does_not_take_holds_up_no_end(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    go = threading.Event()
    monkeypatch.setattr(RigFile, "save", lambda *_: go.wait(20.0))
    monkeypatch.setattr(agent_runtime, "_SAVE_S", 0.1)
    begin_s = time.monotonic()
    runtime, _ = fly(AgentOptions(str(recording), str(tmp_path), rig=str(tmp_path / "rig.toml")), 99, 99, monkeypatch)
    assert time.monotonic() - begin_s < 15.0 and "rig: what this flight found is not written" in runtime.log_notes()[0]
    go.set()


def test_a_rig_file_of_another_calibration_is_told(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "rig.toml"
    RigFile(str(path)).save(KnownRigConfig(camera=(640.0, 400.0, 400.0, 400.0, 320.0, 200.0, 0.11)))
    runtime, told = fly(AgentOptions(str(recording), str(tmp_path / "agent0"), rig=str(path)), 99, 99, monkeypatch)
    assert len(told) == 1 and "was found with another calibration" in told[0] and told[0] in runtime.report()["notes"]


def test_an_agent_flies_without_a_log_that_cannot_begin(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "logs").write_text("no folder")
    options = AgentOptions(str(recording), str(tmp_path / "logs" / "agent0"), log_optional=True)
    runtime, told = fly(options, 99, 99, monkeypatch)
    assert runtime.report()["frames"] == 30
    assert len(told) == 1 and "no log of this flight" in told[0]
    with pytest.raises((OSError, SourceError)):
        fly(AgentOptions(str(recording), str(tmp_path / "logs" / "agent0")), 99, 99, monkeypatch)


def test_what_waits_for_a_full_disk_to_the_end_is_told_as_lost(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runtime, _ = fly(AgentOptions(str(recording), str(tmp_path), log_optional=True), 5, 99, monkeypatch)
    assert [line.split(":")[0] for line in runtime.log_notes()] == ["log", "trajectory", "trajectory"]
    assert all("No space" in line for line in runtime.log_notes())


@pytest.mark.parametrize("what", ["opened", "AgentRuntime"])
def test_ctrl_c_ends_an_agent_that_opens_its_source_or_compiles(
    what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A long recording without an index, and kernels that no folder keeps, took minutes in which it was not heard."""

    begun: list[str] = []

    def slow(*given: object, **named: object) -> None:
        begun.append(what)
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(5.0)
        raise AssertionError

    monkeypatch.setattr(live, "opened", lambda _: SimpleNamespace(close=lambda: None))
    monkeypatch.setattr(kernel_cache, "filled", lambda: True)
    monkeypatch.setattr(live, what, slow)
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        live.fly_live(AgentOptions("any", str(tmp_path), log_name=""), None, StopSignal())
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert begun == [what]
