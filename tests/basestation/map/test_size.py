"""Maps of any size: regions, memory, corrections of many keyframes, loops that many matches close."""

import itertools
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_basestation.config import BaseConfig, PublishConfig
from kiteline_basestation.exchange.publisher import Publisher
from kiteline_basestation.map.free_runs import FreeRuns
from kiteline_basestation.map.map_tables import CULLED, LANDMARK
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.mapper import Mapper
from kiteline_basestation.merging.correction import keyframes_of, move_keyframes
from kiteline_basestation.merging.loop_detector import LoopDetector
from kiteline_basestation.refinement.bundle_window import bundle_window, local_keyframes
from kiteline_basestation.refinement.culling import cull_weak_landmarks
from kiteline_basestation.refinement.local_bundles import LocalBundles
from kiteline_codec.schema import CulledLandmarks, KeyframePose
from kiteline_core.geometry import se3, sim3
from kiteline_core.ids import NO_KEYFRAME, KeyframeId, keyframe_id, submap_id, submap_of_keyframe
from tests.basestation.feeding import WITHOUT_GRID, feed, keyframes_in
from tests.yardstick import slowness

MakeFlight = Callable[..., Any]


@pytest.fixture(scope="module")
def mapped(make_flight: MakeFlight) -> tuple[Any, Mapper]:
    """A flight of 30 keyframes and a mapper that has it."""
    flight, mapper = make_flight(keyframes=30), Mapper()
    feed(mapper, [flight])
    return flight, mapper


@given(st.lists(st.integers(1, 9), min_size=1, max_size=30), st.randoms(use_true_random=False))
def test_freed_runs_are_given_again_and_none_twice(lengths: list[int], draw: Any) -> None:
    runs, used, top = FreeRuns(), dict[int, int](), 0
    for length in lengths:
        begin = runs.take(length)
        if begin is None:
            begin, top = top, top + length
        assert all(begin + length <= b or b + n <= begin for b, n in used.items())
        used[begin] = length
        if draw.random() < 0.5:
            gone = draw.sample(sorted(used), draw.randint(1, len(used)))
            runs.free([(used.pop(b), b) for b in gone])
    runs.free([(n, b) for b, n in used.items()])
    assert runs.take(top) == 0 and runs.take() is None  # all of it is one run again


def test_culling_takes_no_memory_in_proportion_to_the_map(
    mapped: tuple[Any, Mapper], monkeypatch: pytest.MonkeyPatch
) -> None:
    flight, mapper = mapped
    monkeypatch.setattr(mapper.map, "slots", 100_000_000)  # as of a map of 300,000 keyframes
    tracemalloc.start()
    try:
        cull_weak_landmarks(mapper.map, flight.keyframes[25], Publisher(mapper.map))
        assert tracemalloc.get_traced_memory()[1] < 10_000_000
    finally:
        tracemalloc.stop()


def test_pairs_of_keyframes_are_those_that_covisibility_tells(mapped: tuple[Any, Mapper]) -> None:
    flight, mapper = mapped
    sparse_map = mapper.map
    rows = sparse_map.rows_of_map(submap_of_keyframe(flight.keyframes[0]))
    ids = sparse_map.keyframes.id[rows].tolist()
    for least in (1, 60, 100):
        wanted = {
            (ids.index(other), i)
            for i, keyframe in enumerate(map(KeyframeId, ids))
            for other in sparse_map.covisible_keyframes(keyframe, least)
            if other < keyframe
        }
        found = sparse_map.covisible_pairs(rows, least)
        assert set(map(tuple, found.tolist())) == wanted and len(found) == len(wanted) > 0


def test_rows_nearby_are_those_of_the_map_within_a_cube(mapped: tuple[Any, Mapper]) -> None:
    flight, mapper = mapped
    sparse_map = mapper.map
    submap = submap_of_keyframe(flight.keyframes[0])
    at = sparse_map.keyframes.T_w_k[sparse_map.rows[flight.keyframes[7]], :3, 3]
    rows = sparse_map.rows_of_map(submap)
    inside = np.abs(sparse_map.keyframes.T_w_k[rows, :3, 3] - at).max(axis=1) <= 0.6
    assert np.array_equal(sparse_map.rows_near(submap, at, 0.6), rows[inside])
    assert 1 < np.count_nonzero(inside) < len(rows)


def test_two_bundles_never_adjust_one_landmark(mapped: tuple[Any, Mapper]) -> None:
    """A window fixes only so many keyframes: others that see its landmarks may be free in another one."""
    flight, mapper = mapped
    config = BaseConfig(bundle_window=replace(BaseConfig().bundle_window, max_free=3, max_fixed=1))
    bundles = LocalBundles(config, mapper.map, Publisher(mapper.map), itertools.count(1))
    bundles.add(flight.keyframes[8])
    (job,) = bundles.jobs()
    _, pending = bundles._pending[job.id]

    def shares_landmarks_alone(keyframe: KeyframeId) -> bool:
        free = local_keyframes(mapper.map, keyframe, config.bundle_window)
        window = bundle_window(mapper.map, free, config.bundle_window, config.measurement)
        met = set(window.rows[window.problem.free].tolist()) & set(pending.rows.tolist())
        met |= set(window.rows.tolist()) & set(pending.rows[pending.problem.free].tolist())
        return not met and bool(np.isin(window.points, pending.points).any())

    other = next(k for k in flight.keyframes if shares_landmarks_alone(k))
    bundles.add(other)
    assert bundles.jobs() == []
    bundles.forget(job.id)
    assert len(bundles.jobs()) == 1


def test_rows_and_numbers_follow_keyframes_that_come_in_any_order(make_flight: MakeFlight) -> None:
    flight, sparse_map = make_flight(keyframes=40), SparseMap()
    order = np.random.default_rng(2).permutation(40).tolist()
    for n in order:
        header = flight.records[n][0]
        sparse_map.add_keyframe(header.keyframe, header.t_ns, header.parent, header.T_p_k, header.keypoints)
    submap = submap_of_keyframe(flight.keyframes[0])
    assert sparse_map.keyframes.id[sparse_map.rows_of(submap)].tolist() == flight.keyframes
    assert [sparse_map.number_of(k) for k in flight.keyframes] == list(range(40))


def test_keyframes_after_a_moved_one_move_along_and_those_before_stay(mapped: tuple[Any, Mapper]) -> None:
    flight, mapper = mapped
    sparse_map = mapper.map
    submap = submap_of_keyframe(flight.keyframes[0])
    keyframes = keyframes_of(sparse_map, submap)
    before = {k: sparse_map.world_pose(k) for k in keyframes}
    step = se3.exp(np.array([0.2, -0.1, 0.05, 0.0, 0.0, 0.1]))
    chosen, held = keyframes[12], keyframes[20]
    publisher = Publisher(sparse_map)
    targets = {chosen: step @ before[chosen], held: before[held]}
    assert not move_keyframes(sparse_map, submap, targets, publisher, PublishConfig())
    for k in keyframes:
        moved = np.allclose(sparse_map.world_pose(k), step @ before[k], atol=1e-9)
        stays = np.array_equal(sparse_map.world_pose(k), before[k])
        assert moved if chosen <= k < held else stays
    sent = [r.keyframe for _, records in publisher.collect() for r in records if isinstance(r, KeyframePose)]
    assert sent == [k for k in keyframes if chosen <= k < held]
    move_keyframes(sparse_map, submap, before, publisher, PublishConfig())


def chain(length: int) -> tuple[SparseMap, list[KeyframeId]]:
    """Keyframes in a row, each composed from the one before."""
    sparse_map, keyframes = SparseMap(), [keyframe_id(submap_id(0, 0, 0), i) for i in range(length)]
    for i, (parent, keyframe) in enumerate(pairwise([NO_KEYFRAME, *keyframes])):
        T_p_k = se3.exp(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.001])) if i else np.eye(4)
        sparse_map.add_keyframe(keyframe, i, parent, T_p_k, 0)
    return sparse_map, keyframes


def test_keyframes_without_refined_poses_are_moved_in_linear_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pose graph moves thousands: each is composed once, not once for each keyframe before it."""
    sparse_map, keyframes = chain(300)
    targets = {
        k: sparse_map.world_pose(k) @ se3.exp(np.array([0.01, 0.0, 0.0, 0.0, 0.0, 0.001])) for k in keyframes[1:]
    }
    updated: list[int] = []
    update = sparse_map._update_world_pose
    monkeypatch.setattr(sparse_map, "_update_world_pose", lambda row: (updated.append(row), update(row)))
    move_keyframes(sparse_map, submap_id(0, 0, 0), targets, Publisher(sparse_map), PublishConfig())
    assert len(updated) <= 2 * len(keyframes)
    assert all(np.allclose(sparse_map.world_pose(k), T, atol=0.01) for k, T in targets.items())


def test_keyframes_carried_along_to_their_targets_stay_composed_and_are_not_sent() -> None:
    sparse_map, keyframes = chain(30)
    step = se3.exp(np.array([0.2, 0.1, 0.0, 0.0, 0.0, 0.3]))
    targets = {k: step @ sparse_map.world_pose(k) for k in keyframes[10:]}
    targets[keyframes[20]] = targets[keyframes[20]] @ step
    publisher = Publisher(sparse_map)
    move_keyframes(sparse_map, submap_id(0, 0, 0), targets, publisher, PublishConfig())
    sent = [r.keyframe for _, records in publisher.collect() for r in records if isinstance(r, KeyframePose)]
    assert sent == [keyframes[n] for n in (10, 20, 21)]
    assert all(np.allclose(sparse_map.world_pose(k), T, atol=1e-9) for k, T in targets.items())


@pytest.mark.parametrize("scale", [0.0, 1.0, 1.7])
def test_keyframes_are_moved_together_to_the_bit_as_one_by_one(scale: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """A pose graph moves 20,000 keyframes in one step, for which all agents wait. scale: of the submap, or 0."""
    (together, keyframes), (single, _) = chain(40), chain(40)
    submap = submap_id(0, 0, 0)
    for sparse_map in (together, single):
        for keyframe in keyframes[1:]:
            sparse_map.set_pose(keyframe, sparse_map.pose(keyframe), carry=False)
        if scale:
            S_w_m = sim3.of(scale, se3.exp(np.array([1.0, -2.0, 0.5, 0.2, 0.1, -0.4])))
            sparse_map.move_submap(submap, S_w_m)
    step = se3.exp(np.array([0.2, 0.1, 0.0, 0.0, 0.1, 0.3]))
    targets = {k: step @ together.world_pose(k) for k in keyframes[1:]}
    for keyframe, T_w_k in targets.items():
        single.set_world_pose(keyframe, T_w_k, carry=False)
    updated: list[int] = []
    monkeypatch.setattr(together, "_update_world_pose", updated.append)
    publisher = Publisher(together)
    move_keyframes(together, submap, targets, publisher, PublishConfig())
    assert not updated
    assert np.array_equal(together.keyframes.T_w_k, single.keyframes.T_w_k)
    assert np.array_equal(together.keyframes.T_m_k, single.keyframes.T_m_k)
    assert together.moved_rows == single.moved_rows
    ((_, records),) = publisher.collect()
    assert keyframes_in(records) == keyframes[1:]


def test_counts_of_landmarks_and_observations_follow_the_map(make_flight: MakeFlight) -> None:
    """They are kept by keyframe: the page asks twice a second, and 20,000 keyframes have seven million keypoints."""
    flight, mapper = make_flight(keyframes=30), Mapper(WITHOUT_GRID)
    feed(mapper, [flight])
    sparse_map, table = mapper.map, mapper.map.keypoints
    height = len(sparse_map.keyframes.id)

    def check() -> None:
        live, slots = sparse_map.live_landmarks(), np.arange(sparse_map.slots, dtype=np.int32)
        assert [sparse_map.is_live_landmark(s) for s in slots.tolist()] == sparse_map.is_live(slots).tolist()
        assert [sparse_map.has_position(s) for s in slots.tolist()] == sparse_map.positions(slots)[1].tolist()
        assert sparse_map.count_live() == len(live) == sum(sparse_map.live_by_submap().values())
        assert np.array_equal(sparse_map.keyframes.live, np.bincount(table.row[live], minlength=height))
        assert sparse_map.keyframes.usable.sum() == np.count_nonzero(table.usable[: sparse_map.slots])

    check()
    roots = sparse_map.live_landmarks()
    fused = [
        sparse_map.slots_of(k)[(table.kind[s := sparse_map.slots_of(k)] == LANDMARK) & (table.root[s] != s)]
        for k in flight.keyframes
    ]
    again = np.concatenate(fused)
    assert len(again) > 0
    sparse_map.unfuse(again)
    check()
    sparse_map.fuse(int(roots[5]), int(roots[2]))
    sparse_map.set_flags(roots[7:9], CULLED)
    check()
    sparse_map.cull_keyframe(flight.keyframes[4])
    check()
    sparse_map.forget([submap_of_keyframe(flight.keyframes[0])])
    check()
    assert sparse_map.count_live() == 0


def test_many_corrections_are_sent_newest_first_a_batch_at_a_time(mapped: tuple[Any, Mapper]) -> None:
    flight, mapper = mapped
    publisher = Publisher(mapper.map, replace(PublishConfig(), batch_values=8))
    agent = flight.agent
    for keyframe in flight.keyframes[1:]:
        publisher.mark_changed(KeyframePose.KIND, keyframe)
    assert publisher.collect({agent: 0}) == () and publisher.waiting
    sent = []
    while publisher.waiting:
        ((_, records),) = publisher.collect()
        sent.append(keyframes_in(records))
    live = flight.keyframes[1:]
    assert sent == [live[max(0, n - 8) : n] for n in range(len(live), 0, -8)]


def test_a_step_codes_a_part_of_a_batch_and_the_next_ones_the_rest(mapped: tuple[Any, Mapper]) -> None:
    """A loop over a large map changes all its keyframes: a step that codes a whole batch keeps every agent waiting."""
    flight, mapper = mapped
    publisher = Publisher(mapper.map, replace(PublishConfig(), batch_values=20, step_values=6))
    agent, live = flight.agent, flight.keyframes[1:]
    for keyframe in live:
        publisher.mark_changed(KeyframePose.KIND, keyframe)
    sent: list[list[KeyframeId]] = []
    for _ in range(4):  # the batch goes on though it has not arrived
        for _, records in publisher.collect({agent: 0} if sent else {}):
            sent.append(keyframes_in(records))
        publisher.mark_changed(KeyframePose.KIND, live[-1])  # changes again
        publisher.mark_changed(KeyframePose.KIND, live[-9])  # the same, while it is chosen
    assert [len(part) for part in sent] == [6, 6, 6, 2]
    assert sorted(k for part in sent for k in part) == live[-20:]
    assert not publisher.unfinished and publisher.collect({agent: 0}) == ()
    ((_, records),) = publisher.collect()
    assert publisher.unfinished == {agent} and keyframes_in(records)[-1] == live[-1]


def test_what_moves_nothing_is_coded_over_several_steps_too(mapped: tuple[Any, Mapper]) -> None:
    """A full bundle removes observations and landmarks of 800 keyframes at once."""
    flight, mapper = mapped
    publisher = Publisher(mapper.map, replace(PublishConfig(), step_values=8))
    for keyframe in flight.keyframes:
        publisher.mark_changed(CulledLandmarks.KIND, keyframe)
    sent = [[k for _, records in publisher.collect() for k in keyframes_in(records)] for _ in range(4)]
    assert sent == [flight.keyframes[n : n + 8] for n in range(0, 32, 8)]
    assert not publisher.waiting
    for keyframe in flight.keyframes:
        publisher.mark_deleted(keyframe)
    ((_, records),) = publisher.collect()  # they are forgotten in the next step
    assert keyframes_in(records) == flight.keyframes


def test_a_large_map_is_merged_in_a_step(words: Any) -> None:
    mapper = Mapper(BaseConfig(), words)
    for submap in (submap_id(0, 1, 0), submap_id(1, 1, 0)):
        for k in range(20_000 if submap > submap_id(0, 1, 0) else 1):
            mapper.map.add_keyframe(keyframe_id(submap, k), k, NO_KEYFRAME, np.eye(4), 0)
    begin_ns = time.process_time_ns()
    mapper.merger.merge(submap_id(1, 1, 0), submap_id(0, 1, 0), np.eye(4))
    mapper.merger.search_overlap(submap_id(1, 1, 0), submap_id(0, 1, 0))
    assert time.process_time_ns() - begin_ns < 1.5e9 * slowness()


def test_a_keyframe_whose_time_changed_leaves_no_frame_behind(words: Any) -> None:
    sparse_map = SparseMap()
    detector = LoopDetector(BaseConfig().loops, sparse_map, words)
    a, b = keyframe_id(submap_id(0, 1, 0), 0), keyframe_id(submap_id(0, 1, 1), 0)
    for t_ns in (5, 7):
        sparse_map.add_keyframe(a, t_ns, NO_KEYFRAME, np.eye(4), 0)
        if t_ns == 5:
            detector.add(a)
    detector.remove(a)
    sparse_map.forget([submap_id(0, 1, 0)])
    sparse_map.add_keyframe(b, 5, NO_KEYFRAME, np.eye(4), 0)
    detector.add(b)
    assert detector.query(b) is None
