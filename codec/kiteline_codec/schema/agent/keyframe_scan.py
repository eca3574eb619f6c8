"""The column scans of a keyframe and of frames after it, and which of its keypoints lie on the ground."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from kiteline_codec.coding import quantise
from kiteline_codec.coding import scan_kernels as kernels
from kiteline_codec.coding.packing import Reader, WireError, Writer, unzigzag, zigzag
from kiteline_codec.schema.poses import read_coarse_pose, read_direction, write_coarse_pose, write_direction
from kiteline_codec.schema.record import IdOf, Key, Priority, Record, register
from kiteline_core.arrays import F64, I64, U8
from kiteline_core.geometry import se3
from kiteline_core.ground.column_scan import MAX_COLUMNS, ColumnScan, level_rotation
from kiteline_core.ground.ground_height import without_ground
from kiteline_core.ids import MAX_KEYPOINTS, KeyframeId

_AZIMUTH_STEPS = 1 << 12  # codes in 1 rad, of the first column: an error of 0.12 mrad
_STEP_STEPS = 1 << 18  # codes in 1 rad: over 128 columns an error of 0.25 mrad
_MAX_AZIMUTH = 4 * _AZIMUTH_STEPS
_HEIGHT_STEPS = 256  # codes in 1 m
_MAX_HEIGHT = 1 << 18  # 1024 m
_COARSE = 2  # range codes in a step of where free ground begins, which is rounded up; 8 cost 2 % of a grid's recall
_MOST_COARSE = (quantise.RANGE_CODES - 1) // _COARSE
_LABELS = 3  # unknown, ground, obstacle
_LEVEL_UP_C = np.array([0.0, -1.0, 0.0])  # against gravity in a level camera


@register
@dataclass(frozen=True, slots=True)
class KeyframeScan(Record):
    """Ground and obstacles that a keyframe saw, or a frame between it and the next one.

    labels: (m,) uint8 of the keyframe's first m keypoints: 0 unknown, 1 ground, 2 obstacle. part: 0 the keyframe's own
    image, 1 and more: of later frames. T_k_s: (4,4) of the camera of a later frame in that of the keyframe, as the
    agent tracked it; None in part 0. It is rounded in a level frame: as decoded, its scan has an up_c of (0, -1, 0).
    Scans of later frames go without clear_m, and with half as many range codes.
    """

    KIND = 11
    ID = IdOf.KEYFRAME
    PRIORITY = Priority.LANDMARKS
    URGENCY = Priority.GRID
    PARTS = 16
    FIRST_PARTS = 2  # a hundred bytes each: later, a link that is full for a whole flight would not carry one

    keyframe: KeyframeId
    scan: ColumnScan
    labels: U8
    part: int = 0
    T_k_s: F64 | None = None

    def without_ground(self) -> "KeyframeScan":
        """The scan where its ground is not believed: it shows the line of sight alone."""
        return replace(self, scan=without_ground(self.scan), labels=self.labels[:0])

    def write(self, out: Writer) -> None:
        """Append direction of gravity or pose, columns and labels. Raises ValueError for values that have no code."""
        scan, n = self.scan, len(self.scan)
        if not 0 < n <= MAX_COLUMNS or len(self.labels) > MAX_KEYPOINTS or self.labels.max(initial=0) >= _LABELS:
            raise ValueError(
                f"found {n} columns and {len(self.labels)} labels, expected 1..{MAX_COLUMNS} and known ones"
            )
        if (self.T_k_s is None) != (self.part == 0):
            raise ValueError("the scan of a frame after its keyframe has a pose, and only that")
        if self.T_k_s is None:
            write_direction(out, scan.up_c)
        else:
            write_coarse_pose(out, _levelled(self.T_k_s, scan.up_c))
        first, step = round(scan.azimuth0_rad * _AZIMUTH_STEPS), round(scan.azimuth_step_rad * _STEP_STEPS)
        unknown = scan.camera_height_m != scan.camera_height_m
        height = 0 if unknown else 1 + zigzag(round(scan.camera_height_m * _HEIGHT_STEPS))
        if abs(first) > _MAX_AZIMUTH or not 0 < step <= _STEP_STEPS or height > _MAX_HEIGHT:
            raise ValueError("azimuths or the height of the camera are out of range")
        out.signed(first)
        out.varint(step)
        out.varint(height)
        out.varint(n)
        if not np.array_equal(np.isfinite(scan.obstacle_m), scan.bands > 0):
            raise ValueError("an obstacle reaches into at least one height band, and only an obstacle does")
        out.varint(len(self.labels))
        out.raw(_packed(self._columns(), self.labels))

    def _columns(self) -> I64:
        """Codes of ranges, and bands, as rows."""
        scan = self.scan
        obstacle = np.where(
            scan.bands > 0, np.maximum(quantise.range_codes(np.where(scan.bands > 0, scan.obstacle_m, 0.0)), 1), 0
        )
        free_from, free, clear = (quantise.range_codes(r) for r in (scan.free_from_m, scan.free_m, scan.clear_m))
        free_from = np.minimum(-(-free_from // _COARSE), _MOST_COARSE)
        if self.part:
            clear, foot = np.zeros_like(clear), free == obstacle
            obstacle = np.minimum((obstacle + 1) // _COARSE, _MOST_COARSE)
            free = np.where(foot, obstacle, np.where(free > 0, np.maximum(free // _COARSE, 1), 0))
            free_from = np.minimum(free_from, free)
        return np.stack([obstacle, free, free_from, clear, scan.bands.astype(np.int64)])

    @classmethod
    def read(cls, source: Reader, key: Key) -> Self:
        """The record of a key and a code. Raises WireError."""
        up_c, T_k_s = (
            (read_direction(source), None) if key.part == 0 else (_LEVEL_UP_C.copy(), read_coarse_pose(source))
        )
        first, step, height = source.signed(_MAX_AZIMUTH), source.varint(_STEP_STEPS), source.varint(_MAX_HEIGHT)
        n = source.varint(MAX_COLUMNS)
        if not step or not n:
            raise WireError("a scan has columns, and a step between them")
        m = source.varint(MAX_KEYPOINTS)
        columns, labels = np.zeros((5, n), np.int64), np.zeros(m, np.uint8)
        data = source.raw(source.left)
        if len(data) > kernels.MAX_CODE:
            raise WireError("the columns of a scan are expected")
        most = _MOST_COARSE if key.part else quantise.RANGE_CODES - 1
        if kernels.code_scan(columns, labels, most, True, np.frombuffer(bytearray(data), np.uint8)) < 0:
            raise WireError("a range is out of range")
        obstacle, free, free_from, clear, bands = columns
        if key.part:
            if clear.any() or (free_from > free).any():
                raise WireError("later frames tell no line of sight, and free ground begins before it ends")
            obstacle, free = obstacle * _COARSE, free * _COARSE
        free_from = free_from * _COARSE
        if free_from.max() >= quantise.RANGE_CODES:
            raise WireError("free ground begins too far away")
        if not np.array_equal(obstacle > 0, bands > 0):
            raise WireError("an obstacle reaches into at least one height band, and only an obstacle does")
        if _packed(columns, labels) != data:
            raise WireError("a scan in its shortest code is expected")
        scan = ColumnScan(
            up_c, first / _AZIMUTH_STEPS, step / _STEP_STEPS, quantise.ranges(free_from), quantise.ranges(free),
            np.where(obstacle > 0, quantise.ranges(obstacle), np.inf), bands.astype(np.uint8), quantise.ranges(clear),
            unzigzag(height - 1) / _HEIGHT_STEPS if height else float("nan"),
        )  # fmt: skip
        return cls(KeyframeId(key.id), scan, labels, key.part, T_k_s)


def _levelled(T_k_s: F64, up_c: F64) -> F64:
    """The pose (4,4) of a camera after it was turned so that its up_c (3,) became (0, -1, 0)."""
    return se3.from_rt(T_k_s[:3, :3] @ level_rotation(up_c) @ level_rotation(_LEVEL_UP_C).T, T_k_s[:3, 3])


def _packed(columns: I64, labels: U8) -> bytes:
    data = np.empty(kernels.MAX_CODE, np.uint8)
    size = kernels.code_scan(columns.copy(), labels.copy(), quantise.RANGE_CODES - 1, False, data)
    return data[:size].tobytes()
