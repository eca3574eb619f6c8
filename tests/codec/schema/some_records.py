"""Examples of all records."""

from dataclasses import fields
from typing import Any

import numpy as np

from kiteline_codec.schema import (
    CachedKeyframe,
    CachedLandmarks,
    CameraIntrinsics,
    CorrectionBatch,
    CulledLandmarks,
    DisparityCalibration,
    FusedLandmarks,
    GravityAlignment,
    GridTile,
    InertialSteps,
    Key,
    KeyframeHeader,
    KeyframePose,
    KeyframeScan,
    LivePose,
    NewLandmarks,
    Observations,
    Record,
    RefinedLandmarks,
    RemovedObservations,
    ScanImages,
    StereoAlignment,
    SubmapPlacement,
    SubmapScale,
    SubmapTie,
)
from kiteline_core.arrays import I8
from kiteline_core.geometry import se3, sim3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ground.column_scan import ColumnScan
from kiteline_core.ids import (
    MAX_BOOTS,
    MAX_KEYFRAMES,
    MAX_SUBMAPS,
    NO_KEYFRAME,
    SEQUENCE_BITS,
    SUBMAP_BITS,
    AgentId,
    KeyframeId,
    SubmapId,
    keyframe_id,
    submap_id,
)


def a_scan(seed: int, n: int) -> ColumnScan:
    """n columns of which some saw nothing."""
    rng = np.random.default_rng(seed + 2)
    seen = rng.integers(0, 2, (3, n))
    free, bands = rng.uniform(2.0, 9.0, n) * seen[0], rng.integers(1, 256, n) * seen[1]
    return ColumnScan(
        se3.exp(rng.normal(0.0, 1.0, 6))[0, :3],
        -0.7,
        0.02,
        0.6 * free,
        free,
        np.where(bands > 0, rng.uniform(0.1, 60.0, n), np.inf),
        bands.astype(np.uint8),
        rng.uniform(0.1, 300.0, n) * seen[2],
        float("nan") if n % 2 else float(rng.uniform(-1.0, 90.0)),
    )


def some_records(seed: int, n: int) -> list[Record]:
    """One record of each kind, two scans, with n rows."""
    rng, steps = np.random.default_rng(seed), np.random.default_rng(seed + 1)
    agent, high, middle, low = (int(rng.integers(*r)) for r in ((256,), (1 << 14,), (1 << 12,), (50, 1 << 20)))
    number = high << 32 | middle << 20 | low  # of boot, submap and sequence
    submap = submap_id(
        agent, number >> SUBMAP_BITS + SEQUENCE_BITS & MAX_BOOTS - 1, number >> SEQUENCE_BITS & MAX_SUBMAPS - 1
    )
    keyframe = keyframe_id(submap, max(50, number & MAX_KEYFRAMES - 1))
    pose = se3.exp(np.concatenate([rng.normal(0, 3, 3), rng.normal(0, 0.5, 3)]))
    index = np.sort(rng.permutation(2048)[:n]).astype(np.uint16)
    uv = rng.uniform(-10, 1300, (n, 2)).astype(np.float32)
    inv_depth = rng.uniform(-0.1, 2.0, n).astype(np.float32)
    octave = rng.integers(0, 4, n).astype(np.uint8)
    point = (keyframe - rng.integers(0, 50, n)) << 11 | rng.integers(0, 2048, n)
    T_b_c = se3.from_rt(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.1, -0.05, 0.025]))
    camera = RectifiedCamera(752, 480, 458.5, 457.25, 367.0, 248.5, 0.11, bool(rng.integers(2)), T_b_c)
    return [
        CameraIntrinsics(AgentId(3), camera),
        LivePose(AgentId(255), int(rng.integers(1 << 62)), keyframe, pose, int(rng.integers(-1, 101))),
        LivePose(AgentId(0), 0, NO_KEYFRAME, np.eye(4), -1),
        KeyframeHeader(keyframe, int(rng.integers(1 << 62)), KeyframeId(keyframe - 3), pose, n),
        KeyframeHeader(keyframe, 5, NO_KEYFRAME, pose, 0),
        NewLandmarks(
            keyframe, 4, index, uv, inv_depth, octave, rng.integers(0, 256, n).astype(np.uint8),
            rng.integers(0, 256, (n, 32)).astype(np.uint8),
        ),
        Observations(keyframe, 2, rng.permutation(index), uv, inv_depth, octave, point),
        GravityAlignment(submap, pose),
        SubmapScale(submap, 0.73),
        InertialSteps(
            keyframe, KeyframeId(keyframe - 2), 2e-3, steps.uniform(0.02, 0.3, n + 1),
            *steps.normal(0.0, 0.5, (4, n + 1, 3)),
        ),
        StereoAlignment(
            AgentId(5), np.array([700.0, -88.0, 0.0, 1100.0, -420.0]) / 1024.0, True,
            np.array([0.0, 1.0, -9.0, 64.0, 2.0]) / 1024.0,
        ),
        StereoAlignment(AgentId(6), np.zeros(5), False, np.array([0.0, 1.0, -9.0, 64.0, 2.0]) / 1024.0, 0.25),
        StereoAlignment(AgentId(7), np.zeros(5), True, np.array([0.0, 1.0, -9.0, 64.0, 2.0]) / 1024.0, None, True),
        KeyframePose(keyframe, pose),
        RefinedLandmarks(keyframe, index, inv_depth, rng.normal(0, 1, (n, 2)).astype(np.float32)),
        FusedLandmarks(keyframe, index, point),
        RemovedObservations(keyframe, index),
        CulledLandmarks(keyframe, index, int(rng.integers(2))),
        SubmapPlacement(submap, sim3.of(1.0 + 0.37 * n, pose)),
        DisparityCalibration(AgentId(3), np.array([-72.0, 3.0, 0.0, -450.0, 1.0]) / 1024.0),
        GridTile(-7, 12, -2, 0.05, some_cells(rng, 8 + n)),
        CachedKeyframe(keyframe, submap_id(2, 1, 7), pose),
        CachedLandmarks(
            keyframe, 3, index, uv, inv_depth, octave, rng.integers(0, 256, n).astype(np.uint8),
            rng.integers(0, 256, (n, 32)).astype(np.uint8),
        ),
        CorrectionBatch.of(
            AgentId(3), int(rng.integers(1, 1 << 32)), [Key(16, keyframe), Key(17, keyframe)][: n % 3]
        ),
        KeyframePose(KeyframeId(keyframe - 1), pose, 5),
        RefinedLandmarks(
            KeyframeId(keyframe - 1), index, inv_depth, rng.normal(0, 1, (n, 2)).astype(np.float32), 200
        ),
        SubmapPlacement(SubmapId(submap ^ 1), sim3.of(1.0 + 0.37 * n, pose), False, 5),
        SubmapPlacement(SubmapId(submap ^ 2), sim3.of(1.0, pose), True, 5),
        DisparityCalibration(AgentId(4), np.array([-72.0, 3.0, 0.0, -450.0, 1.0]) / 1024.0, 0.5, 5),
        SubmapPlacement(SubmapId(submap ^ 3), sim3.of(1.0 + 0.37 * n, pose), False, 0, 0.5**7),
        SubmapPlacement(SubmapId(submap ^ 4), sim3.of(1.0, pose), True, 5, 13.0 / 1024.0),
        KeyframeHeader(
            KeyframeId(keyframe - 1), 7 * n, KeyframeId(keyframe - 2), pose, n, pose[1, :3].copy(), 0.0015 + 0.0007 * n
        ),
        SubmapTie(submap, KeyframeId(keyframe - 9), pose, 0.0123 * (n + 1), 0.0021),
        KeyframeScan(keyframe, a_scan(seed, n + 1), steps.integers(0, 3, n).astype(np.uint8)),
        KeyframeScan(keyframe, a_scan(seed + 1, n + 1), np.zeros(0, np.uint8), 1 + n % 15, pose),
        ScanImages(keyframe, pose, 3 * n, pose[2, :3].copy(), bytes(range(1, n + 2))),
        ScanImages(keyframe, pose, 0, pose[1, :3].copy(), b"\xff\xd8" + bytes(n), 1 + n % 15, se3.inverse(pose)),
    ]  # fmt: skip


def some_cells(rng: np.random.Generator, patch: int) -> I8:
    """Cells (64,64) of a tile in patches of equal ones."""
    small = rng.integers(-1, 8, (64 // patch + 1, 64 // patch + 1))
    return np.repeat(np.repeat(small, patch, 0), patch, 1)[:64, :64].astype(np.int8)


def assert_same(a: Any, b: Any) -> None:
    assert type(a) is type(b)
    for f in fields(a):
        x, y = getattr(a, f.name), getattr(b, f.name)
        if isinstance(x, np.ndarray):
            assert x.dtype == y.dtype
            assert np.array_equal(x, y), f.name
        elif isinstance(x, RectifiedCamera | ColumnScan):
            assert_same(x, y)
        else:
            assert x == y or x != x, f.name
            assert (x != x) == (y != y), f.name
