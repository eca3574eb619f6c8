"""Column scans as the base keeps them: small, and in whole numbers."""

import math
import zlib
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from kiteline_basestation.config import GridConfig
from kiteline_codec.schema.base.grid_tile import MAX_STOREY
from kiteline_core.arrays import F64
from kiteline_core.geometry import sim3
from kiteline_core.ground.column_scan import ColumnScan, level_rotation

_RANGE_STEPS = 256  # codes in 1 m: 4 mm
_MOST = 65535
_ANGLE_STEPS = 1 << 16  # codes in 1 rad
_LATTICE = 4  # positions along a cell's side, and of a scan's farthest end as it turns
_SCALE_STEPS = 1 << 10
_FENCE = 1.5  # interquartile ranges above the upper quartile: longer rays to the ground are cut (Segfloor eq. 5.3)
_ACCURATE_SIGMA_M = 0.05  # m; up to this deviation of a range a view counts in full: a cell by default
GAP_SIGMAS = 3.0  # standard deviations before an obstacle within which ground is not freed


class Lattice(NamedTuple):
    """A scan's pose in w on a lattice: what lies between two points of it moves no cell."""

    x: int  # in a quarter of a cell
    y: int
    heading: int  # in quarters of a cell at the scan's reach
    storeys: tuple[int, ...]  # on which it is drawn; none beyond those that tiles have
    scale: int  # of lengths, in 1/1024


@dataclass(frozen=True, slots=True)
class KeptScan:
    """A column scan. rows: deflated (5, n) uint16: obstacle, bands, free from, free to, clear; ranges in 1/256 m.

    first, step: azimuths in 1/2^16 rad. up_c: against gravity in the camera. reach_m: farthest range that is drawn.
    sigma_per_m2: standard deviation of a range over its square. unit_m: metres in a unit of the keyframe's submap.
    """

    rows: bytes
    columns: int
    first: int
    step: float
    up_c: tuple[float, float, float]
    height_m: float
    reach_m: float
    sigma_per_m2: float
    unit_m: float

    def accurate_m(self, config: GridConfig) -> float:
        """Range up to which a view counts in full."""
        return math.sqrt(_ACCURATE_SIGMA_M / self.sigma_per_m2) if self.sigma_per_m2 > 0.0 else config.max_range_m

    def ranges(self) -> F64:
        """Obstacle, bands, free from, free to and clear (5, n), ranges in m; inf without an obstacle."""
        codes = np.frombuffer(zlib.decompress(self.rows), np.uint16).reshape(5, self.columns).astype(np.float64)
        out = codes / _RANGE_STEPS
        out[1] = codes[1]
        out[0, codes[1] == 0] = np.inf
        return out

    def lattice(self, config: GridConfig, S_w_c: F64) -> Lattice:
        """The point of the lattice next to a camera's pose (4,4)."""
        ahead = S_w_c[:2, :3] @ level_rotation(np.array(self.up_c))[:, 0]
        scale, cell = sim3.scale_of(S_w_c) / self.unit_m, config.cell_m / _LATTICE
        storey = storey_at(config, float(S_w_c[2, 3]) - scale * self.height_m)
        overlap = config.storey_overlap_m / config.storey_m
        low, high = round(storey - overlap), round(storey + overlap)
        return Lattice(
            round(S_w_c[0, 3] / cell),
            round(S_w_c[1, 3] / cell),
            round(math.atan2(ahead[1], ahead[0]) * self.reach_m / cell),
            tuple(range(max(low, -MAX_STOREY - 1), min(high, MAX_STOREY) + 1)),
            round(scale * _SCALE_STEPS),
        )

    @property
    def first_rad(self) -> float:
        """Azimuth of the lower edge of the first column."""
        return self.first / _ANGLE_STEPS

    def heading_rad(self, config: GridConfig, lattice: Lattice) -> float:
        """Heading of the levelled camera in w."""
        return lattice.heading * config.cell_m / _LATTICE / self.reach_m


def storey_at(config: GridConfig, ground_m: float) -> float:
    """The storey of a height in w of the ground; its own is a whole number."""
    return (ground_m - config.ground_m) / config.storey_m


def position_cells(lattice: Lattice) -> tuple[float, float]:
    """Position of the camera in cells of w; exact."""
    return lattice.x / _LATTICE, lattice.y / _LATTICE


def scale_of(lattice: Lattice) -> float:
    """Length in w of a unit of the scan."""
    return lattice.scale / _SCALE_STEPS


def keep(config: GridConfig, scan: ColumnScan, bf_px_m: float, unit_m: float = 1.0) -> KeptScan | None:
    """The part of a scan that is drawn; None without a known ground.

    bf_px_m: focal length times baseline: ranges are used up to where their deviation passes a limit. 0: it never does.
    unit_m: metres in a unit of the keyframe's submap, as it is known now: the scan is rescaled with its submap.
    Free ranges are cut at the third quartile and _FENCE interquartile ranges (Segfloor, equation 5.3).
    """
    if not math.isfinite(scan.camera_height_m):
        return None
    sigma_per_m2 = config.sigma_px / bf_px_m if bf_px_m > 0.0 else 0.0
    limit_m = config.max_range_m
    if sigma_per_m2 > 0.0:
        limit_m = min(limit_m, math.sqrt(config.max_sigma_m / sigma_per_m2))
    seen = scan.free_m[scan.free_m > 0.0]
    if len(seen):
        q1, q3 = np.quantile(seen, (0.25, 0.75))
        free_limit_m = min(limit_m, float(q3 + _FENCE * (q3 - q1)))
    else:
        free_limit_m = 0.0
    solid = (scan.bands > 0) & (scan.obstacle_m <= limit_m)
    stop = np.where(scan.bands > 0, scan.obstacle_m, np.inf)  # nothing is known behind an obstacle, however far it is
    # Before an obstacle that is too far to be drawn, nothing is free within some deviations of its range, either.
    far_m = np.where((scan.bands > 0) & ~solid & np.isfinite(scan.obstacle_m), scan.obstacle_m, np.nan)
    before = np.fmin(far_m - np.maximum(GAP_SIGMAS * sigma_per_m2 * far_m**2, config.cell_m), np.inf)
    free = np.minimum(np.minimum(scan.free_m, free_limit_m), before)
    free = np.where(free > scan.free_from_m, free, 0.0)
    free_from = np.where(free > 0.0, scan.free_from_m, 0.0)
    clear = np.maximum(np.minimum(np.minimum(scan.clear_m, limit_m), np.minimum(stop, before)), 0.0)
    rows = np.stack([
        np.where(solid, scan.obstacle_m, 0.0) * _RANGE_STEPS,
        np.where(solid, scan.bands, 0),
        free_from * _RANGE_STEPS,
        free * _RANGE_STEPS,
        clear * _RANGE_STEPS,
    ])  # fmt: skip
    codes = np.clip(np.rint(rows), 0, _MOST).astype(np.uint16)
    reach = max(float(codes[[0, 3, 4]].max(initial=0)) / _RANGE_STEPS, config.cell_m)
    first = round((scan.azimuth0_rad - 0.5 * scan.azimuth_step_rad) * _ANGLE_STEPS)
    up = tuple(float(v) for v in scan.up_c)
    return KeptScan(
        zlib.compress(codes.tobytes(), 6), codes.shape[1], first, float(scan.azimuth_step_rad), (up[0], up[1], up[2]),
        float(scan.camera_height_m), reach, sigma_per_m2, unit_m,
    )  # fmt: skip
