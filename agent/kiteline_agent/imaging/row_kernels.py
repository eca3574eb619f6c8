"""Kernels that measure how far a right image lies above or below the rows of the left one."""

import numpy as np

from kiteline_agent.imaging.rectification_kernels import _raw_at
from kiteline_core.jit import njit

RADIUS = 4
SIDE = 2 * RADIUS + 1
MAX_STEP_PX = 1.0  # px of the level: Gauss-Newton steps are cut here, where the patches hardly overlap in phase
CONVERGED_PX = 0.02  # px of the level
LEAST_PIVOT = 100.0  # sum of squared gradients across the weaker direction: less is an edge, along which rows slide


@njit
def _dots(a, b, c, d):  # type: ignore[no-untyped-def]
    """Sums of products of a patch with itself and with three others: in one loop none waits for another."""
    aa, ab, ac, ad = 0.0, 0.0, 0.0, 0.0
    for r in range(SIDE):
        for k in range(SIDE):
            aa += a[r, k] * a[r, k]
            ab += a[r, k] * b[r, k]
            ac += a[r, k] * c[r, k]
            ad += a[r, k] * d[r, k]
    return aa, ab, ac, ad


@njit
def _take_off(a, share, b):  # type: ignore[no-untyped-def]
    """a -= share b."""
    for r in range(SIDE):
        for c in range(SIDE):
            a[r, c] -= share * b[r, c]


@njit
def _cut(image, x, y, patch, gu, gv):  # type: ignore[no-untyped-def]
    """Patch around (x, y), zero-mean, and its gradients made orthogonal to gain and offset; its sum of squares.

    Sums are written as loops: array expressions would allocate an array each.
    """
    x0, y0 = int(x), int(y)
    fx, fy = x - x0, y - y0
    w00, w01, w10, w11 = (1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy
    wide = np.empty((SIDE + 2, SIDE + 2))
    for r in range(SIDE + 2):
        a = y0 + r - RADIUS - 1
        for c in range(SIDE + 2):
            b = x0 + c - RADIUS - 1
            wide[r, c] = (
                w00 * image[a, b] + w01 * image[a, b + 1] + w10 * image[a + 1, b] + w11 * image[a + 1, b + 1]
            )  # fmt: skip
    mean, mean_u, mean_v = 0.0, 0.0, 0.0
    for r in range(SIDE):
        for c in range(SIDE):
            patch[r, c] = wide[r + 1, c + 1]
            gu[r, c] = 0.5 * (wide[r + 1, c + 2] - wide[r + 1, c])
            gv[r, c] = 0.5 * (wide[r + 2, c + 1] - wide[r, c + 1])
            mean += patch[r, c]
            mean_u += gu[r, c]
            mean_v += gv[r, c]
    mean, mean_u, mean_v = mean / (SIDE * SIDE), mean_u / (SIDE * SIDE), mean_v / (SIDE * SIDE)
    for r in range(SIDE):
        for c in range(SIDE):
            patch[r, c] -= mean
            gu[r, c] -= mean_u
            gv[r, c] -= mean_v
    tt, _, tu, tv = _dots(patch, patch, gu, gv)
    tt += 1e-9
    _take_off(gu, tu / tt, patch)
    _take_off(gv, tv / tt, patch)
    return tt


@njit
def _sample(image, grid, scale, x, y, out):  # type: ignore[no-untyped-def]
    """Patch of the right image around rectified (x, y) of a level, zero-mean; False outside. Distortion is affine over
    it.
    """
    h, w = image.shape
    u, v, uu, uv, vu, vv = x, y, 1.0, 0.0, 0.0, 1.0
    if grid.shape[0] > 0:
        d = RADIUS * scale
        u, v = _raw_at(grid, x * scale, y * scale)
        ur, vr = _raw_at(grid, x * scale + d, y * scale)
        ul, vl = _raw_at(grid, x * scale - d, y * scale)
        ub, vb = _raw_at(grid, x * scale, y * scale + d)
        ut, vt = _raw_at(grid, x * scale, y * scale - d)
        uu, vu, uv, vv = (ur - ul) / (2.0 * d), (vr - vl) / (2.0 * d), (ub - ut) / (2.0 * d), (vb - vt) / (2.0 * d)
        u, v = u / scale, v / scale
    room = 1.5 * RADIUS + 2.0
    if u < room or v < room or u > w - 1.0 - room or v > h - 1.0 - room:
        return False
    mean = 0.0
    for r in range(SIDE):
        for c in range(SIDE):
            du, dv = c - RADIUS, r - RADIUS
            px, py = u + uu * du + uv * dv, v + vu * du + vv * dv
            a, b = int(py), int(px)
            fx, fy = px - b, py - a
            top = image[a, b] * (1.0 - fx) + image[a, b + 1] * fx
            bottom = image[a + 1, b] * (1.0 - fx) + image[a + 1, b + 1] * fx
            out[r, c] = top + fy * (bottom - top)
            mean += out[r, c]
    mean = mean / (SIDE * SIDE)
    for r in range(SIDE):
        for c in range(SIDE):
            out[r, c] -= mean
    return True


@njit
def measure_rows(  # type: ignore[no-untyped-def]
    left, right, grid, uv, octave, disparity, iterations, max_px, min_ncc, offset_px, found
):
    """Row in the right image less that in the left one, by 2-D Lucas-Kanade, invariant to gain and offset.

    left: rectified pyramid. right, grid: see `stereo_kernels.refine_rows`. uv (n,2) px. disparity (n,) px: predictions,
    negative to skip. max_px: largest offset, in px of the level. offset_px (n,): out, px at level 0. found (n,): out.
    """
    levels = len(left)
    patch, gu, gv, other = (np.empty((SIDE, SIDE)), np.empty((SIDE, SIDE)), np.empty((SIDE, SIDE)),
                            np.empty((SIDE, SIDE)))  # fmt: skip
    for i in range(uv.shape[0]):
        found[i] = False
        if disparity[i] < 0.0:
            continue
        level = min(int(octave[i]), levels - 1)
        h, w = left[level].shape
        s = float(1 << level)
        x, y = uv[i, 0] / s, uv[i, 1] / s
        if x < RADIUS + 1 or y < RADIUS + 1 or x >= w - RADIUS - 3 or y >= h - RADIUS - 3:
            continue
        tt = _cut(left[level], x, y, patch, gu, gv)
        huu, huv, _, _ = _dots(gu, gv, gv, gv)
        hvv, _, _, _ = _dots(gv, gv, gv, gv)
        pivot = hvv - huv * huv / max(huu, 1e-9)
        if pivot < LEAST_PIVOT or huu < LEAST_PIVOT:
            continue
        xr, yr = x - disparity[i] / s, y
        for _ in range(iterations):
            if not _sample(right[level], grid, s, xr, yr, other):
                break
            square, along, bu, bv = _dots(other, patch, gu, gv)
            gain = along / tt
            ncc = gain * np.sqrt(tt / max(square, 1e-9))
            if gain < 0.1:
                break
            bu, bv = -bu / gain, -bv / gain
            dv = (bv - huv / huu * bu) / pivot
            du = (bu - huv * dv) / huu
            if abs(du) < CONVERGED_PX and abs(dv) < CONVERGED_PX:
                found[i] = ncc >= min_ncc
                break
            xr += min(max(du, -MAX_STEP_PX), MAX_STEP_PX)
            yr += min(max(dv, -MAX_STEP_PX), MAX_STEP_PX)
            if abs(yr - y) > max_px or abs(xr - x + disparity[i] / s) > max_px:
                break
        offset_px[i] = (yr - y) * s
