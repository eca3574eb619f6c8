"""Velocity of an agent between two plans."""

import numpy as np

from kiteline_basestation.exchange.agent_velocity import AgentVelocity
from kiteline_core.ids import AgentId, submap_id

FIRST, SECOND = submap_id(AgentId(0), 1, 0), submap_id(AgentId(0), 1, 1)
HERE, THERE = np.array([1.0, 2.0, 3.0]), np.array([2.0, 2.0, 1.0])


def test_the_velocity_is_that_since_the_last_plan() -> None:
    velocity = AgentVelocity(0.5)
    assert not velocity.update(10**9, FIRST, HERE).any()
    np.testing.assert_allclose(velocity.update(1_500_000_000, FIRST, THERE), [2.0, 0.0, -4.0])
    np.testing.assert_allclose(velocity.update(2_500_000_000, FIRST, HERE), [-1.0, 0.0, 2.0])


def test_nothing_is_derived_from_another_submap_or_an_old_or_later_plan() -> None:
    velocity = AgentVelocity(0.5)
    velocity.update(10**9, FIRST, HERE)
    assert not velocity.update(1_500_000_000, SECOND, THERE).any()
    assert not velocity.update(4_000_000_000, SECOND, HERE).any()  # five periods later
    assert not velocity.update(3_500_000_000, SECOND, THERE).any()  # the agent's clock went back
    assert velocity.update(4_000_000_000, SECOND, HERE).any()


def test_later_changes_of_the_position_do_not_matter() -> None:
    velocity, position = AgentVelocity(1.0), HERE.copy()
    velocity.update(10**9, FIRST, position)
    position += 5.0
    np.testing.assert_allclose(velocity.update(2 * 10**9, FIRST, THERE), THERE - HERE)
