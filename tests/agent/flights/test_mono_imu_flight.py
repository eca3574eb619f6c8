"""Flights of one camera with an IMU through a rendered room: metres, budgets, an IMU that contradicts the images."""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig, KeyframeConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.governor.cost_model import cost_ns
from kiteline_agent.runtime.controller import pose_sample
from kiteline_agent.runtime.frame_counts import FrameCounts, live_line, odometry_line
from kiteline_agent.step import Estimate, Identity, StepInput
from kiteline_codec.channel import plain_pair
from kiteline_codec.schema import GravityAlignment, KeyframeHeader, NewLandmarks, Observations, SubmapScale, SubmapTie
from kiteline_core.arrays import F64
from kiteline_core.frame import Frame, ImuBatch, ImuCalibration
from kiteline_core.geometry import se3
from kiteline_core.ids import KEYPOINT_BITS, NO_KEYFRAME, AgentId, submap_of_keyframe
from tests.agent.mono_room import (
    RIG,
    frame,
    path,
    room,
    similar,
    step,
)


def imu_at(t_s: F64, haste: float, along: Callable[[float], F64] = path) -> ImuBatch:
    """Samples of an IMU in the camera, whose y axis points down, on the path `haste` times as fast."""
    h, gyro, accel = 1e-3, [], []
    for t in t_s:
        before, here, after = (along(3.0 + 20.0 * haste * x) for x in (t - h, t, t + h))
        gyro.append(se3.so3_log(before[:3, :3].T @ after[:3, :3]) / (2.0 * h))
        moved = (before[:3, 3] - 2.0 * here[:3, 3] + after[:3, 3]) / h**2
        accel.append(here[:3, :3].T @ (moved - np.array([0.0, 9.81, 0.0])))
    return ImuBatch(np.round(t_s * 1e9).astype(np.int64), np.array(gyro), np.array(accel))


@cache
def taken(k: int, haste: float, along: Callable[[float], F64] = path) -> tuple[Frame, ImuBatch]:
    """The k-th frame on the path `haste` times as fast, and the samples up to it."""
    t_s = (k - 3) * 0.05
    image = Frame(round(t_s * 1e9), room(along(3.0 + haste * (k - 3)))[0])
    return image, imu_at(t_s - np.arange(9, -1, -1) * 0.005, haste, along)


def test_an_imu_gives_metres_from_the_first_pose_on() -> None:
    near, far = plain_pair()
    config = AgentConfig(keyframe=KeyframeConfig(earlier=True))
    one = Agent(RIG, ImuCalibration(), config, Identity(AgentId(0), 0), near)
    estimates: list[Estimate] = []
    words: list[str] = []
    begin, end, haste = 4, 110, 1.7  # in full motion from the first frame on
    for k in range(begin, end):
        image, imu = taken(k, haste)
        output = one.step(StepInput(image, imu), image.t_ns)
        assert output.estimate is not None
        estimates.append(output.estimate)
        words += output.events
    assert any(word.startswith("mono: metric within") for word in words) and one.metric
    first = next(i for i, e in enumerate(estimates) if e.tracked)
    assert 40 < first < 85
    before = estimates[:first]
    assert all(e.initialising and e.quality == -1 and odometry_line(e) == "" and live_line(e) == "" for e in before)
    assert all(e.tracked and not e.initialising for e in estimates[first:])
    found = np.array([e.T_m_b[:3, 3] for e in estimates[first:] if e.T_m_b is not None])
    true = np.array([path(3.0 + haste * (k - 3)) for k in range(begin + first, end)])
    scale, error_m = similar(found, true[:, :3, 3])
    assert scale == pytest.approx(1.0, abs=0.04) and error_m < 0.02
    # the map is gravity-aligned from its first pose on: the camera's y axis points down
    up = np.array([e.T_o_b[2, :3] for e in estimates[first:]])
    assert np.degrees(np.arccos(np.clip((up * -true[:, 1, :3]).sum(axis=1), -1.0, 1.0))).max() < 2.0
    records = far.receive((), 0)
    new_landmarks = [r for r in records if isinstance(r, NewLandmarks) and (r.inv_depth > 0).any()]
    assert {submap_of_keyframe(r.keyframe) for r in new_landmarks} == {e.submap for e in estimates[first:]}
    counts = FrameCounts()
    for e in estimates:
        counts.count(e)
    headers = {r.keyframe: r for r in records if isinstance(r, KeyframeHeader)}
    assert counts.keyframes == len(headers)
    # the base also gets what the camera saw before, from the first frame on
    began_ns = estimates[first].t_ns
    early = [k for k in sorted(headers) if headers[k].t_ns < began_ns]
    assert len(early) >= 3 and headers[early[0]].t_ns == estimates[0].t_ns
    T_m_k: dict[int, F64] = {NO_KEYFRAME: np.eye(4)}
    for k in sorted(headers):
        T_m_k[k] = T_m_k[headers[k].parent] @ headers[k].T_p_k
    at = np.array([T_m_k[k][:3, 3] for k in early])
    true_at = np.array([path(3.0 + haste * headers[k].t_ns / 5e7)[:3, 3] for k in early])
    scale, error_m = similar(at, true_at)
    assert scale == pytest.approx(1.0, abs=0.05) and error_m < 0.02
    observed = np.concatenate([r.point for r in records if isinstance(r, Observations) and r.keyframe in early])
    shared = Counter(dict.fromkeys(early, 0))
    for r in records:
        if isinstance(r, NewLandmarks) and r.keyframe in shared:
            shared[r.keyframe] += len(r.index)
    assert len(observed) > 50 and {int(p) >> KEYPOINT_BITS for p in observed} <= set(early)
    assert min(shared.values()) > 30  # corners as any keyframe has them, not only those that were followed


@cache
def fly_on_budget(cpu_percent: float) -> tuple[list[str], list[int], list[Estimate | None]]:
    config = AgentConfig()
    config = replace(config, governor=replace(config.governor, cpu_percent=cpu_percent))
    one = Agent(RIG, ImuCalibration(), config, Identity(AgentId(0), 0), NoBaseChannel())
    words: list[str] = []
    costs: list[int] = []
    estimates: list[Estimate | None] = []
    for k in range(4, 150):
        image, imu = taken(k, 1.7)
        output = one.step(StepInput(image, imu, cpu_ns=costs[-1] if costs else 0), image.t_ns)
        costs.append(cost_ns(one.work))
        words += [word for word in output.events if word.startswith("mono")]
        estimates.append(output.estimate)
        if output.estimate is not None:
            assert output.estimate.t_ns == image.t_ns  # none of a frame that waited
    return words, costs, estimates


@pytest.mark.parametrize("percent", [8.0, 30.0])
def test_a_budget_delays_the_first_pose_and_nothing_else(percent: float) -> None:
    """The solution for the first map costs a tenth of a second and more: frames wait for it, and are tracked after."""
    words, costs, estimates = fly_on_budget(percent)
    free, _, _ = fly_on_budget(0.0)
    assert words[0] == free[0] and words[0].startswith("mono: metric within")
    assert max(sum(costs[k : k + 20]) for k in range(len(costs) - 20)) <= percent * 1e7
    assert sum(e is not None and e.tracked for e in estimates[-20:]) > 3  # it has caught up
    assert max(np.diff([k for k, e in enumerate(estimates) if e is not None and e.tracked])) < 10


def test_a_still_camera_with_an_imu_has_no_pose() -> None:
    one = Agent(RIG, ImuCalibration(), AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel())
    image = room(path(0))[0]
    noise = np.random.default_rng(0)
    for k in range(60):
        t_ns = (k + 1) * 50_000_000
        stamps = t_ns - np.arange(9, -1, -1, dtype=np.int64) * 5_000_000
        imu = ImuBatch(
            stamps, 1e-3 * noise.normal(size=(10, 3)), np.array([0.0, -9.81, 0.0]) + 0.02 * noise.normal(size=(10, 3))
        )
        estimate = one.step(StepInput(Frame(t_ns, image), imu), t_ns).estimate
        assert estimate.initialising and not estimate.tracked


def test_images_alone_are_flown_where_the_imu_contradicts_them() -> None:
    config = AgentConfig()
    begin, end, haste = 4, 180, 0.8
    start = config.inertial_start
    start = replace(start, contradiction=replace(start.contradiction, lasts_s=1.5, unsure_s=2.0))
    one = Agent(RIG, ImuCalibration(), replace(config, inertial_start=start), Identity(AgentId(0), 0), NoBaseChannel())
    estimates: list[Estimate] = []
    words: list[str] = []
    for k in range(begin, end):
        image, imu = taken(k, haste)
        turned = replace(imu, gyro=imu.gyro * [1.0, -1.0, -1.0], accel=imu.accel * [1.0, -1.0, -1.0])
        output = one.step(StepInput(image, turned), image.t_ns)
        assert output.estimate is not None
        estimates.append(output.estimate)
        words += output.events
        sample = pose_sample(one, output, image.t_ns, 0)
        assert sample is None or not sample.tracked  # a flight controller would take its lengths for metres
    assert sum(word.startswith("imu: images and IMU contradict") for word in words) == 1
    assert sum(word.startswith("imu: not used from here on") for word in words) == 1
    assert not one.metric and one.motion_reports()["time_offset"] is None
    first = next(i for i, e in enumerate(estimates) if e.tracked)
    assert all(e.initialising for e in estimates[:first])
    assert all(e.tracked and not e.initialising for e in estimates[first:])
    found = np.array([e.T_m_b[:3, 3] for e in estimates[first:] if e.T_m_b is not None])
    true = np.array([path(3.0 + haste * (k - 3)) for k in range(begin + first, end)])
    assert similar(found, true[:, :3, 3])[1] < 0.03
    # as without an IMU, the camera counts as level where the flight began: z up in o is -y of the camera
    assert np.degrees(np.arccos(-estimates[first].T_o_b[2, 1])) < 12.0


def test_without_samples_a_monocular_map_keeps_its_own_unit() -> None:
    """An IMU that is calibrated but silent does not hold up tracking for ever."""
    one = Agent(RIG, ImuCalibration(), AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel())
    estimates = [step(one, frame(k)) for k in range(4, 110)]
    assert estimates[-1].tracked and not one.metric
    assert estimates[40].initialising
    first = next(e for e in estimates if e.tracked)
    assert np.degrees(np.arccos(-first.T_o_b[2, 1])) < 12.0  # the camera counts as level where the flight began


LOOKS_DOWN_RAD = 0.2


def swing(k: float) -> F64:
    """`path`, to and fro, of a camera that looks down."""
    s, T = max(k - 3, 0) * 0.05, path(k)
    return se3.from_rt(
        T[:3, :3] @ se3.so3_exp(np.array([-LOOKS_DOWN_RAD, 0.0, 0.0])),
        np.array([T[0, 3], T[1, 3], 1.2 * np.sin(0.45 * s)]),
    )


@pytest.mark.parametrize("percent", [0.0, 60.0])
def test_an_imu_whose_samples_begin_late_gives_metres_to_the_map_that_is_tracked(percent: float) -> None:
    """An agent that begins before its flight controller has a map in a unit of its own by then."""
    near, far = plain_pair()
    config = AgentConfig()
    two_views = replace(config.two_view_start, median_depth_m=8.0)  # twice what it is
    config = replace(config, governor=replace(config.governor, cpu_percent=percent), two_view_start=two_views)
    one = Agent(RIG, ImuCalibration(), config, Identity(AgentId(0), 0), near)
    flown: dict[int, Estimate] = {}
    words: list[str] = []
    begin, samples, end, haste = 4, 100, 270, 1.7
    cpu_ns, metric = 0, 0
    for k in range(begin, end):
        image, imu = taken(k, haste, swing)
        output = one.step(StepInput(image, imu if k >= samples else None, cpu_ns=cpu_ns), image.t_ns)
        cpu_ns = cost_ns(one.work)
        words += output.events
        if output.estimate is not None:  # a budget lets frames wait before there is a map
            flown[k] = output.estimate
        if not metric and one.metric:
            metric = k
    assert samples + 40 < metric < samples + 200
    (word,) = [w for w in words if "one unit was" in w]
    assert word.startswith("mono: metric within")
    first = next(k for k, e in flown.items() if e.tracked)
    assert all(flown[k].tracked for k in range(first, end))  # the search holds up no frame
    later = [flown[k] for k in range(metric, end)]
    found = np.array([e.T_m_b[:3, 3] for e in later if e.T_m_b is not None])
    true = np.array([swing(3.0 + haste * (k - 3)) for k in range(metric, end)])
    scale, error_m = similar(found, true[:, :3, 3])
    assert scale == pytest.approx(1.0, abs=0.04) and error_m < 0.02
    assert min(e.quality for e in later) > 60
    # upright for a flight controller from the first pose in metres on
    assert all(e.R_l_o is None for k, e in flown.items() if k < metric)
    up = np.array([(e.R_l_o @ e.T_o_b[:3, :3])[2] for e in later[5:] if e.R_l_o is not None])
    assert len(up) == len(later) - 5
    assert np.degrees(np.arccos(np.clip((up * -true[5:, 1, :3]).sum(axis=1), -1.0, 1.0))).max() < 2.0
    # the base is told how long a unit was, how the submaps lie to each other, and how the first one is tilted
    records = far.receive((), 0)
    old, new = (submap for submap in sorted({e.submap for e in flown.values()}))
    metres = {r.submap: r.metres for r in records if isinstance(r, SubmapScale)}
    own = np.array([e.T_m_b[:3, 3] for k in range(metric - 60, metric) if (e := flown[k]).T_m_b is not None])
    was = np.array([swing(3.0 + haste * (k - 3))[:3, 3] for k in range(metric - 60, metric)])
    assert metres[new] == 1.0 and metres[old] == pytest.approx(similar(own, was)[0], rel=0.04)
    (tie,) = [r for r in records if isinstance(r, SubmapTie)]
    assert tie.submap == new and submap_of_keyframe(tie.since) == old
    (alignment,) = [r for r in records if isinstance(r, GravityAlignment)]
    assert alignment.submap == old  # there the camera had counted as level
    tilt_rad = float(np.linalg.norm(se3.so3_log(alignment.T_l_m[:3, :3])))
    assert tilt_rad == pytest.approx(LOOKS_DOWN_RAD, abs=0.15)
