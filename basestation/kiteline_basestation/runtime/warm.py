"""Compiles all kernels of the base before the first packet, by mapping a small synthetic flight."""

from dataclasses import replace
from functools import cache

import numpy as np

from kiteline_basestation.config import BaseConfig, GraphConfig, GridConfig
from kiteline_basestation.grid.sparse_scan import LandmarksAround, sparse_scan
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import JobDone
from kiteline_basestation.merging.essential_graph import GraphInputs, optimise
from kiteline_basestation.merging.loop_verification import verify_loop
from kiteline_basestation.station import Station
from kiteline_codec.channel import plain_pair
from kiteline_codec.schema import CameraIntrinsics, KeyframeHeader, KeyframeScan, NewLandmarks, Observations, Record
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ground.column_scan import ColumnScan
from kiteline_core.ground.ground_warm import warm_ground
from kiteline_core.ids import NO_KEYFRAME, AgentId, KeyframeId, keyframe_id, point_id, submap_id
from kiteline_core.places.place_index import Vocabulary, nodes

WARMING = ("kiteline_codec.warm", "kiteline_basestation.runtime.warm")  # modules whose `warm` runs all its kernels
_KEYFRAMES = 8  # enough for a bundle, a grid, and landmarks old enough to be culled
_POINTS = 120
_FAR = 20  # points without stereo depth
_STEP_M = 0.05  # m sideways between two keyframes


@cache
def warm(config: BaseConfig | None = None) -> None:
    """Run every kernel once, with the types of flights; once in a process for each configuration.

    Takes a fraction of a second if the kernel cache is filled.
    """
    centres = np.random.default_rng(0).integers(0, 1 << 63, (nodes(4, 2), 4)).astype(np.uint64)
    vocabulary = Vocabulary(4, 2, centres, np.ones(16, np.float32))
    agent, base = plain_pair()
    station = Station(config or BaseConfig(), lambda _: base, vocabulary)
    station.join(AgentId(0))
    done: tuple[JobDone, ...] = ()
    agent.put(CameraIntrinsics(AgentId(0), RectifiedCamera(640, 480, 400.0, 400.0, 319.5, 239.5, 0.1, True, np.eye(4))))
    for k in range(_KEYFRAMES):
        for record in _keyframe(k):
            agent.put(record)
        output = station.step({}, done, k * 1_000_000_000)
        done = tuple(run_job(job) for job in output.jobs)
    sparse_map = station.mapper.map
    stereo = sparse_map.cameras[AgentId(0)]
    sparse_map.set_camera(AgentId(0), replace(stereo, stereo=False))
    station.mapper.grid_updates.update()  # of a camera that sends no scans, landmarks are drawn ...
    _scan_landmarks(stereo)  # ... where they show the ground
    sparse_map.set_camera(AgentId(0), stereo)
    for before, far_m in ((2, 8.0), (1, 2.0)):  # the second one takes a part of the cells of the first
        agent.put(_scan(_KEYFRAMES - before, far_m))
    station.step({}, done, _KEYFRAMES * 1_000_000_000)
    station.mapper.grid_updates.update()
    station.mapper.views.take()
    warm_ground(stereo)  # scans of images that agents send
    submap = submap_id(0, 0, 0)
    easy = replace(station.mapper.config.loops, min_inliers=4, min_inliers_all=4, min_matched_share=0.0)
    last, first = keyframe_id(submap, _KEYFRAMES - 1), keyframe_id(submap, 0)
    verify_loop(sparse_map, last, first, easy)
    sparse_map.covisible_pairs(sparse_map.rows_of(submap), 1)
    sparse_map.set_camera(AgentId(0), replace(stereo, stereo=False))
    sparse_map.measures_depth.clear()
    verify_loop(sparse_map, last, first, easy)  # monocular, with a scale


def warm_graphs() -> None:
    """Load gtsam (40 MiB), which the first loop closure would wait for. Raises ImportError without it."""
    held, edges = np.arange(3) == 0, np.array([[0, 1], [1, 2], [0, 2]])
    poses = np.tile(np.eye(4), (3, 1, 1))
    sigma = np.tile([0.01, 0.003], (3, 1))
    optimise(GraphInputs(np.arange(3), poses, held, edges, poses, sigma, np.arange(3) == 2, GraphConfig()))


def _scan(k: int, far_m: float) -> KeyframeScan:
    """A floor and a wall behind it."""
    near, far = np.full(8, 0.5), np.full(8, far_m)
    up = np.array([0.0, -1.0, 0.0])
    scan = ColumnScan(up, -0.4, 0.1, near, far, far, np.full(8, 7, np.uint8), far, 1.0)
    return KeyframeScan(keyframe_id(submap_id(0, 0, 0), k), scan, np.zeros(0, np.uint8))


def _scan_landmarks(camera: RectifiedCamera) -> None:
    """A scan of landmarks on a floor 1 m below the camera."""
    ahead = np.linspace(1.0, 4.0, 8)
    floor, level = np.column_stack([np.zeros(8), np.ones(8), ahead]), np.array([-1.0, 0.0, 0.0])
    S_w_k = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    every = np.ones(8, np.bool_)
    sparse_scan(GridConfig(), camera, S_w_k, LandmarksAround(floor, every, every, np.full(8, 2)), level)


def _keyframe(k: int) -> list[Record]:
    """Keyframe k of a sideways flight past a wall: observations of the even points, new landmarks of the odd ones."""
    submap = submap_id(0, 0, 0)
    random = np.random.default_rng(0)  # one wall for all keyframes
    points = np.column_stack(
        [random.uniform(-1.5, 1.5, _POINTS), random.uniform(-1.0, 1.0, _POINTS), random.uniform(2.0, 4.0, _POINTS)]
    )
    descriptors = random.integers(0, 256, (_POINTS, 32)).astype(np.uint8)
    T_p_k = np.eye(4)
    if k == 0:  # z of m is up
        T_p_k[:3, :3] = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
    else:
        T_p_k[0, 3] = _STEP_M
    local = points - [k * _STEP_M, 0.0, 0.0]
    uv = (400.0 * local[:, :2] / local[:, 2:] + [319.5, 239.5]).astype(np.float32)
    inv_depth = (1.0 / local[:, 2]).astype(np.float32)
    inv_depth[:_FAR] = 0.0  # no depth: to be triangulated
    keyframe, first = keyframe_id(submap, k), keyframe_id(submap, 0)
    parent = NO_KEYFRAME if k == 0 else keyframe_id(submap, k - 1)
    new = np.arange(_POINTS) if k == 0 else np.arange(1, _POINTS, 2)
    observed = np.zeros(0, np.int64) if k == 0 else np.arange(0, _POINTS, 2)
    zeros = np.zeros(_POINTS, np.uint8)
    records: list[Record] = [
        KeyframeHeader(KeyframeId(keyframe), k * 1_000_000_000, parent, T_p_k, len(new) + len(observed)),
        NewLandmarks(
            keyframe, 0, new.astype(np.uint16), uv[new], inv_depth[new], zeros[new], zeros[new], descriptors[new]
        ),
    ]
    if len(observed):
        names = np.array([point_id(first, int(i)) for i in observed], np.int64)
        records.append(
            Observations(
                keyframe, 0, observed.astype(np.uint16), uv[observed], inv_depth[observed], zeros[observed], names
            )
        )
    return records
