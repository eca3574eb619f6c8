"""The velocity of a vehicle without an IMU, as of an instant after its last frame."""

import numpy as np
import pytest

from kiteline_agent.motion.recent_motion import RecentMotion

MS = 1_000_000


def at(t_s: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = 1.5 * t_s**2  # 3 m/s^2
    return T


def test_it_is_of_the_instant_asked_for_but_looks_ahead_one_frame_at_most() -> None:
    motion = RecentMotion()
    for i in range(10):
        motion.add(i * 50 * MS, at(0.05 * i), measured=True)
    for ask_ms, t_s in ((450, 0.45), (480, 0.48), (500, 0.5), (900, 0.5)):
        found = motion.rates(ask_ms * MS)
        assert found[0] == pytest.approx([3.0 * t_s, 0.0, 0.0], abs=1e-6)


def test_a_loss_forgets_the_motion() -> None:
    motion = RecentMotion()
    for i in range(5):
        motion.add(i * 50 * MS, at(0.05 * i), measured=i != 3)
    assert motion.rates(210 * MS) is None
