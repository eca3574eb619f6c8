"""Predicted poses of skipped frames and between frames: true, of growing covariance, and without effect on tracking."""

from dataclasses import replace

import numpy as np
import pytest

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.runtime.controller import pose_sample
from kiteline_agent.runtime.flight_log import estimate_to_json, predicted_to_json
from kiteline_agent.runtime.frame_counts import FrameCounts, live_line, odometry_line
from kiteline_agent.runtime.frame_reader import FrameReader
from kiteline_agent.runtime.pose_schedule import PoseSchedule
from kiteline_agent.step import Identity, PredictedPose, StepInput, StepOutput
from kiteline_core import odometry
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuBatch, OdometryBatch
from kiteline_core.geometry import se3
from kiteline_core.ids import AgentId
from tests.agent.room_flight import RoomFlight

S = 1_000_000_000
BEGIN = 20  # frames until all is initialised


@pytest.fixture(scope="module")
def flight(room_flight: RoomFlight) -> RoomFlight:
    """3.5 s in full motion through a room, at half the usual size."""
    return room_flight.first(3.5)


def between(flight: RoomFlight, from_ns: int, to_ns: int) -> ImuBatch | None:
    felt = flight.samples
    some = (felt.t_ns > from_ns) & (felt.t_ns <= to_ns)
    return ImuBatch(felt.t_ns[some], felt.gyro[some], felt.accel[some]) if some.any() else None


def driven_between(flight: RoomFlight, from_ns: int, to_ns: int) -> OdometryBatch:
    t = flight.driven.t_ns
    return odometry.chosen(flight.driven, (t > from_ns) & (t <= to_ns))


def agent_of(flight: RoomFlight, sensor: str, config: AgentConfig | None = None) -> Agent:
    imu = flight.imu if sensor == "imu" else None
    return Agent(flight.rig, imu, config or AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel())


def fly(
    flight: RoomFlight,
    sensor: str,
    every: int,
    *,
    ask: bool = True,
    config: AgentConfig | None = None,
    busy_ns: int = 0,
) -> list[StepOutput]:
    """From BEGIN on only every n-th frame is given; for the others a pose is asked for. busy_ns: of a frame."""
    agent = agent_of(flight, sensor, config)
    out, last_ns = [], flight.frames[0].t_ns - S
    for k, frame in enumerate(flight.frames):
        given = k < BEGIN or k % every == 0
        imu = between(flight, last_ns, frame.t_ns) if sensor == "imu" else None
        told = driven_between(flight, last_ns, frame.t_ns) if sensor == "odometer" else None
        last_ns = frame.t_ns
        step = StepInput(
            frame if given else None, imu, cpu_ns=busy_ns, odometry=told,
            predict_ns=frame.t_ns if ask and not given else None,
        )  # fmt: skip
        out.append(agent.step(step, frame.t_ns))
    return out


def errors(flight: RoomFlight, out: list[StepOutput]) -> tuple[F64, F64]:
    """Position error in m of predicted poses, from the tracked one before, and normalised squares of the six errors."""
    off, squares = [], []
    for k in range(BEGIN, len(out)):
        predicted, before = out[k].predicted, out[k - 1].estimate
        if predicted is None or before is None:
            continue
        moved = se3.inverse(before.T_o_b) @ predicted.T_o_b
        true = se3.inverse(flight.truth[k - 1]) @ flight.truth[k]
        e = np.concatenate(
            [before.T_o_b[:3, :3] @ (moved[:3, 3] - true[:3, 3]), se3.so3_log(true[:3, :3].T @ moved[:3, :3])]
        )
        growth = predicted.cov_o - before.cov_o
        assert np.linalg.eigvalsh(growth).min() > -1e-12
        off.append(np.linalg.norm(e[:3]))
        squares.append(e @ np.linalg.solve(growth + 1e-12 * np.eye(6), e))
    return np.array(off), np.array(squares)


@pytest.mark.parametrize(("sensor", "source", "most_m"), [
    ("imu", "imu", 0.0015), ("odometer", "odometer", 0.008), ("none", "velocity", 0.015),
])  # fmt: skip
def test_a_skipped_frame_gets_the_true_pose(flight: RoomFlight, sensor: str, source: str, most_m: float) -> None:
    out = fly(flight, sensor, 2)
    predicted = [o.predicted for o in out[BEGIN:] if o.estimate is None]
    assert len(predicted) > 20
    assert all(p is not None and p.tracked and p.source == source and p.quality > 0 for p in predicted)
    off, squares = errors(flight, out)
    assert len(off) > 20
    assert np.sqrt(np.mean(off**2)) < most_m
    assert np.mean(squares) < 24.0  # six errors: within twice their deviations


@pytest.mark.parametrize("sensor", ["imu", "odometer", "none"])
def test_predicting_changes_nothing(flight: RoomFlight, sensor: str) -> None:
    asked, unasked = fly(flight, sensor, 3), fly(flight, sensor, 3, ask=False)
    for a, b in zip(asked, unasked, strict=True):
        assert (a.estimate is None) == (b.estimate is None)
        if a.estimate is not None and b.estimate is not None:
            assert estimate_to_json(a.estimate) == estimate_to_json(b.estimate)
        assert b.predicted is None
    again = fly(flight, sensor, 3)
    poses = [[predicted_to_json(o.predicted) for o in flown if o.predicted is not None] for flown in (asked, again)]
    assert poses[0] == poses[1] and len(poses[0]) > 20


def test_frames_that_the_governor_skips_get_a_pose(flight: RoomFlight) -> None:
    governor = replace(AgentConfig().governor, cpu_percent=30.0, grace_s=0.5)
    out = fly(flight, "imu", 1, config=replace(AgentConfig(), governor=governor), busy_ns=30_000_000)
    counts = FrameCounts()
    for o in out:
        counts.count(o.estimate, o.predicted)
        pose = o.estimate or o.predicted
        assert pose is not None
        assert odometry_line(pose)
        assert bool(live_line(o.estimate)) == (o.estimate is not None)
    assert counts.frames == len(flight.frames)
    assert counts.tracked + counts.lost + counts.dropped == counts.frames
    assert counts.as_report()["predicted"] == counts.dropped > 10


def test_between_frames_velocity_and_rate_are_those_of_the_instant(flight: RoomFlight) -> None:
    agent = agent_of(flight, "imu")
    last_ns, off = flight.frames[0].t_ns - S, []
    for k, frame in enumerate(flight.frames[:-1]):
        agent.step(StepInput(frame, between(flight, last_ns, frame.t_ns)), frame.t_ns)
        last_ns = frame.t_ns
        if k < BEGIN:
            continue
        middle_ns = (frame.t_ns + flight.frames[k + 1].t_ns) // 2
        step = StepInput(None, between(flight, last_ns, middle_ns), predict_ns=middle_ns)
        pose = agent.step(step, middle_ns).predicted
        last_ns = middle_ns
        moved = flight.truth[k + 1][:3, 3] - flight.truth[k][:3, 3]
        speed = moved * S / (flight.frames[k + 1].t_ns - frame.t_ns)
        R_o_w = pose.T_o_b[:3, :3] @ se3.inverse(flight.truth[k])[:3, :3]  # to some mrad
        off.append(np.linalg.norm(pose.velocity_o - R_o_w @ speed) - 0.05 * np.linalg.norm(speed))
        sample = pose_sample(agent, StepOutput(None, (), (), pose), middle_ns, 0)
        assert np.linalg.norm(sample.velocity) == pytest.approx(np.linalg.norm(pose.velocity_o))
    assert np.median(off) < 0.05


def test_no_pose_without_a_map_before_the_last_frame_or_long_after(flight: RoomFlight) -> None:
    agent, frame = agent_of(flight, "none"), flight.frames[0]
    assert agent.predict(frame.t_ns) is None
    agent.step(StepInput(frame), frame.t_ns)
    assert agent.predict(frame.t_ns) is None
    soon, late = agent.predict(frame.t_ns + S // 10), agent.predict(frame.t_ns + S)
    assert isinstance(soon, PredictedPose)
    assert isinstance(late, PredictedPose)
    assert np.all(np.diag(late.cov_o) > np.diag(soon.cov_o))
    assert late.quality <= soon.quality
    assert agent.predict(frame.t_ns + S + 1) is None


def test_poses_are_sent_at_their_rate_whatever_the_steps() -> None:
    schedule, sent = PoseSchedule(40.0, 0), []
    for k in range(4000):
        if schedule.take_due(now_ns := k * 700_000 + (k % 3) * 200_000):
            sent.append(now_ns)
    assert len(sent) == pytest.approx(4000 * 0.0007 * 40.0, abs=1.5)
    assert np.diff(sent).min() > 23_000_000
    assert schedule.take_due(60 * S)
    assert not schedule.take_due(60 * S)  # what was missed is not made up for
    assert PoseSchedule(0.0, 0).next_ns is None
    assert not PoseSchedule(0.0, 0).take_due(S)


def test_samples_before_a_frame_are_taken_once(flight: RoomFlight) -> None:
    first = flight.frames[0]
    samples = ImuBatch(first.t_ns + np.arange(10, dtype=np.int64), np.ones((10, 3)), np.ones((10, 3)))
    reader = FrameReader([samples, first], None, lambda: 0)
    early = reader.take_imu(first.t_ns + 3)
    assert early.t_ns.tolist() == samples.t_ns[:4].tolist()
    assert reader.take_imu(first.t_ns + 3) is None
    _, rest, _ = reader.take()
    assert rest.t_ns.tolist() == samples.t_ns[4:].tolist()
