"""The agent on recordings and on bad frames: it follows the truth, survives faults, and stays continuous."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.mapping.track_stage import TrackStage
from kiteline_agent.step import Estimate, Identity, StepInput
from kiteline_agent.tracking.frame_context import FrameContext
from kiteline_agent.tracking.track import Track
from kiteline_core.arrays import F64
from kiteline_core.frame import Frame, ImuBatch, joined
from kiteline_core.geometry import se3
from kiteline_core.ids import AgentId
from kiteline_hw.ports import FrameSource
from kiteline_hw.sources.open import open_source


def fly(source: FrameSource, frames: Iterable[Frame | ImuBatch], config: AgentConfig | None = None) -> list[Estimate]:
    agent = Agent(source.rig, source.imu, config or AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel())
    out: list[Estimate] = []
    imu: ImuBatch | None = None
    for item in frames:
        if isinstance(item, ImuBatch):
            imu = item
            continue
        estimate = agent.step(StepInput(item, imu), item.t_ns).estimate
        assert estimate is not None
        out.append(estimate)
        imu = None
    return out


def first_frames(source: FrameSource, n: int) -> list[Frame | ImuBatch]:
    items: list[Frame | ImuBatch] = []
    for item in source:
        items.append(item)
        n -= isinstance(item, Frame)
        if n == 0:
            break
    return items


def map_pose(estimate: Estimate) -> F64 | None:
    return estimate.T_m_b


def odometry_pose(estimate: Estimate) -> F64 | None:
    return estimate.T_o_b


def step_errors_m(
    source: FrameSource, estimates: list[Estimate], pose: Callable[[Estimate], F64 | None] = map_pose
) -> F64:
    """Error of the motion between frames that have a true pose at their time."""
    truth = source.ground_truth
    at = {int(t): T for t, T in zip(truth.t_ns, truth.T_w_b)}
    known = [(e.t_ns, T) for e in estimates if e.t_ns in at and (T := pose(e)) is not None]
    errors = []
    for (t_a, a), (t_b, b) in pairwise(known):
        true = se3.inverse(at[t_a]) @ at[t_b]
        errors.append(np.linalg.norm((se3.inverse(true) @ se3.inverse(a) @ b)[:3, 3]))
    return np.array(errors)


def every(items: list[Frame | ImuBatch], step: int) -> list[Frame | ImuBatch]:
    """Every so many frames; all samples of the IMU are given with the next one."""
    out: list[Frame | ImuBatch] = []
    waiting: list[ImuBatch] = []
    number = 0
    for item in items:
        if isinstance(item, ImuBatch):
            waiting.append(item)
            continue
        if number % step == 0:
            samples = joined(waiting)
            out += [item] if samples is None else [samples, item]
            waiting = []
        number += 1
    return out


@pytest.mark.parametrize("with_imu", [True, False])
def test_room_flight_is_followed_to_millimetres(data_dir: Path, with_imu: bool) -> None:
    source = open_source(str(data_dir / "room_flight.mcap"), imu=with_imu)
    estimates = fly(source, first_frames(source, 60))
    assert all(e.tracked for e in estimates)
    errors = step_errors_m(source, estimates)
    assert len(errors) > 20
    assert np.sqrt((errors**2).mean()) < 0.004


def test_kitti_is_followed(data_dir: Path) -> None:
    source = open_source(str(data_dir / "kitti_straight"))
    estimates = fly(source, first_frames(source, 20))
    assert all(e.tracked for e in estimates)
    assert np.sqrt((step_errors_m(source, estimates) ** 2).mean()) < 0.025


@pytest.mark.parametrize("step", [2, 3, 4])
def test_a_street_is_followed_from_the_first_frame_on_by_slow_cameras(data_dir: Path, step: int) -> None:
    """The vehicle makes 2.4 to 4.8 m between two frames, and nothing tells that before the second one."""
    source = open_source(str(data_dir / "kitti_straight"))
    estimates = fly(source, every(first_frames(source, 7 * step), step))
    assert all(e.tracked for e in estimates) and len({e.submap for e in estimates}) == 1
    assert step_errors_m(source, estimates, odometry_pose).max() < 0.1


def test_steps_along_the_axis_are_tried_without_a_landmark_in_view(
    data_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found, track = list[Track](), TrackStage.track

    def looking_back(stage: TrackStage, ctx: FrameContext, *, was_lost: bool) -> Track | None:
        turned = se3.from_rt(se3.so3_exp(np.array([0.0, np.pi, 0.0])), np.zeros(3)) @ ctx.T_c_m
        found.append(stage._tracker.track_along_axis(ctx, turned))
        return track(stage, ctx, was_lost=was_lost)

    monkeypatch.setattr(TrackStage, "track", looking_back)
    source = open_source(str(data_dir / "kitti_straight"))
    fly(source, first_frames(source, 2))
    assert [each.inliers for each in found] == [0]


@pytest.mark.parametrize(("begin", "end", "step"), [(0, 300, 4), (120, 400, 8)])
def test_the_odometry_follows_what_slow_cameras_measure(data_dir: Path, begin: int, end: int, step: int) -> None:
    """Five frames a second, or half as many: what is found by descriptors counts against a guessed prediction."""
    source = open_source(str(data_dir / "room_flight.mcap"), imu=False)
    estimates = fly(source, every(first_frames(source, end)[begin:], step))
    assert all(e.tracked for e in estimates) and len({e.submap for e in estimates}) == 1
    assert step_errors_m(source, estimates, odometry_pose).max() < 0.02


@pytest.mark.parametrize("with_imu", [True, False])
def test_the_odometry_follows_what_is_measured_over_frames_without_an_image(data_dir: Path, with_imu: bool) -> None:
    """At 1.3 m/s and before an IMU is of use: one frame, and three. What stands there meanwhile is a good guess."""
    source = open_source(str(data_dir / "room_flight.mcap"), imu=with_imu)
    items, k, lost = [], 0, (6, 9, 10, 11)
    for item in first_frames(source, 118):
        if isinstance(item, Frame):
            k += 1
            blank = k - 101 in lost
            item = replace(item, left=np.full_like(item.left, 90), right=np.full_like(item.left, 90)) if blank else item
        if k > 100:
            items.append(item)
    estimates = fly(source, items)
    assert [k for k, e in enumerate(estimates) if not e.tracked] == [*lost]
    tracked = [e for e in estimates if e.tracked]
    assert step_errors_m(source, tracked, odometry_pose).max() < 0.004
    assert step_errors_m(source, estimates, odometry_pose).max() < 0.03


@pytest.mark.parametrize("with_imu", [True, False])
def test_frames_without_their_right_image_are_tracked(data_dir: Path, with_imu: bool) -> None:
    """Three of ten are lost, and all for one second."""
    source = open_source(str(data_dir / "room_flight.mcap"), imu=with_imu)
    rng = np.random.default_rng(2)
    frames, k = [], 0
    for item in first_frames(source, 90):
        if isinstance(item, Frame):
            lost = (k > 0 and rng.random() < 0.3) or 40 <= k < 60
            item, k = replace(item, right=None, encoded=()) if lost else item, k + 1
        frames.append(item)
    estimates = fly(source, frames)
    assert all(e.tracked for e in estimates) and len({e.submap for e in estimates}) == 1
    assert np.sqrt(np.mean(step_errors_m(source, estimates) ** 2)) < 0.005


def jump_m(estimates: list[Estimate]) -> float:
    p = np.array([e.T_o_b[:3, 3] for e in estimates])
    return float(np.linalg.norm(np.diff(p, axis=0), axis=1).max())


@pytest.mark.parametrize("fault", ["black", "frozen", "half", "dropped", "exposure", "swapped"])
def test_faults_on_frames_are_survived(data_dir: Path, fault: str) -> None:
    source = open_source(str(data_dir / "room_flight.mcap"))
    frames = [f for f in first_frames(source, 38) if isinstance(f, Frame)]
    for k in range(20, 23):
        f = frames[k]
        assert f.right is not None
        if fault == "black":
            frames[k] = replace(f, left=np.zeros_like(f.left), right=np.zeros_like(f.right))
        elif fault == "frozen":
            frames[k] = replace(frames[19], t_ns=f.t_ns)
        elif fault == "half":
            frames[k] = replace(f, right=None)
        elif fault == "exposure":
            frames[k] = replace(f, left=(f.left * 0.55).astype(np.uint8), right=(f.right * 0.55).astype(np.uint8))
        elif fault == "swapped":
            frames[k] = replace(f, left=f.right, right=f.left)
    if fault == "dropped":
        del frames[20:23]
    estimates = fly(source, frames)
    assert all(e.tracked for e in estimates[-12:])
    assert all(np.isfinite(e.T_o_b).all() for e in estimates)
    assert jump_m(estimates) < 0.35


def test_dead_reckoning_extends_the_map(data_dir: Path) -> None:
    source = open_source(str(data_dir / "room_flight.mcap"))
    items, seen = [], 0
    for item in first_frames(source, 90):
        if isinstance(item, Frame):
            seen += 1
            if 60 <= seen < 68:  # 0.4 s of black in a flight, and what was known of the place is gone with it
                item = replace(item, left=np.zeros_like(item.left), right=np.zeros_like(item.left), encoded=())
        items.append(item)
    agent = Agent(source.rig, source.imu, AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel())
    found: list[Estimate] = []
    imu: ImuBatch | None = None
    for item in items:
        if isinstance(item, ImuBatch):
            imu = item
            continue
        if len(found) == 66:
            agent.map.drop_submap(agent.submap)
        estimate = agent.step(StepInput(item, imu), item.t_ns).estimate
        assert estimate is not None
        found.append(estimate)
        imu = None
    assert all(e.tracked for e in found) and {e.submap for e in found} == {found[0].submap}
    assert found[67].bridged and not found[70].bridged
    assert step_errors_m(source, found)[-20:].max() < 0.02
    assert found[70].cov_m[0, 0] > found[58].cov_m[0, 0]


def test_nothing_to_see_is_no_error() -> None:
    from kiteline_core.geometry.cameras import CameraModel, CameraRig

    camera = CameraModel(320, 240, 200.0, 200.0, 159.5, 119.5)
    rig = CameraRig(camera, camera, np.eye(4), se3.from_rt(np.eye(3), np.array([0.1, 0.0, 0.0])))
    agent = Agent(rig, None, AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel())
    grey = np.full((240, 320), 100, np.uint8)
    for k in range(6):
        estimate = agent.step(StepInput(Frame(k * 50_000_000, grey, grey)), k * 50_000_000).estimate
        assert not estimate.tracked
        assert estimate.quality == -1 and estimate.T_m_b is None
