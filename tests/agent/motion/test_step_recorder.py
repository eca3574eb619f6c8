"""Steps between keyframes: they tile the flight, and are left out where they would not."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kiteline_agent.inertial.preintegration import Samples
from kiteline_agent.motion.step_recorder import StepRecorder
from kiteline_codec.schema import messages
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry import se3
from kiteline_core.ids import AgentId, KeyframeId, keyframe_id, submap_id

FRAME_NS = 50_000_000
SUBMAP = submap_id(AgentId(0), 0, 0)
K0, K1, K2 = (keyframe_id(SUBMAP, i) for i in range(3))
RATE = np.array([0.1, -0.2, 0.3])
FORCE = np.array([0.4, 0.1, 9.8])
BIAS = np.array([0.01, 0.02, -0.01, 0.3, 0.2, 0.1])


class Tracker:
    """Constant rate and force; `silent` has no samples."""

    silent = False
    come_ns = 1 << 60  # samples up to this time have come
    state = SimpleNamespace(bias=BIAS)

    def has_samples(self, t_ns: int) -> bool:
        return t_ns <= self.come_ns

    def samples_between(self, from_ns: int, to_ns: int) -> Samples | None:
        t = np.linspace(0.0, (to_ns - from_ns) * 1e-9, 11)
        return None if self.silent else Samples(t, np.tile(RATE + BIAS[:3], (11, 1)), np.tile(FORCE, (11, 1)))


def pose(n: int) -> F64:
    t = n * FRAME_NS * 1e-9
    return se3.from_rt(se3.so3_exp(RATE * t), np.array([t, 0.2 * t * t, 1.0]))


def take(steps: StepRecorder, keyframe: KeyframeId, frame: int, tracker: Any) -> Any:
    """The steps up to a keyframe of a frame; None if there are none."""
    steps.mark(keyframe, frame * FRAME_NS)
    found = steps.take(tracker)
    assert len(found) <= 1
    return found[0] if found else None


@pytest.fixture
def tracker() -> Any:
    return Tracker()


def recorder(tracker: Any, frames: int) -> StepRecorder:
    """A recorder that has seen frames 0..frames-1, with keyframe 0 at frame 0."""
    out = StepRecorder(ImuCalibration(), 0.14)
    for n in range(frames):
        out.see(n * FRAME_NS, pose(n))
        if n == 0:
            assert take(out, K0, 0, tracker) is None
    return out


def test_steps_tile_the_time_between_two_keyframes(tracker: Any) -> None:
    record = take(recorder(tracker, 9), K1, 8, tracker)
    assert (record.keyframe, record.since) == (K1, K0)
    assert np.allclose(record.dt_s, [0.15, 0.15, 0.1])
    T = np.eye(4)
    for turn, moved in zip(record.turn, record.moved, strict=True):
        T = T @ se3.from_rt(se3.so3_exp(turn), moved)
    assert np.allclose(T, se3.inverse(pose(0)) @ pose(8), atol=1e-9)
    # the accelerometer's bias is left in, the gyro's taken off
    assert np.allclose(record.velocity[:, 2], 9.8 * record.dt_s, atol=0.02)
    decoded: Any = messages.decode(messages.key(record), messages.encode(record))
    assert np.allclose(decoded.velocity, record.velocity, atol=2e-4)
    assert np.allclose(decoded.position, record.position, atol=4e-5)
    assert len(messages.encode(record)) < 25 * len(record.dt_s)


def test_the_next_steps_begin_at_the_keyframe(tracker: Any) -> None:
    steps = recorder(tracker, 9)
    take(steps, K1, 8, tracker)
    for n in range(9, 13):
        steps.see(n * FRAME_NS, pose(n))
    record = take(steps, K2, 12, tracker)
    assert record.since == K1
    assert record.dt_s.sum() == pytest.approx(0.2)


def test_frames_without_images_break_the_chain_until_the_next_keyframe(tracker: Any) -> None:
    steps = recorder(tracker, 6)
    steps.clear()
    steps.see(7 * FRAME_NS, pose(7))
    steps.see(8 * FRAME_NS, pose(8))
    assert take(steps, K1, 8, tracker) is None
    steps.see(9 * FRAME_NS, pose(9))
    assert take(steps, K2, 9, tracker) is not None


def test_missing_samples_break_the_chain(tracker: Any) -> None:
    steps = recorder(tracker, 6)
    tracker.silent = True
    for n in range(6, 9):
        steps.see(n * FRAME_NS, pose(n))
    assert steps.take(tracker) == []
    tracker.silent = False
    assert take(steps, K1, 8, tracker) is None


def test_a_keyframe_by_dead_reckoning_has_no_steps(tracker: Any) -> None:
    assert take(recorder(tracker, 6), K1, 8, tracker) is None


def test_a_map_that_moves_does_not_change_steps(tracker: Any) -> None:
    T_new_old = se3.exp(np.array([1.0, -2.0, 0.5, 0.1, 0.2, -0.4]))
    still, moved = recorder(tracker, 8), recorder(tracker, 8)
    moved.move_map(T_new_old)
    still.see(8 * FRAME_NS, pose(8))
    moved.see(8 * FRAME_NS, T_new_old @ pose(8))
    a, b = (take(steps, K1, 8, tracker) for steps in (still, moved))
    assert np.allclose(a.moved, b.moved, atol=1e-9)


def test_a_new_submap_at_a_keyframe_continues_the_chain(tracker: Any) -> None:
    steps = recorder(tracker, 9)
    assert take(steps, K1, 8, tracker) is not None
    elsewhere = se3.exp(np.array([3.0, 0.0, 0.0, 0.0, 0.0, 1.0]))
    steps.restart(8 * FRAME_NS, elsewhere @ pose(8))
    steps.see(9 * FRAME_NS, elsewhere @ pose(9))
    record = take(steps, K2, 9, tracker)
    assert np.allclose(record.moved[0], (se3.inverse(pose(8)) @ pose(9))[:3, 3])


def test_another_place_in_the_map_between_keyframes_breaks_the_chain(tracker: Any) -> None:
    steps = recorder(tracker, 6)
    steps.restart(6 * FRAME_NS, pose(6))
    steps.see(8 * FRAME_NS, pose(8))
    assert take(steps, K1, 8, tracker) is None


def test_a_motion_that_is_no_flight_is_left_out(tracker: Any) -> None:
    steps = recorder(tracker, 6)
    for n in range(6, 9):
        steps.see(n * FRAME_NS, se3.from_rt(np.eye(3), np.array([n * 1e3, 0.0, 0.0])))
    assert take(steps, K1, 8, tracker) is None


def test_steps_wait_until_their_samples_have_come(tracker: Any) -> None:
    at_once = take(recorder(tracker, 9), K1, 8, tracker)
    steps = recorder(tracker, 1)
    for n in range(1, 12):
        tracker.come_ns = (n - 2) * FRAME_NS
        steps.see(n * FRAME_NS, pose(n))
        if n == 8:
            steps.mark(K1, 8 * FRAME_NS)
        found = steps.take(tracker)
        assert len(found) == (n == 10)
        if found:
            assert (found[0].keyframe, found[0].since) == (K1, K0)
            assert np.array_equal(found[0].moved, at_once.moved)
            assert np.array_equal(found[0].velocity, at_once.velocity)


def test_no_steps_begin_at_a_keyframe_that_images_did_not_place(tracker: Any) -> None:
    steps = recorder(tracker, 6)
    assert take(steps, K1, 8, tracker) is None
    for n in (10, 12, 14):
        steps.see(n * FRAME_NS, pose(n))
    assert take(steps, K2, 14, tracker) is None


def test_nothing_piles_up_while_the_imu_is_dead(tracker: Any) -> None:
    steps = recorder(tracker, 1)
    tracker.come_ns, tracker.silent = 0, True
    steps.see(5 * FRAME_NS, pose(5))
    for n in range(6, 300):
        steps.mark(keyframe_id(SUBMAP, n), n * FRAME_NS)
        assert steps.take(tracker) == [] and len(steps._waiting) < 100


def test_steps_do_not_wait_for_ever(tracker: Any) -> None:
    steps = recorder(tracker, 1)
    tracker.come_ns, tracker.silent = 0, True
    for n in range(1, 200):
        steps.see(n * FRAME_NS, pose(n))
        if n % 8 == 0:
            steps.mark(keyframe_id(SUBMAP, n // 8), n * FRAME_NS)
        assert steps.take(tracker) == [] and len(steps._waiting) < 30
