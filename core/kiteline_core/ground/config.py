"""Options of ground segmentation."""

from dataclasses import dataclass
from typing import ClassVar

_MOST_DISPARITIES = 128  # px: a third of the narrowest half-size images
_COLUMNS = 8, 100  # least and most: a record holds 128, with those of the wider view


@dataclass(frozen=True, slots=True)
class GroundConfig:
    """Ground segmentation and column scans. Pixels are those of the half-size image."""

    MAY_BE_ZERO: ClassVar = ("wider", "lower")

    wider: float = 0.085  # of the rectified width that scans see more of to both sides: 64 px of 70 to 110; 0: no more
    lower: float = 0.067  # of its height by which their view lies lower: 32 of 480 px, of 15 to 70; 0: not lower
    disparities: int = 48  # px searched, a multiple of 16: from 0.5 m on with 0.11 m of baseline; less CPU if fewer
    stripes: int = 2  # in which a pair is matched, one a frame: 2 ms each of a fast core at 752x480; a whole one is 3.5
    sigma_px: float = 0.25  # px; error of a disparity
    depth_sigma: float = 2.85e-3  # 1/m; error of inverse depth of a depth camera (K. Khoshelham, S. Elberink, 2012)
    largest_height_m: float = 8.0  # m of the camera above the ground, at most: from higher up, disparities say little
    ground_m: float = 0.06  # m above or below the curve that is still ground: half a door sill
    columns: int = 64  # of a scan over the field of view: 1.3 degrees each, 0.1 m at 5 m; 80 to 110 bytes in all
    bands_m: tuple[float, ...] = (0.1, 0.5, 1.2, 2.0)  # m above ground between which obstacles count: foot, table, head
    slab_m: float = 0.2  # m above and below the camera within which the line of sight must be clear: a small drone

    def __post_init__(self) -> None:
        if self.disparities % 16 or not 0 < self.disparities <= _MOST_DISPARITIES:
            raise ValueError(f"disparities: expected a multiple of 16, at most {_MOST_DISPARITIES}")
        if not _COLUMNS[0] <= self.columns <= _COLUMNS[1]:
            raise ValueError(f"columns: expected {_COLUMNS[0]} to {_COLUMNS[1]}")
