"""Which poses a flight controller gets, and what the user is told of those that it does not get."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from kiteline_agent.runtime.controller import UnsentPoses, pose_sample
from kiteline_agent.step import Estimate, PredictedPose, StepOutput
from kiteline_core.ids import KeyframeId, SubmapId

S = 1_000_000_000
UP, COV = np.eye(3), np.eye(6)
ESTIMATE = Estimate(
    0, True, False, np.eye(4), np.eye(4), KeyframeId(0), np.eye(4), SubmapId(0), 100, 90, COV, COV, UP, None
)  # fmt: skip
PREDICTED = PredictedPose(0, "imu", True, np.eye(4), np.zeros(3), np.zeros(3), 90, COV, UP)


def test_no_pose_goes_out_in_another_unit_or_tilted() -> None:
    agent: Any = SimpleNamespace(in_metres=True, odometry_quality=lambda _estimate: 80)
    of_frame, between = StepOutput(ESTIMATE, (), ()), StepOutput(None, (), (), PREDICTED)
    for output in (of_frame, between):
        sample = pose_sample(agent, output, 0, 0)
        assert sample is not None and sample.tracked
    agent.in_metres = False
    assert pose_sample(agent, of_frame, 0, 0) is None and pose_sample(agent, between, 0, 0) is None
    agent.in_metres = True
    tilted = replace(of_frame, estimate=replace(ESTIMATE, R_l_o=None))
    assert pose_sample(agent, tilted, 0, 0) is None
    lost = pose_sample(agent, replace(of_frame, estimate=replace(ESTIMATE, tracked=False)), 0, 0)
    assert lost is not None and not lost.tracked


def test_why_no_pose_goes_out_is_told_when_it_begins_and_when_it_ends() -> None:
    told, unsent = [], UnsentPoses()
    tilted = replace(ESTIMATE, R_l_o=None)
    flight: list[tuple[float, Estimate | None, bool]] = [
        (0.0, tilted, True), (1.0, tilted, True), (2.0, ESTIMATE, True),  # most starts
        (3.0, tilted, True), (5.9, tilted, True), (6.0, tilted, True), (9.0, tilted, True), (10.0, ESTIMATE, True),
        (11.0, tilted, True), (12.0, ESTIMATE, False), (12.5, None, False),
        (13.0, replace(ESTIMATE, tracked=False), True), (14.0, ESTIMATE, True),
    ]  # fmt: skip
    for t_s, estimate, in_metres in flight:
        at = None if estimate is None else replace(estimate, t_ns=round(t_s * S))
        told += [(t_s, line) for line in unsent.lines(at, in_metres=in_metres)]
    assert [t_s for t_s, _ in told] == [6.0, 10.0, 12.0, 14.0]
    assert "which way is up" in told[0][1] and "--no-imu" in told[0][1]
    assert told[1][1] == told[3][1] == "flight controller: gets poses"
    assert "not in metres" in told[2][1]
