"""A frame in which most landmarks move alike, as people do: the IMU tells which landmarks stand still."""

from typing import Any

import numpy as np
import pytest

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.imaging import alignment_kernels
from kiteline_agent.motion.motion_model import MotionModel
from kiteline_agent.step import Identity, StepInput
from kiteline_agent.tracking.frame_context import FrameContext
from kiteline_agent.tracking.track import Track
from kiteline_agent.tracking.tracker import Tracker
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuBatch
from kiteline_core.geometry import se3
from kiteline_core.ids import AgentId
from tests.agent.room_flight import RoomFlight

FRAMES = 56
CROWDED = range(44, 50)  # frames
SHIFT_PX = 6.0
OF_TWENTY = 12  # landmarks that move
real_align, real_nearer = alignment_kernels.align, Tracker.nearer


class Crowd:
    """Moves what is found of some landmarks to the right, while it is there."""

    def __init__(self) -> None:
        self.there = False

    def align(self, sampled: Any, grid: Any, templates: Any, rows: Any, *more: Any) -> None:
        """As alignment_kernels.align."""
        real_align(sampled, grid, templates, rows, *more)
        if self.there:
            more[2][rows * 7919 % 20 < OF_TWENTY] += (SHIFT_PX, 0.0)


def fly(flight: RoomFlight, crowd: Crowd, alignments: list[int] | None = None) -> list[F64]:
    """Poses T_o_b. alignments: counted in each frame, out."""
    agent = Agent(flight.rig, flight.imu, AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel())
    out, begin_ns = [], 0
    for k, frame in enumerate(flight.frames[:FRAMES]):
        s = flight.samples
        felt = (s.t_ns > begin_ns) & (s.t_ns <= frame.t_ns)
        crowd.there, begin_ns = k in CROWDED, frame.t_ns
        step = StepInput(frame, ImuBatch(s.t_ns[felt], s.gyro[felt], s.accel[felt]))
        estimate = agent.step(step, frame.t_ns).estimate
        out.append(estimate.T_o_b)
        if alignments is not None:
            alignments.append(agent.work.alignments)
    return out


def worst_m(flight: RoomFlight, poses: list[F64]) -> float:
    """Largest error of a position since the frame before the crowd."""
    first = CROWDED[0] - 1
    T_w_o = flight.truth[first] @ se3.inverse(poses[first])
    return max(float(np.linalg.norm((T_w_o @ poses[k] - flight.truth[k])[:3, 3])) for k in range(first, FRAMES))


def test_landmarks_that_move_alike_do_not_drag_the_pose(
    room_flight: RoomFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    crowd = Crowd()
    monkeypatch.setattr(alignment_kernels, "align", crowd.align)
    begun_by_imu = worst_m(room_flight, fly(room_flight, crowd))
    monkeypatch.setattr(Tracker, "track_by_imu", lambda _self, _ctx: None)
    with_imu = worst_m(room_flight, fly(room_flight, crowd))
    monkeypatch.setattr(Tracker, "nearer", lambda _self, _ctx, track: track)
    by_images = worst_m(room_flight, fly(room_flight, crowd))
    assert begun_by_imu < 0.01 and with_imu < 0.01
    assert by_images > 3.0 * with_imu


def test_a_wrong_prediction_is_corrected_by_both_passes(
    room_flight: RoomFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    once: list[int] = []
    both: list[int] = []
    plain = fly(room_flight, Crowd(), once)
    real_predict, turn = MotionModel.predict, se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.02, 0.0]))  # 5 px or more

    def off(self: MotionModel, t_ns: int, imu: ImuBatch | None, dt_s: float) -> F64:
        return np.asarray(real_predict(self, t_ns, imu, dt_s) @ turn)

    monkeypatch.setattr(MotionModel, "predict", off)
    wrong = fly(room_flight, Crowd(), both)
    assert max(float(np.linalg.norm((a - b)[:3, 3])) for a, b in zip(plain, wrong, strict=True)) < 0.005
    align = AgentConfig().align
    assert 0 < max(once[CROWDED[0] :]) <= align.points  # the finest level alone
    least = (align.fine_from + 2) * min(once[CROWDED[0] :])  # that, and both levels of the fine pass again
    assert min(both[CROWDED[0] :]) > least


def test_a_flight_without_people_is_the_same(room_flight: RoomFlight, monkeypatch: pytest.MonkeyPatch) -> None:
    kept: list[bool] = []

    def nearer(self: Tracker, ctx: FrameContext, track: Track) -> Track:
        kept.append(real_nearer(self, ctx, track) is track)
        return track

    def track_by_imu(self: Tracker, ctx: FrameContext) -> Track | None:
        near.append(track := real_by_imu(self, ctx))
        return track

    near: list[Track | None] = []
    real_by_imu = Tracker.track_by_imu
    monkeypatch.setattr(Tracker, "nearer", nearer)
    monkeypatch.setattr(Tracker, "track_by_imu", track_by_imu)
    fly(room_flight, Crowd())
    assert len(near) > 30  # those near the prediction stand at once
    assert len(kept) == near.count(None) and all(kept)
