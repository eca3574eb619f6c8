"""Poses of the base are moved by the changes of the disparity offset that it did not know."""

import numpy as np

from kiteline_agent.local_map.offset_history import OffsetHistory
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.geometry.disparity_offset import terms

FIRST, SECOND, THIRD = 4, 5, 6
PARENTS = {SECOND: FIRST, THIRD: SECOND}
FIRST_PX, SECOND_PX = np.array([0.3, -0.1, 0.2, 0.15, 0.1]), np.array([-0.2, 0.4, 0.1, 0.0, 0.3])


def flown() -> tuple[OffsetHistory, F64, F64]:
    """Two changes of the offset, which move the first two keyframes; the twists of both, by keyframe."""
    rng, history = np.random.default_rng(4), OffsetHistory()
    once, again = 0.05 * rng.normal(size=(2, 2, 6))
    history.add(FIRST_PX, np.array([FIRST, SECOND]), once)
    history.add(SECOND_PX, np.array([FIRST, SECOND]), again)
    return history, once, again


def test_a_pose_is_moved_on_the_left_by_each_change_that_is_unknown_to_it() -> None:
    history, once, again = flown()
    T = se3.exp(np.array([1.0, -2.0, 0.5, 0.4, -0.9, 1.3]))
    np.testing.assert_allclose(history.moved(T, FIRST, 0, PARENTS), se3.exp(again[0]) @ se3.exp(once[0]) @ T)
    np.testing.assert_allclose(history.moved(T, SECOND, 1, PARENTS), se3.exp(again[1]) @ T)
    np.testing.assert_array_equal(history.moved(T, SECOND, 2, PARENTS), T)
    np.testing.assert_allclose(history.moved(T, THIRD, 1, PARENTS), se3.exp(again[1]) @ T)  # with its parent
    np.testing.assert_array_equal(history.moved(T, THIRD, 0, {}), T)


def test_disparities_shrink_by_the_changes_that_are_unknown_to_them() -> None:
    history, bearing = flown()[0], np.array([[0.1, -0.2], [-0.5, 0.3]])
    np.testing.assert_allclose(history.disparity_px(bearing, 0), terms(bearing) @ (FIRST_PX + SECOND_PX))
    np.testing.assert_allclose(history.disparity_px(bearing, 1), terms(bearing) @ SECOND_PX)
    assert not history.disparity_px(bearing, 2).any()


def test_what_the_base_knew_is_told_by_poses_that_fit_the_map() -> None:
    _, once, again = flown()
    held = {k: se3.exp(np.array([1.0 * k, 0.0, 0.3, 0.1, 0.2, 0.3])) for k in (FIRST, SECOND)}
    twists = {FIRST: (once[0], again[0]), SECOND: (once[1], again[1])}
    for known in (0, 1, 2):
        told = dict(held)
        for k, changes in twists.items():
            for twist in reversed(changes[known:]):
                told[k] = se3.inverse(se3.exp(twist)) @ told[k]
        assert flown()[0].known_to_base(told, held, PARENTS) == known
