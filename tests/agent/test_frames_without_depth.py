"""Frames of a depth camera that came without depth: they are tracked, but no keyframe is made of them."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_bench.harness.recording import Recording, load
from kiteline_bench.harness.result import AgentRun
from kiteline_bench.harness.run import FlyingAgent
from kiteline_codec.schema import KeyframeHeader, Record
from kiteline_core.frame import Frame

WALL_M = 2.0
EVERY = 3  # frames: one of so many has depth


class Headers(NoBaseChannel):
    """Keeps the headers of keyframes."""

    def __init__(self) -> None:
        super().__init__()
        self.t_ns: list[int] = []

    def put(self, record: Record) -> Record:
        if isinstance(record, KeyframeHeader):
            self.t_ns.append(record.t_ns)
        return super().put(record)


def fly(wall: Recording) -> tuple[AgentRun, list[int]]:
    """The flight, and the frames of its keyframes."""
    channel = Headers()
    agent = FlyingAgent(wall.rig, None, channel=channel, vocabulary=False)
    for item in wall.items:
        agent.step(item)
    stamps = [item.frame.t_ns for item in wall.items]
    return agent.run, [stamps.index(t_ns) for t_ns in channel.t_ns]


def depth_camera(wall: Recording) -> Recording:
    depth = np.full(wall.items[0].frame.left.shape, WALL_M, np.float32)
    items = (replace(item, frame=replace(item.frame, right=None, depth_m=depth)) for item in wall.items)
    return replace(wall, rig=replace(wall.rig, right=None, T_c_r=None, has_depth=True), items=tuple(items))


def no_depth(frame: Frame) -> Frame:
    return replace(frame, right=None, depth_m=None)


def test_a_keyframe_waits_for_depth(recording: Path) -> None:
    wall = depth_camera(load(str(recording)))
    items = [item if k % EVERY == 0 else replace(item, frame=no_depth(item.frame)) for k, item in enumerate(wall.items)]
    run, keyframes = fly(replace(wall, items=tuple(items)))
    assert run.lost == 0 and run.ate_m("o") < 0.004
    assert len(keyframes) > 2 and all(k % EVERY == 0 for k in keyframes)


def test_a_keyframe_does_not_wait_for_depth_for_long(recording: Path) -> None:
    wall = depth_camera(load(str(recording)))
    items = [item if k == 0 else replace(item, frame=no_depth(item.frame)) for k, item in enumerate(wall.items)]
    run, keyframes = fly(replace(wall, items=tuple(items)))
    assert run.lost == 0 and len(keyframes) > 2


def test_before_the_first_depth_there_is_no_map(recording: Path) -> None:
    wall = depth_camera(load(str(recording)))
    items = [replace(item, frame=no_depth(item.frame)) if k < 4 else item for k, item in enumerate(wall.items)]
    run, keyframes = fly(replace(wall, items=tuple(items)))
    assert keyframes[0] == 4 and run.lost == 4
