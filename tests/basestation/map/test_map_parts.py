"""Full bundles of maps of any size: none, one, or parts that overlap."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import Job, JobDone
from kiteline_basestation.mapper import Mapper, MapperInput
from kiteline_basestation.merging.correction import full_bundle_window, part_spans
from kiteline_basestation.merging.correction_jobs import FullBundle
from kiteline_basestation.refinement.bundle_window import bundle_window
from kiteline_codec.schema import CameraIntrinsics
from kiteline_core.geometry import se3
from kiteline_core.ids import submap_of_keyframe
from kiteline_core.optimisation.bundle import BundleResult
from tests.basestation.feeding import STEP_NS, WITHOUT_GRID, feed

MakeFlight = Callable[..., Any]


def test_parts_overlap_by_half_and_cover_everything() -> None:
    for count in (1, 799, 800, 801, 1199, 1200, 1201, 20_000):
        spans = part_spans(count, 800)
        assert spans[0][0] == 0 and spans[-1][1] == count
        assert all(b[0] - a[0] == 400 and b[0] < a[1] for a, b in pairwise(spans))
        assert all(end - begin <= 800 for begin, end in spans)


@pytest.mark.parametrize("most", [0, 1])
def test_without_full_bundles_a_base_goes_on(make_flight: MakeFlight, most: int) -> None:
    config = BaseConfig()
    mapper = Mapper(replace(config, graph=replace(config.graph, max_full=most)), _no_words())
    feed(mapper, [make_flight(keyframes=6)])
    assert mapper.counts.bundles > 0


def test_a_map_too_large_for_one_bundle_is_bundled_in_parts(make_flight: MakeFlight, ring: Any) -> None:
    flight = make_flight(keyframes=40, turns=0.8, scene=ring, drift_m=0.01, seed=3)
    errors = {}
    for most in (0, 16):
        config = WITHOUT_GRID
        graph = replace(config.graph, max_full=most or 800, full_share=1.0)
        jobs: list[Job] = []

        def run(job: Job, jobs: list[Job] = jobs) -> JobDone:
            jobs.append(job)
            return run_job(job)

        mapper = Mapper(replace(config, graph=graph), _no_words())
        feed(mapper, [flight], run=run)
        full = [job for job in jobs if job.kind == "full"]
        if most:
            assert max(len(job.inputs.problem.T_c_m) for job in full) <= 16 + 16  # free, and held around them
            bundled = mapper.merger._corrections._schedule.bundled
            assert {part for _, part in bundled} >= set(range(len(part_spans(40, 16))))
        poses = [mapper.map.pose(k) for k in flight.keyframes]
        errors[most] = np.sqrt(np.mean([np.sum((p - t)[:3, 3] ** 2) for p, t in zip(poses, flight.true_T_m_k)]))
    assert errors[16] < 1.5 * errors[0] + 0.01


def test_what_follows_a_part_is_held_also_behind_culled_keyframes(make_flight: MakeFlight) -> None:
    flight, mapper, config = make_flight(keyframes=20), Mapper(), BaseConfig()
    feed(mapper, [flight])
    for k in (10, 11):
        mapper.map.cull_keyframe(flight.keyframes[k])
    alone = replace(config.bundle_window, max_fixed=0)
    free = flight.keyframes[2:10]
    window = bundle_window(mapper.map, free, alone, config.measurement, set(), with_children=True)
    held = mapper.map.keyframes.id[window.rows[~window.problem.free]].tolist()
    assert held == [flight.keyframes[1], flight.keyframes[12]]


def test_a_part_tells_all_that_it_moves_also_what_came_since_it_began(make_flight: MakeFlight) -> None:
    flight, config = make_flight(keyframes=30), BaseConfig()
    mapper = Mapper(replace(config, graph=replace(config.graph, max_full=16)), _no_words())
    camera = CameraIntrinsics(flight.agent, flight.camera)
    for n, records in enumerate(flight.records[:20]):
        mapper.step(MapperInput(((flight.agent, (camera, *records)),)), n * STEP_NS)
    submap = submap_of_keyframe(flight.keyframes[0])
    window = full_bundle_window(mapper.map, submap, (), mapper.config, (submap, 1))
    for n, records in enumerate(flight.records[20:], 20):
        mapper.step(MapperInput(((flight.agent, tuple(records)),)), n * STEP_NS)
    T_c_m = window.problem.T_c_m.copy()
    T_c_m[window.problem.free] = T_c_m[window.problem.free] @ se3.exp(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))
    points = window.problem.points
    result = BundleResult(T_c_m, points, np.ones(len(window.slots), np.bool_), 0.0, 0.0, 1, 0)
    before = mapper.map.keyframes.T_w_k.copy()
    changes = mapper.merger._apply_full_bundle(FullBundle(submap, window, (), part=(submap, 1)), result)
    moved = np.flatnonzero((before != mapper.map.keyframes.T_w_k).any(axis=(1, 2))).tolist()
    assert mapper.map.rows[flight.keyframes[-1]] in moved
    assert changes.bent == frozenset(moved)


def test_what_a_part_holds_stays_where_it_is(make_flight: MakeFlight) -> None:
    """Keyframes that follow a part hang on its last ones: they moved along, unlike the landmarks that held them."""
    flight, config = make_flight(keyframes=30), BaseConfig()
    mapper = Mapper(replace(config, graph=replace(config.graph, max_full=16)), _no_words())
    feed(mapper, [flight])
    submap = submap_of_keyframe(flight.keyframes[0])
    window = full_bundle_window(mapper.map, submap, (), mapper.config, (submap, 0))
    held = window.rows[~window.problem.free]
    assert mapper.map.rows[flight.keyframes[16]] in held
    T_c_m = window.problem.T_c_m.copy()
    T_c_m[window.problem.free] = T_c_m[window.problem.free] @ se3.exp(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))
    kept = np.ones(len(window.slots), np.bool_)
    result = BundleResult(T_c_m, window.problem.points, kept, 0.0, 0.0, 1, 0)
    before = mapper.map.keyframes.T_w_k.copy()
    mapper.merger._apply_full_bundle(FullBundle(submap, window, (), part=(submap, 0)), result)
    assert np.array_equal(mapper.map.keyframes.T_w_k[held], before[held])
    assert not np.array_equal(mapper.map.keyframes.T_w_k, before)


def _no_words() -> Any:
    from kiteline_core.places.place_index import Vocabulary, nodes

    centres = np.random.default_rng(5).integers(0, 2**64, (nodes(20, 2), 4), dtype=np.uint64)
    return Vocabulary(20, 2, centres, np.ones(400, np.float32))
