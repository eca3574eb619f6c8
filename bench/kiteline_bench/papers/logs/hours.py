"""Hours of a flight's log in minutes: the agent's runtime, its log and its limit on the disk, without tracking."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.governor.cost_model import Work
from kiteline_agent.onboard import OnboardAgent
from kiteline_agent.runtime.agent_runtime import AgentRuntime
from kiteline_agent.runtime.options import LOG_STEM, AgentOptions
from kiteline_agent.step import Estimate, StepInput, StepOutput
from kiteline_core.frame import Frame, ImuBatch, ImuCalibration, Trajectory
from kiteline_core.geometry.cameras import CameraModel, CameraRig
from kiteline_core.ids import KeyframeId, SubmapId
from kiteline_hw.logs.mcap_log import LEFT, LogReader, LogWriter
from kiteline_hw.ports import SourceReport

RATE_HZ = 20
EARLIER = 3  # logs of starts before, which are the first to go
_PERIOD_NS = 1_000_000_000 // RATE_HZ
_IMU_SAMPLES = 10  # between two frames
_PACKET_BYTES = 400  # of a frame, on average
_IMAGES = 16  # that are logged in turn
_CAMERA = CameraModel(64, 48, 60.0, 60.0, 31.5, 23.5)


class SteadySource:
    """A stereo camera with an IMU for so many frames: raw images, a few in turn."""

    name = "steady"
    ground_truth: Trajectory | None = None

    def __init__(self, frames: int) -> None:
        T_c_r = np.eye(4)
        T_c_r[0, 3] = 0.1
        self.rig = CameraRig(_CAMERA, _CAMERA, np.eye(4), T_c_r)
        self.imu: ImuCalibration | None = None
        self.report = SourceReport()
        self.frame_count: int | None = frames
        random = np.random.default_rng(3)
        self._images = random.integers(0, 256, (_IMAGES, 2, _CAMERA.height, _CAMERA.width), np.uint8)
        self._samples = random.normal(0.0, 1.0, (_IMU_SAMPLES, 6))

    def __iter__(self) -> Iterator[Frame | ImuBatch]:
        steps = np.arange(1, _IMU_SAMPLES + 1, dtype=np.int64) * (_PERIOD_NS // _IMU_SAMPLES)
        for k in range(self.frame_count or 0):
            t_ns = (k + 1) * _PERIOD_NS
            yield ImuBatch(t_ns - _PERIOD_NS + steps, self._samples[:, :3], self._samples[:, 3:])
            left, right = self._images[k % _IMAGES]
            yield Frame(t_ns, left, right)

    def close(self) -> None:
        """Nothing is open."""


class SteadyAgent:
    """Stands in for an agent: a pose and a packet for each frame, without looking at it."""

    def __init__(self) -> None:
        self.work = Work()
        self._packet = np.random.default_rng(4).bytes(_PACKET_BYTES)

    def step(self, step_input: StepInput, now_ns: int) -> StepOutput:
        """The same output for every frame, but for its stamp."""
        pose = np.eye(4)
        estimate = Estimate(
            now_ns if step_input.frame is None else step_input.frame.t_ns, True, False, pose, pose, KeyframeId(0), pose,
            SubmapId(0), 100, 90, np.eye(6), np.eye(6), np.eye(3), pose,
        )  # fmt: skip
        return StepOutput(estimate, (self._packet,), ())


@dataclass(slots=True)
class LogDay:
    """What hours of flight left. most_bytes: of all logs at any look. in_order: every deleted log was the oldest."""

    frames: int
    written_bytes: int
    most_bytes: int
    looks: int
    kept_bytes: int
    deleted: int
    in_order: bool
    notices: list[str]
    lost_messages: int
    parts: int
    unreadable: list[str]
    gaps: int


def fly_hours(folder: Path, hours: float, cap_mib: int) -> LogDay:
    """Log so many hours of flight time within a limit; looks at the folder once a second of flight time."""
    folder.mkdir(parents=True)
    for number in range(1, EARLIER + 1):
        with LogWriter(folder / f"{LOG_STEM}{number:05d}.mcap", {"role": "agent"}) as log:
            for k in range(40):
                log.blob("/earlier", k, bytes(cap_mib << 13))
    frames = round(hours * 3600 * RATE_HZ)
    name = f"{LOG_STEM}{EARLIER + 1:05d}.mcap"
    options = AgentOptions("steady", str(folder), log_name=name, log_mib=cap_mib)
    day = LogDay(frames, 0, 0, 0, 0, 0, True, [], 0, 0, [], 0)
    runtime = AgentRuntime(options, SteadySource(frames), NoBaseChannel(), whole_process=False)
    runtime.agent = cast(OnboardAgent, SteadyAgent())
    seen: dict[str, int] = {}
    for k in range(frames):
        frame, imu, odometry = cast(Any, runtime.reader).take()
        runtime.step(StepInput(frame, imu, odometry=odometry), frame.t_ns)
        if k % RATE_HZ == 0:
            day.notices += runtime.take_notices()
            _look(folder, day, seen)
    runtime.close()
    day.lost_messages = 0 if runtime.log_notes() == [] else 1
    _look(folder, day, seen)
    day.written_bytes = sum(seen.values())
    _read_all(folder, day, frames)
    return day


def _look(folder: Path, day: LogDay, seen: dict[str, int]) -> None:
    """Sizes of all logs, and whether those that are gone were the oldest. seen: largest size of each, by name."""
    now = {}
    for path in folder.glob("*.mcap"):
        with suppress(FileNotFoundError):  # deleted meanwhile
            now[path.stem] = path.stat().st_size
    day.looks += 1
    day.most_bytes = max(day.most_bytes, sum(now.values()))
    seen |= {name: max(size, seen.get(name, 0)) for name, size in now.items()}
    gone = [name for name in seen if name not in now]
    oldest = min(map(_age, now))
    day.in_order &= all(_age(name) < oldest for name in gone)
    day.deleted, day.kept_bytes = len(gone), sum(now.values())


def _age(name: str) -> tuple[int, int]:
    start, _, part = name.removeprefix(LOG_STEM).partition("_")
    return int(start), int(part or 0)


def _read_all(folder: Path, day: LogDay, frames: int) -> None:
    """Open every part that is left: whole, begins with a step, goes on where the one before ended."""
    stamps: list[int] = []
    for path in sorted(folder.glob("*.mcap"), key=lambda path: _age(path.stem)):
        if _age(path.stem)[0] <= EARLIER:
            continue
        day.parts += 1
        with LogReader(path) as log:
            heads = [m.json() for m in log.messages(["/step"])]
            pairs = log.topics.get(LEFT, 0)
            if log.cut is not None or not heads or pairs != len(heads) or "/rig" not in log.topics:
                day.unreadable.append(path.name)
            stamps += [head["frame_ns"] for head in heads]
    steps = np.diff(np.array(stamps))
    day.gaps = int(np.count_nonzero(steps != _PERIOD_NS)) + (not stamps or stamps[-1] != frames * _PERIOD_NS)
