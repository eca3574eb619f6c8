"""Sectors of free cells and obstacles around a camera, from the columns of a scan, in cells of w."""

from typing import NamedTuple

import numpy as np

from kiteline_basestation.config import GridConfig
from kiteline_basestation.grid.kept_scan import GAP_SIGMAS, KeptScan, Lattice, position_cells, scale_of
from kiteline_basestation.grid.scan_kernels import BANDS, SIDE
from kiteline_core.arrays import F64, I64, U8, Bool

_AT_BORDER = 0.1  # of a scan's columns, at least, in which ground is seen from the image's lower border on
_HIDDEN = 1.25  # times that distance, from which on something hides the ground before
_STEEPEST = 4.0  # tangent of the angle under which a surface is seen that goes on from column to column
_MOST = 0.5  # of an inverse range, by which it changes from column to column of one surface, at most
_SURE_SIGMAS = 2.0  # standard deviations beyond GAP_SIGMAS from which on a far view is well before what it sees
_OPEN_SIGMAS = 1.0  # the same before a scan's end without an obstacle, which lies two before the last ground
_FAIR_SIGMAS = 1.0  # fewer of them from which on it is less far before: 0.3 % are wrong with no sign near


class Sectors(NamedTuple):
    """Columns of n sectors, lengths in cells. x, y: the camera. first_rad, step_rad: heading of their lower edges.

    obstacle: (n,3) nearest obstacle at the lower edge, in the middle and at the upper edge, inf without. bands: (n,) of
    it; weight: (n,) of a hit. begin, start: (n,) from where rays to the nearest seen ground are low, from where the
    ground was seen. end: (n,3) up to where all bands are free; under: (n,) bands that are free from there up to `low`
    (n,). clear: (n,) up to where camera_band is free, -1 none. accurate: (n,) up to where a view counts in full; sure,
    fair: (n,) up to where it frees cells alone, as what it sees is well behind, and up to where it does with no sign of
    an obstacle near. All three are 0 in columns at the sides of the view.
    """

    x: float
    y: float
    first_rad: float
    step_rad: float
    obstacle: F64
    bands: U8
    weight: I64
    begin: F64
    start: F64
    end: F64
    low: F64
    under: U8
    clear: F64
    camera_band: int
    accurate: F64
    sure: F64
    fair: F64

    def box(self) -> tuple[int, int, int, int]:
        """First row and column, and those after the last, of the tiles around the sectors."""
        solid = self.obstacle[self.bands > 0]
        reach = max(float(max(self.end.max(), self.low.max(), self.clear.max())), float(solid.max(initial=0.0))) + 2.0
        angles = self.first_rad + self.step_rad * np.arange(len(self.bands) + 1)
        ends_x, ends_y = self.x + reach * np.cos(angles), self.y + reach * np.sin(angles)
        low_x, high_x = min(self.x - 2.0, ends_x.min()), max(self.x + 2.0, ends_x.max())
        low_y, high_y = min(self.y - 2.0, ends_y.min()), max(self.y + 2.0, ends_y.max())
        return (
            int(np.floor(low_y / SIDE)), int(np.floor(low_x / SIDE)),
            int(np.floor(high_y / SIDE)) + 1, int(np.floor(high_x / SIDE)) + 1,
        )  # fmt: skip


def sectors_of(config: GridConfig, scan: KeptScan, lattice: Lattice, hit: int) -> Sectors:
    """The sectors of a scan at a pose. hit: log-odds of a near view of an obstacle."""
    scale = scale_of(lattice)
    unit, ranges = scale / config.cell_m, scan.ranges()
    middle, start, free, clear = (ranges[k] * unit for k in (0, 2, 3, 4))
    bands = np.where(middle > 0.0, ranges[1], 0).astype(np.uint8)  # nothing stands in the camera
    obstacle = _surfaces(middle, bands, scan.step)
    near_m = np.where(np.isfinite(ranges[0]), ranges[0], 0.0)
    # Cells before an obstacle are free up to some deviations of its range, and at least a cell, before it.
    gap = np.maximum(1.0, GAP_SIGMAS * scan.sigma_per_m2 * near_m**2 * unit)
    before = obstacle - gap[:, None]
    under = np.where(bands & 1, 0, 1).astype(np.uint8)  # the floor is seen below what stands higher, a table
    behind = start > middle  # ground that was seen over a low obstacle, which hides what lies before it
    foot = (free >= middle - 1e-9) & ~behind
    end = np.where(foot[:, None], before, np.minimum(free[:, None], before))
    end = np.where((behind & (under == 0))[:, None], free[:, None], end)
    end = np.where((free > 0.0)[:, None], end, 0.0)
    accurate_m = scan.accurate_m(config)
    last_m = np.where(bands > 0, near_m, ranges[3])
    margin = np.where(bands > 0, _SURE_SIGMAS, _OPEN_SIGMAS)
    deviation = scan.sigma_per_m2 * last_m**2 * unit
    sure = np.maximum(end.min(1) - margin * deviation, 0.0)
    fair = np.maximum(end.min(1) - (margin - _FAIR_SIGMAS) * deviation, 0.0)
    weight = np.clip(np.rint(hit * accurate_m / np.maximum(near_m, accurate_m)), 1, 127).astype(np.int64)
    camera_band = int(np.searchsorted(config.bands_m, scan.height_m, side="right")) - 1
    accurate = np.full(scan.columns, accurate_m / config.cell_m)
    begin = _begin(config, scan, start, free, behind)
    # What stands at the image's side is not seen whole, and matching is worst there: such a view frees no cell alone.
    for side in (slice(0, config.side_columns), slice(max(scan.columns - config.side_columns, 0), None)):
        accurate[side] = sure[side] = fair[side] = 0.0
        begin[side] = start[side]
    x, y = position_cells(lattice)
    return Sectors(
        x, y, scan.heading_rad(config, lattice) + scan.first_rad, scan.step, obstacle, bands, weight,
        begin, start, end, np.where(under > 0, free, 0.0), under,
        np.minimum(clear, before.min(1)), camera_band if 0 <= camera_band < BANDS else -1,
        accurate, sure, fair,
    )  # fmt: skip


def _begin(config: GridConfig, scan: KeptScan, start: F64, free: F64, behind: Bool) -> F64:
    """From where (n,) cells before the nearest seen ground are free: the ray to it passes below the lowest band there.

    Where the ground begins farther than at the image's lower border, something too near to be measured hides it.
    """
    ahead = start * np.cos(scan.first_rad + scan.step * (np.arange(scan.columns) + 0.5))
    border = np.quantile(ahead[free > 0.0], _AT_BORDER) if (free > 0.0).any() else 0.0
    hidden = behind | (ahead > _HIDDEN * border)
    return np.where(hidden, start, start * max(0.0, 1.0 - config.bands_m[0] / max(scan.height_m, 1e-3)))


def _surfaces(middle: F64, bands: U8, step: float) -> F64:
    """Ranges (n,3) of obstacles at the lower edges, in the middle and at the upper edges of columns.

    Between two columns that see one surface its inverse range is taken as linear, as that of a wall nearly is. Where it
    ends it goes on as it came.
    """
    solid = bands > 0
    inverse = np.where(solid, 1.0 / np.where(solid, middle, 1.0), 0.0)
    one = solid[1:] & solid[:-1]
    one &= np.abs(np.diff(inverse)) < min(_STEEPEST * step, _MOST) * np.minimum(inverse[1:], inverse[:-1])
    between = 0.5 * (inverse[1:] + inverse[:-1])
    lower, upper = np.full(len(middle), np.nan), np.full(len(middle), np.nan)
    lower[1:][one], upper[:-1][one] = between[one], between[one]
    lower = np.where(np.isnan(lower), 2.0 * inverse - np.where(np.isnan(upper), inverse, upper), lower)
    upper = np.where(np.isnan(upper), 2.0 * inverse - lower, upper)
    edges = np.stack([lower, inverse, upper], 1)
    return np.where(solid[:, None], 1.0 / np.where(solid[:, None], edges, 1.0), np.inf)
