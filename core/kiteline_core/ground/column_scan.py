"""What one keyframe saw of ground and obstacles, by columns of azimuth in the levelled camera frame."""

import math
from dataclasses import dataclass

import numpy as np

from kiteline_core.arrays import F64, U8

MAX_COLUMNS = 128
_LEAST_FORWARD = 0.05  # horizontal part of a viewing direction, below which the image's up says what is ahead


@dataclass(frozen=True, slots=True)
class ColumnScan:
    """Ground and obstacles around a camera, in its levelled frame l (`level_rotation`); ranges are horizontal, in m.

    up_c: (3,) unit vector against gravity in c. Column i of n looks to azimuth0_rad + i azimuth_step_rad,
    counter-clockwise from x of l, seen from above.
    free_from_m, free_m: (n,) from where and up to where ground was seen, before the obstacle or, over a low one, behind
    it; both 0 where none was. Up to an obstacle's foot free_m is obstacle_m: how far before it cells are free is up to
    who draws them. What was not seen is unknown, never free.
    obstacle_m: (n,) to the nearest obstacle within the height bands above the ground; inf where none was seen.
    bands: (n,) uint8, bit i set if that obstacle reaches into height band i; 0 without an obstacle.
    clear_m: (n,) up to where nothing stands at the height of the camera; 0 if that was not seen.
    camera_height_m: of the camera above the ground that it saw, or that earlier scans saw; NaN if neither did.
    """

    up_c: F64
    azimuth0_rad: float
    azimuth_step_rad: float
    free_from_m: F64
    free_m: F64
    obstacle_m: F64
    bands: U8
    clear_m: F64
    camera_height_m: float

    def __len__(self) -> int:
        """Number of columns."""
        return len(self.free_m)

    @property
    def azimuths_rad(self) -> F64:
        """Azimuth (n,) of each column's middle."""
        return self.azimuth0_rad + self.azimuth_step_rad * np.arange(len(self), dtype=np.float64)


def level_rotation(up_c: F64) -> F64:
    """R_c_l (3,3): the levelled frame l in the camera: z up, x along the horizontal viewing direction, y left.

    up_c: (3,) unit vector against gravity in the camera. A camera that looks straight up or down has no horizontal
    viewing direction: then that side of the image is ahead that lay ahead before the camera was tilted so far.
    """
    x, y, z = up_c.tolist()
    n = math.sqrt(x * x + y * y + z * z)
    x, y, z = x / n, y / n, z / n
    ahead = -z * x, -z * y, 1.0 - z * z
    if math.hypot(*ahead) < _LEAST_FORWARD:
        image_up = -1.0 if z < 0.0 else 1.0
        ahead = -image_up * y * x, image_up - image_up * y * y, -image_up * y * z
    n = math.hypot(*ahead)
    a, b, c = ahead[0] / n, ahead[1] / n, ahead[2] / n
    return np.array((a, y * c - z * b, x, b, z * a - x * c, y, c, x * b - y * a, z)).reshape(3, 3)
