"""Batches of corrections: applied whole, in any order of arrival, and nothing waits for ever."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from kiteline_agent.exchange import correction_batches
from kiteline_agent.exchange.correction_batches import ReceivedBatches
from kiteline_codec.schema import CorrectionBatch, CulledLandmarks, Key, KeyframePose, Record, messages
from kiteline_core.geometry import se3
from kiteline_core.ids import AgentId, KeyframeId

AGENT = AgentId(3)


def pose(keyframe: int, batch: int, x: float = 0.0) -> KeyframePose:
    return KeyframePose(KeyframeId(keyframe), se3.from_rt(np.eye(3), np.array([x, 0.0, 0.0])), batch)


def batch_of(number: int, keyframes: list[int]) -> list[Record]:
    values = [pose(k, number, float(number)) for k in keyframes]
    return [*values, CorrectionBatch.of(AGENT, number, [messages.key(v) for v in values])]


def applied(records: list[Record]) -> list[tuple[int, int]]:
    return [(int(r.keyframe), r.batch) for r in records if isinstance(r, KeyframePose)]


def test_a_batch_waits_for_its_last_value() -> None:
    batches = ReceivedBatches()
    *values, head = batch_of(1, [5, 6, 7])
    assert not batches.take([values[2], head], [])
    assert not batches.take([values[0], values[0]], [])  # a repetition is no third value
    assert applied(batches.take([values[1]], [])) == [(5, 1), (6, 1), (7, 1)]
    assert not len(batches)


def test_as_many_values_of_another_key_are_not_the_batch() -> None:
    batches = ReceivedBatches()
    *values, head = batch_of(1, [5, 6])
    assert not batches.take([head, values[0], pose(9, 1)], [])
    assert applied(batches.take([pose(9, 0), values[1]], [])) == [(9, 0), (5, 1), (6, 1)]


def test_values_without_a_number_wait_for_nothing() -> None:
    culled = CulledLandmarks(KeyframeId(1), np.zeros(0, np.uint16), 1)
    batches = ReceivedBatches()
    assert applied(batches.take([pose(5, 0)], [])) == [(5, 0)]
    assert batches.take([culled], []) == [culled]


def test_a_value_without_a_number_replaces_one_that_waits() -> None:
    batches = ReceivedBatches()
    batches.take([pose(5, 1)], [])
    assert applied(batches.take([pose(5, 0)], [])) == [(5, 0)]
    assert not len(batches)


def test_a_batch_without_members_lets_all_up_to_it_go() -> None:
    batches = ReceivedBatches()
    batches.take([pose(5, 3), pose(6, 4)], [])
    assert applied(batches.take([CorrectionBatch.of(AGENT, 4, [])], [])) == [(5, 3), (6, 4)]
    assert applied(batches.take([pose(7, 4)], [])) == [(7, 4)]  # later ones too
    assert not batches.take([pose(7, 5)], [])


def test_a_removed_value_is_not_applied_later() -> None:
    batches = ReceivedBatches()
    batches.take([pose(5, 1), pose(6, 1)], [Key(KeyframePose.KIND, 5)])
    assert applied(batches.take([CorrectionBatch.of(AGENT, 1, [])], [])) == [(6, 1)]


def test_a_base_that_forgot_its_numbers_is_followed() -> None:
    batches = ReceivedBatches()
    batches.take(batch_of(40, [5, 6]), [])
    assert len(applied(batches.take(batch_of(1, [5, 6]), []))) == 2  # not above 40: they wait for none
    *values, head = batch_of(2, [5, 6])
    assert not batches.take([head, values[0]], [])
    assert applied(batches.take([values[1]], [])) == [(5, 2), (6, 2)]


def test_memory_is_bounded() -> None:
    batches = ReceivedBatches()
    out = batches.take([pose(k, 9) for k in range(correction_batches._MAX_HELD + 3)], [])
    assert applied(out) == [(0, 9), (1, 9), (2, 9)]
    assert len(batches) == correction_batches._MAX_HELD


@given(st.lists(st.sets(st.integers(0, 9), min_size=1), min_size=1, max_size=8), st.data())
def test_whole_batches_in_any_order(plan: list[set[int]], data: st.DataObject) -> None:
    """A batch follows when the one before has arrived; within one, values come in any order, repeated and in parts."""
    batches, held = ReceivedBatches(), {}
    for number, keyframes in enumerate(plan, 1):
        records = batch_of(number, sorted(keyframes))
        arrivals = data.draw(st.permutations(records + data.draw(st.lists(st.sampled_from(records), max_size=4))))
        seen: set[Key] = set()
        for record in arrivals:
            out = applied(batches.take([record], []))
            seen.add(messages.key(record))
            if out and len(out) > 1:
                assert out == [(k, number) for k in sorted(keyframes)]
            if len(seen) < len(records):
                assert not out  # in part
            held.update(out)
        assert all(held[k] == number for k in keyframes)
    assert not len(batches)
    assert held == {k: max(n for n, ks in enumerate(plan, 1) if k in ks) for k in set().union(*plan)}
