"""Errors of a calibrated lens: eight factors that move pixels over focal length from where a true camera has them.

A pixel at (x, y), r from the axis, is moved by (x, y) (focal + r^2 radial + r^4 outer) + centre, and by a small
rotation of the camera in the body, which a shift of the centre resembles.
"""

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.geometry.cameras import RectifiedCamera

TERMS = 8  # focal, centre x, centre y, radial, outer, rotation about x, y, z of the camera
FARTHEST = 1.0  # r^2 beyond which the radial factors grow no more: outside of all but the widest images
_ITERATIONS = 4


def moved(xy: F64, lens: F64) -> F64:
    """Where the calibrated camera shows true places (...,2). lens: (8,)."""
    x, y = xy[..., 0], xy[..., 1]
    square = np.minimum(x * x + y * y, FARTHEST)
    radial = lens[0] + square * (lens[3] + square * lens[4])
    about_x, about_y, about_z = lens[5:]
    return np.stack(
        [
            x * (1.0 + radial) + lens[1] + x * y * about_x - (1.0 + x * x) * about_y + y * about_z,
            y * (1.0 + radial) + lens[2] + (1.0 + y * y) * about_x - x * y * about_y - x * about_z,
        ],
        axis=-1,
    )


def true_place(shown: F64, lens: F64) -> F64:
    """True places (...,2) of what the calibrated camera shows there: the inverse of `moved`."""
    xy = shown
    for _ in range(_ITERATIONS):
        xy = xy - (moved(xy, lens) - shown)
    return xy


def rms_px(lens: F64, camera: RectifiedCamera) -> float:
    """Error of the lens over the image, px, without what shifts and turns all of the image alike."""
    x, y = np.meshgrid(np.linspace(0.0, camera.width, 9), np.linspace(0.0, camera.height, 7))
    xy = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy], axis=-1).reshape(-1, 2)
    inner = lens.copy()
    inner[1:3] = inner[5:] = 0.0
    off = (moved(xy, inner) - xy) * [camera.fx, camera.fy]
    return float(np.sqrt(np.mean(np.sum(off * off, axis=1))))
