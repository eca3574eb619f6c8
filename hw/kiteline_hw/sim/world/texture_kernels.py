"""Paints opaque shapes onto a square texture that wraps around."""

import numpy as np

from kiteline_core.arrays import F32, I32
from kiteline_core.jit import njit


@njit
def paint(shapes: F32, kinds: I32, out: F32) -> None:
    """Paint shapes in order, later ones over earlier ones; `out` (n, n), n a power of two, wraps around.

    shapes (m, 9): centre x y, half-sides a b in texels, cos and sin of the rotation, value, its gradient along a and b
    over the shape. kinds: 0 ellipse, 1 rectangle, 2 triangle, 3 ring.
    """
    mask = out.shape[0] - 1
    for i in range(shapes.shape[0]):
        cx, cy, a, b, c, s, value, ga, gb = shapes[i]
        reach_x = abs(c) * a + abs(s) * b
        reach_y = abs(s) * a + abs(c) * b
        kind = kinds[i]
        ia, ib = 1.0 / a, 1.0 / b
        for y in range(int(np.floor(cy - reach_y)), int(np.ceil(cy + reach_y)) + 1):
            for x in range(int(np.floor(cx - reach_x)), int(np.ceil(cx + reach_x)) + 1):
                dx, dy = x - cx, y - cy
                p, q = (c * dx + s * dy) * ia, (c * dy - s * dx) * ib
                if kind == 1:
                    inside = abs(p) <= 1.0 and abs(q) <= 1.0
                elif kind == 2:
                    inside = q >= -1.0 and q <= 1.0 and abs(p) <= 0.5 * (1.0 - q)
                else:
                    r = p * p + q * q
                    inside = r <= 1.0 and (kind == 0 or r >= 0.55)
                if inside:
                    out[y & mask, x & mask] = value + ga * p + gb * q
