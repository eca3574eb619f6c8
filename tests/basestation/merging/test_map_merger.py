"""Maps are merged where they overlap, and not where they only look alike."""

import itertools
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kiteline_agent.exchange.correction_batches import ReceivedBatches
from kiteline_basestation.config import BaseConfig
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import Job, JobDone
from kiteline_basestation.management import Command
from kiteline_basestation.map.map_tables import REFINED
from kiteline_basestation.mapper import Mapper, MapperInput
from kiteline_basestation.merging.loop_detector import Contradiction
from kiteline_basestation.refinement.bundle_job import FULL_BUNDLE, LOCAL_BUNDLE
from kiteline_basestation.station import Station
from kiteline_codec.channel import PlainChannel, plain_pair
from kiteline_codec.schema import (
    CameraIntrinsics,
    Key,
    KeyframeHeader,
    KeyframePose,
    NewLandmarks,
    Record,
    RefinedLandmarks,
    SubmapPlacement,
)
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.ids import SEQUENCE_BITS, KeyframeId, SubmapId, submap_of_keyframe
from tests.basestation.feeding import STEP_NS, WITHOUT_GRID, feed

MakeFlight = Callable[..., Any]
ELSEWHERE = se3.exp(np.array([3.0, -1.0, 0.2, 0.02, -0.03, 1.1]))


def joint_error_m(mapper: Mapper, flights: Sequence[Any]) -> F64:
    """Errors (n,) of all keyframes in the world of the first."""
    out = []
    for flight in flights:
        T_w_m = mapper.placements[submap_of_keyframe(flight.keyframes[0])]
        for k, true in zip(flight.keyframes, flight.true_T_w_k):
            pose = mapper.map.pose(k)
            out.append(float(np.linalg.norm((T_w_m @ pose)[:3, 3] - true[:3, 3])))
    return np.array(out)


def test_maps_of_two_agents_in_one_room_are_merged(make_flight: MakeFlight, words: Any) -> None:
    a = make_flight(keyframes=26, turns=0.8)
    b = make_flight(keyframes=26, turns=0.8, start=0.5, variant=1, agent=1, T_w_m=ELSEWHERE)
    mapper = Mapper(WITHOUT_GRID, words)
    published = feed(mapper, [a, b])
    assert mapper.summary()["merges"] == 1
    assert np.sqrt(np.mean(joint_error_m(mapper, [a, b]) ** 2)) < 0.02
    placed = [r for r in published if isinstance(r, SubmapPlacement)]
    assert {r.submap for r in placed if r.recognised} == {submap_of_keyframe(b.keyframes[0])}
    last = [r for r in placed if r.submap == submap_of_keyframe(b.keyframes[0])][-1]
    assert np.allclose(last.S_w_m, ELSEWHERE, atol=0.03)


def test_maps_are_merged_whose_keyframes_have_few_corners_in_common(make_flight: MakeFlight, words: Any) -> None:
    a = make_flight(keyframes=10, turns=0.2, points=24000)  # of the points in view a keyframe has one in fifteen
    b = make_flight(keyframes=10, turns=0.2, start=0.1, variant=1, agent=1, T_w_m=ELSEWHERE, points=24000)
    mapper = Mapper(WITHOUT_GRID, words)
    feed(mapper, [a, b])
    assert mapper.summary()["merges"] == 1
    assert np.sqrt(np.mean(joint_error_m(mapper, [a, b]) ** 2)) < 0.03


def test_maps_are_merged_by_the_few_landmarks_that_a_thin_link_describes(make_flight: MakeFlight, words: Any) -> None:
    flights = [
        make_flight(keyframes=10, turns=0.2, points=1400),
        make_flight(keyframes=10, turns=0.2, start=0.05, variant=1, agent=1, T_w_m=ELSEWHERE, points=1400),
    ]
    for flight in flights:
        flight.records = [[few_described(record) for record in records] for records in flight.records]
    mapper = Mapper(WITHOUT_GRID, words)
    feed(mapper, flights)
    assert mapper.summary()["merges"] == 1
    assert np.sqrt(np.mean(joint_error_m(mapper, flights) ** 2)) < 0.03


def few_described(record: Record) -> Record:
    """The record, with descriptors of the same fifth of all corners, whichever agent sees them."""
    if not isinstance(record, NewLandmarks):
        return record
    return replace(record, descriptor=np.where((record.angle < 51)[:, None], record.descriptor, np.uint8(0)))


@pytest.mark.parametrize("rooms", ["papered", "half_papered"])
def test_similar_rooms_are_not_merged(
    make_flight: MakeFlight, request: pytest.FixtureRequest, words: Any, rooms: str
) -> None:
    one, other = request.getfixturevalue(rooms)
    a = make_flight(keyframes=28, turns=1.0, scene=one)
    b = make_flight(keyframes=28, turns=1.0, scene=other, variant=1, agent=1)
    mapper = Mapper(WITHOUT_GRID, words)
    feed(mapper, [a, b])
    assert mapper.merger.detector.verified > 0  # single walls do look alike
    assert mapper.summary()["merges"] == 0
    assert mapper.summary()["maps"] == 2


def test_a_map_is_not_merged_by_a_place_that_the_other_map_has_twice(
    make_flight: MakeFlight, shelves: Any, words: Any
) -> None:
    long = make_flight(keyframes=30, turns=13.0, scene=shelves, drift_m=0.002)
    short = make_flight(keyframes=8, turns=2.0, start=5.0, scene=shelves, variant=1, agent=1)
    mapper = Mapper(WITHOUT_GRID, words)
    feed(mapper, [long, short], [0, 30])
    assert mapper.summary()["loop_matches"] > 0
    assert mapper.summary()["merges"] == mapper.summary()["merges_undone"] == 0


def test_agents_in_two_similar_rooms_are_merged_by_room(
    make_flight: MakeFlight, half_papered: tuple[Any, Any], words: Any
) -> None:
    flights = [
        make_flight(keyframes=26, turns=0.9, scene=scene, start=start, variant=agent, agent=agent, T_w_m=T_w_m)
        for agent, (scene, start, T_w_m) in enumerate(
            (scene, start, T_w_m) for scene in half_papered for start, T_w_m in ((0.1, np.eye(4)), (0.5, ELSEWHERE))
        )
    ]
    mapper = Mapper(WITHOUT_GRID, words)
    feed(mapper, flights)
    maps = [mapper.map.map_id(submap_of_keyframe(flight.keyframes[0])) for flight in flights]
    assert maps[0] == maps[1] != maps[2] == maps[3]
    assert mapper.summary()["merges_undone"] == 0


@pytest.mark.parametrize(("predecessors", "merges"), [(0, 0), (4, 1)])
def test_predecessors_of_a_matched_keyframe_are_verified(
    make_flight: MakeFlight, words: Any, predecessors: int, merges: int
) -> None:
    first = make_flight(keyframes=24, turns=0.45, start=0.3, variant=1, agent=1)
    second = make_flight(keyframes=24, turns=0.45, T_w_m=ELSEWHERE)
    loops = replace(BaseConfig().loops, predecessors=predecessors, min_likeness=0.075)  # the index finds one keyframe
    mapper = Mapper(replace(WITHOUT_GRID, loops=loops), words)
    feed(mapper, [first, second], [0, 24])
    assert mapper.summary()["merges"] == merges
    if merges:
        assert np.sqrt(np.mean(joint_error_m(mapper, [first, second]) ** 2)) < 0.03


def test_predecessors_whose_parents_never_came_are_left_out(make_flight: MakeFlight, words: Any) -> None:
    """They have no pose; where a lossy link or an agent that means harm left them so, the base ended."""
    first = make_flight(keyframes=24, turns=0.45, start=0.3, variant=1, agent=1)
    second = make_flight(keyframes=24, turns=0.45, T_w_m=ELSEWHERE)
    headers: dict[int, KeyframeHeader] = {}
    for n, group in enumerate(second.records):
        (headers[n],) = (record for record in group if isinstance(record, KeyframeHeader))
    missing, last = 2, 1
    second.records[missing] = []
    for n in range(3, 24):
        lost = n % 3 == 2
        parent = missing if lost else last
        T_p_k = se3.inverse(second.agent_T_m_k[parent]) @ second.agent_T_m_k[n]
        header = replace(headers[n], parent=second.keyframes[parent], T_p_k=T_p_k)
        second.records[n] = [header if isinstance(r, KeyframeHeader) else r for r in second.records[n]]
        last = last if lost else n
    mapper = Mapper(WITHOUT_GRID, words)
    feed(mapper, [first, second], [0, 24])
    assert mapper.map.pose(second.keyframes[5]) is None and mapper.map.pose(second.keyframes[6]) is not None
    assert mapper.merger is not None and mapper.merger.detector.verified > 0


@pytest.mark.parametrize("keyframes", [1, 2])
def test_two_keyframes_suffice_where_two_of_the_other_map_match(
    make_flight: MakeFlight, words: Any, keyframes: int
) -> None:
    first = make_flight(keyframes=24, turns=0.45, start=0.3, variant=1, agent=1)
    second = make_flight(keyframes=keyframes, turns=0.02, start=0.4, T_w_m=ELSEWHERE)
    mapper = Mapper(WITHOUT_GRID, words)
    feed(mapper, [first, second], [0, 24])
    assert mapper.merger is not None and mapper.merger.detector.verified >= 1
    assert mapper.summary()["merges"] == keyframes - 1  # one view alone merges nothing
    if keyframes == 2:
        assert np.sqrt(np.mean(joint_error_m(mapper, [first, second]) ** 2)) < 0.03


def test_equal_stamps_of_two_starts_are_not_one_frame(make_flight: MakeFlight, words: Any) -> None:
    """The clock begins anew with the agent, as in a simulator: two rooms lay in each other, merged again and again."""
    flights = [make_flight(keyframes=10, turns=0.2), make_flight(keyframes=10, turns=0.2, seed=9, boot=2)]
    mapper = Mapper(WITHOUT_GRID, words)
    feed(mapper, flights)
    assert mapper.summary()["maps"] == 2
    assert mapper.summary()["merges"] == mapper.summary()["merges_undone"] == 0


def test_agents_share_maps_within_groups(make_flight: MakeFlight, words: Any) -> None:
    flights = [
        make_flight(keyframes=16, turns=0.45, start=0.3 * n, variant=n, agent=n, T_w_m=se3.exp(np.full(6, 0.2 * n)))
        for n in range(3)
    ]
    for share, merges in (("all", 2), ("0 1", 1), ("none", 0)):
        config = replace(WITHOUT_GRID, loops=replace(BaseConfig().loops, share=share))
        mapper = Mapper(config, words)
        feed(mapper, flights)
        assert mapper.summary()["merges"] == merges
        if merges == 2:
            assert np.sqrt(np.mean(joint_error_m(mapper, flights) ** 2)) < 0.02


def test_submap_after_a_loss_is_merged_and_split_again(make_flight: MakeFlight, words: Any) -> None:
    a = make_flight(keyframes=20, turns=0.6)
    b = make_flight(keyframes=20, turns=0.6, start=0.3, variant=1, submap=1, T_w_m=ELSEWHERE)
    mapper = Mapper(WITHOUT_GRID, words)
    feed(mapper, [a, b], [0, 20])
    assert mapper.summary()["merges"] == 1
    assert np.sqrt(np.mean(joint_error_m(mapper, [a, b]) ** 2)) < 0.02
    assert mapper.merger is not None and mapper.merger.edges
    output = mapper.step(MapperInput(((a.agent, ()),), (), (Command(1, "split", '{"map": "0.1.1"}'),)), 10**12)
    assert not mapper.merger.edges  # they would bend both maps if these became one by others
    table, sparse_map = mapper.map.keypoints, mapper.map
    slots = np.flatnonzero(table.root[: sparse_map.slots] >= 0)
    here = sparse_map.keyframes.id[table.row[slots]] >> SEQUENCE_BITS
    there = sparse_map.keyframes.id[table.row[table.root[slots]]] >> SEQUENCE_BITS
    assert np.array_equal(here, there)  # no point of one is seen from the other
    assert mapper.summary()["maps"] == 2
    young = submap_of_keyframe(b.keyframes[0])
    assert output.withdrawn == ((a.agent, Key(SubmapPlacement.KIND, young, 0)),)  # its place was the merge's
    assert young not in mapper.placements and submap_of_keyframe(a.keyframes[0]) in mapper.placements
    assert mapper.step(MapperInput(((a.agent, ()),)), 10**12 + STEP_NS).withdrawn == ()


def test_refined_landmarks_are_sent_when_they_are_split_off(make_flight: MakeFlight, words: Any) -> None:
    """While they were fused with others, a record that replaced an earlier one left them out."""
    a = make_flight(keyframes=20, turns=0.6)
    b = make_flight(keyframes=20, turns=0.6, start=0.3, variant=1, agent=1, T_w_m=ELSEWHERE)
    mapper = Mapper(WITHOUT_GRID, words)
    published = feed(mapper, [a, b])
    table = mapper.map.keypoints
    slots = np.flatnonzero(table.flags[: mapper.map.slots] & REFINED != 0)
    fused = slots[table.root[slots] != slots]
    mapper._publisher.mark_changed_slots(RefinedLandmarks.KIND, fused.astype(np.int32))  # as by the next bundle
    split = Command(1, "split", '{"map": "1.1.0"}')
    for n in range(-5, 5):  # in which no bundle ends, that would refine them anew
        output = mapper.step(MapperInput((), (), () if n else (split,)), 10**12 + n * STEP_NS)
        published += [record for _, records in output.publish for record in records]
    told = {record.keyframe: set(record.index) for record in published if isinstance(record, RefinedLandmarks)}
    live = mapper.map.live_landmarks()
    assert mapper.map.is_live(fused).any()
    for slot in live[table.flags[live] & REFINED != 0].tolist():
        keyframe = int(mapper.map.keyframes.id[table.row[slot]])
        assert mapper.map.keypoint_of(np.array([slot]))[0] in told[KeyframeId(keyframe)]


def test_undoing_an_inner_merge_cancels_the_jobs_of_the_outer_map(make_flight: MakeFlight, words: Any) -> None:
    """A full bundle of the outer map, which was at the worker, moved the separated keyframes by metres."""
    worlds = [np.eye(4), ELSEWHERE, se3.exp(np.array([-2.0, 2.0, 0.1, 0.01, 0.02, -0.7]))]
    outer, middle, inner = flights = [
        make_flight(keyframes=12, turns=0.3, start=0.1 * n, variant=n, agent=n, T_w_m=world)
        for n, world in enumerate(worlds)
    ]
    mapper = Mapper(WITHOUT_GRID, words)
    merger = mapper.merger
    assert merger is not None
    found: list[Contradiction] = []
    merger.detector.query = lambda keyframe: found.pop() if found else None  # type: ignore[method-assign]
    feed(mapper, flights)
    clock = itertools.count(10**12, STEP_NS)
    merge_by_command(mapper, inner, middle, se3.inverse(worlds[1]) @ worlds[2], clock)
    merge_by_command(mapper, middle, outer, worlds[1], clock)
    maps = [submap_of_keyframe(flight.keyframes[0]) for flight in flights]
    assert {mapper.map.map_id(submap) for submap in maps} == {maps[0]}
    merger.search_overlap(maps[1], maps[0])  # after its last keyframe a full bundle is due
    jobs: list[Job] = []
    while not any(job.kind == FULL_BUNDLE.name for job in jobs):
        jobs += mapper.step(MapperInput(()), next(clock)).jobs
    found.append(Contradiction((maps[1], maps[2])))
    merger.search_overlap(maps[1], maps[0])
    mapper.step(MapperInput(()), next(clock))
    assert merger.undone == 1 and mapper.map.map_id(maps[2]) == maps[2]
    assert [set(merge.moved) for merge in merger.merges] == [{maps[1]}]  # the outer merge would move it, if undone
    mapper.step(MapperInput((), tuple(run_job(job) for job in jobs)), next(clock))
    errors_m = [np.linalg.norm((mapper.map.pose(k) - T)[:3, 3]) for k, T in zip(inner.keyframes, inner.true_T_m_k)]
    assert max(errors_m) < 0.1


def test_a_full_bundle_of_a_map_that_is_merged_meanwhile_is_void(make_flight: MakeFlight, words: Any) -> None:
    """It would take the keyframes back to where they were before the merge."""
    a = make_flight(keyframes=12, turns=0.3)
    b = make_flight(keyframes=12, turns=0.3, seed=9, agent=1)
    mapper = Mapper(WITHOUT_GRID, words)
    feed(mapper, [a, b])
    merger = mapper.merger
    assert merger is not None
    older, newer = (submap_of_keyframe(flight.keyframes[0]) for flight in (a, b))
    merger._corrections.request_bundle(newer)
    jobs = mapper.step(MapperInput(()), 10**12).jobs
    assert [job.kind for job in jobs] == [FULL_BUNDLE.name]
    merger.merge(newer, older, ELSEWHERE)
    merged = [mapper.map.world_pose(k) for k in b.keyframes]
    mapper.step(MapperInput((), tuple(run_job(job) for job in jobs)), 10**12 + STEP_NS)
    assert np.allclose([mapper.map.world_pose(k) for k in b.keyframes], merged, atol=0.1)


def test_a_local_bundle_of_a_map_that_the_same_step_moves_is_void(make_flight: MakeFlight, words: Any) -> None:
    """Both results come in one step, the full bundle's first: the other was computed where the map lay before."""
    a = make_flight(keyframes=12, turns=0.3)
    b = make_flight(keyframes=12, turns=0.3, start=0.1, variant=1, agent=1, T_w_m=ELSEWHERE)
    mapper, clock = Mapper(WITHOUT_GRID, words), itertools.count(10**12, STEP_NS)
    merger = mapper.merger
    assert merger is not None
    merger.detector.query = lambda keyframe: None  # type: ignore[method-assign]
    feed(mapper, [a, b])
    merge_by_command(mapper, b, a, ELSEWHERE, clock)
    older, newer = (submap_of_keyframe(flight.keyframes[0]) for flight in (a, b))
    merger.search_overlap(newer, older)  # bundles of its keyframes are due, after the last one a full bundle
    jobs: list[Job] = []
    while not any(job.kind == FULL_BUNDLE.name for job in jobs):
        jobs += mapper.step(MapperInput(()), next(clock)).jobs
    assert {job.kind for job in jobs} == {LOCAL_BUNDLE.name, FULL_BUNDLE.name}
    bundles = mapper.summary()["bundles"]
    done = sorted((run_job(job) for job in jobs), key=lambda done: done.kind != FULL_BUNDLE.name)
    mapper.step(MapperInput((), tuple(done)), next(clock))
    assert mapper.summary()["bundles"] == bundles


def merge_by_command(mapper: Mapper, newer: Any, older: Any, T_older_newer: F64, clock: Iterator[int]) -> None:
    """Merge the maps of two flights, and run the jobs that follow."""
    order = {"map": f"{newer.agent}.1.0", "into": f"{older.agent}.1.0", "T_into_map": T_older_newer.ravel().tolist()}
    output = mapper.step(MapperInput((), (), (Command(1, "merge", json.dumps(order)),)), next(clock))
    assert output.answers[0].ok, output.answers[0].text
    while not mapper.idle:
        output = mapper.step(MapperInput((), tuple(run_job(job) for job in output.jobs)), next(clock))


def test_placement_of_a_split_map_is_withdrawn(make_flight: MakeFlight, words: Any) -> None:
    station, theirs, young = joined_flights(make_flight, words, 50)
    assert any(isinstance(r, SubmapPlacement) and r.submap == young for r in theirs.receive((), 0))
    (answer,) = station.step({}, (), 100 * STEP_NS, [Command(1, "split", '{"map": "1.1.0"}')]).answers
    assert answer.ok
    assert theirs.take_removed() == [Key(SubmapPlacement.KIND, young, 0)]
    assert not any(isinstance(r, SubmapPlacement) for r in theirs.receive((), 0))


def test_the_place_of_a_merged_map_waits_for_no_corrections(make_flight: MakeFlight, words: Any) -> None:
    """Over a radio they take seconds, in which the vehicle would lie metres off."""
    station, theirs, young = joined_flights(make_flight, words, 36)  # too early to give up the first batch
    assert station.mapper.summary()["merges"] == 1
    records = theirs.receive((), 0)  # the first time: until now nothing had arrived
    placed = [r for r in records if isinstance(r, SubmapPlacement) and r.recognised]
    assert placed and {(r.submap, r.batch) for r in placed} == {(young, 0)}
    applied = ReceivedBatches().take(records, ())
    assert placed[0] in applied and all(r in applied for r in records if isinstance(r, KeyframePose))


def joined_flights(make_flight: MakeFlight, words: Any, steps: int) -> tuple[Station, PlainChannel, SubmapId]:
    """Two agents in one room, to none of which anything arrives; the second one's end, and its submap."""
    a = make_flight(keyframes=20, turns=0.6)
    b = make_flight(keyframes=20, turns=0.6, start=0.3, variant=1, agent=1, T_w_m=ELSEWHERE)
    ours, theirs = {}, {}
    for flight in (a, b):
        theirs[flight.agent], ours[flight.agent] = plain_pair()
    station = Station(WITHOUT_GRID, ours.__getitem__, words)
    done: tuple[JobDone, ...] = ()
    for n in range(steps):
        for flight in (a, b):
            if n == 0:
                theirs[flight.agent].put(CameraIntrinsics(flight.agent, flight.camera))
            for record in flight.records[n] if n < len(flight.records) else []:
                theirs[flight.agent].put(record)
        done = tuple(run_job(job) for job in station.step({a.agent: (), b.agent: ()}, done, n * STEP_NS).jobs)
    return station, theirs[b.agent], submap_of_keyframe(b.keyframes[0])
