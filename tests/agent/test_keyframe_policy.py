"""When a frame becomes a keyframe: not where another keyframe would find no more landmarks."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from kiteline_agent.config import KeyframeConfig
from kiteline_agent.keyframes.policy import Situation, keyframe_need
from kiteline_bench.harness.recording import load
from kiteline_bench.harness.run import FlyingAgent
from kiteline_core.frame import U8

CONFIG = KeyframeConfig()
USUAL = Situation(5, 0.25, 200, 210, 0.9, 0.01, 0.01)


def test_bare_regions_need_a_keyframe_only_where_the_last_one_filled_them() -> None:
    assert keyframe_need(USUAL, CONFIG) is None
    left = replace(USUAL, cover=0.40, reference_cover=0.9)
    need = keyframe_need(left, CONFIG)
    assert need.rule == "bare image regions"
    assert keyframe_need(replace(left, reference_cover=0.42), CONFIG) is None
    assert keyframe_need(replace(left, cover=0.30, reference_cover=0.42), CONFIG) is not None


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
