"""An agent flies on when the disk of its log, trajectories and rig file is full or failing, and says so once."""

import errno
import os
from pathlib import Path

import pytest

from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.runtime import agent_runtime
from kiteline_agent.runtime.agent_runtime import AgentRuntime
from kiteline_agent.runtime.options import AgentOptions
from kiteline_agent.runtime.rig_file import RigFile
from kiteline_core.config import ConfigError
from kiteline_hw.lockstep.messages import Down, Phase
from kiteline_hw.logs.mcap_log import LogReader
from kiteline_hw.ports import SourceError
from kiteline_hw.sources.open import open_source


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
