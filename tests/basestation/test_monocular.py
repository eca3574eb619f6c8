"""Monocular maps: loops take the drift of their unit of length back, and merges find how long it is."""

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.exchange.map_cache_planner import MapCachePlanner
from kiteline_basestation.grid.placed_map import placed_map
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import Job, JobDone
from kiteline_basestation.management import Command
from kiteline_basestation.mapper import Mapper, MapperInput
from kiteline_basestation.merging.loop_consistency import within_drift
from kiteline_basestation.merging.loop_edges import LoopEdge, similarity
from kiteline_basestation.merging.loop_verification import depth_scale
from kiteline_basestation.merging.similarity import align_points
from kiteline_basestation.refinement.bundle_job import LOCAL_BUNDLE, BundleInputs
from kiteline_basestation.runtime.flight_summary import keyframe_poses
from kiteline_basestation.store.integrity import contradictions
from kiteline_codec.channel import plain_pair
from kiteline_codec.schema import (
    CachedKeyframe,
    CachedLandmarks,
    CameraIntrinsics,
    GravityAlignment,
    KeyframeHeader,
    LivePose,
    Record,
    SubmapPlacement,
    SubmapScale,
)
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3, sim3
from kiteline_core.ids import agent_of_keyframe, agent_of_submap, submap_of_keyframe
from kiteline_core.optimisation.bundle import BundleResult
from tests.basestation.feeding import STEP_NS, WITHOUT_GRID, feed

MakeFlight = Callable[..., Any]
ELSEWHERE = se3.exp(np.array([3.0, -1.0, 0.2, 0.02, -0.03, 1.1]))


def in_own_unit(flight: Any, unit: float, growth: float = 0.0) -> Any:
    """The flight as one camera shows it: lengths are unit times metres, and grow by a share with each keyframe."""
    assert not flight.camera.stereo
    for n, records in enumerate(flight.records):
        head = records[0]
        assert isinstance(head, KeyframeHeader)
        grown = unit * (1.0 + growth) ** max(n - 0.5, 0.0)
        records[0] = replace(head, T_p_k=sim3.with_scaled_translation(head.T_p_k, grown))
    return flight


def untouched(job: Job) -> JobDone:
    """Local bundles change nothing, so that what drifts keeps its drift until a loop takes it back."""
    if job.kind != LOCAL_BUNDLE.name:
        return run_job(job)
    assert isinstance(job.inputs, BundleInputs)
    problem = job.inputs.problem
    kept = np.ones(len(problem.camera), np.bool_)
    return JobDone(job.id, job.kind, BundleResult(problem.T_c_m, problem.points, kept, 1.0, 1.0, 0, 1), 1)


def placed(mapper: Mapper, flight: Any) -> F64:
    """Positions (n,3) of a flight's keyframes in the world."""
    S_w_m = mapper.placements[submap_of_keyframe(flight.keyframes[0])]
    return np.array([(S_w_m @ mapper.map.pose(k))[:3, 3] for k in flight.keyframes])


def true_places(flight: Any) -> F64:
    return np.array([T[:3, 3] for T in flight.true_T_w_k])


def believed(flight: Any) -> F64:
    """Poses (n,4,4) that the agent's keyframes alone give: what a base without loops shows."""
    poses: list[F64] = []
    for n, records in enumerate(flight.records):
        poses.append(poses[-1] @ records[0].T_p_k if n else records[0].T_p_k)
    return np.stack(poses)


def error_m(found: F64, true: F64) -> tuple[float, float]:
    """RMS after the best similarity, in true metres, and the scale of that."""
    S = align_points(true, found, with_scale=True)
    return float(np.sqrt(np.mean(np.sum((se3.transform(S, found) - true) ** 2, axis=1)))), sim3.scale_of(S)


def the_other_eye(make_flight: MakeFlight) -> Any:
    return in_own_unit(
        make_flight(keyframes=26, turns=0.8, start=0.5, variant=1, agent=1, T_w_m=ELSEWHERE, stereo=False), 0.37
    )


def lengths(ours: F64, flight: Any) -> F64:
    """How long each step between places (n,3) is, over what it is in truth."""
    true = true_places(flight)
    return np.asarray(np.linalg.norm(np.diff(ours, axis=0), axis=1) / np.linalg.norm(np.diff(true, axis=0), axis=1))


@pytest.mark.parametrize("growth", [0.0016, 0.0035])
def test_a_loop_takes_back_the_drift_of_the_unit(make_flight: MakeFlight, ring: Any, words: Any, growth: float) -> None:
    flight = in_own_unit(
        make_flight(keyframes=50, turns=1.2, scene=ring, drift_m=0.002, seed=4, noise_px=0.5, memory=3, stereo=False),
        0.4, growth,
    )  # fmt: skip
    blind, mapper = believed(flight), Mapper(WITHOUT_GRID, words)
    published = feed(mapper, [flight], run=untouched)
    assert mapper.summary()["loops"] >= 1
    before, after = (error_m(p, true_places(flight))[0] for p in (blind[:, :3, 3], placed(mapper, flight)))
    assert after < 0.15 * before
    drifted, mended = (lengths(p, flight) for p in (blind[:, :3, 3], placed(mapper, flight)))
    assert np.median(drifted[-8:]) / np.median(drifted[:8]) > 1.0 + 36 * growth
    assert abs(np.median(mended[-8:]) / np.median(mended[:8]) - 1.0) < 0.04
    assert abs(np.median(mended[:8]) / np.median(drifted[:8]) - 1.0) < 0.05  # the world keeps its unit
    # Where the agent flies nothing was stretched: its place says how long its unit has become, by twenty keyframes.
    submap = submap_of_keyframe(flight.keyframes[0])
    last = [r for r in published if isinstance(r, SubmapPlacement)][-1]
    assert np.allclose(last.S_w_m, mapper.placements[submap], atol=1e-5)
    assert sim3.scale_of(last.S_w_m) < 1.0 - 26 * growth  # between the middles of the first twenty and the last
    steps = [blind[-9:, :3, 3], np.array([mapper.map.pose(k)[:3, 3] for k in flight.keyframes[-9:]])]  # type: ignore[index]
    ours, theirs = (np.median(np.linalg.norm(np.diff(s, axis=0), axis=1)) for s in steps)
    assert abs(theirs / ours - 1.0) < max(0.015, 0.005 + 6 * growth)  # from the middle of twenty to that of eight


Met = tuple[Any, Any, Mapper, list[Record]]


@pytest.fixture(scope="module")
def met(make_flight: MakeFlight, words: Any) -> Met:
    """A stereo agent and a monocular one that fly together, the map of both, and what was published."""
    pair, eye = make_flight(keyframes=26, turns=0.8), the_other_eye(make_flight)
    mapper = Mapper(WITHOUT_GRID, words)
    return pair, eye, mapper, feed(mapper, [pair, eye])


@pytest.mark.parametrize("late", [False, True])
def test_a_monocular_map_takes_the_scale_of_a_stereo_map(met: Met, words: Any, late: bool) -> None:
    pair, eye, mapper, published = met
    flights = [eye, pair] if late else [pair, eye]  # whose map is the world at first
    if late:
        mapper = Mapper(WITHOUT_GRID, words)
        published = feed(mapper, flights, [0, 13])
    assert mapper.summary()["merges"] == 1
    found = np.concatenate([placed(mapper, f) for f in flights])
    error, scale = error_m(found, np.concatenate([true_places(f) for f in flights]))
    assert error < 0.01
    assert abs(scale - 1.0) < 0.005
    of = {submap_of_keyframe(f.keyframes[0]): f for f in flights}
    last = {r.submap: r.S_w_m for r in published if isinstance(r, SubmapPlacement)}
    assert set(last) == set(of)
    for submap, S_w_m in last.items():
        assert np.array_equal(S_w_m, mapper.placements[submap])
        assert (sim3.scale_of(S_w_m) == 1.0) == of[submap].camera.stereo
    assert abs(sim3.scale_of(last[submap_of_keyframe(eye.keyframes[0])]) * 0.37 - 1.0) < 0.05
    (answer,) = mapper.step(MapperInput((), (), (Command(1, "list", "{}"),)), 10**12).answers
    told = json.loads(answer.text)["maps"]
    assert [m["unit"] for m in told] == ["metre"]
    assert {s["unit"] for s in told[0]["submaps"]} == {"own", "metre"}
    poses = keyframe_poses(mapper)
    assert np.allclose([poses[k][:3, 3] for k in eye.keyframes], placed(mapper, eye))
    assert all(abs(sim3.scale_of(poses[k]) * 0.37 - 1.0) < 0.05 for k in eye.keyframes)


def test_two_eyes_with_other_units_become_one_map_and_part_again(make_flight: MakeFlight, words: Any) -> None:
    a = in_own_unit(make_flight(keyframes=26, turns=0.8, stereo=False), 2.0)
    b = the_other_eye(make_flight)
    mapper = Mapper(BaseConfig(), words)
    feed(mapper, [a, b])
    assert mapper.summary()["merges"] == 1
    both = np.concatenate([placed(mapper, a), placed(mapper, b)])
    assert error_m(both, np.concatenate([true_places(a), true_places(b)]))[0] < 0.01
    assert placed_map(mapper.map, mapper.placements).observations.size > 0
    assert not mapper.grid.places  # no metre, no grid
    young = submap_of_keyframe(b.keyframes[0])
    assert abs(mapper.map.scale(young) * 0.37 / 2.0 - 1.0) < 0.1
    assert mapper.merger is not None
    mapper.step(MapperInput((), (), (Command(1, "split", '{"map": "1.1.0"}'),)), 10**12)
    assert abs(mapper.map.scale(young) - 1.0) < 0.01  # as long as it was when it was laid into the other
    assert young not in mapper.placements
    assert contradictions(mapper) == []
    alone = np.array([mapper.map.world_pose(k)[:3, 3] for k in b.keyframes])  # type: ignore[index]
    error, scale = error_m(alone, true_places(b))
    assert error < 0.01
    assert abs(scale * 0.37 - 1.0) < 0.1


def test_the_map_cache_of_a_monocular_agent_is_in_its_unit(met: Met) -> None:
    pair, eye, mapper, _ = met
    base, reader = plain_pair()
    planner = MapCachePlanner(
        replace(BaseConfig().map_cache, min_cosine=-1.0, max_distance_ratio=9.0), BaseConfig().loops, mapper.map
    )
    planner.update(eye.agent, LivePose(eye.agent, 10**9, eye.keyframes[-1], np.eye(4), 90), base, 10**9)
    records = reader.receive((), 0)
    copies = {r.keyframe: r for r in records if isinstance(r, CachedKeyframe)}
    assert any(k in pair.keyframes for k in copies)
    S_w_m = mapper.map.submap_pose(submap_of_keyframe(eye.keyframes[0]))
    compared = 0
    for copied in (r for r in records if isinstance(r, CachedLandmarks)):
        T_m_k, camera = copies[copied.keyframe].T_m_k, eye.camera
        z = 1.0 / copied.inv_depth.astype(np.float64)
        x, y = ((copied.uv - (camera.cx, camera.cy)) / (camera.fx, camera.fy)).T
        seen = se3.transform(S_w_m, se3.transform(T_m_k, np.stack([x * z, y * z, z], 1)))
        slots = mapper.map.slots_of(copied.keyframe)[copied.index]
        there, known = mapper.map.positions(slots)
        assert known.all()
        assert np.abs(seen - there).max() < 1e-3
        compared += len(slots)
    assert compared > 50


@pytest.mark.parametrize("rooms", ["papered", "half_papered"])
def test_rooms_with_one_wallpaper_stay_two_for_monocular_agents_too(
    make_flight: MakeFlight, request: pytest.FixtureRequest, words: Any, rooms: str
) -> None:
    one, other = request.getfixturevalue(rooms)
    for stereo in (True, False):
        a = make_flight(keyframes=40, turns=1.0, scene=one, stereo=stereo)
        a = a if stereo else in_own_unit(a, 1.7)
        b = in_own_unit(make_flight(keyframes=40, turns=1.0, scene=other, variant=1, agent=1, stereo=False), 0.6)
        mapper = Mapper(WITHOUT_GRID, words)
        feed(mapper, [a, b])
        assert mapper.summary()["merges"] == 0


def test_a_repetitive_corridor_is_not_merged_by_a_monocular_agent(
    make_flight: MakeFlight, corridor: Any, words: Any
) -> None:
    a = make_flight(keyframes=26, turns=0.6, scene=corridor)
    b = make_flight(keyframes=26, turns=0.6, start=0.35, scene=corridor, variant=1, agent=1, stereo=False)
    b = in_own_unit(b, 0.6)
    mapper = Mapper(WITHOUT_GRID, words)
    feed(mapper, [a, b])
    assert mapper.summary()["merges"] == 0
    lone = Mapper(WITHOUT_GRID, words)
    feed(lone, [in_own_unit(make_flight(keyframes=40, turns=1.0, scene=corridor, seed=4, stereo=False), 0.6)])
    assert lone.summary()["loops"] == 0


def test_a_loop_may_be_off_by_as_much_as_its_scale_says(make_flight: MakeFlight, ring: Any, words: Any) -> None:
    flight = make_flight(keyframes=30, turns=0.9, scene=ring, drift_m=0.002, seed=4, memory=3, stereo=False)
    mapper = Mapper(WITHOUT_GRID, words)
    feed(mapper, [flight])
    assert mapper.merger is not None
    old, new = flight.keyframes[0], flight.keyframes[-1]

    def explained(shift_m: float, scale: float) -> bool:
        at = similarity(mapper.map, new)[:3, 3]
        X = sim3.of(scale, se3.from_rt(np.eye(3), at - scale * at + [shift_m, 0.0, 0.0]))  # about where the camera is
        S = sim3.inverse(similarity(mapper.map, old)) @ X @ similarity(mapper.map, new)
        edge = LoopEdge(new, old, sim3.rigid(S), 90, 3.0, sim3.scale_of(S))
        return within_drift(mapper.map, edge, mapper.config.loops)

    # 50 m on, a place that looks the same stands 6 m aside: no drift of the unit, and so no drift of the way either.
    assert not explained(6.0, 1.0)
    assert explained(6.0, 1.15)
    assert explained(2.0, 1.0)
    assert not explained(0.0, 1.8)


def test_depths_that_do_not_say_one_length_say_none() -> None:
    rng = np.random.default_rng(0)
    own = rng.uniform(1.0, 8.0, 60)
    told = depth_scale(own, 2.5 * own * np.exp(rng.normal(0.0, 0.05, 60)))
    assert abs(told / 2.5 - 1.0) < 0.03
    assert depth_scale(own[:10], 2.5 * own[:10]) is None
    assert depth_scale(own, own * np.exp(rng.normal(0.0, 0.4, 60))) is None
    halves = np.where(np.arange(60) < 31, 1.0, 2.0)
    assert depth_scale(own, halves * own) is None


def test_what_a_base_remembers_of_units_is_known_to_the_next(met: Met, words: Any) -> None:
    pair, eye, mapper, published = met
    again = Mapper(WITHOUT_GRID, words)
    for flight in (eye, pair):
        own = [r for r in published if agent_of_record(r) == flight.agent]
        again.restore(flight.agent, tuple(flight.all_records()), tuple(own), 0)
    again.restore_state(mapper.state())
    for flight in (eye, pair):
        assert np.allclose(placed(again, flight), placed(mapper, flight), atol=1e-9)
        for k in flight.keyframes:
            assert np.allclose(again.map.world_pose(k), mapper.map.world_pose(k), atol=1e-9)
    points = mapper.map.landmark_ids(mapper.map.live_landmarks())
    here, there = mapper.map.find_landmarks(points), again.map.find_landmarks(points)
    assert np.allclose(mapper.map.positions(here)[0], again.map.positions(there)[0], atol=1e-6)
    assert [v.scale for v in again.merger.edges] == [v.scale for v in mapper.merger.edges]
    assert sorted(again.merger.merges[0].moved) == sorted(mapper.merger.merges[0].moved)


def test_a_map_begun_in_metres_stays_as_it_is_and_the_one_before_it_is_stretched(make_flight: MakeFlight) -> None:
    flight = in_own_unit(make_flight(keyframes=8, turns=0.15, stereo=False), 0.5)
    later = make_flight(keyframes=8, turns=0.15, start=0.15, submap=1, stereo=False)
    before, after = (submap_of_keyframe(f.keyframes[0]) for f in (flight, later))
    t_ns = later.records[0][0].t_ns - 10**8
    left = LivePose(flight.agent, t_ns, flight.keyframes[-1], np.eye(4), 80)
    for first in (True, False):  # whether the unit is heard of before the new map
        mapper = Mapper()
        said: list[Record] = [SubmapScale(before, 2.0), SubmapScale(after, 1.0)]
        batches = [[CameraIntrinsics(flight.agent, flight.camera)], *flight.records, [left]]
        batches += [said, *later.records] if first else [*later.records, said]
        placed_at: dict[int, F64] = {}
        for n, batch in enumerate([*batches, [], []]):
            output = mapper.step(MapperInput(((flight.agent, tuple(batch)),)), n * STEP_NS)
            for _, out in output.publish:
                placed_at |= {r.submap: r.S_w_m for r in out if isinstance(r, SubmapPlacement)}
        assert np.isclose(sim3.scale_of(placed_at[before]), 2.0)
        assert sim3.scale_of(placed_at[after]) == 1.0
        begin, end = mapper.map.pose(later.keyframes[0]), mapper.map.pose(flight.keyframes[-1])
        assert np.allclose((placed_at[after] @ begin)[:3, 3], 2.0 * end[:3, 3], atol=1e-6)  # where it was left


def told_metres(make_flight: MakeFlight, *, first_in_metres: bool) -> tuple[Mapper, list[Any]]:
    """A base before it hears of the metre: submaps of four keyframes, each where the one before was left.

    The last but one is in a unit of its own, half a metre long, the last one in metres.
    """
    parts = [make_flight(keyframes=4, turns=0.07, start=0.07 * n, submap=n, stereo=False) for n in range(3)]
    flights = parts if first_in_metres else parts[1:]
    own = in_own_unit(flights[-2], 0.5)
    mapper = Mapper(WITHOUT_GRID)
    batches: list[list[Record]] = [[CameraIntrinsics(own.agent, own.camera)]]
    for n, flight in enumerate(flights):
        submap = submap_of_keyframe(flight.keyframes[0])
        batches += [[SubmapScale(submap, 1.0)]] if flight is not own else []
        batches += [*flight.records, []]
        if n + 1 < len(flights):
            t_ns = flights[n + 1].records[0][0].t_ns - 10**8
            batches.append([LivePose(flight.agent, t_ns, flight.keyframes[-1], np.eye(4), 80)])
    for n, batch in enumerate(batches):
        mapper.step(MapperInput(((own.agent, tuple(batch)),)), n * STEP_NS)
    return mapper, flights


def tell(mapper: Mapper, flight: Any, metres: float) -> None:
    record = SubmapScale(submap_of_keyframe(flight.keyframes[0]), metres)
    mapper.step(MapperInput(((flight.agent, (record,)),)), 10**12)


def test_a_unit_that_grew_while_the_base_refined_is_as_long_as_its_agent_says(make_flight: MakeFlight) -> None:
    mapper, (own, _) = told_metres(make_flight, first_in_metres=False)
    submap = submap_of_keyframe(own.keyframes[0])
    mapper._placements.rescale({submap: 1.002}, {})
    tell(mapper, own, 2.0)
    assert sim3.scale_of(mapper.placements[submap]) == pytest.approx(2.0)
    mapper._placements.rescale({submap: 1.001}, {})  # what the base finds later stands
    mapper.step(MapperInput(()), 2 * 10**12)
    assert sim3.scale_of(mapper.placements[submap]) == pytest.approx(2.002)


def test_metre_and_vertical_that_come_together_are_applied_together(make_flight: MakeFlight) -> None:
    """A map that is placed in the same step would lie elsewhere for a moment, and live poses with it."""
    mapper, (own, _) = told_metres(make_flight, first_in_metres=False)
    submap = submap_of_keyframe(own.keyframes[0])
    tilt = GravityAlignment(submap, se3.exp(np.array([0.0, 0.0, 0.0, 0.2, -0.1, 0.0])))
    mapper.step(MapperInput(((own.agent, (SubmapScale(submap, 2.0), tilt)),)), 10**12)
    S_w_m = mapper.placements[submap]
    assert sim3.scale_of(S_w_m) == pytest.approx(2.0)
    np.testing.assert_allclose(sim3.rigid(S_w_m)[:3, :3], tilt.T_l_m[:3, :3], atol=1e-9)


def test_a_submap_of_unknown_unit_has_no_place_in_metres_until_that_is_told(make_flight: MakeFlight) -> None:
    """It would lie there as if its unit were a metre."""
    mapper, (first, own, last) = told_metres(make_flight, first_in_metres=True)
    before = placed(mapper, first)
    assert list(mapper.placements) == [submap_of_keyframe(first.keyframes[0])]
    tell(mapper, own, 2.0)
    now = [placed(mapper, f) for f in (first, own, last)]
    np.testing.assert_array_equal(now[0], before)
    np.testing.assert_allclose(now[1][0], before[-1], atol=1e-6)
    assert lengths(now[1], own).mean() == pytest.approx(1.0, rel=0.1)
    assert lengths(now[2], last).mean() == pytest.approx(1.0, rel=0.1)
    left, there = mapper.map.pose(own.keyframes[-1]), mapper.map.pose(last.keyframes[0])
    S_own, S_last = (mapper.placements[submap_of_keyframe(f.keyframes[0])] for f in (own, last))
    np.testing.assert_allclose((S_last @ there)[:3, 3], (S_own @ left)[:3, 3], atol=1e-6)


def agent_of_record(record: Any) -> int:
    if isinstance(record, SubmapPlacement):
        return int(agent_of_submap(record.submap))
    return int(agent_of_keyframe(record.keyframe)) if hasattr(record, "keyframe") else -1
