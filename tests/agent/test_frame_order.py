"""Frames that come late or twice change nothing, whoever steps the agent."""

from collections.abc import Iterator
from dataclasses import fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.frame_order import FrameOrder
from kiteline_agent.onboard import OnboardAgent, onboard_agent
from kiteline_agent.runtime.agent_runtime import AgentRuntime
from kiteline_agent.runtime.options import AgentOptions
from kiteline_agent.step import Identity, StepInput, StepOutput
from kiteline_core.frame import Frame, ImuBatch, ImuCalibration
from kiteline_core.ids import AgentId
from kiteline_hw.lockstep.messages import Down, Phase
from kiteline_hw.sources.open import open_source
from kiteline_lab.replay.replay import main as replay


@pytest.fixture(scope="module")
def frames(recording: Path) -> list[Frame]:
    return [item for item in open_source(str(recording)) if isinstance(item, Frame)]


def new_agent(
    recording: Path, tracker: str, cpu_percent: float, imu: ImuCalibration | None = None
) -> OnboardAgent:  # fmt: skip
    source, config = open_source(str(recording), mono=tracker == "ekf"), AgentConfig()
    governor = replace(config.governor, cpu_percent=cpu_percent)
    config = replace(config, tracker=tracker, governor=governor)
    return onboard_agent(source.rig, imu, config, Identity(AgentId(0), 1), NoBaseChannel(), None)


def fly(agent: OnboardAgent, frames: list[Frame]) -> list[StepOutput]:
    outputs = [agent.step(StepInput(frame, cpu_ns=15_000_000), n) for n, frame in enumerate(frames)]
    return [output for output in outputs if output.estimate is not None or output.predicted is not None]


def bits(outputs: list[StepOutput]) -> list[Any]:
    estimates = [output.estimate or output.predicted for output in outputs]
    return [
        [v.tobytes() if isinstance(v, np.ndarray) else v for v in (getattr(e, f.name) for f in fields(e))]
        for e in estimates if e is not None
    ]  # fmt: skip


def disordered(frames: list[Frame]) -> Iterator[Frame]:
    """Also some frames again, some that were taken before, and one that a step of the clock set back."""
    for n, frame in enumerate(frames):
        yield frame
        if n % 3 == 0:
            yield frame
        if n % 4 == 1:
            yield replace(frames[n - 1], left=frame.left)
        if n == 20:
            yield replace(frame, t_ns=frame.t_ns - 900_000_000)


@pytest.mark.parametrize("cpu_percent", [0.0, 30.0])
@pytest.mark.parametrize("tracker", ["map", "ekf"])
def test_frames_that_are_not_newer_change_nothing(
    recording: Path, frames: list[Frame], tracker: str, cpu_percent: float
) -> None:
    """The governor divided by the time between them, which was none."""
    given, agent = list(disordered(frames)), new_agent(recording, tracker, cpu_percent)
    assert bits(fly(agent, given)) == bits(fly(new_agent(recording, tracker, cpu_percent), frames))
    assert agent.left_out == len(given) - len(frames)


def test_samples_that_come_with_such_a_frame_count_with_the_next_one(recording: Path, frames: list[Frame]) -> None:
    def flown(late: bool) -> list[StepOutput]:
        agent = new_agent(recording, "map", 0.0, ImuCalibration())
        outputs = [agent.step(StepInput(frames[0]), 0)]
        for before, frame in pairwise(frames):
            t_ns = np.arange(before.t_ns + 1, frame.t_ns, 5_000_000, dtype=np.int64)
            imu = ImuBatch(t_ns, np.zeros((len(t_ns), 3)), np.tile([0.0, -9.81, 0.0], (len(t_ns), 1)))
            if late:
                outputs.append(agent.step(StepInput(before, imu), 0))
            outputs.append(agent.step(StepInput(frame, None if late else imu), 0))
        return [output for output in outputs if output.estimate is not None]

    assert bits(flown(late=True)) == bits(flown(late=False))


def test_an_event_says_when_frames_are_left_out_and_when_no_more(frames: list[Frame]) -> None:
    order = FrameOrder()
    said = [order.newer(None if t is None else replace(frames[0], t_ns=t))[1] for t in (5, 5, None, 4, 3, 6, 7, 7)]
    assert said == [
        [], ["frame left out: its stamp 5 ns is not after 5 ns"], [], [], [],
        ["stamps increase again; frames left out: 3"], [], ["frame left out: its stamp 7 ns is not after 7 ns"],
    ]  # fmt: skip
    assert order.left_out == 4


def test_a_flight_with_such_frames_is_replayed_bit_for_bit(
    recording: Path, frames: list[Frame], tmp_path: Path
) -> None:
    source = open_source(str(recording))
    mixed = Mixed(source, list(disordered(frames)))
    options = AgentOptions(str(recording), str(tmp_path))
    runtime = AgentRuntime(options, mixed, NoBaseChannel(), whole_process=False)
    now_ns = 0
    while runtime.next_ns is not None:
        now_ns = max(now_ns + 1, runtime.next_ns)
        runtime.tick(Down(now_ns, Phase.FLY, ()))
    runtime.close()
    assert runtime.agent.left_out > 10
    assert runtime.report()["frames"] == len(mixed.frames)
    assert replay([str(tmp_path / "log.mcap"), "--verify"]) == 0


class Mixed:
    """A source whose frames are in another order."""

    frame_count = None

    def __init__(self, source: Any, frames: list[Frame]) -> None:
        self.rig, self.imu, self.name, self.report, self.frames = source.rig, None, "mixed", source.report, frames

    def __iter__(self) -> Iterator[Frame]:
        return iter(self.frames)

    def close(self) -> None:
        """Nothing is open."""
