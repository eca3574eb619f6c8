"""The time from a frame to its pose is that of the tracker, not of what follows."""

import time
from pathlib import Path

import pytest

from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.runtime import agent_runtime
from kiteline_agent.runtime.agent_runtime import AgentRuntime
from kiteline_agent.runtime.flight_record import FlightRecord
from kiteline_agent.runtime.options import AgentOptions
from kiteline_agent.step import StepInput
from kiteline_hw.sources.open import open_source


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
