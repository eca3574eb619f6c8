"""Kernels that collect the labelled pixels of columns to a column scan: where free ground begins and ends."""

import numpy as np

from kiteline_core.ground.level_kernels import BIN_PX
from kiteline_core.jit import njit

_PX = 0.5  # px: half-width of the window in which pixels of one surface lie
_SAME_PX = 0.25  # px between two surfaces that are one
_NEVER = 1 << 30  # pixels
_FALL_BINS = 2  # before the ray on which a fall is seen: matched blocks carry an edge on by half their rows
_SOME_FALL = 3  # pixels of a column below the ground, no farther than its end, from which a fall is near
_STEP_M = 0.06  # by which ground falls within _STEP_OVER_M, beyond a slope of _STEP_SLOPE: a step, no ramp
_STEP_SLOPE, _STEP_OVER_M = 0.15, 0.8
_STEP_PIXELS = 8  # that tell a height on either side of it
_NOTHING, _WALL, _FALL = 0, 1, 2  # before which ground ends
_LEAST_BINS = 3  # of disparity over which ground is seen, at least: less is a wall's foot
_ROWS_APART = 2.0  # rows between two views of ground without a gap: from low above, rows lie farther apart than bins
_SOME_ASTRAY = 3  # pixels of a column that lie beyond the ground on their rays: there is a hole
_OPEN_SIGMAS = 2.0  # standard deviations by which ground that ends before no obstacle ends earlier


@njit
def _mark_falls(grounds, falls, least, fell):  # type: ignore[no-untyped-def]
    """Mark bins (bins,) where as many pixels lie below the ground as on it, `least` or more, and the bins before."""
    bins, total = len(grounds), 0
    for j in range(bins):
        fell[j] = False
        total += falls[j]
    if total < least:
        return
    below, on = falls[0], grounds[0]  # around bin i
    for i in range(bins):
        if i + 1 < bins:
            below += falls[i + 1]
            on += grounds[i + 1]
        if i > 1:
            below -= falls[i - 2]
            on -= grounds[i - 2]
        if below >= least and below >= on:
            for j in range(i, min(i + _FALL_BINS + 1, bins)):
                fell[j] = True


@njit
def _mark_steps(grounds, heights, bf, lowest, means, steps):  # type: ignore[no-untyped-def]
    """Mark bins (bins,) from `lowest` on whose ground lies lower than nearer ground by more than a ramp would.

    heights: sums of z. means: (bins,), out: mean height of the ground around a bin, -inf where too few pixels tell it.
    """
    bins = len(grounds)
    m, highest = 0, -np.inf  # pixels around bin k; highest mean of the bins up to it, which are nearer than bin k - 2
    for k in range(bins - 1, lowest + 1, -1):
        if k == bins - 1:
            m = grounds[k] + grounds[k - 1]
            means[k] = -np.inf
        else:
            m += grounds[k - 1] - (grounds[k + 2] if k + 2 < bins else 0)
            means[k] = (heights[k - 1] + heights[k] + heights[k + 1]) / m if m >= _STEP_PIXELS else -np.inf
        highest = max(highest, means[k])
        j = k - 2
        steps[j] = False
        n = grounds[j] + grounds[j - 1] if j > 0 else grounds[j]
        if n < _STEP_PIXELS:
            continue
        low = ((heights[j - 1] if j > 0 else 0.0) + heights[j]) / n
        if highest - low <= _STEP_M:
            continue
        far = bf / ((j + 0.5) * BIN_PX)
        for i in range(j + 2, bins - 1):
            apart = far - bf / ((i + 0.5) * BIN_PX)
            if apart > _STEP_OVER_M:
                break
            if means[i] - low > _STEP_M + _STEP_SLOPE * apart:
                steps[j] = True
                break
    for j in range(max(bins - 2, 0), bins):
        steps[j] = False


@njit
def _longest_ground(  # type: ignore[no-untyped-def]
    grounds, obstacles, falls, astray, fell, steps, least, begin_m, end_m, lowest, bf, row_per_m, sigma_px, gap_m
):
    """From where and up to where ground was seen in counts (bins,), between two ranges; 0, 0 if it was not.

    And whether it ended before a _WALL, a _FALL or _NOTHING, and whether _SOME_FALL pixels up to its end lie below it.
    The longest part with gaps of at most gap_m, or two deviations of the range, or _ROWS_APART if no pixels are astray
    there, and without `least` pixels of obstacles (bins,) at the same range: those stand there, or hang above. Nor is a
    step within it, nor a fall: see `_mark_steps`, `_mark_falls`. bf: px m along the column. row_per_m: m between two
    rows, over squared m.
    """
    bins = len(grounds)
    half = int(_PX / BIN_PX)
    best_from, best, start, last, ended, below, has_fall = 0.0, 0.0, 0.0, 0.0, _NOTHING, 0, False
    above, wrong = 0, 0  # pixels of obstacles around a bin; those astray since the last ground
    for j in range(bins - half, bins):
        above += obstacles[j]
    for j in range(bins - 1, lowest - 1, -1):
        below += falls[j]
        wrong += astray[j]
        if j >= half:
            above += obstacles[j - half]
        if j + half + 1 < bins:
            above -= obstacles[j + half + 1]
        stops = above >= least or fell[j] or (last > 0.0 and steps[j])
        if not stops and grounds[j] < 2:
            continue
        near = bf / ((j + 1) * BIN_PX)
        if near < begin_m:
            continue
        gap = max(gap_m, 2.0 * near * sigma_px / ((j + 1) * BIN_PX))
        if wrong < _SOME_ASTRAY:
            gap = max(gap, _ROWS_APART * row_per_m * near * near)
        apart = near - last > gap
        if stops:
            wrong = 0
            if last > 0.0 and last == best:
                ended = _FALL if fell[j] or steps[j] else _NOTHING if apart else _WALL
            last = 0.0
            continue
        if near >= end_m:
            break
        if last == 0.0 or apart:
            start = near
        last, wrong = bf / ((j if j else 0.5) * BIN_PX), 0
        if last - start > best - best_from:
            best_from, best, ended, has_fall = start, last, _NOTHING, below >= _SOME_FALL
    if best > 0.0 and bf / BIN_PX * (1.0 / best_from - 1.0 / best) < _LEAST_BINS - 0.5:
        return 0.0, 0.0, ended, False
    return best_from, min(best, end_m), ended, has_fall


@njit
def collect_scan(  # type: ignore[no-untyped-def]
    grounds, heights, obstacles, falls, astray, least, surface, bands, limits, height, azimuth, bf, row_rad, lowest,
    sigma_px, gap_m, free_from, free, obstacle, clear,
):  # fmt: skip
    """Ranges (n,) in m of a column scan from ground and obstacles counted over (n, bins) and surfaces (n,2).

    surface: disparities. bands: (n,) of obstacles; limits: of bands. height: of the camera. azimuth: (n,).
    row_rad: angle between two rows. lowest: least bin that counts. Free is the longest part of the ground, before the
    obstacle or behind; there only where fewer than `least` pixels of obstacles have its range, and it was seen over the
    obstacle, not beside a leg or below a top.
    """
    bins = grounds.shape[1]
    means, fell, steps = np.empty(bins), np.empty(bins, np.bool_), np.empty(bins, np.bool_)
    for c in range(len(grounds)):
        along = 1.0 / np.cos(azimuth[c])
        row_per_m = row_rad / (height * along)
        obstacle[c], free[c], free_from[c], clear[c] = np.inf, 0.0, 0.0, 0.0
        if surface[c, 0] > 0.0:
            obstacle[c] = bf / surface[c, 0] * along
        if surface[c, 1] > 0.0:
            clear[c] = bf / surface[c, 1] * along
            if abs(surface[c, 1] - surface[c, 0]) < _SAME_PX:
                clear[c] = obstacle[c]  # the same surface: the obstacle's mean is that of more pixels
        _mark_falls(grounds[c], falls[c], least, fell)
        _mark_steps(grounds[c], heights[c], bf * along, lowest, means, steps)
        free_from[c], free[c], ended, has_fall = _longest_ground(
            grounds[c], obstacles[c], falls[c], astray[c], fell, steps, _NEVER, 0.0, obstacle[c], lowest, bf * along,
            row_per_m, sigma_px, gap_m,
        )  # fmt: skip
        deviation = obstacle[c] * sigma_px / surface[c, 0] if obstacle[c] < np.inf else 0.0
        if free[c] > 0.0 and ended == _NOTHING and obstacle[c] - free[c] < max(gap_m, 3.0 * deviation):
            free[c] = obstacle[c]  # up to its foot
        elif free[c] > 0.0:
            free[c] = _open_end(free[c], bf * along, sigma_px)
        if has_fall:
            free_from[c] = _open_start(free_from[c], limits[0] / height, bf * along, sigma_px)
        if obstacle[c] < np.inf:
            top = 0
            while bands[c] >> (top + 1):
                top += 1
            if height > limits[top]:
                over = obstacle[c] / (1.0 - limits[top] / height)
                begin, end, ended, _ = _longest_ground(
                    grounds[c], obstacles[c], falls[c], astray[c], fell, steps, least,
                    max(obstacle[c] + 3.0 * deviation, over), np.inf, lowest, bf * along, row_per_m, sigma_px, gap_m,
                )  # fmt: skip
                if ended != _WALL:  # what else stands there is not in the scan
                    end = _open_end(end, bf * along, sigma_px)
                if end - begin > free[c] - free_from[c]:  # seen over a low obstacle
                    free_from[c], free[c] = begin, end
        if free[c] <= free_from[c]:
            free_from[c], free[c] = 0.0, 0.0


@njit
def _open_end(end, bf, sigma_px):  # type: ignore[no-untyped-def]
    """A range up to which ground was seen, less the deviation of its last pixels: a pit may begin there."""
    return bf / (bf / end + _OPEN_SIGMAS * sigma_px) if end > 0.0 else 0.0


@njit
def _open_start(start, low, bf, sigma_px):  # type: ignore[no-untyped-def]
    """A range from which ground was seen that falls near there, later by the deviation of its first pixels.

    low: height of the lowest obstacles over that of the camera. A grid also frees cells before `start` where the ray to
    it is lower than such obstacles, this share of the range, so the range is made longer by as much.
    """
    return bf / max(bf / start - _OPEN_SIGMAS * sigma_px, BIN_PX) / (1.0 - min(low, 0.5))
