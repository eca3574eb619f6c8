"""Corrections reach the live pose at once, or no faster than asked for."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from kiteline_agent.config import SmoothingConfig
from kiteline_agent.exchange.smoothing import Smoothing
from kiteline_core.geometry import se3, sim3

TICK_NS = 50_000_000


def test_off_is_at_once() -> None:
    smoothing = Smoothing(SmoothingConfig(max_m_s=0.0, max_rad_s=0.0))
    assert not smoothing.on
    for n in range(3):
        T = se3.exp(np.array([n, 0.0, 0.0, 0.0, 0.0, 0.1 * n]))
        assert np.array_equal(smoothing.follow(T, np.zeros(3), n * TICK_NS), T)


@given(st.integers(0, 1 << 30))
def test_it_keeps_its_pace_and_arrives(seed: int) -> None:
    rng = np.random.default_rng(seed)
    smoothing = Smoothing(SmoothingConfig(snap_m=5.0, max_m_s=0.5, max_rad_s=0.2))
    here = rng.normal(0.0, 10.0, 3)
    told = start = se3.exp(np.concatenate([np.zeros(3), rng.normal(0.0, 1.0, 3)]))
    smoothing.follow(start, here, 0)
    turn = se3.exp(np.concatenate([np.zeros(3), rng.normal(0.0, 0.02, 3)]))
    shift = se3.from_rt(np.eye(3), rng.uniform(-0.5, 0.5, 3))
    # About the vehicle, so that the way is what was drawn.
    at = se3.transform(start, here[None])[0]
    about = se3.from_rt(np.eye(3), at) @ turn @ se3.from_rt(np.eye(3), -at)
    goal = shift @ about @ start
    for n in range(1, 200):
        last, told = told, smoothing.follow(goal, here, n * TICK_NS)
        moved = np.linalg.norm(se3.transform(told, here[None]) - se3.transform(last, here[None]))
        turned = np.linalg.norm(se3.so3_log(told[:3, :3] @ last[:3, :3].T))
        assert moved <= 0.5 * 0.05 + 1e-9
        assert turned <= 0.2 * 0.05 + 1e-9
        to_goal, to_last = (np.linalg.norm(se3.so3_log(goal[:3, :3] @ R[:3, :3].T)) for R in (told, last))
        assert to_goal + turned <= to_last + 1e-6  # straight on
    assert np.allclose(told, goal, atol=1e-9)


def test_another_place_is_taken_at_once() -> None:
    smoothing = Smoothing(SmoothingConfig(snap_m=5.0, max_m_s=0.5, max_rad_s=0.2))
    smoothing.follow(np.eye(4), np.zeros(3), 0)
    far = se3.from_rt(np.eye(3), np.array([9.0, 0.0, 0.0]))
    assert np.array_equal(smoothing.follow(far, np.zeros(3), TICK_NS), far)


def test_another_unit_of_length_is_told_at_once_and_the_vehicle_does_not_jump() -> None:
    smoothing = Smoothing(SmoothingConfig(snap_m=5.0, max_m_s=0.5, max_rad_s=0.2))
    here = np.array([3.0, -1.0, 0.5])
    smoothing.follow(np.eye(4), here, 0)
    goal = sim3.of(1.1, se3.from_rt(np.eye(3), np.array([0.2, 0.1, 0.0])))
    told = smoothing.follow(goal, here, TICK_NS)
    assert np.isclose(sim3.scale_of(told), 1.1)
    assert np.linalg.norm(se3.transform(told, here[None])[0] - here) <= 0.5 * 0.05 + 1e-9
    for n in range(2, 200):
        told = smoothing.follow(goal, here, n * TICK_NS)
    assert np.allclose(told, goal, atol=1e-9)


def test_the_vehicle_turns_at_once_and_moves_slowly() -> None:
    limits = SmoothingConfig()
    smoothing = Smoothing(limits)
    here = np.array([20.0, 5.0, 1.0])
    told = smoothing.follow(np.eye(4), here, 0)
    turn = se3.from_rt(np.eye(3), here) @ se3.exp(np.array([0, 0, 0, 0, 0, 0.1])) @ se3.from_rt(np.eye(3), -here)
    goal = se3.from_rt(np.eye(3), np.array([0.1, 0.0, 0.0])) @ turn
    told = smoothing.follow(goal, here, TICK_NS)
    assert np.allclose(told[:3, :3], goal[:3, :3])
    moved = np.linalg.norm(se3.transform(told, here[None])[0] - here)
    assert np.isclose(moved, limits.max_m_s * 0.05)


def test_what_adds_up_to_more_than_a_merge_is_no_jump() -> None:
    """Many small corrections that run ahead of the reported pose: it moves faster, but never at once."""
    limits = SmoothingConfig()
    smoothing = Smoothing(limits)
    told = smoothing.follow(np.eye(4), np.zeros(3), 0)
    for n in range(1, 400):
        goal = se3.from_rt(np.eye(3), np.array([min(n, 100) * 0.05, 0.0, 0.0]))  # 5 m in 5 s
        last, told = told, smoothing.follow(goal, np.zeros(3), n * TICK_NS)
        left = goal[0, 3] - last[0, 3]
        assert 0.0 <= told[0, 3] - last[0, 3] <= max(limits.max_m_s, left / limits.time_s) * 0.05 + 1e-12
    assert goal[0, 3] - told[0, 3] < goal[0, 3] * np.exp(-14.0 / limits.time_s)


@settings(max_examples=20)
@given(st.floats(0.02, 0.9), st.floats(0.2, 2.0))
def test_where_lengths_are_uncertain_no_window_is_stretched_by_more_than_a_share_of_the_correction(
    size_m: float, speed_m_s: float
) -> None:
    """A correction along the path: in 5 s no more than 1 - exp(-5 s / time_s) of it, in 30 s all but a twentieth."""
    limits = SmoothingConfig()
    smoothing = Smoothing(limits)
    goal = se3.from_rt(np.eye(3), np.array([size_m, 0.0, 0.0]))
    said, flown = [], []
    smoothing.follow(np.eye(4), np.zeros(3), 0, by_share=True)
    for n in range(1, 601):  # 30 s
        here = np.array([speed_m_s * n * 0.05, 0.0, 0.0])
        said.append(se3.transform(smoothing.follow(goal, here, n * TICK_NS, by_share=True), here[None])[0, 0])
        flown.append(here[0])
    window = 100  # frames in 5 s
    longer = (np.array(said)[window:] - said[:-window]) - (np.array(flown)[window:] - flown[:-window])
    assert longer.min() >= -1e-9
    assert longer.max() <= size_m * (1.0 - np.exp(-5.0 / limits.time_s)) * 1.01
    assert said[-1] - flown[-1] >= 0.95 * size_m


def test_a_relocalisation_is_not_smoothed_but_what_is_left_of_a_correction_is() -> None:
    smoothing = Smoothing(SmoothingConfig(max_m_s=0.1, time_s=10.0, snap_m=1.0))
    here = np.array([3.0, 1.0, 0.5])
    smoothing.follow(np.eye(4), here, 0)
    correction = se3.from_rt(np.eye(3), np.array([0.0, 0.2, 0.0]))
    left = correction @ se3.inverse(smoothing.follow(correction, here, TICK_NS))
    # Dead reckoning was off by 0.6 m: the vehicle lies elsewhere in the map, and the map where it lay in w.
    T_o_n = se3.from_rt(np.eye(3), np.array([0.6, 0.0, 0.0]))
    smoothing.move_odometry(T_o_n)
    told = smoothing.follow(correction @ T_o_n, here, 2 * TICK_NS)
    assert np.linalg.norm((told - correction @ T_o_n)[:3, 3]) < np.linalg.norm(left[:3, 3])
    assert np.linalg.norm(told[:3, 3] - correction[:3, 3]) > 0.55
