"""What the base sends of its changes and when: order, room, batches over several steps, and what is dropped."""

from collections.abc import Sequence

import numpy as np
import pytest

from kiteline_basestation.config import PublishConfig
from kiteline_basestation.exchange.publisher import Publisher, apply_record
from kiteline_basestation.map.map_tables import COMPOSED, CULLED, REMOVED
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_codec.schema import (
    CulledLandmarks,
    FusedLandmarks,
    GridTile,
    KeyframePose,
    Record,
    RefinedLandmarks,
    RemovedObservations,
    SubmapPlacement,
)
from kiteline_core.geometry import se3
from kiteline_core.ids import AgentId, KeyframeId, point_id, submap_id
from tests.basestation.map.test_sparse_map import SUBMAP, chain, kf

AGENT = AgentId(3)
POSE, DEPTHS, CULL, REMOVE, FUSE = (
    kind.KIND for kind in (KeyframePose, RefinedLandmarks, CulledLandmarks, RemovedObservations, FusedLandmarks)
)


def publisher(keyframes: int = 8, **config: int) -> tuple[SparseMap, Publisher]:
    """A map whose keyframes have refined poses and two refined landmarks each."""
    sparse_map = chain(keyframes)
    for n in range(keyframes):
        pose = sparse_map.pose(kf(n))
        assert pose is not None
        sparse_map.set_pose(kf(n), pose)
        sparse_map.set_depths(sparse_map.slots_of(kf(n))[:2], np.full(2, 0.5, np.float32), np.zeros((2, 2), np.float32))
    return sparse_map, Publisher(sparse_map, PublishConfig(**config))


def sent(out: Publisher, room_bytes: int | None = None) -> list[tuple[str, int]]:
    """Kinds and numbers of keyframes that are sent next."""
    found = out.collect(None if room_bytes is None else {AGENT: room_bytes})
    assert all(agent == AGENT for agent, _ in found)
    return [(type(r).__name__, numbers(r)) for _, records in found for r in records]


def numbers(record: Record) -> int:
    keyframe = getattr(record, "keyframe", kf(0))
    return int(keyframe - kf(0))


def poses(*which: int) -> list[tuple[str, int]]:
    return [("KeyframePose", n) for n in which]


def depths(*which: int) -> list[tuple[str, int]]:
    return [("RefinedLandmarks", n) for n in which]


def mark(out: Publisher, kind: int, which: Sequence[int]) -> None:
    for n in which:
        out.mark_changed(kind, kf(n))


def test_a_batch_has_the_newest_poses_then_what_has_waited_longest_and_the_newest_landmarks() -> None:
    _, out = publisher(batch_values=5)
    mark(out, POSE, (1, 5, 3))
    mark(out, DEPTHS, (2, 4, 6, 7))
    assert sent(out) == poses(1, 3, 5) + depths(2, 7)
    mark(out, POSE, (0,))
    assert sent(out) == poses(0) + depths(4, 6)
    assert not out.waiting and sent(out) == []


def test_what_changes_while_a_batch_is_sent_goes_with_the_next_one() -> None:
    _, out = publisher(step_values=2)
    mark(out, POSE, range(5))
    assert sent(out) == poses(3, 4)
    mark(out, POSE, (4, 7))
    assert [sent(out) for _ in range(3)] == [poses(1, 2), poses(0), poses(4, 7)]
    mark(out, POSE, range(3))
    assert sent(out) == poses(1, 2) and out.waiting
    assert sent(out) == poses(0) and not out.waiting


@pytest.mark.parametrize(("room_bytes", "count"), [(1, 1), (24, 1), (25, 2), (48, 2), (49, 3)])
def test_a_batch_fills_the_room_and_has_one_change_at_least(room_bytes: int, count: int) -> None:
    _, out = publisher()
    mark(out, POSE, range(4))
    assert sent(out, 0) == [] and out.waiting
    assert sent(out, room_bytes) == poses(*range(4 - count, 4))


def test_landmarks_take_room_by_how_many_are_refined() -> None:
    _, out = publisher()
    mark(out, DEPTHS, range(4))
    assert sent(out, 2 * (24 + 2 * 4) + 1) == depths(0, 2, 3)


def test_a_batch_that_takes_several_steps_is_sent_as_it_was_chosen() -> None:
    sparse_map, out = publisher(step_values=2)
    mark(out, POSE, range(5))
    before, moved = sparse_map.pose(kf(0)), se3.exp(np.array([1.0, 0, 0, 0, 0, 0]))
    assert before is not None
    assert sent(out) == poses(3, 4) and out.unfinished == {AGENT}
    sparse_map.set_pose(kf(0), moved, carry=False)
    mark(out, POSE, (0,))
    assert sent(out, 0) == poses(1, 2)  # a batch that was begun needs no room
    last = out.collect({AGENT: 0})[0][1][0]
    assert isinstance(last, KeyframePose) and np.array_equal(last.T_m_k, before) and not out.unfinished
    assert out.waiting and sent(out, 0) == []
    again = out.collect()[0][1][0]
    assert isinstance(again, KeyframePose) and np.array_equal(again.T_m_k, moved) and not out.waiting


def test_what_moves_nothing_is_sent_in_parts_without_room_and_as_a_whole_before_a_deletion() -> None:
    _, out = publisher(step_values=3)
    mark(out, CULL, range(7))
    assert [n for _, n in sent(out, 0)] == [0, 1, 2]
    out.mark_deleted(kf(7))
    assert [n for _, n in sent(out, 0)] == [3, 4, 5, 6, 7]
    mark(out, CULL, range(7))
    assert [n for _, n in sent(out)] == [0, 1, 2]


def test_a_placement_waits_for_room_and_for_the_batch_before_it_and_other_records_do_not() -> None:
    _, out = publisher(step_values=2)
    out.publish_placement(SUBMAP, np.eye(4), recognised=False, scale_sigma=0.0, urgent=False)
    out.send(AGENT, GridTile(0, 0, 0, 0.05, np.zeros((64, 64), np.int8)))
    assert sent(out, 0) == [("GridTile", 0)]
    mark(out, POSE, range(3))
    assert sent(out, 100) == [("SubmapPlacement", 0), *poses(1, 2)]
    out.publish_placement(SUBMAP, np.eye(4), recognised=True, scale_sigma=0.0, urgent=False)
    assert sent(out, 100) == poses(0) and out.waiting
    assert sent(out, 100) == [("SubmapPlacement", 0)]


def test_an_urgent_placement_replaces_what_waits_and_goes_apart() -> None:
    _, out = publisher()
    other = submap_id(3, 1, 1)
    for submap in (SUBMAP, other):
        out.publish_placement(submap, np.eye(4), recognised=False, scale_sigma=0.0, urgent=False)
    for sigma in (0.0, 0.1):
        out.publish_placement(SUBMAP, np.eye(4), recognised=True, scale_sigma=sigma, urgent=True)
    out.publish_placement(other, np.eye(4), recognised=True, scale_sigma=0.0, urgent=True)
    out.withdraw_placement(other)
    assert out.waiting
    ((agent, record),) = out.take_urgent()
    assert isinstance(record, SubmapPlacement) and record.recognised
    assert (agent, record.submap, record.scale_sigma) == (AGENT, SUBMAP, 0.1)
    assert out.take_urgent() == () and not out.waiting


def test_nothing_of_a_deleted_submap_is_sent() -> None:
    _, out = publisher(step_values=2)
    mark(out, POSE, range(5))
    mark(out, CULL, range(5))
    sent(out)
    mark(out, POSE, (1,))
    mark(out, DEPTHS, (1,))
    out.forget({SUBMAP})
    assert not out.waiting and sent(out) == []


def test_a_sent_value_is_kept_as_it_was_coded_unless_it_changed_since() -> None:
    sparse_map, out = publisher()
    mark(out, POSE, (2, 3))
    coded = [KeyframePose(kf(n), se3.exp(np.full(6, 0.01 * n))) for n in (2, 3)]
    sent(out)
    mark(out, POSE, (3,))
    before = sparse_map.pose(kf(3))
    for record in coded:
        out.adopt(record)
    assert np.array_equal(sparse_map.pose(kf(2)), coded[0].T_m_k) and np.array_equal(sparse_map.pose(kf(3)), before)


def test_records_hold_the_landmarks_that_they_are_about() -> None:
    sparse_map, out = publisher(3)
    here, before = sparse_map.slots_of(kf(1)), sparse_map.slots_of(kf(0))
    depth, offset = np.full(4, 0.3, np.float32), np.zeros((4, 2), np.float32)
    sparse_map.set_depths(here[1:5], depth, offset)
    sparse_map.set_flags(here[3:4], CULLED)
    sparse_map.set_flags(here[7:9], REMOVED)
    sparse_map.fuse(int(here[2]), int(before[5]))
    for kind in (DEPTHS, CULL, REMOVE, FUSE, POSE):
        out.mark_changed(kind, kf(1))
    sparse_map.keyframes.pose_source[sparse_map.rows[kf(1)]] = COMPOSED  # told by no record
    ((_, records),) = out.collect()
    indices = {type(r).__name__: r.index.tolist() for r in records if not isinstance(r, KeyframePose)}  # type: ignore[attr-defined]
    assert indices == {
        "RefinedLandmarks": [0, 1, 4], "CulledLandmarks": [3], "RemovedObservations": [7, 8], "FusedLandmarks": [2]
    }  # fmt: skip
    (fused,) = (r for r in records if isinstance(r, FusedLandmarks))
    assert fused.point.tolist() == [point_id(kf(0), 5)] and len(records) == 4


def test_a_stored_record_is_applied_as_far_as_the_map_knows_what_it_names() -> None:
    sparse_map, other = chain(3), chain(3)
    roots = sparse_map.keypoints.root
    a, b, c = (int(sparse_map.slots_of(kf(n))[5]) for n in (0, 1, 2))
    unknown = KeyframeId(kf(9))
    index = np.array([5, 4], np.uint16)
    apply_record(
        sparse_map, FusedLandmarks(kf(1), index, np.array([point_id(kf(0), 5), point_id(unknown, 1)], np.int64))
    )
    assert roots[b] == a and roots[b - 1] == b - 1
    apply_record(sparse_map, FusedLandmarks(kf(2), index[:1], np.array([point_id(kf(1), 5)], np.int64)))
    assert roots[c] == a  # what it names is fused itself
    apply_record(sparse_map, FusedLandmarks(kf(2), index[:1], np.array([point_id(kf(2), 4)], np.int64)))
    assert roots[c] == a  # it is fused already
    own = np.array([point_id(kf(0), 5)], np.int64)
    apply_record(sparse_map, FusedLandmarks(kf(0), index[:1], own))
    assert roots[a] == a
    empty = chain(3)
    empty.keypoints.root[empty.slots_of(kf(0))[5]] = -1  # the store has lost its section
    apply_record(empty, FusedLandmarks(kf(1), index[:1], own))
    assert empty.keypoints.root[b] == b
    beyond = np.array([2, 10, 4000], np.uint16)
    for record in (
        CulledLandmarks(kf(1), beyond, 0),
        RemovedObservations(kf(1), beyond + np.uint16(5)),
        RefinedLandmarks(kf(1), beyond, np.full(3, 0.4, np.float32), np.zeros((3, 2), np.float32)),
        KeyframePose(unknown, np.eye(4)),
    ):
        apply_record(other, record)
    flags = other.keypoints.flags
    assert np.flatnonzero(flags[: other.slots] & CULLED).tolist() == [int(other.slots_of(kf(1))[2])]
    assert np.flatnonzero(flags[: other.slots] & REMOVED).tolist() == [int(other.slots_of(kf(1))[7])]
    assert not other.keyframes.culled[: other.height].any()
    apply_record(other, CulledLandmarks(kf(1), beyond[:0], 1))
    assert other.keyframes.culled[other.rows[kf(1)]]
