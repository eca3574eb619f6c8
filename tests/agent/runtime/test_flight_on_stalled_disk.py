"""A live flight waits for no disk that stalls, and ends in time on one that does not answer."""

import os
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.known_rig import KnownRigConfig
from kiteline_agent.runtime import agent_runtime
from kiteline_agent.runtime.agent_runtime import AgentRuntime, channel_with_spill
from kiteline_agent.runtime.options import AgentOptions
from kiteline_agent.runtime.rig_file import RigFile
from kiteline_codec import channel
from kiteline_codec.channel import CodedChannel
from kiteline_hw.lockstep.messages import Down, Phase
from kiteline_hw.logs import spill_file, whole_file
from kiteline_hw.logs.mcap_log import LogReader
from kiteline_hw.sources.open import open_source


def test_a_flight_does_not_wait_for_the_disk_of_its_log(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    go, pwrite = threading.Event(), os.pwrite

    def stalled(fd: int, data: bytes, offset: int) -> int:
        assert threading.current_thread() is not threading.main_thread()
        go.wait(20.0)
        return pwrite(fd, data, offset)

    monkeypatch.setattr(os, "pwrite", stalled)
    options = AgentOptions(str(recording), str(tmp_path), log_optional=True)
    runtime = AgentRuntime(options, open_source(options.source), NoBaseChannel(), whole_process=False)
    while runtime.next_ns is not None:
        runtime.tick(Down(runtime.next_ns, Phase.FLY, ()))
    go.set()
    runtime.close()
    assert runtime.report()["frames"] == 30 and runtime.take_notices() == runtime.log_notes() == []
    with LogReader(tmp_path / "log.mcap") as log:
        assert log.cut is None and log.topics["/left/image"] == 30
    assert (tmp_path / "odometry.tum").read_text().count("\n") == 30


def test_a_disk_that_does_not_answer_at_the_end_is_awaited_once_and_told(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each file waited for it by itself, longer than systemd lets a service end: it was killed and told nothing."""
    monkeypatch.setattr(whole_file, "_CLOSE_S", 1.0)
    monkeypatch.setattr(agent_runtime, "_SAVE_S", 1.0)
    go, pwrite, save = threading.Event(), os.pwrite, RigFile.save

    def stalled(fd: int, data: bytes, offset: int) -> int:
        go.wait(20.0)
        return pwrite(fd, data, offset)

    def stalled_save(file: RigFile, known: KnownRigConfig | None) -> None:
        go.wait(20.0)
        save(file, known)

    options = AgentOptions(str(recording), str(tmp_path), log_optional=True, rig=str(tmp_path / "rig.toml"))
    runtime = AgentRuntime(options, open_source(options.source), NoBaseChannel(), whole_process=False)
    monkeypatch.setattr(os, "pwrite", stalled)
    monkeypatch.setattr(RigFile, "save", stalled_save)
    while runtime.next_ns is not None:
        runtime.tick(Down(runtime.next_ns, Phase.FLY, ()))
    begin_s = time.monotonic()
    runtime.close()
    assert time.monotonic() - begin_s < 2.0
    assert [line.split(":")[0] for line in runtime.log_notes()] == ["log", "trajectory", "trajectory", "rig"]
    go.set()


@pytest.mark.parametrize("room", [4 << 20, 100])
def test_a_flight_does_not_wait_for_the_disk_that_keeps_old_values_for_the_base(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: int
) -> None:
    """Nor is it silent about values that find no room."""
    go, opened, spilled = threading.Event(), set[int](), set[int]()
    mkstemp, pwrite = tempfile.mkstemp, os.pwrite

    def noted(**named: Any) -> tuple[int, str]:
        made = mkstemp(**named)
        opened.add(made[0])
        return made

    def stalled(fd: int, data: bytes, offset: int) -> int:
        if fd in opened:
            assert threading.current_thread() is not threading.main_thread()
            spilled.add(offset)
            go.wait(20.0)
        return pwrite(fd, data, offset)

    monkeypatch.setattr(tempfile, "mkstemp", noted)
    monkeypatch.setattr(os, "pwrite", stalled)
    monkeypatch.setattr(channel, "_SPILLED_BYTES", 2000)
    monkeypatch.setattr(spill_file, "_MOST_WAITING_BYTES", room)
    options = AgentOptions(str(recording), str(tmp_path), link="zenoh:tcp/127.0.0.1:1", log_optional=True)
    runtime = AgentRuntime(options, open_source(options.source), channel_with_spill(options), whole_process=False)
    while runtime.next_ns is not None:
        runtime.tick(Down(runtime.next_ns, Phase.FLY, ()))
    assert isinstance(runtime.channel, CodedChannel)
    if room > 100:
        assert len(spilled) == 1 and runtime.channel.stats.archived > 10 and runtime.take_notices() == []
    else:
        told = runtime.take_notices()
        assert len(told) == 1 and "neither memory nor disk takes more" in told[0] and runtime.take_notices() == []
    go.set()
    runtime.close()
