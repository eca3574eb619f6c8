"""A live flight with a modelled pair of cameras that are unplugged on the way, beside a flight controller and a log."""

import threading
import time
from pathlib import Path

import numpy as np
import pytest

from kiteline_agent.runtime.flight_log import estimate_from_json
from kiteline_agent.runtime.live import fly_live
from kiteline_agent.runtime.options import options_of, parser
from kiteline_core.frame import Frame
from kiteline_hw.cameras import v4l2
from kiteline_hw.logs.mcap_log import LogReader
from kiteline_hw.ports import SourceError
from kiteline_hw.sim.flight_controller import FlightController, UdpFlightController
from kiteline_hw.sim.sensors.video_device import ModelDevice, ModelKernel
from kiteline_hw.sources.open import open_source
from kiteline_hw.system import process
from kiteline_lab.flights.plan import Options, plan
from kiteline_lab.replay.replay import replay_agent

FPS = 20.0


def devices_of(recording: Path) -> tuple[ModelDevice, ModelDevice]:
    """A pair of cameras that show a recording, to and fro for ever."""
    frames = [item for item in open_source(str(recording)) if isinstance(item, Frame)]
    h, w = frames[0].left.shape

    def shown(k: int) -> Frame:
        turn = k % (2 * len(frames) - 2)
        return frames[min(turn, 2 * len(frames) - 2 - turn)]

    left = ModelDevice(lambda k: shown(k).left.tobytes(), {"GREY": [(w, h)]}, FPS)
    right = ModelDevice(lambda k: np.asarray(shown(k).right).tobytes(), {"GREY": [(w, h)]}, FPS)
    left.begin_ns = right.begin_ns = time.monotonic_ns()  # one trigger for both
    return left, right


class StopAfter(process.StopSignal):
    """Stops a flight once a thread says so."""

    def __init__(self) -> None:
        self._over = threading.Event()

    def __bool__(self) -> bool:
        return self._over.is_set()

    def wait(self, seconds: float) -> bool:
        return self._over.wait(max(0.0, seconds))

    def set(self) -> None:
        self._over.set()


def test_cameras_are_unplugged_and_back_and_the_flight_goes_on(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    left, right = devices_of(recording)
    monkeypatch.setattr(v4l2, "KERNEL", ModelKernel({"/dev/video0": left, "/dev/video2": right}))
    stop, model = StopAfter(), FlightController("ardupilot")
    times: dict[str, int] = {}

    def field() -> None:
        while left.delivered < 40:  # the agent warms up first
            time.sleep(0.01)
        for device in (left, right):
            device.unplug()
        times["out"] = time.monotonic_ns()
        time.sleep(1.5)
        times["accepted while out"] = len(model.accepted)
        for device in (left, right):
            device.plug()
        times["back"] = time.monotonic_ns()
        time.sleep(3.0)
        stop.set()

    with UdpFlightController(model) as controller:
        thread = threading.Thread(target=field)
        thread.start()
        source = f"v4l2:/dev/video0,/dev/video2?fps={FPS:g}&calibration={recording}"
        a = parser().parse_args(
            [source, "--mavlink", f"udp:127.0.0.1:{controller.port}", "--log", str(tmp_path), "--no-imu"]
        )
        fly_live(options_of(a, tmp_path), None, stop)
        thread.join()
        heartbeats = sum(model.heartbeats.values())
    said = [line.split(" s  ", 1)[-1] for line in capsys.readouterr().err.splitlines() if "camera" in line]
    assert sum("was unplugged: plug it in again" in line for line in said) == 2, said
    assert sum("images again after" in line for line in said) == 2, said
    assert sum("right image" in line for line in said) == 1, said
    assert heartbeats >= 4  # the controller heard from us all the while
    with LogReader(tmp_path / "boot.mcap") as log:
        estimates = [estimate_from_json(m.json()) for m in log.messages(["/estimate"])]
        stamps = np.array([e.t_ns for e in estimates])
        gap = int(np.argmax(np.diff(stamps)))
        assert 1.3e9 < stamps[gap + 1] - stamps[gap] < 3.2e9
        assert stamps[gap + 1] - times["back"] < 1.2e9
        assert estimates[gap].tracked
        first = next(e.t_ns for e in estimates[gap + 1 :] if e.tracked)
        assert first - stamps[gap + 1] < 1e9  # tracked within a second of the image's return
        heads = [m.json() for m in log.messages(["/step"])]
        idle = [h for h in heads if h["frame_ns"] is None and times["out"] < h["now_ns"] < times["back"]]
        assert len(idle) > 20 and max(np.diff([h["now_ns"] for h in idle])) < 0.25e9  # link and watchdog were served
        assert log.topics["/log"] >= 7  # what was told is in the log, too
        assert replay_agent(log).difference is None
    # Poses of frames reach the controller soon after their capture.
    assert len(model.accepted) > 60


def test_a_camera_is_no_source_for_fly(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    left, right = devices_of(recording)
    monkeypatch.setattr(v4l2, "KERNEL", ModelKernel({"/dev/video0": left, "/dev/video2": right}))
    spec = f"v4l2:/dev/video0,/dev/video2?calibration={recording}"
    with pytest.raises(SourceError, match="flown with `kiteline agent`"):
        plan(Options(sources=(spec,), out=tmp_path))


def test_a_log_without_all_images_says_so_at_replay(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = tmp_path / "agent.toml"
    config.write_text("[agent.log]\nevery = 3\n", encoding="utf-8")
    a = parser().parse_args([str(recording), "--log", str(tmp_path), "--config", str(config)])
    fly_live(options_of(a, tmp_path), None, StopAfter())
    with LogReader(tmp_path / "boot.mcap") as log:
        frames = sum(m.json()["frame_ns"] is not None for m in log.messages(["/step"]))
        assert log.topics["/left/image"] == -(-frames // 3) > 3
        with pytest.raises(SourceError, match=r"has no images: it was flown with every = 0 or more than 1"):
            replay_agent(log)
