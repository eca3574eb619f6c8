"""A live flight by a slow camera tells a flight controller of obstacles at the full rate, and its log replays."""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kiteline_agent.runtime.live import fly_live
from kiteline_agent.runtime.options import AgentOptions
from kiteline_core.frame import Frame
from kiteline_hw.logs.mcap_log import LogReader, LogWriter
from kiteline_hw.sim.flight_controller import FlightController, UdpFlightController
from kiteline_hw.sources.open import open_source
from kiteline_hw.system import process
from kiteline_lab.replay.replay import replay_agent

FRAME_NS = 200_000_000
OBSTACLE_DISTANCE = 330
RATES = ("", "[agent.prediction]\nrate_hz = 0.0\n")  # poses between frames, or those of frames alone


class Told(FlightController):
    """Keeps when it was told of obstacles."""

    def __init__(self) -> None:
        super().__init__("ardupilot")
        self.told_s: list[float] = []

    def receive(self, data: bytes, now_ns: int) -> list[bytes]:
        if int.from_bytes(data[7:10], "little") == OBSTACLE_DISTANCE:
            self.told_s.append(time.monotonic())
        return super().receive(data, now_ns)


@pytest.fixture(scope="module")
def slow(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wall at 5 Hz."""
    source = open_source(str(recording))
    frames = [item for item in source if isinstance(item, Frame)][::2]
    path = tmp_path_factory.mktemp("slow") / "wall.mcap"
    with LogWriter(path, {"made": "for tests"}) as log:
        log.rig(frames[0].t_ns, source.rig, None)
        for k, frame in enumerate(frames):
            log.frame(replace(frame, t_ns=frames[0].t_ns + k * FRAME_NS))
    source.close()
    return path


@pytest.mark.parametrize("rate", RATES)
def test_obstacles_are_told_between_frames_too(slow: Path, tmp_path: Path, rate: str) -> None:
    config, model = tmp_path / "agent.toml", Told()
    config.write_text(f"{rate}[agent.scan]\nmoved_m = 0.0\nturned_rad = 0.0\n", encoding="utf-8")
    with UdpFlightController(model) as controller:
        url = f"udp:127.0.0.1:{controller.port}"
        spec = AgentOptions(source=str(slow), folder=str(tmp_path), mavlink=url, axes="frd", obstacles=True,
                            config=str(config))  # fmt: skip
        fly_live(spec, None, process.StopSignal())
    between_s = np.diff(model.told_s)
    assert len(between_s) > 8
    assert float(np.mean(between_s)) < 0.75 * FRAME_NS * 1e-9, "as rarely as there are frames"
    with LogReader(tmp_path / "log.mcap") as log:
        assert replay_agent(log).difference is None
