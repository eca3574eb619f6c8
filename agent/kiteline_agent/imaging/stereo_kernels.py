"""Kernels of row-wise stereo matching: coarse search, then sub-pixel alignment in one dimension."""

from __future__ import annotations

import numpy as np

from kiteline_agent.imaging.rectification_kernels import SIDE as PATCH_SIDE
from kiteline_agent.imaging.rectification_kernels import _raw_at, _rectify_patch
from kiteline_core.jit import njit

RADIUS = 4
SIDE = 2 * RADIUS + 1
FINE_STEP_PX = 2.0  # px of the finer level: error left by the coarser one, or by a good prediction


@njit
def _row_costs(patch, image, y, first, mean, total, cost):  # type: ignore[no-untyped-def]
    """Zero-mean SAD of a patch (SIDE, SIDE) int16 with n candidates of a row, the first at left column `first`.

    mean: of the patch. total, cost: (n,) int32, out: sums of the candidates, and their costs. The loops run over the
    candidates, with unsigned indices (no check for negative ones), so that they are vectorised.
    """
    n = cost.shape[0]
    for k in range(n):
        j = np.uint64(k)
        total[j] = 0
        cost[j] = 0
    for r in range(SIDE):
        line = image[y + r - RADIUS, first : first + n + SIDE - 1]
        for c in range(SIDE):
            shifted = line[c : c + n]
            for k in range(n):
                j = np.uint64(k)
                total[j] += np.int32(shifted[j])
    for k in range(n):
        j = np.uint64(k)
        total[j] = mean - total[j] // (SIDE * SIDE)
    for r in range(SIDE):
        line = image[y + r - RADIUS, first : first + n + SIDE - 1]
        for c in range(SIDE):
            shifted = line[c : c + n]
            here = np.int32(patch[r, c])
            for k in range(n):
                j = np.uint64(k)
                cost[j] += np.int32(abs(np.int32(here - shifted[j] - total[j])))


@njit
def search_rows(left, right, uv, octave, max_disparity_px, uniqueness, disparity):  # type: ignore[no-untyped-def]
    """Coarse disparity of pixels by zero-mean SAD over whole rows, at pyramid level max(octave, 1).

    left, right: tuples of uint8 pyramids. uv: (n,2) level-0 px. uniqueness: the second-best cost must exceed this
    factor of the best. disparity: (n,) float64 out, level-0 px, -1 without a unique match.
    """
    levels = len(left)
    patch = np.empty((SIDE, SIDE), np.int16)
    total = np.empty(left[0].shape[1], np.int32)
    cost = np.empty(left[0].shape[1], np.int32)
    for i in range(uv.shape[0]):
        disparity[i] = -1.0
        level = min(max(int(octave[i]), 1), levels - 1)
        a = left[level]
        b = right[level]
        h, w = a.shape
        s = float(1 << level)
        x = int(uv[i, 0] / s + 0.5)
        y = int(uv[i, 1] / s + 0.5)
        if x < RADIUS or y < RADIUS or x >= w - RADIUS or y >= h - RADIUS:
            continue
        mean = 0
        for r in range(SIDE):
            for c in range(SIDE):
                patch[r, c] = a[y + r - RADIUS, x + c - RADIUS]
                mean += patch[r, c]
        mean = mean // (SIDE * SIDE)
        reach = min(int(max_disparity_px / s) + 1, x - RADIUS)
        nearest = -1 if x + 1 + RADIUS < w else 0
        n = reach - nearest + 1  # candidate k lies at disparity reach - k
        _row_costs(patch, b, y, x - reach - RADIUS, np.int32(mean), total[0:n], cost[0:n])
        best = 1 << 30
        second = 1 << 30
        best_d = -1
        for d in range(nearest, reach + 1):
            at = cost[reach - d]
            if at < best:
                if d - best_d > 2:
                    second = best
                best = at
                best_d = d
            elif at < second and d - best_d > 2:
                second = at
        if best < (1 << 30) and second > uniqueness * best:
            disparity[i] = max(best_d * s, 0.0)


@njit
def _cut(image, x, y, patch, gradient):  # type: ignore[no-untyped-def]
    """Patch around (x, y) of a level, zero-mean, and its gradient along the row made orthogonal to gain and offset.

    Returns the sums of squares of both. The caller keeps RADIUS + 2 px from the border.
    """
    y0 = int(y)
    fy = y - y0
    x0 = int(x)
    fx = x - x0
    line = np.empty(SIDE + 3)
    mean = 0.0
    mg = 0.0
    for r in range(SIDE):
        row = y0 + r - RADIUS
        for c in range(SIDE + 3):
            col = x0 + c - RADIUS - 1
            line[c] = (1.0 - fy) * image[row, col] + fy * image[row + 1, col]
        for c in range(SIDE):
            v = (1.0 - fx) * line[c + 1] + fx * line[c + 2]
            gv = 0.5 * ((1.0 - fx) * (line[c + 2] - line[c]) + fx * (line[c + 3] - line[c + 1]))
            patch[r, c] = v
            gradient[r, c] = gv
            mean += v
            mg += gv
    mean /= SIDE * SIDE
    mg /= SIDE * SIDE
    tt = 1e-9
    tg = 0.0
    for r in range(SIDE):
        for c in range(SIDE):
            patch[r, c] -= mean
            gradient[r, c] -= mg
            tt += patch[r, c] * patch[r, c]
            tg += patch[r, c] * gradient[r, c]
    hess = 0.0
    for r in range(SIDE):
        for c in range(SIDE):
            gradient[r, c] -= tg / tt * patch[r, c]
            hess += gradient[r, c] * gradient[r, c]
    return tt, hess


@njit
def _strip_of(image, first, columns, y, strip):  # type: ignore[no-untyped-def]
    """Fill strip (SIDE, >= columns) with the rows around y of a level, from column `first` on."""
    y0 = int(y)
    fy = y - y0
    for r in range(SIDE):
        row = y0 + r - RADIUS
        for c in range(columns):
            strip[r, c] = (1.0 - fy) * image[row, first + c] + fy * image[row + 1, first + c]


@njit
def _raw_strip_of(image, grid, scale, first, columns, y, strip):  # type: ignore[no-untyped-def]
    """Fill the strip by rectifying the raw image; False outside of it.

    Distortion along a row is a parabola through three pixels: accurate to 0.02 px over the coarsest level.
    """
    h, w = image.shape
    last = columns - 1.0
    inverse = 1.0 / scale
    for r in range(SIDE):
        row = (y + r - RADIUS) * scale
        u0, v0 = _raw_at(grid, first * scale, row)
        u1, v1 = _raw_at(grid, (first + 0.5 * last) * scale, row)
        u2, v2 = _raw_at(grid, (first + last) * scale, row)
        u0, v0, u1, v1, u2, v2 = u0 * inverse, v0 * inverse, u1 * inverse, v1 * inverse, u2 * inverse, v2 * inverse
        if min(u0, u2) < 0.0 or max(u0, u2) >= w - 1.5 or min(v0, v1, v2) < 0.5 or max(v0, v1, v2) >= h - 1.5:
            return False
        bu, bv = (4.0 * u1 - 3.0 * u0 - u2) / last, (4.0 * v1 - 3.0 * v0 - v2) / last
        cu, cv = 2.0 * (u0 - 2.0 * u1 + u2) / (last * last), 2.0 * (v0 - 2.0 * v1 + v2) / (last * last)
        for c in range(columns):
            px = u0 + c * (bu + c * cu)
            py = v0 + c * (bv + c * cv)
            x0 = int(px)
            y0 = int(py)
            fx = px - x0
            fy = py - y0
            a = float(image[y0, x0])
            b = float(image[y0 + 1, x0])
            top = a + fx * (float(image[y0, x0 + 1]) - a)
            bottom = b + fx * (float(image[y0 + 1, x0 + 1]) - b)
            strip[r, c] = top + fy * (bottom - top)
    return True


@njit
def _slide(strip, first, patch, gradient, tt, hess, begin, width, iterations, max_step_px):  # type: ignore[no-untyped-def]
    """Align the patch along a strip. Returns the column (px of the level) and the correlation, -1 on failure."""
    xr = begin
    ncc = 0.0
    converged = False
    for k in range(iterations + 1):
        if xr < RADIUS or xr >= width - RADIUS - 1 or abs(xr - begin) > max_step_px:
            return xr, -1.0
        c0 = int(xr)
        fr = xr - c0
        base = c0 - RADIUS - first
        si = 0.0
        sii = 0.0
        st = 0.0
        sg = 0.0
        for r in range(SIDE):
            for c in range(SIDE):
                v1 = strip[r, base + c]
                v = v1 + fr * (strip[r, base + c + 1] - v1)
                si += v
                sii += v * v
                st += v * patch[r, c]
                sg += v * gradient[r, c]
        ncc = st / np.sqrt(tt * max(sii - si * si / (SIDE * SIDE), 1e-9))
        gain = st / tt
        if gain < 0.1:
            return xr, -1.0
        if converged or k == iterations:
            break
        move = min(max(-sg / (hess * gain), -1.5), 1.5)
        xr += move
        converged = abs(move) < 0.01
    return xr, ncc


@njit
def refine_rows(  # type: ignore[no-untyped-def]
    left, left_grid, right, grid, uv, octave, sure, iterations, max_step_px, min_ncc, disparity, found
):
    """Sub-pixel disparity by 1-D Lucas-Kanade, invariant to gain and offset, at level `octave` (and one coarser first).

    left_grid: (0,0,2), or the grid of level 0 of `left`, which is then raw; its coarser levels are rectified.
    grid: (0,0,2) if `right` is rectified; else `right` is the raw image's pyramid, and grid (gh,gw,2) float32 the raw
    pixel of every GRID_STEP-th rectified one, so that only the strips are rectified.
    sure: (n,) bool, the prediction is good to a pixel of its octave: the coarser level is skipped.
    disparity: (n,) float64 px at level 0: prediction in (negative: skip), result out. found: (n,) bool out.
    max_step_px: largest distance of the match from the prediction, in px of the level.
    """
    levels = len(left)
    patch = np.empty((SIDE, SIDE))
    gradient = np.empty((SIDE, SIDE))
    strip = np.empty((SIDE, SIDE + 2 * int(np.ceil(max(max_step_px, FINE_STEP_PX))) + 4))
    raw = grid.shape[0] > 0
    raw_left = left_grid.shape[0] > 0
    whole = np.empty((PATCH_SIDE, PATCH_SIDE), np.uint8)
    for i in range(uv.shape[0]):
        found[i] = False
        if disparity[i] < 0.0:
            continue
        d = disparity[i]
        ok = False
        for step in range(1 if sure[i] else 0, 2):
            reach_px = max_step_px if step == 0 else min(max_step_px, FINE_STEP_PX)
            reach = int(np.ceil(reach_px)) + 1
            level = min(int(octave[i]) + 1 - step, levels - 1)
            h, w = left[level].shape
            s = float(1 << level)
            x = uv[i, 0] / s
            y = uv[i, 1] / s
            ok = False
            if x < RADIUS + 1 or y < RADIUS or x >= w - RADIUS - 2 or y >= h - RADIUS - 1:
                continue
            begin = x - d / s
            if begin < RADIUS or begin >= w - RADIUS - 1:
                continue
            if raw_left and level == 0:
                x0 = int(x) - RADIUS - 1
                y0 = int(y) - RADIUS
                if not _rectify_patch(left[0], left_grid, x0, y0, whole):
                    continue
                tt, hess = _cut(whole, x - x0, y - y0, patch, gradient)
            else:
                tt, hess = _cut(left[level], x, y, patch, gradient)
            if hess < 30.0:
                continue
            first = max(int(begin) - RADIUS - reach, 0)
            columns = min(int(begin) + RADIUS + reach + 2, w) - first
            if raw:
                if not _raw_strip_of(right[level], grid, s, first, columns, y, strip):
                    continue
            else:
                _strip_of(right[level], first, columns, y, strip)
            xr, ncc = _slide(strip, first, patch, gradient, tt, hess, begin, w, iterations, reach_px)
            if ncc >= min_ncc or (step == 0 and ncc > 0.6):
                d = (x - xr) * s
                ok = step == 1
        if ok and d > 0.0:
            disparity[i] = d
            found[i] = True
