"""Every frame in its refined place."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from kiteline_basestation.trajectory import FrameRows, compose
from kiteline_core import se3
from kiteline_core.ids import submap_of_keyframe
from kiteline_core.sparse_map import SparseMap


def map_of(flight: Any) -> SparseMap:
    sparse_map = SparseMap()
    sparse_map.set_camera(flight.agent, flight.camera)
    for part in flight.records:
        head = part[0]
        sparse_map.add_keyframe(head.keyframe, head.t_ns, head.parent, head.T_p_k, head.keypoints)
    return sparse_map


def test_frames_follow_their_keyframes_and_bend_towards_the_next(make_flight: Callable[..., Any]) -> None:
    flight = make_flight(keyframes=3, drift_m=0.05)
    sparse_map = map_of(flight)
    head = flight.records[1][0]
    # Frames from the first keyframe to the second, evenly along the step that the agent believed in.
    t_ns = np.linspace(flight.records[0][0].t_ns, head.t_ns, 11).astype(np.int64)
    step = se3.log(head.T_p_k)
    rows = FrameRows(t_ns, np.full(11, flight.keyframes[0]), np.stack([se3.exp(step * i / 10) for i in range(11)]))
    times, before = compose(sparse_map, rows)
    assert np.array_equal(times, t_ns)
    assert np.allclose(before[10], flight.agent_T_m_k[1], atol=1e-9)
    for keyframe, T_m_k in zip(flight.keyframes, flight.true_T_m_k):
        sparse_map.set_pose(keyframe, T_m_k)
    _, after = compose(sparse_map, rows)
    assert np.allclose(after[0], flight.true_T_m_k[0], atol=1e-9)
    assert np.allclose(after[10], flight.true_T_m_k[1], atol=1e-9)  # no step where the reference changes
    moved = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1)
    assert (np.diff(moved) > -1e-9).all()


def test_unplaced_submaps_are_left_out_and_bodies_are_not_cameras(make_flight: Callable[..., Any]) -> None:
    flight = make_flight(keyframes=3)
    sparse_map = map_of(flight)
    rows = FrameRows(
        np.arange(3, dtype=np.int64), np.array(flight.keyframes, np.int64), np.stack([np.eye(4)] * 3)
    )  # fmt: skip
    submap = submap_of_keyframe(flight.keyframes[0])
    assert len(compose(sparse_map, rows, {})[0]) == 0
    T_w_m = se3.exp(np.array([1.0, 2.0, 3.0, 0.0, 0.0, 1.0]))
    T_b_c = se3.exp(np.array([0.1, 0.0, 0.0, 0.5, 0.0, 0.0]))
    _, poses = compose(sparse_map, rows, {submap: T_w_m}, T_b_c)
    assert np.allclose(poses[1], T_w_m @ flight.agent_T_m_k[1] @ se3.inverse(T_b_c))
    unknown = FrameRows(rows.t_ns, rows.keyframe + 50, rows.T_k_c)
    assert compose(sparse_map, unknown)[1].shape == (0, 4, 4)
