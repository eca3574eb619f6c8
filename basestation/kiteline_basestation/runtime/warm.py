"""Compile all kernels of the base before the first packet, by mapping a small made-up flight."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kiteline_basestation.config import BaseConfig, GraphConfig
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import JobDone
from kiteline_basestation.merging.essential_graph import GraphInputs, optimise
from kiteline_basestation.merging.loop_verification import verify_loop
from kiteline_basestation.station import Station
from kiteline_codec.channel import plain_pair
from kiteline_codec.schema import CameraIntrinsics, KeyframeHeader, NewLandmarks, Observations, Record
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import NO_KEYFRAME, AgentId, KeyframeId, keyframe_id, point_id, submap_id
from kiteline_core.places.place_index import Vocabulary

_KEYFRAMES = 8  # enough for a bundle, a grid, and points old enough to be judged
_POINTS = 120
_FAR = 20  # points without stereo depth
_STEP_M = 0.05  # m sideways between two keyframes


def warm(config: BaseConfig | None = None, words: Vocabulary | None = None) -> None:
    """Run every kernel once, on the types that flights use. A filled cache makes this take a fraction of a second."""
    agent, base = plain_pair()
    station = Station(config or BaseConfig(), lambda _: base, words)
    station.join(AgentId(0))
    done: tuple[JobDone, ...] = ()
    agent.put(CameraIntrinsics(AgentId(0), RectifiedCamera(640, 480, 400.0, 400.0, 319.5, 239.5, 0.1, True, np.eye(4))))
    for k in range(_KEYFRAMES):
        for record in _keyframe(k):
            agent.put(record)
        output = station.step({}, done, k * 1_000_000_000)
        done = tuple(run_job(job) for job in output.jobs)
    station.step({}, done, _KEYFRAMES * 1_000_000_000)
    if words is not None:
        submap = submap_id(0, 0, 0)
        easy = replace(station.mapper.config.loops, min_inliers=4, min_inliers_all=4, min_matched_share=0.0)
        sparse_map, last, first = station.mapper.map, keyframe_id(submap, _KEYFRAMES - 1), keyframe_id(submap, 0)
        verify_loop(sparse_map, last, first, easy)
        sparse_map.set_camera(AgentId(0), replace(sparse_map.cameras[AgentId(0)], stereo=False))
        sparse_map.measures_depth.clear()
        verify_loop(sparse_map, last, first, easy)  # as one eye's, with a scale


def warm_graphs() -> None:
    """Load what pose graphs are solved with, 40 MiB of libraries that the first loop would wait for. Needs gtsam."""
    held, edges = np.arange(3) == 0, np.array([[0, 1], [1, 2], [0, 2]])
    poses = np.tile(np.eye(4), (3, 1, 1))
    sigma = np.tile([0.01, 0.003], (3, 1))
    optimise(GraphInputs(np.arange(3), poses, held, edges, poses, sigma, np.arange(3) == 2, GraphConfig()))


def _keyframe(k: int) -> list[Record]:
    """Keyframe k of a level flight sideways past a wall: it sees the even points again and bears the odd ones anew."""
    submap = submap_id(0, 0, 0)
    random = np.random.default_rng(0)  # one wall for all keyframes
    points = np.column_stack(
        [random.uniform(-1.5, 1.5, _POINTS), random.uniform(-1.0, 1.0, _POINTS), random.uniform(2.0, 4.0, _POINTS)]
    )
    descriptors = random.integers(0, 256, (_POINTS, 32)).astype(np.uint8)
    T_p_k = np.eye(4)
    if k == 0:  # z of m points up
        T_p_k[:3, :3] = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
    else:
        T_p_k[0, 3] = _STEP_M
    local = points - [k * _STEP_M, 0.0, 0.0]
    uv = (400.0 * local[:, :2] / local[:, 2:] + [319.5, 239.5]).astype(np.float32)
    inv_depth = (1.0 / local[:, 2]).astype(np.float32)
    inv_depth[:_FAR] = 0.0  # no depth: to be triangulated
    keyframe, first = keyframe_id(submap, k), keyframe_id(submap, 0)
    parent = NO_KEYFRAME if k == 0 else keyframe_id(submap, k - 1)
    born = np.arange(_POINTS) if k == 0 else np.arange(1, _POINTS, 2)
    seen = np.zeros(0, np.int64) if k == 0 else np.arange(0, _POINTS, 2)
    zeros = np.zeros(_POINTS, np.uint8)
    records: list[Record] = [
        KeyframeHeader(KeyframeId(keyframe), k * 1_000_000_000, parent, T_p_k, len(born) + len(seen)),
        NewLandmarks(
            keyframe, 0, born.astype(np.uint16), uv[born], inv_depth[born], zeros[born], zeros[born], descriptors[born]
        ),
    ]
    if len(seen):
        names = np.array([point_id(first, int(i)) for i in seen], np.int64)
        records.append(Observations(keyframe, 0, seen.astype(np.uint16), uv[seen], inv_depth[seen], zeros[seen], names))
    return records
