"""What a person is told of a live flight."""

import numpy as np

from kiteline_agent.runtime.frame_counts import FrameCounts
from kiteline_agent.runtime.terminal import StatusMessages, summary
from kiteline_agent.step import Estimate, StepOutput
from kiteline_core.ids import KeyframeId, SubmapId


def output(tracked: bool, *events: str) -> StepOutput:
    pose = np.eye(4)
    estimate = Estimate(
        t_ns=0, tracked=tracked, bridged=False, T_m_b=pose if tracked else None, T_o_b=pose, keyframe=KeyframeId(0),
        T_k_c=pose, submap=SubmapId(0), inliers=0, quality=1, cov_m=np.eye(6), cov_o=np.eye(6), R_l_o=np.eye(3),
        T_w_b=None,
    )  # fmt: skip
    return StepOutput(estimate, (), events)


def test_changes_are_told_once_and_a_summary_now_and_then() -> None:
    narrator, tally, told = StatusMessages(), FrameCounts(), []
    tracked = [False] * 10 + [True] * 300 + [False] * 4 + [True] * 86  # at 20 Hz
    for k, yes in enumerate(tracked):
        step = output(yes, *(("submap: opened", "keyframe: heartbeat") if k == 10 else ()))
        tally.count(step.estimate)
        told += narrator.lines(step, tally, k * 50_000_000)
    words = [line.split("s  ", 1)[1] for line in told]
    assert words[:2] == ["submap: opened", "first pose"]
    assert words[2].startswith("201 frames: 191 tracked, 10 lost, 0 dropped; 1 keyframes in 1 submap; 0.0 kB/s up")
    assert words[3:] == ["lost: no pose from the images", "tracking again after 0.2 s"]
    assert told[4].startswith("    15.7 s")
    assert summary(tally).startswith("400 frames: 386 tracked, 14 lost")


def test_what_is_found_of_the_flight_controller_is_shown() -> None:
    (line,) = StatusMessages().lines(output(False), FrameCounts(), 2_000_000_000, ["flight controller: found: PX4"])
    assert line == "     2.0 s  flight controller: found: PX4"
