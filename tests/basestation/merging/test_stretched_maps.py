"""Lengths of monocular maps: what a pose graph that changes them takes along, and that wrong ones merge nothing."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kiteline_basestation.jobs import JobDone
from kiteline_basestation.mapper import Mapper
from kiteline_basestation.merging.correction import keyframes_of
from kiteline_basestation.merging.essential_graph import GraphResult
from kiteline_basestation.merging.graph_job import POSE_GRAPH
from kiteline_basestation.merging.loop_edges import LoopEdge, LoopMatch, graph_edge_of
from kiteline_codec.schema import SubmapScale
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3, sim3
from kiteline_core.ids import KeyframeId, submap_of_keyframe
from tests.basestation.feeding import WITHOUT_GRID, feed

ELSEWHERE = se3.exp(np.array([3.0, -1.0, 0.2, 0.02, -0.03, 1.1]))


def distances(mapper: Mapper, keyframe: KeyframeId) -> F64:
    """From a keyframe to the landmarks that hang on it, in w."""
    sparse_map = mapper.map
    slots = sparse_map.slots_of(keyframe)
    xyz, known = sparse_map.positions(slots[sparse_map.is_live(slots)])
    return np.asarray(np.linalg.norm(xyz[known] - sparse_map.world_pose(keyframe)[:3, 3], axis=1))  # type: ignore[index]


def test_edges_pending_matches_and_depths_are_stretched_with_the_map(
    make_flight: Callable[..., Any], words: Any
) -> None:
    flight = make_flight(keyframes=12, turns=0.3, stereo=False)
    mapper = Mapper(WITHOUT_GRID, words)
    feed(mapper, [flight])
    merger, sparse_map = mapper.merger, mapper.map
    assert merger is not None
    submap = submap_of_keyframe(flight.keyframes[0])
    keyframes = keyframes_of(sparse_map, submap)
    old, new = keyframes[0], keyframes[-2]
    edge = LoopEdge(new, old, se3.exp(np.array([0.3, 0.1, -0.2, 0.1, 0.2, 0.0])), 50, 2.0, 1.05)
    merger._edges = [edge]
    merger.detector._matches = {(submap, submap): [LoopMatch(*(getattr(edge, n) for n in LoopEdge.__slots__))]}
    merger._corrections._graphs[99] = submap
    T, ratio = graph_edge_of(sparse_map, edge)
    unit, far = sparse_map.scale(submap), {k: distances(mapper, k) for k in (old, keyframes[-1])}
    growth = np.linspace(1.3, 1.1, len(keyframes))
    poses = sparse_map.keyframes.T_w_k[[sparse_map.rows[k] for k in keyframes]].copy()
    result = GraphResult(np.array(keyframes), poses, growth, np.empty(0), 0)
    changes = merger.finish_graph(JobDone(99, POSE_GRAPH.name, result, 0), 10**12)

    assert changes.rescaled == {submap: growth[-1]}
    assert np.isclose(sparse_map.scale(submap), unit * growth[-1])  # nothing changes for the agent where it flies
    assert np.allclose(distances(mapper, old), growth[0] * far[old], rtol=1e-5)
    assert np.allclose(distances(mapper, keyframes[-1]), growth[-1] * far[keyframes[-1]], rtol=1e-5)
    (pending,) = merger.detector.state().matches[submap, submap]
    for stretched in (merger.edges[0], pending):
        T_after, ratio_after = graph_edge_of(sparse_map, stretched)
        assert np.allclose(T_after[:3, 3], growth[0] * T[:3, 3])
        assert np.isclose(ratio_after, ratio * growth[0] / growth[-2])


@pytest.mark.parametrize(("metres", "merges"), [(1.0, 1), (1.4, 0)])
def test_a_map_with_a_wrong_metre_is_not_merged(
    make_flight: Callable[..., Any], words: Any, metres: float, merges: int
) -> None:
    pair = make_flight(keyframes=14, turns=0.4)
    eye = make_flight(keyframes=14, turns=0.4, start=0.1, variant=1, agent=1, T_w_m=ELSEWHERE, stereo=False)
    for records in eye.records:
        records[0] = replace(records[0], T_p_k=sim3.with_scaled_translation(records[0].T_p_k, metres))
    eye.records[0].append(SubmapScale(submap_of_keyframe(eye.keyframes[0]), 1.0))
    mapper = Mapper(WITHOUT_GRID, words)
    feed(mapper, [pair, eye])
    assert mapper.summary()["merges"] == merges
