"""From radiance to grey values: motion blur and rolling shutter, vignette, exposure, noise, quantisation."""

import numpy as np

from kiteline_core.arrays import F32, F64, U8
from kiteline_core.jit import njit

_MIN_STREAK_PX = 0.7  # resampling would blur more than a shorter streak
_MAX_TAPS = 17


@njit
def motion_blur(
    radiance: F32, distance: F32, rays: F32, linear: F64, angular: F64, exposure_s: float, readout_s: float, out: F32
) -> None:
    """Average each pixel along its streak during the exposure. linear, angular: the camera's twist in its own frame.

    A point at distance t along the unit ray d moves by -(v/t + w x d) per second in the camera frame. The streak is
    centred on the middle of the row's exposure; that of the middle row is the frame's stamp. readout_s: time from the
    first row's exposure to the last row's, 0 for a global shutter. The motion is linear within it.
    """
    height, width = radiance.shape
    for y in range(height):
        row_s = readout_s * ((y + 0.5) / height - 0.5)
        late = row_s / exposure_s  # of the row, in exposures
        for x in range(width):
            d0, d1, d2 = rays[y + 1, x + 1, 0], rays[y + 1, x + 1, 1], rays[y + 1, x + 1, 2]
            inverse = 1.0 / distance[y, x]
            fx = -(linear[0] * inverse + angular[1] * d2 - angular[2] * d1)
            fy = -(linear[1] * inverse + angular[2] * d0 - angular[0] * d2)
            fz = -(linear[2] * inverse + angular[0] * d1 - angular[1] * d0)
            along = fx * d0 + fy * d1 + fz * d2
            fx, fy, fz = fx - along * d0, fy - along * d1, fz - along * d2
            ax, ay, az = rays[y + 1, x + 2, 0] - d0, rays[y + 1, x + 2, 1] - d1, rays[y + 1, x + 2, 2] - d2
            bx, by, bz = rays[y + 2, x + 1, 0] - d0, rays[y + 2, x + 1, 1] - d1, rays[y + 2, x + 1, 2] - d2
            aa, ab, bb = ax * ax + ay * ay + az * az, ax * bx + ay * by + az * bz, bx * bx + by * by + bz * bz
            fa, fb = fx * ax + fy * ay + fz * az, fx * bx + fy * by + fz * bz
            determinant = aa * bb - ab * ab
            u = exposure_s * (fa * bb - fb * ab) / determinant
            v = exposure_s * (fb * aa - fa * ab) / determinant
            length = np.sqrt(u * u + v * v)
            if not length > _MIN_STREAK_PX:
                if not abs(late) * length > 0.0:
                    out[y, x] = radiance[y, x]
                    continue
                taps = 1
            else:
                taps = min(_MAX_TAPS, int(length * 1.2) + 2)
            total = 0.0
            for k in range(taps):
                s = (k + 0.5) / taps - 0.5 - late
                px = min(max(x + s * u, 0.0), width - 1.001)
                py = min(max(y + s * v, 0.0), height - 1.001)
                i, j = int(px), int(py)
                gx, gy = px - i, py - j
                top = radiance[j, i] * (1.0 - gx) + radiance[j, i + 1] * gx
                low = radiance[j + 1, i] * (1.0 - gx) + radiance[j + 1, i + 1] * gx
                total += top * (1.0 - gy) + low * gy
            out[y, x] = total / taps


@njit
def expose(radiance: F32, vignette: F32, gain: F64, read: float, shot: float, key: np.uint64, out: U8) -> None:
    """Grey values of a radiance image: vignette, gain, then noise of variance read^2 + shot * value, rounded.

    gain (rows,): rows of a rolling shutter are exposed in another phase of flickering lamps.
    The noise of a pixel depends only on `key` and its position (splitmix64; the sum of four uniforms is nearly normal),
    so frames can be rendered in any order.
    """
    height, width = radiance.shape
    for y in range(height):
        for x in range(width):
            value = radiance[y, x] * vignette[y, x] * gain[y]
            z = key + np.uint64(y * width + x + 1) * np.uint64(0x9E3779B97F4A7C15)
            z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            z = z ^ (z >> np.uint64(31))
            four = (z & np.uint64(0xFFFF)) + ((z >> np.uint64(16)) & np.uint64(0xFFFF))
            four += ((z >> np.uint64(32)) & np.uint64(0xFFFF)) + (z >> np.uint64(48))
            normal = (float(four) - 131070.0) * (1.7320508 / 65536.0)
            value += normal * np.sqrt(read * read + shot * max(value, 0.0))
            out[y, x] = np.uint8(min(255.0, max(0.0, np.floor(value + 0.5))))
