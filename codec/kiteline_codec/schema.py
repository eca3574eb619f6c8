"""The values that the two sides share: one writer each. Arrays are structure-of-arrays, one row a keypoint.

A keyframe's keypoints share one index space [0, n). Each keypoint is either a *birth* (it has a descriptor, and names a
new point by its own index) or a *sighting* of a point born elsewhere. Pixels are those of the rectified left camera.
Depth is inverse depth along the optical axis of the keyframe (z), in 1/m; 0 means unknown.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kiteline_core.errors import KitelineError
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import AgentId, KeyframeId, SubmapId

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]
I64 = NDArray[np.int64]


class WireError(KitelineError):
    """Bytes that are no valid packet or code. The only exception that a decoder raises, on any bytes."""


class Kind(IntEnum):
    """What a value is. Below 16 the agent writes, from 16 on the base."""

    CAMERA_INTRINSICS = 1
    LIVE_POSE = 2
    KEYFRAME_HEADER = 3
    NEW_LANDMARKS = 4
    OBSERVATIONS = 5
    GRAVITY_ALIGNMENT = 6
    SUBMAP_SCALE = 7
    KEYFRAME_POSE = 16
    REFINED_LANDMARKS = 17
    FUSED_LANDMARKS = 18
    REMOVED_OBSERVATIONS = 19
    CULLED_LANDMARKS = 20
    SUBMAP_PLACEMENT = 21
    GRID_TILE = 22
    CACHED_KEYFRAME = 23
    CACHED_LANDMARKS = 24
    DISPARITY_CALIBRATION = 25


@dataclass(frozen=True, slots=True)
class CameraIntrinsics:
    """The ideal camera to which an agent's keypoints refer."""

    agent: AgentId
    camera: RectifiedCamera


@dataclass(frozen=True, slots=True)
class LivePose:
    """An agent's newest pose, relative to a keyframe. T_k_c: (4,4) camera in the keyframe. quality: -1, 0, 1..100."""

    agent: AgentId
    t_ns: int
    keyframe: KeyframeId
    T_k_c: F64
    quality: int


@dataclass(frozen=True, slots=True)
class KeyframeHeader:
    """A keyframe's header. T_p_k: (4,4) this keyframe's camera in its parent's; for the first of a submap
    (parent NO_KEYFRAME) in the submap frame m, whose z points up.
    """

    keyframe: KeyframeId
    t_ns: int
    parent: KeyframeId
    T_p_k: F64
    keypoints: int  # how many keypoints the keyframe has, over all sections


@dataclass(frozen=True, slots=True)
class NewLandmarks:
    """New keypoints of a keyframe, best first over the parts. index: (n,) increasing within a part. uv: (n,2) px.
    inv_depth: (n,) 1/m as seen. octave: (n,) pyramid level (scale 2 per level). angle: (n,) in 1/256 turns.
    descriptor: (n,32).
    """

    keyframe: KeyframeId
    part: int
    index: U16
    uv: F32
    inv_depth: F32
    octave: U8
    angle: U8
    descriptor: U8


@dataclass(frozen=True, slots=True)
class Observations:
    """Observations of points born in other keyframes. point: (n,) PointId. inv_depth: (n,) 1/m from stereo, 0 none."""

    keyframe: KeyframeId
    part: int
    index: U16
    uv: F32
    inv_depth: F32
    octave: U8
    point: I64


@dataclass(frozen=True, slots=True)
class GravityAlignment:
    """A submap that began in motion lies askew until its agent knows which way is up. T_l_m: (4,4) sets it upright."""

    submap: SubmapId
    T_l_m: F64


@dataclass(frozen=True, slots=True)
class SubmapScale:
    """What one eye's agent has learnt of a submap's unit of length. metres: of one unit; a submap begun in metres has
    1. Of a submap of which nothing is said the unit is its own.
    """

    submap: SubmapId
    metres: float


@dataclass(frozen=True, slots=True)
class KeyframePose:
    """The base's pose of a keyframe. T_m_k: (4,4) camera in the submap frame."""

    keyframe: KeyframeId
    T_m_k: F64


@dataclass(frozen=True, slots=True)
class RefinedLandmarks:
    """The base's positions of points born in a keyframe. index: (n,) keypoints. inv_depth: (n,) 1/m.
    offset: (n,2) px added to the keypoint's pixel to give the bearing.
    """

    keyframe: KeyframeId
    index: U16
    inv_depth: F32
    offset: F32


@dataclass(frozen=True, slots=True)
class FusedLandmarks:
    """Births that the base recognised as older points: keypoint index[i] of the keyframe shows point[i] (a root).
    The point born at that keypoint is thereby an alias of the root.
    """

    keyframe: KeyframeId
    index: U16
    point: I64


@dataclass(frozen=True, slots=True)
class RemovedObservations:
    """Observations that the base rejected: keypoints of the keyframe that no longer count (as sighting or as birth)."""

    keyframe: KeyframeId
    index: U16


@dataclass(frozen=True, slots=True)
class CulledLandmarks:
    """Points born in the keyframe that the base dropped; `keyframe_too` drops the keyframe's observations as well."""

    keyframe: KeyframeId
    index: U16
    keyframe_too: int  # 0 or 1


@dataclass(frozen=True, slots=True)
class SubmapPlacement:
    """Where a submap lies, and in which unit of length. S_w_m: (4,4) similarity: a rigid motion where that is w's."""

    submap: SubmapId
    S_w_m: F64


@dataclass(frozen=True, slots=True)
class GridTile:
    """A square of the occupancy grid. cells: (32,32) int8, 0..100 occupied percent, -1 unknown; row 0 is the lowest y.
    column, row: tile numbers; the tile's corner lies at (column, row) * 32 * cell_m in w.
    """

    column: int
    row: int
    cell_m: float
    cells: NDArray[np.int8]


@dataclass(frozen=True, slots=True)
class CachedKeyframe:
    """A keyframe that its reader does not have, another agent's or one that it forgot. T_m_k: (4,4) camera in the
    reader's `submap`.
    """

    keyframe: KeyframeId
    submap: SubmapId
    T_m_k: F64


@dataclass(frozen=True, slots=True)
class CachedLandmarks:
    """Points that were born in a copied keyframe, where the base has them. index: (n,) keypoints, increasing within a
    part. uv: (n,2) px as the reader's own camera would see them from the keyframe. The rest as in Births.
    """

    keyframe: KeyframeId
    part: int
    index: U16
    uv: F32
    inv_depth: F32
    octave: U8
    angle: U8
    descriptor: U8


@dataclass(frozen=True, slots=True)
class DisparityCalibration:
    """What the base found of an agent's cameras. disparity_px: (5,) what its disparities are too large by, as factors
    of 1, x, y, x^2, x y in normalised image coordinates (`kiteline_core.geometry.disparity_offset`).
    """

    agent: AgentId
    disparity_px: F64


Record = (
    CameraIntrinsics
    | LivePose
    | KeyframeHeader
    | NewLandmarks
    | Observations
    | GravityAlignment
    | SubmapScale
    | KeyframePose
    | RefinedLandmarks
    | FusedLandmarks
    | RemovedObservations
    | CulledLandmarks
    | SubmapPlacement
    | GridTile
    | CachedKeyframe
    | CachedLandmarks
    | DisparityCalibration
)


class Key(NamedTuple):
    """The name of a value: what it is, of what, and which part of it. A tuple, since it is hashed without end."""

    kind: int
    id: int  # keyframe, submap or agent id; a tile's packed column and row
    part: int = 0
