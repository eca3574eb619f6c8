"""Kernels of row-wise stereo matching: coarse search, then sub-pixel alignment in one dimension."""

import numpy as np

from kiteline_agent.imaging.alignment_kernels import GREY, LANES, STRIDE, dot
from kiteline_agent.imaging.rectification_kernels import _rectify_patch
from kiteline_core.jit import njit

RADIUS = 4
SIDE = 2 * RADIUS + 1
LEAST_SLOPES = 30.0  # sum of squared slopes in grey levels a px, made orthogonal to gain and offset; less is flat
FINE_STEP_PX = 2.0  # px of the finer level: error left by the coarser one, or by a good prediction


@njit
def _row_costs(patch, image, y, first, mean, columns, total, cost):  # type: ignore[no-untyped-def]
    """Zero-mean SAD of a patch (SIDE, SIDE) int16 with n candidates of a row, the first at left column `first`.

    mean: of the patch. columns: (n + SIDE - 1,) int32, sums of the image's columns, out. total, cost: (n,) int32, out:
    sums of the candidates, and their costs. The loops run over the candidates, with unsigned indices (no check for
    negative ones), so that they are vectorised.
    """
    n = cost.shape[0]
    for k in range(n + SIDE - 1):
        columns[np.uint64(k)] = 0
    for r in range(SIDE):
        line = image[y + r - RADIUS, first : first + n + SIDE - 1]
        for k in range(n + SIDE - 1):
            j = np.uint64(k)
            columns[j] += np.int32(line[j])
    for k in range(n):
        j = np.uint64(k)
        t = np.int32(0)
        for c in range(SIDE):
            t = np.int32(t + columns[np.uint64(k + c)])
        total[j] = mean - t // (SIDE * SIDE)
        cost[j] = 0
    for r in range(SIDE):
        line = image[y + r - RADIUS, first : first + n + SIDE - 1]
        here = patch[r]
        for k in range(n):
            j = np.uint64(k)
            t = cost[j]
            for c in range(SIDE):
                t = np.int32(t + abs(np.int32(here[np.uint64(c)] - line[np.uint64(k + c)] - total[j])))
            cost[j] = t


@njit
def search_rows(left, right, uv, octave, max_disparity_px, uniqueness, disparity):  # type: ignore[no-untyped-def]
    """Coarse disparity of pixels by zero-mean SAD over whole rows, at pyramid level max(octave, 1).

    left, right: tuples of uint8 pyramids. uv: (n,2) level-0 px. uniqueness: the second-best cost must exceed this
    factor of the best. disparity: (n,) float64 out, level-0 px, -1 without a unique match.
    """
    levels = len(left)
    patch = np.empty((SIDE, SIDE), np.int16)
    columns = np.empty(left[0].shape[1] + SIDE, np.int32)
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
        _row_costs(patch, b, y, x - reach - RADIUS, np.int32(mean), columns, total[0:n], cost[0:n])
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
def _sample_columns(image, left, top, columns, out):  # type: ignore[no-untyped-def]
    """Fill out[:columns, :SIDE] with the image from (left, top) on, in 1/GREY grey levels."""
    x0 = int(left)
    y0 = int(top)
    fx = np.int32((left - x0) * 128.0 + 0.5)
    fy = np.int32((top - y0) * 128.0 + 0.5)
    for r in range(SIDE):
        upper = image[y0 + r, x0 : x0 + columns + 1]
        lower = image[y0 + r + 1, x0 : x0 + columns + 1]
        to = np.uint64(r)
        a = np.int32(upper[0])
        before = (a << 7) + fy * (np.int32(lower[0]) - a)
        for k in range(columns):
            a = np.int32(upper[np.uint64(k + 1)])
            here = (a << 7) + fy * (np.int32(lower[np.uint64(k + 1)]) - a)
            out[np.uint64(k), to] = ((before << 7) + fx * (here - before) + 512) >> 10
            before = here


@njit
def _sample_slanted(image, left, top, stretch, shear, out):  # type: ignore[no-untyped-def]
    """Fill out[: SIDE + 2, :SIDE] with the image from (left, top) on, as `_rectify_patch` does; all inside of it."""
    first = left - shear * RADIUS
    y0 = int(top)
    fy = np.int32((top - y0) * 128.0 + 0.5)
    for r in range(SIDE):
        upper = image[y0 + r]
        lower = image[y0 + r + 1]
        to = np.uint64(r)
        x = first + shear * r
        for k in range(SIDE + 2):
            x0 = int(x)
            fx = np.int32((x - x0) * 128.0 + 0.5)
            a = np.int32(upper[x0])
            b = np.int32(lower[x0])
            above = (a << 7) + fx * (np.int32(upper[x0 + 1]) - a)
            below = (b << 7) + fx * (np.int32(lower[x0 + 1]) - b)
            out[np.uint64(k), to] = ((above << 7) + fy * (below - above) + 512) >> 10
            x += stretch


@njit
def _put_template(wide, patches):  # type: ignore[no-untyped-def]
    """Write the template (row 0 of patches) and twice its gradient along the row (1), by wide (SIDE + 2, STRIDE)."""
    grey = wide.reshape(-1)
    for k in range(LANES):
        j = np.uint64(k)
        patches[0, j] = grey[np.uint64(k + STRIDE)]
        patches[1, j] = grey[np.uint64(k + 2 * STRIDE)] - grey[j]


@njit
def _slide(strip, first, patches, begin, width, iterations, max_step_px):  # type: ignore[no-untyped-def]
    """Align the template along a strip. Returns the column (px of the level) and the correlation, -1 on failure.

    strip: (columns * STRIDE,) int16, columns of SIDE pixels, the first at column `first`. patches: (3, LANES) int16:
    the template, twice its gradient, and ones, in columns as well. Gain and offset drop out as in `alignment_kernels`.
    The patch between two columns is interpolated: so are its sums.
    """
    t, g, ones = patches[0], patches[1], patches[2]
    count = float(SIDE * SIDE)
    mean = dot(t, ones) / count
    mean_g = dot(g, ones) / count
    tt = dot(t, t) - count * mean * mean + 1e-9
    share = (dot(t, g) - count * mean * mean_g) / tt
    hess = dot(g, g) - count * mean_g * mean_g - share * share * tt
    if hess < LEAST_SLOPES * 4.0 * GREY * GREY:
        return begin, -1.0
    xr = begin
    converged = False
    at = -1
    a = b = strip[:LANES]
    t0, g0, n0, t1, g1, n1 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(iterations + 1):
        if xr < RADIUS or xr >= width - RADIUS - 1 or abs(xr - begin) > max_step_px:
            return xr, -1.0
        c0 = int(xr)
        f = xr - c0
        if c0 != at:
            at = c0
            from_ = (c0 - RADIUS - first) * STRIDE
            a = strip[from_ : from_ + LANES]
            b = strip[from_ + STRIDE : from_ + STRIDE + LANES]
            t0, g0, n0 = float(dot(a, t)), float(dot(a, g)), float(dot(a, ones))
            t1, g1, n1 = float(dot(b, t)), float(dot(b, g)), float(dot(b, ones))
        total = n0 + f * (n1 - n0)
        st = t0 + f * (t1 - t0) - mean * total
        gain = st / tt
        if gain < 0.1:
            return xr, -1.0
        if converged or k == iterations:
            e = 1.0 - f
            square = e * e * dot(a, a) + 2.0 * e * f * dot(a, b) + f * f * dot(b, b)
            return xr, st / np.sqrt(tt * max(square - total * total / count, 1e-9))
        sg = g0 + f * (g1 - g0) - mean_g * total - share * st
        move = min(max(-2.0 * sg / (hess * gain), -1.5), 1.5)
        xr += move
        converged = abs(move) < 0.01
    return xr, -1.0


@njit
def refine_rows(  # type: ignore[no-untyped-def]
    left, left_grid, right, grid, uv, octave, sure, slopes, iterations, max_step_px, min_ncc, disparity, found
):
    """Sub-pixel disparity by 1-D Lucas-Kanade, invariant to gain and offset, at level `octave` (and one coarser first).

    left_grid, grid: (0,0,2) if `left` or `right` is rectified; else that is the raw image's pyramid, and the grid
    (gh,gw,2) float32 the raw pixel of every GRID_STEP-th rectified one, so that only patches and strips are rectified.
    sure: (n,) bool, the prediction is good to a pixel of its octave: the coarser level is skipped.
    slopes: (n,2) gradient of the disparity by the left pixel: the left patch is sampled so that the right one, which is
    straight, shows the same surface.
    disparity: (n,) float64 px at level 0: prediction in (negative: skip), result out. found: (n,) bool out.
    max_step_px: largest distance of the match from the prediction, in px of the level.
    """
    levels = len(left)
    patches = np.zeros((3, LANES), np.int16)
    for r in range(SIDE):
        for c in range(SIDE):
            patches[2, c * STRIDE + r] = 1
    wide = np.zeros((SIDE + 2, STRIDE), np.int16)  # columns, padded to full vectors
    strip = np.zeros((SIDE + 1 + 2 * int(np.ceil(max(max_step_px, FINE_STEP_PX))), STRIDE), np.int16)
    raw = grid.shape[0] > 0
    raw_left = left_grid.shape[0] > 0
    for i in range(uv.shape[0]):
        found[i] = False
        if disparity[i] < 0.0:
            continue
        d = disparity[i]
        ok = False
        for step in range(1 if sure[i] else 0, 2):
            reach_px = max_step_px if step == 0 else min(max_step_px, FINE_STEP_PX)
            reach = int(np.ceil(reach_px))
            level = min(int(octave[i]) + 1 - step, levels - 1)
            h, w = left[level].shape
            s = float(1 << level)
            x = uv[i, 0] / s
            y = uv[i, 1] / s
            ok = False
            stretch = 1.0 / (1.0 - slopes[i, 0])
            shear = slopes[i, 1] * stretch
            reach_x = (RADIUS + 1) * stretch
            edge = reach_x + RADIUS * abs(shear)
            if x < edge or y < RADIUS or x >= w - edge - 1 or y >= h - RADIUS - 1:
                continue
            begin = x - d / s
            if begin < RADIUS or begin >= w - RADIUS - 1:
                continue
            if raw_left:
                if not _rectify_patch(
                    left[level], left_grid, s, x - reach_x, y - RADIUS, SIDE, SIDE + 2, 10, wide, stretch, shear
                ):
                    continue
            elif slopes[i, 0] == 0.0 and slopes[i, 1] == 0.0:
                _sample_columns(left[level], x - RADIUS - 1, y - RADIUS, SIDE + 2, wide)
            else:
                _sample_slanted(left[level], x - reach_x, y - RADIUS, stretch, shear, wide)
            _put_template(wide, patches)
            first = max(int(begin) - RADIUS - reach, 0)
            columns = min(int(begin) + RADIUS + reach + 2, w - 1) - first
            if raw:
                if not _rectify_patch(right[level], grid, s, float(first), y - RADIUS, SIDE, columns, 10, strip):
                    continue
            else:
                _sample_columns(right[level], float(first), y - RADIUS, columns, strip)
            xr, ncc = _slide(strip.reshape(-1), first, patches, begin, w, iterations, reach_px)
            if ncc >= min_ncc or (step == 0 and ncc > 0.6):
                d = (x - xr) * s
                ok = step == 1
        if ok and d > 0.0:
            disparity[i] = d
            found[i] = True
