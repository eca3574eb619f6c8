"""Chains of inertial steps over keyframes of a map, and a world in metres by all of them."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kiteline_basestation.inertial.chain import segments_of
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import JobDone
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.mapper import Mapper, MapperInput
from kiteline_basestation.refinement.apply_bundle import keep_scales
from kiteline_basestation.refinement.bundle_window import BundleWindow
from kiteline_basestation.store.integrity import contradictions
from kiteline_codec.schema import CameraIntrinsics, InertialSteps, Record, SubmapPlacement, SubmapScale
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3, sim3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import NO_KEYFRAME, AgentId, KeyframeId, keyframe_id, submap_id, submap_of_keyframe
from kiteline_core.optimisation.bundle import BundleResult
from tests.basestation.feeding import WITHOUT_GRID
from tests.basestation.inertial_maps import FINE, GRAVITY, T_B_C, steps


def a_sparse_map(culled: set[int]) -> tuple[SparseMap, BundleWindow, list[KeyframeId]]:
    sparse_map = SparseMap()
    submap = submap_id(AgentId(0), 0, 0)
    sparse_map.set_camera(AgentId(0), RectifiedCamera(640, 480, 400.0, 400.0, 320.0, 240.0, 0.1, False, T_B_C))
    sparse_map.metric_submaps.add(submap)
    keyframes = [keyframe_id(submap, i) for i in range(5)]
    rng = np.random.default_rng(3)
    for i, keyframe in enumerate(keyframes):
        parent = keyframes[i - 1] if i else NO_KEYFRAME
        sparse_map.add_keyframe(keyframe, i * 10**9, parent, np.eye(4), 0)
        if i:
            fields = steps(0.9 * i - 0.9, 0.9 * i, 3, 1.0, 1.0, rng, np.zeros(3))
            sparse_map.inertial_steps[keyframe] = InertialSteps(keyframe, parent, 2e-3, **fields)
    rows = np.array([sparse_map.rows[k] for i, k in enumerate(keyframes) if i not in culled], np.int32)
    none = SimpleNamespace(
        camera=np.zeros(0, np.int32), starts=np.zeros(1, np.int32), points=np.zeros((0, 3)),
        T_c_m=np.tile(np.eye(4), (len(rows), 1, 1)),
    )  # fmt: skip
    return sparse_map, BundleWindow(rows, np.zeros(0, np.int32), np.zeros(0, np.int32), none), keyframes  # type: ignore[arg-type]


def test_steps_over_culled_keyframes_are_joined() -> None:
    sparse_map, window, _ = a_sparse_map({2})
    found = segments_of(sparse_map, window.rows, window.problem)
    assert [(s.first, s.last, len(s.steps.dt_s)) for s in found] == [(0, 1, 3), (1, 2, 6), (2, 3, 3)]


def test_a_lost_record_breaks_the_chain_and_another_unit_has_none() -> None:
    sparse_map, window, keyframes = a_sparse_map(set())
    del sparse_map.inertial_steps[keyframes[2]]
    assert [(s.first, s.last) for s in segments_of(sparse_map, window.rows, window.problem)] == [(0, 1), (2, 3), (3, 4)]
    sparse_map.metric_submaps.clear()
    assert segments_of(sparse_map, window.rows, window.problem) == ()


UNIT = 0.96


def a_flight_in_wrong_metres(make_flight: Callable[..., Any], scene: Any, *, with_steps: bool) -> Any:
    """A monocular flight around a room in 10 s, whose agent calls 0.96 m a metre."""
    turns, keyframes = 1.6, 40
    flight = make_flight(keyframes=keyframes, turns=turns, stereo=False, drift_m=0.002, scene=scene)
    submap = submap_of_keyframe(flight.keyframes[0])

    def true(t: float) -> F64:
        return np.asarray(scene.path(turns * t / (0.25 * keyframes)))

    for n, records in enumerate(flight.records):
        head = records[0]
        records[0] = replace(head, T_p_k=sim3.with_scaled_translation(head.T_p_k, UNIT))
        if n == 0:
            records.append(SubmapScale(submap, 1.0))
        elif with_steps:
            fields = steps_along(true, 0.25 * (n - 1), 0.25 * n, 2)
            records.append(InertialSteps(flight.keyframes[n], flight.keyframes[n - 1], 2e-3, **fields))
    return flight


def steps_along(true: Callable[[float], F64], from_s: float, to_s: float, n: int) -> dict[str, Any]:
    """Steps of a camera that is the body, without noise."""
    rows: dict[str, list[Any]] = {name: [] for name in ("dt_s", "turn", "moved", "velocity", "position")}
    for a, b in pairwise(np.linspace(from_s, to_s, n + 1)):
        T0, T1 = true(a), true(b)
        moved, m = se3.inverse(T0) @ T1, round((b - a) / FINE)
        h = (b - a) / m
        v, p = np.zeros(3), np.zeros(3)
        for k in range(m):
            t = a + (k + 0.5) * h
            second = (true(t + h) - 2.0 * true(t) + true(t - h))[:3, 3] / h**2
            force = T0[:3, :3].T @ (second - GRAVITY)
            p, v = p + v * h + 0.5 * force * h * h, v + force * h
        for name, value in zip(rows, (b - a, se3.so3_log(moved[:3, :3]), UNIT * moved[:3, 3], v, p), strict=True):
            rows[name].append(value)
    return {name: np.array(values) for name, values in rows.items()}


def fed(flight: Any, words: Any, told: list[SubmapPlacement] | None = None) -> Mapper:
    """The base after a flight. told: takes the placements that it publishes."""
    mapper = Mapper(WITHOUT_GRID, words)
    done: tuple[JobDone, ...] = ()
    for n in range(len(flight.records) + 30):
        records: list[Record] = [CameraIntrinsics(flight.agent, flight.camera)] if n == 0 else []
        records += flight.records[n] if n < len(flight.records) else []
        output = mapper.step(MapperInput(((flight.agent, tuple(records)),), done), n * 250_000_000)
        done = tuple(run_job(job) for job in output.jobs)
        if told is not None:
            told += [r for _, records in output.publish for r in records if isinstance(r, SubmapPlacement)]
    assert mapper.idle
    assert contradictions(mapper) == []
    return mapper


def test_that_accelerations_told_the_scale_is_told_with_its_deviation(
    make_flight: Callable[..., Any], lively_room: Any, words: Any
) -> None:
    told: list[SubmapPlacement] = []
    mapper = fed(a_flight_in_wrong_metres(make_flight, lively_room, with_steps=True), words, told)
    assert all(sim3.scale_of(p.S_w_m) == 1.0 for p in told)
    known = [p for p in told if p.scale_sigma > 0.0]
    assert known and known[-1].scale_sigma == mapper._placements._scale_sigma[known[-1].submap]


def length_ratio(places: F64, flight: Any) -> float:
    true = np.array([T[:3, 3] for T in flight.true_T_w_k])
    return float(np.linalg.norm(places - places.mean(axis=0)) / np.linalg.norm(true - true.mean(axis=0)))


def test_world_and_agents_map_are_in_metres_by_all_accelerations(
    make_flight: Callable[..., Any], lively_room: Any, words: Any
) -> None:
    told, untold = (a_flight_in_wrong_metres(make_flight, lively_room, with_steps=known) for known in (True, False))
    mapper, other = fed(told, words), fed(untold, words)
    submap = submap_of_keyframe(told.keyframes[0])
    S_w_m = mapper.placements[submap]
    own = np.array([mapper.map.pose(k) for k in told.keyframes])
    assert sim3.scale_of(S_w_m) == sim3.scale_of(other.placements[submap]) == 1.0
    assert length_ratio(own[:, :3, 3], told) == pytest.approx(1.0, abs=0.01)  # what the agent is told
    again = Mapper(WITHOUT_GRID, words)
    sigma = mapper._placements._scale_sigma[submap]
    placement = SubmapPlacement(submap, S_w_m, scale_sigma=sigma)
    again.restore(told.agent, tuple(told.all_records()), (placement,), 0)
    again.restore_state(mapper.state())
    assert again._placements._scale_sigma == {submap: sigma} and sigma > 0.0  # goes on being told
    assert again.map.scaled_submaps == mapper.map.scaled_submaps == {submap}
    assert again.map.inertial_steps.keys() == mapper.map.inertial_steps.keys()
    assert length_ratio(np.array([other.map.pose(k) for k in untold.keyframes])[:, :3, 3], untold) < 0.975


def test_a_submap_that_was_placed_in_another_unit_is_told_in_metres() -> None:
    """As a merge places it: once accelerations tell lengths in w, its keyframes hold them, not its placement."""
    sparse_map, window, keyframes = a_sparse_map(set())
    submap = submap_of_keyframe(keyframes[0])
    sparse_map.scale_submap(submap, 1.02)
    result = BundleResult(np.eye(4)[None], np.zeros((1, 3)), np.zeros(0, np.bool_), 0.0, 0.0, 0, 0)
    assert keep_scales(sparse_map, submap, window, result)[1] == {}
    _, factors = keep_scales(sparse_map, submap, window, replace(result, scale_sigma=0.01))
    assert factors == {submap: pytest.approx(1.0 / 1.02)} and sparse_map.scale(submap) == 1.0
