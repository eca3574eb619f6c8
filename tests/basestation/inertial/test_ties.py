"""Submaps that an agent flew without a break are tied, with the metre that it corrected."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.inertial.ties import InertialTie, InertialTies, moved
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import JobDone
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.mapper import Mapper, MapperInput
from kiteline_basestation.merging.correction import scale_map
from kiteline_basestation.merging.similarity import align_points
from kiteline_basestation.store.integrity import contradictions
from kiteline_codec.schema import CameraIntrinsics, InertialSteps, SubmapScale
from kiteline_core.geometry import se3, sim3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import NO_KEYFRAME, AgentId, KeyframeId, keyframe_id, submap_id, submap_of_keyframe

T_B_C = se3.from_rt(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.1, 0.02, -0.05]))
AGENT = AgentId(0)
OLD, NEW = submap_id(AGENT, 0, 0), submap_id(AGENT, 0, 1)
LAST, FIRST = keyframe_id(OLD, 1), keyframe_id(NEW, 2)
UNIT = 0.97  # metres that the agent found the old submap's unit to have
T_W_LAST = se3.exp(np.array([1.0, 0.5, 0.2, 0.1, -0.2, 0.3]))
T_M_FIRST = se3.exp(np.array([-0.3, 0.2, 1.0, 0.3, 0.1, -0.5]))


def a_record() -> InertialSteps:
    rng = np.random.default_rng(2)
    dt, five = np.full(3, 0.15), rng.normal(0.0, 0.05, (4, 3, 3))
    return InertialSteps(FIRST, LAST, 2e-3, dt, *five)


def a_map(told: float = UNIT) -> SparseMap:
    """Two submaps of a monocular agent, in metres."""
    sparse_map = SparseMap()
    sparse_map.set_camera(AGENT, RectifiedCamera(640, 480, 400.0, 400.0, 320.0, 240.0, 0.1, False, T_B_C))
    sparse_map.metric_submaps.update((OLD, NEW))
    sparse_map.add_keyframe(keyframe_id(OLD, 0), 0, NO_KEYFRAME, np.eye(4), 0)
    sparse_map.add_keyframe(LAST, 1, keyframe_id(OLD, 0), T_W_LAST, 0)
    sparse_map.add_keyframe(FIRST, 2, NO_KEYFRAME, T_M_FIRST, 0)
    sparse_map.metres_per_unit = {OLD: told, NEW: 1.0}
    return sparse_map


def the_tie(sparse_map: SparseMap) -> InertialTie:
    ties = InertialTies(sparse_map)
    ties.add(a_record())
    tie = ties.take()
    assert tie is not None
    assert ties.take() is None
    return tie


@pytest.mark.parametrize("told", [1.0, UNIT])
def test_the_new_submap_begins_where_the_steps_end_in_the_agents_new_metre(told: float) -> None:
    sparse_map = a_map(told)
    tie = the_tie(sparse_map)
    assert (tie.older, tie.newer, tie.metre) == (OLD, NEW, told)
    S_new_old, units = scale_map(sparse_map, tie.older, tie.metre)
    assert units == {OLD: told}
    S = sim3.normalise(S_new_old @ tie.S_older_newer)
    assert sim3.scale_of(S) == pytest.approx(1.0)  # a metre of the new submap is one of w
    T_w_a = sparse_map.world_pose(LAST)
    relative = se3.inverse(T_B_C) @ moved(a_record()) @ T_B_C
    expected = T_w_a @ sim3.with_scaled_translation(relative, told)
    assert np.allclose(sim3.place(S, T_M_FIRST), expected, atol=1e-9)
    assert np.allclose(T_w_a[:3, 3], told * T_W_LAST[:3, 3], atol=1e-9)


def test_a_map_that_the_base_has_scaled_keeps_its_metre() -> None:
    sparse_map = a_map()
    sparse_map.scale_submap(OLD, 0.98)
    tie = the_tie(sparse_map)
    assert tie.metre == 1.0
    assert sim3.scale_of(tie.S_older_newer) == pytest.approx(0.98 / UNIT)


def test_a_map_in_the_base_s_metres_tells_how_long_the_agents_unit_was_there() -> None:
    """The base corrected the old submap to 0.98 of what the agent measured, in keyframes, not in the placement."""
    sparse_map, n = a_map(), 12
    step = se3.from_rt(np.eye(3), np.array([0.3, 0.0, 0.0]))
    for k in range(2, n):
        sparse_map.add_keyframe(keyframe_id(OLD, k), k, keyframe_id(OLD, k - 1), step, 0)
    for k in range(n):
        keyframe = keyframe_id(OLD, k)
        T = sparse_map.pose(keyframe)
        sparse_map.set_pose(keyframe, sim3.with_scaled_translation(T, 0.98), carry=False)
    sparse_map.scaled_submaps.add(OLD)
    ties = InertialTies(sparse_map)
    ties.add(replace(a_record(), since=keyframe_id(OLD, n - 1)))
    tie = ties.take()
    assert tie.metre == 1.0
    assert sim3.scale_of(tie.S_older_newer) == pytest.approx(0.98 / UNIT)


def test_nothing_is_tied_that_is_one_map_already_or_has_no_metre() -> None:
    for change in ("merged", "unknown", "alone"):
        sparse_map, record = a_map(), a_record()
        if change == "merged":
            sparse_map.root_submaps[NEW] = OLD
        elif change == "unknown":
            sparse_map.metric_submaps.remove(NEW)
        else:
            fields = (record.dt_s, record.turn, record.moved, record.velocity, record.position)
            record = InertialSteps(LAST, keyframe_id(OLD, 0), 2e-3, *fields)
        ties = InertialTies(sparse_map)
        ties.add(record)
        assert ties.take() is None, change


def test_a_record_waits_for_its_keyframes() -> None:
    late = a_map()
    sparse_map = SparseMap()
    sparse_map.cameras, sparse_map.metric_submaps = late.cameras, late.metric_submaps
    ties = InertialTies(sparse_map)
    ties.add(a_record())
    assert ties.take() is None
    sparse_map.add_keyframe(LAST, 1, NO_KEYFRAME, T_W_LAST, 0)
    assert ties.take() is None
    sparse_map.add_keyframe(KeyframeId(FIRST), 2, NO_KEYFRAME, T_M_FIRST, 0)
    assert ties.take() is not None


def test_a_mapper_joins_what_was_flown_without_a_break(make_flight: Callable[..., Any], words: Any) -> None:
    """The agent flew 8 keyframes in metres that were 3 % short, noticed it, and flew on in a new submap."""
    before = make_flight(keyframes=8, turns=0.15, stereo=False, drift_m=0.001)
    after = make_flight(keyframes=8, turns=0.15, start=0.15, submap=1, stereo=False, drift_m=0.001)
    old, new = (submap_of_keyframe(f.keyframes[0]) for f in (before, after))
    for records in before.records:
        records[0] = replace(records[0], T_p_k=sim3.with_scaled_translation(records[0].T_p_k, 1.0 / UNIT))
    step = se3.inverse(before.true_T_w_k[-1]) @ after.true_T_w_k[0]
    turn, there = se3.so3_log(step[:3, :3])[None], step[None, :3, 3] / UNIT
    none = np.zeros((1, 3))
    before.records[0].append(SubmapScale(old, 1.0))
    after.records[0] += [
        SubmapScale(old, UNIT),
        SubmapScale(new, 1.0),
        InertialSteps(after.keyframes[0], before.keyframes[-1], 2e-3, np.array([0.25]), turn, there, none, none),
    ]
    mapper, done = Mapper(BaseConfig(), words), tuple[JobDone, ...]()
    flown = [[CameraIntrinsics(before.agent, before.camera)], *before.records, *after.records, *([[]] * 20)]
    for n, records in enumerate(flown):
        output = mapper.step(MapperInput(((before.agent, tuple(records)),), done), n * 250_000_000)
        done = tuple(run_job(job) for job in output.jobs)
    assert mapper.map.map_id(new) == old
    assert contradictions(mapper) == []
    assert sim3.scale_of(mapper.placements[new]) == pytest.approx(1.0, abs=0.01)
    assert sim3.scale_of(mapper.placements[old]) == pytest.approx(UNIT, abs=0.01)
    keyframes = [*before.keyframes, *after.keyframes]
    found = np.array(
        [sim3.place(mapper.placements[submap_of_keyframe(k)], mapper.map.pose(k))[:3, 3] for k in keyframes]
    )
    true = np.array([T[:3, 3] for T in (*before.true_T_w_k, *after.true_T_w_k)])
    S = align_points(true, found, with_scale=False)
    assert np.linalg.norm(se3.transform(S, found) - true, axis=1).max() < 0.02
