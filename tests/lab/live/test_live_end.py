"""The end of a live flight whose base does not answer: the wait for it is told, and how the map reaches it later."""

import threading
import time
from pathlib import Path

import pytest

from kiteline_agent.runtime import live
from kiteline_agent.runtime.frame_reader import FrameReader
from kiteline_agent.runtime.options import AgentOptions
from kiteline_hw.system import process
from kiteline_lab.flights.processes import free_endpoint


@pytest.mark.parametrize(("log_name", "mend"), [("log.mcap", "base --store DIR --import LOG"), ("", "was not logged")])
def test_the_wait_for_a_base_at_the_end_is_told(
    log_name: str, mend: str, recording: Path, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """It was ten seconds of silence after the line that says that the flight is over."""
    monkeypatch.setattr(live, "_DRAIN_S", 1.0)
    monkeypatch.setattr(live, "_DRAIN_TOLD_S", 0.2)
    options = AgentOptions(str(recording), str(tmp_path), log_name=log_name, link=f"zenoh:{free_endpoint()}")
    live.fly_live(options, None, process.StopSignal())
    said = capfd.readouterr().err
    _, over, after = said.partition("over:")
    assert over and "waiting, 1 s at most, until the base has it all" in after
    assert "not all has reached the base" in after and mend in after


def test_a_flight_without_a_link_waits_for_no_base(
    recording: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    live.fly_live(AgentOptions(str(recording), str(tmp_path)), None, process.StopSignal())
    assert "base" not in capfd.readouterr().err.partition("over:")[2]


def test_a_flight_whose_frames_are_read_more_slowly_than_they_come_stops_when_told(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each frame that is tracked follows more that are dropped: a simulated camera had its loop wait for minutes."""
    advance, stop = FrameReader._advance, process.StopSignal()

    def slowly(reader: FrameReader) -> None:
        time.sleep(0.25)
        advance(reader)

    monkeypatch.setattr(FrameReader, "_advance", slowly)
    told_s: list[float] = []
    begin = live._LiveFlight.fly

    def fly(flight: live._LiveFlight) -> None:
        threading.Timer(2.0, lambda: (told_s.append(time.monotonic()), stop.set())).start()
        begin(flight)

    monkeypatch.setattr(live._LiveFlight, "fly", fly)
    live.fly_live(AgentOptions(str(recording), str(tmp_path)), None, stop)
    assert time.monotonic() - told_s[0] < 1.0
