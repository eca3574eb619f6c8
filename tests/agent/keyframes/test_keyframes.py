"""When a frame becomes a keyframe, and what it holds in small images and without depths."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kiteline_agent.config import AgentConfig, KeyframeConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.image_cells import with_cells_for
from kiteline_agent.keyframes.policy import Situation, keyframe_need
from kiteline_bench.harness.recording import Recording, load
from kiteline_bench.harness.result import AgentRun
from kiteline_bench.harness.run import FlyingAgent
from kiteline_codec.schema import KeyframeHeader, Record
from kiteline_core.arrays import U8
from kiteline_core.frame import Frame

CONFIG = KeyframeConfig()
USUAL = Situation(5, 0.25, 200, 210, 0.9, 0.01, 0.01)


def test_bare_regions_need_a_keyframe_only_where_the_last_one_filled_them() -> None:
    assert keyframe_need(USUAL, CONFIG) is None
    left = replace(USUAL, cover=0.40, reference_cover=0.9)
    need = keyframe_need(left, CONFIG)
    assert need.rule == "bare image regions"
    assert keyframe_need(replace(left, reference_cover=0.42), CONFIG) is None
    assert keyframe_need(replace(left, cover=0.30, reference_cover=0.42), CONFIG) is not None


def test_a_camera_that_sees_less_needs_keyframes_after_smaller_turns() -> None:
    turned = replace(USUAL, turned_rad=0.2)
    assert keyframe_need(turned, CONFIG) is None
    need = keyframe_need(turned, replace(CONFIG, rotation_rad=0.15))
    assert need is not None and need.rule == "new direction"


@pytest.mark.parametrize(("first_points", "min_depth_m", "begins"), [
    (40, 0.25, True), (10_000, 0.25, False), (40, 100.0, False),
])  # fmt: skip
def test_a_map_begins_with_as_many_landmarks_as_is_asked_where_surfaces_are_looked_for(
    recording: Path, first_points: int, min_depth_m: float, begins: bool
) -> None:
    wall, config = load(str(recording), frames=3), AgentConfig()
    config = replace(
        config,
        local_map=replace(config.local_map, first_points=first_points),
        stereo=replace(config.stereo, min_depth_m=min_depth_m),
    )
    agent = FlyingAgent(wall.rig, None, config, vocabulary=False)
    for item in wall.items:
        agent.step(item)
    assert bool(agent.run.tracked) == begins


def test_a_view_of_which_two_thirds_are_black_does_not_make_a_keyframe_of_every_second_frame(recording: Path) -> None:
    wall = load(str(recording))

    def seen(image: U8) -> U8:
        part = np.zeros_like(image)
        part[60:180, 40:280] = image[60:180, 40:280]
        return part

    agent = FlyingAgent(wall.rig, None, vocabulary=False)
    for item in wall.items:
        assert item.frame.right is not None
        frame = replace(item.frame, left=seen(item.frame.left), right=seen(item.frame.right), encoded=())
        agent.step(replace(item, frame=frame))
    bare = [e for events in agent.run.events for e in events if e == "keyframe: bare image regions"]
    assert agent.run.lost == 0 and len(bare) < 4


def test_an_image_that_shows_much_less_than_the_one_before_makes_no_keyframe(recording: Path) -> None:
    wall, bad = load(str(recording)), range(4, 30, 5)
    agent = FlyingAgent(wall.rig, None, vocabulary=False)
    for k, item in enumerate(wall.items):
        left = np.concatenate([item.frame.left[:90], np.roll(item.frame.left[90:], 40, axis=1)])
        agent.step(replace(item, frame=replace(item.frame, left=left, encoded=())) if k in bad else item)
    made = [k for k, events in enumerate(agent.run.events) if any(e.startswith("keyframe") for e in events)]
    assert made and not set(made) & set(bad)
    assert agent.run.lost == 0


def test_an_image_that_goes_on_showing_less_makes_a_keyframe(recording: Path) -> None:
    wall = load(str(recording))
    agent = FlyingAgent(wall.rig, None, vocabulary=False)
    for k, item in enumerate(wall.items):
        left = item.frame.left.copy()
        left[90 if k > 10 else 240 :] = 90
        agent.step(replace(item, frame=replace(item.frame, left=left, encoded=())))
    made = [k for k, events in enumerate(agent.run.events) if "keyframe: few points left" in events]
    assert 11 not in made and 12 in made


@pytest.mark.parametrize("size", [(320, 240), (424, 240), (640, 480)])
def test_a_small_image_has_as_many_cells(size: tuple[int, int]) -> None:
    config = with_cells_for(AgentConfig(), *size)
    for cell_px in (config.detector.cell_px, config.align.cell_px, config.inertial_start.corner_tracks.cell_px):
        cells = -(-size[0] // cell_px) * -(-size[1] // cell_px)
        assert 300 < cells < 420, "about as many as 752x480 px have"
    assert config.keyframe.min_inliers < 300, "a frame can have more landmarks than a keyframe needs"


def test_cells_stay_at_752x480_and_above_and_never_vanish() -> None:
    assert with_cells_for(AgentConfig(), 752, 480) == AgentConfig()
    assert with_cells_for(AgentConfig(), 1280, 720) == AgentConfig()
    assert with_cells_for(AgentConfig(), 64, 48).detector.cell_px >= 12


def test_a_cell_that_was_set_stays() -> None:
    config = AgentConfig()
    config = replace(config, detector=replace(config.detector, cell_px=40), align=replace(config.align, cell_px=20))
    small = with_cells_for(config, 320, 240)
    assert (small.detector.cell_px, small.align.cell_px) == (40, 20)
    assert small.relocalisation.cell_px < config.relocalisation.cell_px
    written = replace(AgentConfig(), shrink_cells=False)
    assert with_cells_for(written, 320, 240) == written


def test_a_small_pair_has_landmarks_for_few_keyframes(recording: Path) -> None:
    small = load(str(recording))
    agent = FlyingAgent(small.rig, None, vocabulary=False)
    for item in small.items:
        agent.step(item)
    keyframes = [event for events in agent.run.events for event in events if event.startswith("keyframe")]
    assert 3 <= len(keyframes) <= 9  # with cells of 32 px every second frame had too few landmarks
    assert min(found.inliers for found in agent.run.found[1:]) > 90


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
