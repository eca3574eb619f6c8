"""Thresholds of ground segmentation."""

from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True, slots=True)
class GroundConfig:
    """Ground segmentation and column scans. Pixels are those of the half-size image."""

    MAY_BE_ZERO: ClassVar = ("wider", "lower")

    wider: float = 0.085  # of the rectified width that scans see more of to both sides: 64 px of 70 to 110; 0: no more
    lower: float = 0.067  # of its height by which their view lies lower: 32 of 480 px, of 15 to 70; 0: not lower
    disparities: int = 48  # px searched, a multiple of 16: from 0.5 m on with 0.11 m of baseline; less CPU if fewer
    block_px: int = 7  # px, side of a matched block: smaller ones are noisier, larger ones widen obstacles
    small_step: int = 1  # cost of a step of one pixel of disparity, times the block's pixels: slanted ground has many
    large_step: int = 5  # the same of a larger step: an edge
    stripes: int = 2  # in which a pair is matched, one a frame: 2 ms each of a fast core at 752x480; a whole one is 3.5
    uniqueness: int = 10  # percent by which the best cost is below the next: rejects floors without texture
    texture: int = 4  # grey levels over two pixels along a row, at least: six times the noise of a plain floor
    texture_px: int = 16  # px along a row within which a pixel has texture: semi-global matching fills in between
    sigma_px: float = 0.25  # px; error of a disparity
    depth_sigma: float = 2.85e-3  # 1/m; error of inverse depth of a depth camera (K. Khoshelham, S. Elberink, 2012)
    obstacle_rows: float = 5.0  # rows of one disparity in a column, beyond those of level ground: `a` of Segfloor
    max_slope: float = 0.35  # m a m of the ground, at most: steeper is an obstacle; ramps have up to 0.2
    least_height_m: float = 0.15  # m of the camera above the ground, at least
    largest_height_m: float = 8.0  # m; the same at most: from higher up, disparities of half a pixel say little
    least_pixels: int = 150  # on the ground, at least
    least_share: float = (
        0.4  # of what is neither upright nor unknown at these distances, that is ground: else it is noise
    )
    least_bins: int = 6  # quarter pixels of disparity over which ground is seen, at least: less may be a wall's foot
    expected_m: float = 0.1  # m between the height found and the one expected, at most: beyond, it is a table or a box
    expected_pixels: int = 30  # there, from which the height is that of these pixels
    lowest_pixels: int = 60  # that must lie as low to tell that the ground lies no higher: fewer may be errors
    lowest_ahead_m: float = 5.0  # m ahead up to which they count
    lowest_sigma_m: float = 0.1  # m; deviation of their height, at most
    lowest_slope: float = 0.06  # m a m that the ground may fall ahead
    curve_slope: float = 0.25  # m a m of a curve that takes the place of level ground where its height is known
    lower_m: float = 0.25  # m below the ground from which points refute it: their errors are half of that
    climb: float = 0.1  # m a m that the ground may climb from one scan to another: ramps and hills
    most_climb_m: float = 0.15  # m of that, at most: boxes are higher
    agreeing_m: float = 0.1  # m between two cameras that saw the same ground, at least, until it is believed
    ground_width_m: float = 3.0  # m that it is wide by then: tables are narrower
    known_for_m: float = 8.0  # m of flight without a view of the ground after which its height is unknown
    ground_m: float = 0.06  # m above or below the curve that is still ground: half a door sill
    ground_sigmas: float = 2.5  # the same in standard deviations of the measured height
    ground_most_m: float = 0.15  # m; farther above or below nothing is ground, however uncertain: it may be a low box
    columns: int = 64  # of a scan over the field of view: 1.3 degrees each, 0.1 m at 5 m; 80 to 110 bytes in all
    bands_m: tuple[float, ...] = (0.1, 0.5, 1.2, 2.0)  # m above ground between which obstacles count: foot, table, head
    least_known: float = 0.7  # of a column's pixels below the horizon: among more unknown ones an obstacle may hide
    column_pixels: int = 5  # of an obstacle in a column, at least: fewer are chance
    slab_m: float = 0.2  # m above and below the camera within which the line of sight must be clear: a small drone
    max_range_m: float = 60.0  # m; farther ground and obstacles are left out
    max_range_sigma: float = 0.1  # relative deviation of a range, at most: a disparity of 2.5 px
