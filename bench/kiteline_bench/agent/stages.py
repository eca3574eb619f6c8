"""Where an agent's CPU time goes: stages of frames and of keyframes, flown again from the log of a flight."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.imaging import alignment_kernels, features
from kiteline_agent.keyframes import depth_from_motion, keyframe_maker
from kiteline_agent.relocalisation import relocaliser as recovery
from kiteline_agent.runtime import flight_log
from kiteline_agent.runtime.warm import warm
from kiteline_agent.step import Identity, StepInput
from kiteline_agent.tracking import frame_images, tracker
from kiteline_bench.benchmark import Bar, Bench, at_most
from kiteline_codec import warm as codec_warm
from kiteline_codec.channel import CodedChannel, coded_channel
from kiteline_core.ids import AgentId
from kiteline_core.imaging import stereo_kernels
from kiteline_core.pose import pose_kernels
from kiteline_hw.logs.mcap_log import DEPTH, LEFT, RIG, RIGHT, LogReader, read_frame
from kiteline_hw.logs.rig_json import rig_from_json
from kiteline_hw.system.vocabulary import shipped_vocabulary
from kiteline_lab.flights.fly import Options, fly
from kiteline_lab.replay.replay import steps

TITLE = "Stages"

# What is timed: the owner of a function, its name, and what it is called in the table. A stage's own time is told, that
# of stages inside it taken off.
STAGES: tuple[tuple[Any, str, str], ...] = (
    (Agent, "step", "all else"),
    (Agent, "_view", "rectification"),
    (frame_images, "build_pyramid", "pyramids"),
    (tracker.Tracker, "track", "tracking, but for:"),
    (alignment_kernels, "align", "alignment"),
    (stereo_kernels, "refine_rows", "stereo, sub-pixel"),
    (pose_kernels, "optimise_pose", "pose"),
    (depth_from_motion.DepthFromMotion, "update", "depth from motion"),
    (keyframe_maker.KeyframeMaker, "make", "keyframe, but for:"),
    (features, "detect", "corners"),
    (features, "describe", "descriptors"),
    (stereo_kernels, "search_rows", "stereo, search"),
    (frame_images.RightImage, "coarse", "right image, half"),
    (alignment_kernels, "cut_templates", "templates"),
    (recovery.Relocaliser, "remember", "place words"),
    (CodedChannel, "receive", "codec, in"),
    (CodedChannel, "put", "codec, records"),
    (CodedChannel, "poll", "codec, packets"),
)


class Clocks:
    """Own CPU time of stages, in ns, since the last `clear`."""

    def __init__(self) -> None:
        self.own_ns: dict[str, int] = {}
        self._inner_ns: list[int] = []

    def clear(self) -> None:
        """Begin a new step."""
        self.own_ns = {}

    def timed(self, function: Callable[..., Any], stage: str) -> Callable[..., Any]:
        """The function, with its own time booked under a stage."""

        def run(*args: Any, **named: Any) -> Any:
            begin_ns = time.thread_time_ns()
            self._inner_ns.append(0)
            try:
                return function(*args, **named)
            finally:
                spent_ns = time.thread_time_ns() - begin_ns
                self.own_ns[stage] = self.own_ns.get(stage, 0) + spent_ns - self._inner_ns.pop()
                if self._inner_ns:
                    self._inner_ns[-1] += spent_ns

        return run

    @contextmanager
    def running(self) -> Iterator[None]:
        """Time all STAGES."""
        with ExitStack() as stack:
            for owner, name, stage in STAGES:
                stack.enter_context(patch.object(owner, name, self.timed(getattr(owner, name), stage)))
            yield


def profile(log_path: Path) -> dict[str, list[dict[str, int]]]:
    """Fly an agent again from its log. Own times in ns by stage, of every "frame" and every "keyframe"."""
    found: dict[str, list[dict[str, int]]] = {"frame": [], "keyframe": []}
    clocks = Clocks()
    with LogReader(log_path) as log:
        rig, imu = rig_from_json(next(iter(log.messages((RIG,)))).json())
        codec_warm.warm()
        warm(rig)
        agent = Agent(rig, imu, AgentConfig(), Identity(AgentId(0), 0), coded_channel(1), shipped_vocabulary())
        with clocks.running():
            for step in steps(log):
                frame = batch = None
                if step.head["frame_ns"] is not None:
                    images = [m.image() for topic in (LEFT, RIGHT, DEPTH) for m in step.of(topic)]
                    frame = read_frame(images, step.head["frame_ns"], bool(step.of(DEPTH)))
                if step.head["imu"]:
                    batch = step.of(flight_log.IMU)[0].imu()
                clocks.clear()
                agent.step(
                    StepInput(frame, batch, step.blobs(flight_log.PACKETS_IN), step.head["cpu_ns"]), step.head["now_ns"]
                )
                if frame is not None:
                    found["keyframe" if agent.work.keyframes else "frame"].append(clocks.own_ns)
    return found


def table(found: dict[str, list[dict[str, int]]]) -> str:
    """Means in ms as Markdown, a line a stage."""
    lines = ["| stage | a frame, ms | a keyframe, ms |", "|---|---|---|"]
    for _, _, stage in STAGES:
        cells = (np.mean([own.get(stage, 0) for own in found[kind]] or [0]) / 1e6 for kind in ("frame", "keyframe"))
        lines.append(f"| {stage} | {' | '.join(f'{cell:.2f}' for cell in cells)} |")
    sums = (np.mean(_sums_ms(found[kind])) for kind in ("frame", "keyframe"))
    return "\n".join([*lines, f"| **together** | {' | '.join(f'**{ms:.2f}**' for ms in sums)} |"])


def _sums_ms(steps_ns: list[dict[str, int]]) -> list[float]:
    return [sum(own.values()) / 1e6 for own in steps_ns] or [0.0]


def run(bench: Bench) -> list[Bar]:
    """One table a recording. A keyframe keeps to what 95 % of frames may cost: p95 holds whatever their share."""
    cv2.setNumThreads(1)
    bars = []
    for name in ("room_flight.mcap", "kitti_straight"):
        bench.say(f"flying {name}, then again from its log")
        out = bench.folder / f"stages_{Path(name).stem}"
        fly(Options((bench.source(name),), out), quiet=True)
        found = profile(out / "agent0" / "log.mcap")
        bench.more.append(f"{name}: own CPU time of stages, means over {len(found['frame'])} frames and "
                          f"{len(found['keyframe'])} keyframes\n\n{table(found)}")  # fmt: skip
        bars.append(
            at_most(f"{name}: a keyframe's step, mean", float(np.mean(_sums_ms(found["keyframe"]))), 12.0, "ms", 2)
        )
        bars.append(at_most(f"{name}: a frame's step, mean", float(np.mean(_sums_ms(found["frame"]))), 5.0, "ms", 2))
    return bars
