"""The pose between frames: what is guessed gives way to what is measured next."""

import numpy as np
import pytest

from kiteline_agent.tracking.pose_state import PoseState
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3

STEP = se3.exp(np.array([0.05, -0.02, 0.10, 0.01, 0.02, -0.03]))
DT_S = 0.05
MAP_MOTION = se3.exp(np.array([0.4, -0.7, 0.2, 0.3, -0.5, 0.8]))


def moving() -> PoseState:
    """Measured twice, a step apart; the map does not lie in o as it began."""
    pose = PoseState()
    pose.T_o_m = se3.exp(np.array([1.0, 2.0, -0.5, 0.2, 0.1, -0.4]))
    pose.measured(STEP, DT_S)
    return pose


def apart(a: F64, b: F64) -> float:
    return float(np.abs(a - b).max())


def test_a_measured_pose_tells_the_motion_over_all_frames_that_were_guessed() -> None:
    pose, T_o_m = moving(), moving().T_o_m
    for _ in range(3):
        pose.guess(pose.predict(DT_S) @ se3.exp(np.full(6, 0.02)), DT_S)
    assert pose.is_guess
    there = STEP @ STEP @ STEP @ STEP @ STEP
    pose.measured(there, DT_S)
    assert not pose.is_guess and np.array_equal(pose.T_o_m, T_o_m)
    assert apart(pose.predict(DT_S), there @ STEP) < 1e-9
    assert apart(pose.velocity, (there[:3, 3] - STEP[:3, 3]) / (4 * DT_S)) < 1e-12


def test_a_map_that_moves_takes_the_last_measured_pose_along() -> None:
    pose = moving()
    guess = pose.predict(DT_S) @ se3.exp(np.full(6, 0.02))
    pose.guess(guess, DT_S)
    before = pose.T_o_m @ pose.T_m_c
    pose.move_map(MAP_MOTION @ guess)
    assert apart(pose.T_o_m @ pose.T_m_c, before) < 1e-9
    pose.measured(MAP_MOTION @ STEP @ STEP @ STEP, DT_S)
    assert apart(pose.predict(DT_S), MAP_MOTION @ STEP @ STEP @ STEP @ STEP) < 1e-9


@pytest.mark.parametrize("event", ["a new submap", "the motion is forgotten"])
def test_nothing_is_measured_from_before(event: str) -> None:
    pose = moving()
    pose.guess(pose.predict(DT_S), DT_S)
    if event == "a new submap":
        pose.enter_submap()
    else:
        pose.reset_motion()
    assert not pose.is_guess
    pose.measured(pose.T_m_c @ STEP, DT_S)
    assert apart(pose.predict(DT_S), pose.T_m_c @ STEP) < 1e-9


@pytest.mark.parametrize("guessed_first", [False, True])
def test_a_sensor_tells_the_velocity_and_a_guess_beside_it_stays_a_guess(guessed_first: bool) -> None:
    """The sensor ends before the images come back; until then its velocity counts, not that of the last images."""
    pose, slow = moving(), se3.exp(0.5 * se3.log(STEP))
    if guessed_first:
        pose.guess(pose.predict(DT_S), DT_S)
    pose.reckon(pose.T_m_c @ slow, DT_S)
    assert pose.is_guess == guessed_first
    assert guessed_first or apart(pose.predict(DT_S), pose.T_m_c @ slow) < 1e-9
    pose.guess(pose.predict(DT_S), DT_S)
    assert pose.is_guess
    pose.measured(STEP, DT_S)
    assert not pose.is_guess and not pose.moves  # from where the sensor ended nothing is measured
    pose.guess(pose.predict(DT_S), DT_S)
    assert pose.is_guess


def test_a_guess_goes_on_for_half_a_second_and_then_fades() -> None:
    pose = moving()
    turn = se3.exp(np.array([0.05, 0.0, 0.0, 0.0, 0.05, 0.0]))  # 1 m/s and 1 rad/s
    pose.measured(pose.T_m_c @ turn, DT_S)
    begin = pose.T_m_c.copy()
    for _ in range(10):
        pose.guess(pose.predict(DT_S), DT_S)
    assert apart(pose.predict(DT_S), pose.T_m_c @ turn) < 1e-9
    for _ in range(90):
        pose.guess(pose.predict(DT_S), DT_S)
    turned = np.linalg.norm(se3.so3_log(begin[:3, :3].T @ pose.T_m_c[:3, :3]))
    assert 0.8 < turned < 1.1 and 0.05 < np.linalg.norm(pose.velocity) < 0.2  # of 1 m/s, 4.5 s later
    pose.measured(pose.T_m_c @ turn, DT_S)
    assert not pose.moves  # long ago


def test_what_a_sensor_told_all_the_way_is_no_guess() -> None:
    pose = moving()
    for _ in range(3):
        pose.reckon(pose.T_m_c @ STEP, DT_S)
    assert not pose.is_guess
    pose.measured(pose.T_m_c @ STEP, DT_S)
    assert pose.moves and apart(pose.predict(DT_S), pose.T_m_c @ STEP) < 1e-9


def test_the_mean_of_a_long_loss_tells_no_velocity() -> None:
    for frames, step in ((25, STEP), (4, se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.5, 0.0])))):
        pose = moving()
        for _ in range(frames):
            pose.guess(pose.predict(DT_S), DT_S)
        there = se3.exp(frames * se3.log(step))
        pose.measured(there, DT_S)
        assert not pose.moves and pose.measured_over_s is None and apart(pose.predict(DT_S), there) < 1e-9


def test_an_old_image_tells_no_motion_and_takes_its_time() -> None:
    pose = moving()
    pose.measured(STEP, DT_S, repeated=True)
    assert apart(pose.predict(DT_S), STEP @ STEP) < 1e-9
    pose.measured(STEP @ STEP @ STEP, DT_S)
    assert apart(pose.predict(DT_S), STEP @ STEP @ STEP @ STEP) < 1e-9


def test_a_gyro_turns_the_prediction_and_the_velocity_stays() -> None:
    pose, turn = moving(), se3.so3_exp(np.array([0.02, -0.3, 0.1]))
    ahead = pose.predict_turned(2 * DT_S, turn)
    assert apart(ahead[:3, :3], STEP[:3, :3] @ turn) < 1e-9
    assert apart(ahead[:3, 3], 3.0 * STEP[:3, 3]) < 1e-9
