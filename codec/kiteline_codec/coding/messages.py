"""Records to codes and back. A code says everything of a value but its key."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kiteline_codec.coding import quantise
from kiteline_codec.coding.packing import Reader, Writer, unzigzag, zigzag
from kiteline_codec.coding.rows import MAX_KEYFRAME_ID, read_columns, read_points, write_columns, write_points
from kiteline_codec.schema import (
    CachedKeyframe,
    CachedLandmarks,
    CameraIntrinsics,
    CulledLandmarks,
    DisparityCalibration,
    FusedLandmarks,
    GravityAlignment,
    GridTile,
    Key,
    KeyframeHeader,
    KeyframePose,
    Kind,
    LivePose,
    NewLandmarks,
    Observations,
    Record,
    RefinedLandmarks,
    RemovedObservations,
    SubmapPlacement,
    SubmapScale,
    WireError,
)
from kiteline_core.geometry import disparity_offset, sim3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import MAX_KEYPOINTS, NO_KEYFRAME, AgentId, KeyframeId, SubmapId
from kiteline_core.imaging import descriptors
from kiteline_core.imaging.descriptors import DESCRIPTOR_BYTES, NARROW_BYTES

MAX_PARTS = 1 << 8
TILE_CELLS = 32  # along each side
_TILE_BITS = 24  # of a column or row number
_TILE_OFFSET = 1 << _TILE_BITS - 1
_MAX_SIZE_PX = 1 << 14
_MAX_SUBMAP_ID = (1 << 32) - 1


def key(record: Record) -> Key:
    """The name under which a record is shared."""
    coder = _CODERS[_KIND_OF[type(record)]]
    return Key(int(coder.kind), *coder.key(record))


def encode(record: Record) -> bytes:
    """The code of a record: quantised, without its key. Raises ValueError for a record that cannot be coded."""
    coder = _CODERS[_KIND_OF[type(record)]]
    out = Writer()
    coder.write(out, record)
    return out.bytes()


def decode(key: Key, code: bytes) -> Record:
    """The record of a key and a code. `encode` gives the same code of it again. Raises WireError, on any bytes."""
    coder = _CODERS.get(key.kind)
    if coder is None:
        raise WireError(f"kind {key.kind} is unknown; known are {sorted(_CODERS)}")
    if not 0 <= key.id <= coder.max_id or not 0 <= key.part < coder.parts:
        raise WireError(f"{key} is out of range")
    source = Reader(code)
    record = coder.read(source, key)
    source.end()
    return record


def _write_pose(out: Writer, pose: NDArray[np.float64]) -> None:
    for c in quantise.pose_codes(pose):
        out.signed(c)


def _read_pose(source: Reader) -> NDArray[np.float64]:
    moved = [source.signed(quantise.TRANSLATION_CODES - 1) for _ in range(3)]
    turned = [source.signed(quantise.ROTATION_STEPS) for _ in range(3)]
    try:
        return quantise.pose((*moved, *turned))
    except ValueError as e:
        raise WireError(str(e)) from None


def _write_scale(out: Writer, scale: float) -> None:
    if not quantise.MIN_SCALE <= scale <= quantise.MAX_SCALE:
        raise ValueError(f"found scale {scale}: expected a rigid motion, or a scale of 2^-20 to 2^20")
    out.f32(scale)


def _read_scale(source: Reader) -> float:
    scale = source.f32()
    if not quantise.MIN_SCALE <= scale <= quantise.MAX_SCALE:
        raise WireError(f"found scale {scale}: expected 2^-20 to 2^20")
    return scale


def _write_placement(out: Writer, record: SubmapPlacement) -> None:
    scale = sim3.scale_of(record.S_w_m)
    _write_scale(out, scale)
    _write_pose(out, sim3.rigid(record.S_w_m))


def _read_placement(source: Reader, key: Key) -> SubmapPlacement:
    scale = _read_scale(source)
    return SubmapPlacement(SubmapId(key.id), sim3.of(scale, _read_pose(source)))


def _write_camera(out: Writer, record: CameraIntrinsics) -> None:
    c = record.camera
    out.varint(c.width)
    out.varint(c.height)
    for value in (c.fx, c.fy, c.cx, c.cy, c.baseline_m):
        out.f64(value)
    out.u8(int(c.stereo))
    for value in np.asarray(c.T_b_c, np.float64)[:3].reshape(-1):
        out.f64(float(value))


def _read_camera(source: Reader, key: Key) -> CameraIntrinsics:
    width, height = source.varint(_MAX_SIZE_PX), source.varint(_MAX_SIZE_PX)
    fx, fy, cx, cy, baseline_m = (source.f64() for _ in range(5))
    stereo = source.u8()
    t_b_c = np.eye(4)
    t_b_c[:3] = np.array([source.f64() for _ in range(12)]).reshape(3, 4)
    if not (width and height and fx > 0 and fy > 0 and baseline_m > 0 and stereo < 2):
        raise WireError("a camera has size, focal lengths and a baseline above zero")
    if np.abs(t_b_c).max() > 1e6 or np.abs(t_b_c[:3, :3] @ t_b_c[:3, :3].T - np.eye(3)).max() > 1e-3:
        raise WireError("the camera's place in the body is no rigid motion")
    return CameraIntrinsics(
        AgentId(key.id), RectifiedCamera(width, height, fx, fy, cx, cy, baseline_m, stereo == 1, t_b_c)
    )


def _write_live(out: Writer, record: LivePose) -> None:
    out.varint(record.t_ns)
    out.varint(record.keyframe + 1)
    _write_pose(out, record.T_k_c)
    out.signed(record.quality)


def _read_live(source: Reader, key: Key) -> LivePose:
    t_ns = source.varint()
    keyframe = KeyframeId(source.varint(MAX_KEYFRAME_ID + 1) - 1)
    t_k_c = _read_pose(source)
    quality = source.signed(100)
    if quality < -1:
        raise WireError(f"quality is -1, 0 or 1..100, found {quality}")
    return LivePose(AgentId(key.id), t_ns, keyframe, t_k_c, quality)


def _write_calibration(out: Writer, record: DisparityCalibration) -> None:
    limit = quantise.CALIBRATION_CODES // 2
    for value in record.disparity_px.tolist():
        out.signed(min(max(round(value * quantise.CALIBRATION_STEPS), -limit), limit))


def _read_calibration(source: Reader, key: Key) -> DisparityCalibration:
    codes = [source.signed(quantise.CALIBRATION_CODES // 2) for _ in range(disparity_offset.TERMS)]
    return DisparityCalibration(AgentId(key.id), np.array(codes, np.float64) / quantise.CALIBRATION_STEPS)


def _write_head(out: Writer, record: KeyframeHeader) -> None:
    out.varint(record.t_ns)
    # Most parents are the keyframe before: their difference is 1.
    out.varint(0 if record.parent == NO_KEYFRAME else 1 + zigzag(record.keyframe - record.parent))
    _write_pose(out, record.T_p_k)
    out.varint(record.keypoints)


def _read_head(source: Reader, key: Key) -> KeyframeHeader:
    t_ns = source.varint()
    step = source.varint()
    parent = NO_KEYFRAME
    if step:
        parent = KeyframeId(key.id - unzigzag(step - 1))
        if not 0 <= parent <= MAX_KEYFRAME_ID:
            raise WireError(f"parent {parent} is no keyframe id")
    t_p_k = _read_pose(source)
    return KeyframeHeader(KeyframeId(key.id), t_ns, parent, t_p_k, source.varint(MAX_KEYPOINTS))


def _write_described(out: Writer, kind: Kind, record: NewLandmarks | CachedLandmarks) -> None:
    descriptor = np.ascontiguousarray(record.descriptor, np.uint8)
    if descriptor.shape != (len(record.index), DESCRIPTOR_BYTES):
        raise ValueError(f"descriptors are {descriptor.shape}, expected {(len(record.index), DESCRIPTOR_BYTES)}")
    write_columns(out, kind, record)
    if descriptor.any():
        narrow = descriptors.is_narrow(descriptor).all()
        out.raw((descriptors.packed(descriptor) if narrow else descriptor).tobytes())


def _read_described(source: Reader, kind: Kind, key: Key) -> dict[str, Any]:
    n, columns = read_columns(source, kind)
    size = {NARROW_BYTES * n: NARROW_BYTES, 0: 0}.get(source.left, DESCRIPTOR_BYTES)
    raw = np.frombuffer(source.raw(size * n), np.uint8).reshape(n, size)
    if size < DESCRIPTOR_BYTES:
        raw = descriptors.unpacked(raw) if size else np.zeros((n, DESCRIPTOR_BYTES), np.uint8)
    if n and size and (not raw.any() or (size == DESCRIPTOR_BYTES and descriptors.is_narrow(raw).all())):
        raise WireError("descriptors are written in the fewest bytes that hold them")
    return {"keyframe": KeyframeId(key.id), "part": key.part, "descriptor": raw, **columns}


def _write_sightings(out: Writer, record: Observations) -> None:
    write_columns(out, Kind.OBSERVATIONS, record)
    write_points(out, record.point)


def _read_sightings(source: Reader, key: Key) -> Observations:
    n, columns = read_columns(source, Kind.OBSERVATIONS)
    return Observations(keyframe=KeyframeId(key.id), part=key.part, point=read_points(source, n), **columns)


def _write_found(out: Writer, record: FusedLandmarks) -> None:
    write_columns(out, Kind.FUSED_LANDMARKS, record)
    write_points(out, record.point)


def _read_found(source: Reader, key: Key) -> FusedLandmarks:
    n, columns = read_columns(source, Kind.FUSED_LANDMARKS)
    return FusedLandmarks(keyframe=KeyframeId(key.id), point=read_points(source, n), **columns)


def _write_culled(out: Writer, record: CulledLandmarks) -> None:
    write_columns(out, Kind.CULLED_LANDMARKS, record)
    out.u8(record.keyframe_too)


def _read_culled(source: Reader, key: Key) -> CulledLandmarks:
    _, columns = read_columns(source, Kind.CULLED_LANDMARKS)
    too = source.u8()
    if too > 1:
        raise WireError(f"keyframe_too is 0 or 1, found {too}")
    return CulledLandmarks(keyframe=KeyframeId(key.id), keyframe_too=too, **columns)


def _write_copy(out: Writer, record: CachedKeyframe) -> None:
    out.varint(record.submap)
    _write_pose(out, record.T_m_k)


def _read_copy(source: Reader, key: Key) -> CachedKeyframe:
    submap = SubmapId(source.varint(_MAX_SUBMAP_ID))
    return CachedKeyframe(KeyframeId(key.id), submap, _read_pose(source))


def _tile_id(record: GridTile) -> int:
    column, row = record.column + _TILE_OFFSET, record.row + _TILE_OFFSET
    if not (0 <= column < 1 << _TILE_BITS and 0 <= row < 1 << _TILE_BITS):
        raise ValueError(f"tile ({record.column}, {record.row}) lies beyond +-{_TILE_OFFSET}")
    return column << _TILE_BITS | row


def _write_tile(out: Writer, record: GridTile) -> None:
    if record.cells.shape != (TILE_CELLS, TILE_CELLS):
        raise ValueError(f"a tile is {TILE_CELLS}x{TILE_CELLS} cells, found {record.cells.shape}")
    out.f32(record.cell_m)
    levels = quantise.occupancy_codes(record.cells).reshape(-1)
    deflate = zlib.compressobj(9, zlib.DEFLATED, -10)
    out.raw(deflate.compress((levels[0::2] | levels[1::2] << 4).tobytes()) + deflate.flush())


def _read_tile(source: Reader, key: Key) -> GridTile:
    cell_m = source.f32()
    if cell_m <= 0:
        raise WireError(f"a cell has a size, found {cell_m} m")
    inflate = zlib.decompressobj(-15)
    expected = TILE_CELLS * TILE_CELLS // 2
    try:
        data = inflate.decompress(source.raw(source.left), expected + 1)
    except zlib.error as e:
        raise WireError(f"tile: {e}") from None
    if len(data) != expected or not inflate.eof or inflate.unused_data or inflate.unconsumed_tail:
        raise WireError(f"a tile holds {expected} bytes, found {len(data)}")
    pairs = np.frombuffer(data, np.uint8)
    levels = np.stack([pairs & 15, pairs >> 4], axis=1).reshape(TILE_CELLS, TILE_CELLS)
    column, row = key.id >> _TILE_BITS, key.id & (1 << _TILE_BITS) - 1
    return GridTile(column - _TILE_OFFSET, row - _TILE_OFFSET, cell_m, quantise.occupancy(levels))


@dataclass(frozen=True, slots=True)
class _Coder:
    kind: Kind
    record: type
    max_id: int
    parts: int
    key: Callable[[Any], tuple[int, ...]]
    write: Callable[[Writer, Any], None]
    read: Callable[[Reader, Key], Record]


def _of_keyframe(record: Any) -> tuple[int, ...]:
    return (int(record.keyframe),)


def _of_part(record: Any) -> tuple[int, ...]:
    return int(record.keyframe), int(record.part)


def _of_agent(record: Any) -> tuple[int, ...]:
    return (int(record.agent),)


_TABLE = (
    _Coder(Kind.CAMERA_INTRINSICS, CameraIntrinsics, 63, 1, _of_agent, _write_camera, _read_camera),
    _Coder(Kind.LIVE_POSE, LivePose, 63, 1, _of_agent, _write_live, _read_live),
    _Coder(Kind.KEYFRAME_HEADER, KeyframeHeader, MAX_KEYFRAME_ID, 1, _of_keyframe, _write_head, _read_head),
    _Coder(
        Kind.NEW_LANDMARKS, NewLandmarks, MAX_KEYFRAME_ID, MAX_PARTS, _of_part,
        lambda out, r: _write_described(out, Kind.NEW_LANDMARKS, r),
        lambda source, key: NewLandmarks(**_read_described(source, Kind.NEW_LANDMARKS, key)),
    ),
    _Coder(Kind.OBSERVATIONS, Observations, MAX_KEYFRAME_ID, MAX_PARTS, _of_part, _write_sightings, _read_sightings),
    _Coder(
        Kind.GRAVITY_ALIGNMENT, GravityAlignment, _MAX_SUBMAP_ID, 1, lambda r: (int(r.submap),),
        lambda out, r: _write_pose(out, r.T_l_m),
        lambda source, key: GravityAlignment(SubmapId(key.id), _read_pose(source)),
    ),
    _Coder(
        Kind.SUBMAP_SCALE, SubmapScale, _MAX_SUBMAP_ID, 1, lambda r: (int(r.submap),),
        lambda out, r: _write_scale(out, r.metres),
        lambda source, key: SubmapScale(SubmapId(key.id), _read_scale(source)),
    ),
    _Coder(
        Kind.KEYFRAME_POSE, KeyframePose, MAX_KEYFRAME_ID, 1, _of_keyframe,
        lambda out, r: _write_pose(out, r.T_m_k),
        lambda source, key: KeyframePose(KeyframeId(key.id), _read_pose(source)),
    ),
    _Coder(
        Kind.REFINED_LANDMARKS, RefinedLandmarks, MAX_KEYFRAME_ID, 1, _of_keyframe,
        lambda out, r: write_columns(out, Kind.REFINED_LANDMARKS, r),
        lambda source, key: RefinedLandmarks(keyframe=KeyframeId(key.id), **read_columns(source, Kind.REFINED_LANDMARKS)[1]),
    ),
    _Coder(Kind.FUSED_LANDMARKS, FusedLandmarks, MAX_KEYFRAME_ID, 1, _of_keyframe, _write_found, _read_found),
    _Coder(
        Kind.REMOVED_OBSERVATIONS, RemovedObservations, MAX_KEYFRAME_ID, 1, _of_keyframe,
        lambda out, r: write_columns(out, Kind.REMOVED_OBSERVATIONS, r),
        lambda source, key: RemovedObservations(keyframe=KeyframeId(key.id), **read_columns(source, Kind.REMOVED_OBSERVATIONS)[1]),
    ),
    _Coder(Kind.CULLED_LANDMARKS, CulledLandmarks, MAX_KEYFRAME_ID, 1, _of_keyframe, _write_culled, _read_culled),
    _Coder(
        Kind.SUBMAP_PLACEMENT, SubmapPlacement, _MAX_SUBMAP_ID, 1, lambda r: (int(r.submap),),
        _write_placement, _read_placement,
    ),
    _Coder(Kind.DISPARITY_CALIBRATION, DisparityCalibration, 63, 1, _of_agent, _write_calibration, _read_calibration),
    _Coder(Kind.GRID_TILE, GridTile, (1 << 2 * _TILE_BITS) - 1, 1, lambda r: (_tile_id(r),), _write_tile, _read_tile),
    _Coder(Kind.CACHED_KEYFRAME, CachedKeyframe, MAX_KEYFRAME_ID, 1, _of_keyframe, _write_copy, _read_copy),
    _Coder(
        Kind.CACHED_LANDMARKS, CachedLandmarks, MAX_KEYFRAME_ID, MAX_PARTS, _of_part,
        lambda out, r: _write_described(out, Kind.CACHED_LANDMARKS, r),
        lambda source, key: CachedLandmarks(**_read_described(source, Kind.CACHED_LANDMARKS, key)),
    ),
)  # fmt: skip
_CODERS: dict[int, _Coder] = {int(c.kind): c for c in _TABLE}
_KIND_OF: dict[type, int] = {c.record: int(c.kind) for c in _TABLE}
