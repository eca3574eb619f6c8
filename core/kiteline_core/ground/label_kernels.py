"""Kernels that label pixels by their height above the ground, and collect them to a column scan."""

from __future__ import annotations

import numpy as np

from kiteline_core.ground.level_kernels import BIN_PX
from kiteline_core.jit import njit

UNKNOWN, GROUND, OBSTACLE = 0, 1, 2
_PX = 0.5  # px: half-width of the window in which pixels of one surface lie
_BEHIND_PX = 2.0  # px behind a few pixels in which a real surface explains them as its outliers
_LOWER_M = 0.5  # below the ground where there may be ditches and lawns beside a road
_SAME_PX = 0.25  # px between two surfaces that are one
_LEAST_ENERGY = 300.0  # grey levels^2 of a surface's gradients: 0.06 px for an error of one level
_MOST_STEP_PX = 0.4  # px of a refinement: more is another surface
_NEVER = 1 << 30  # pixels
_OUTLIERS = 0.15  # share of a surface's pixels that are outliers
_FALL_M = 0.12  # below the ground, at least, of a pixel that shows that it falls: a step
_FALL_SIGMAS = 3.0  # the same in standard deviations of its height
_FALL_BINS = 2  # before the ray on which a fall is seen: matched blocks carry an edge on by half their rows
_SOME_FALL = 3  # pixels of a column below the ground, no farther than its end, from which a fall is near
_STEP_M = 0.06  # by which ground falls within _STEP_OVER_M, beyond a slope of _STEP_SLOPE: a step, no ramp
_STEP_SLOPE, _STEP_OVER_M = 0.15, 0.8
_STEP_PIXELS = 8  # that tell a height on either side of it
_NOTHING, _WALL, _FALL = 0, 1, 2  # before which ground ends
_LEAST_BINS = 3  # of disparity over which ground is seen, at least: less is a wall's foot
_OPEN_SIGMAS = 2.0  # standard deviations by which ground that ends before no obstacle ends earlier


@njit
def mark_texture(image, least, reach, out):  # type: ignore[no-untyped-def]
    """Mark pixels (h,w) with a step of at least so many grey levels within `reach` px along the row."""
    h, w = image.shape
    for v in range(h):
        last = -reach - 1
        for u in range(w):
            out[v, u] = False
        for u in range(1, w - 1):
            if abs(np.int64(image[v, u + 1]) - np.int64(image[v, u - 1])) >= least:
                for i in range(max(last + reach + 1, u - reach), min(u + reach + 1, w)):
                    out[v, i] = True
                last = u


@njit
def label_points(  # type: ignore[no-untyped-def]
    x, z, column, textured, ground, seen, bf, sigma_px, ground_m, sigmas, most_m, bands, slab_m, labels, grounds,
    obstacles, falls, heights, sums, in_band, slab, slab_sums,
):  # fmt: skip
    """Label pixels (h,w), and count them by column and bin (n, bins): ground, obstacles, their band, falls, slab.

    ground: (bins+1,) slope -z/x of the ground at the borders of bins; seen: (bins,) whether it was seen there.
    most_m: heights beyond are not ground, however uncertain. bands: (b,) heights. sums: of disparities of obstacles.
    falls: pixels below the ground, where their rays pass through it. heights: sums of z of ground in m.
    in_band: (n, bins, b-1). slab, slab_sums: within slab_m of the camera's height. Labels and counts are zero before.
    Returns how many pixels lie on the ground that was seen, and how many below it.
    """
    bins = grounds.shape[1]
    last = len(bands) - 1
    on, under = 0, 0
    for v in range(x.shape[0]):
        for u in range(x.shape[1]):
            c = column[v, u]
            if c < 0:
                continue
            d = bf / x[v, u]
            j = int(d / BIN_PX)
            if j >= bins:
                continue
            if abs(z[v, u]) < slab_m:
                slab[c, j] += 1
                slab_sums[c, j] += d
            part = d / BIN_PX - j
            height = z[v, u] + x[v, u] * (ground[j] + part * (ground[j + 1] - ground[j]))
            sigma = x[v, u] * abs(ground[j + 1] - ground[j]) / BIN_PX * sigma_px  # of a height above the ground
            limit = max(ground_m, sigmas * sigma)
            if abs(height) <= limit:
                on += seen[j]
                if seen[j] and textured[v, u] and abs(height) <= most_m:
                    labels[v, u] = GROUND
                    grounds[c, j] += 1
                    heights[c, j] += z[v, u]
            elif height > 0.0:
                labels[v, u] = OBSTACLE
                if bands[0] <= height < bands[last]:
                    b = 0
                    while height >= bands[b + 1]:
                        b += 1
                    obstacles[c, j] += 1
                    sums[c, j] += d
                    in_band[c, j, b] += 1
            elif height < -limit:
                if height < -max(_FALL_M, _FALL_SIGMAS * sigma):
                    at = j
                    while at < bins - 1 and ground[at + 1] * x[v, u] < -z[v, u]:
                        at += 1
                    falls[c, at] += 1
                if height < -limit - _LOWER_M:
                    under += seen[j]
    return on, under


@njit
def _surface(counts, least, lowest):  # type: ignore[no-untyped-def]
    """Bin of the nearest surface in counts (bins,) from bin `lowest` on; -1 if there is none."""
    bins = len(counts)
    half, behind = int(_PX / BIN_PX), int(_BEHIND_PX / BIN_PX)
    j = bins - 1
    while j >= lowest:
        n = 0
        for i in range(max(j - half, 0), min(j + half + 1, bins)):
            n += counts[i]
        if n >= least:
            best, most = j, n
            for k in range(j - 1, max(j - behind, lowest) - 1, -1):
                m = 0
                for i in range(max(k - half, 0), min(k + half + 1, bins)):
                    m += counts[i]
                if m > most:
                    best, most = k, m
            if n >= _OUTLIERS * most:  # no outliers of what lies behind: the summit next to it
                best, most = j, n
                for k in range(j - 1, max(j - 2 * half - 1, lowest) - 1, -1):
                    m = 0
                    for i in range(max(k - half, 0), min(k + half + 1, bins)):
                        m += counts[i]
                    if m <= most:
                        break
                    best, most = k, m
                return best
        j -= 1
    return -1


@njit
def _mean(counts, sums, at):  # type: ignore[no-untyped-def]
    """Mean disparity of a surface at a bin."""
    half = int(_PX / BIN_PX)
    total, n = 0.0, 0
    for i in range(max(at - half, 0), min(at + half + 1, len(counts))):
        total += sums[i]
        n += counts[i]
    return total / n


@njit
def find_surfaces(obstacles, sums, in_band, slab, slab_sums, least, lowest, surface, bands):  # type: ignore[no-untyped-def]
    """Levelled disparities (n,2) of the nearest obstacle and of what stands at the camera's height; 0 for none.

    Counts are over (n, bins). lowest: least bin in which obstacles count. bands: (n,) mask of the obstacle's.
    """
    n, bins = obstacles.shape
    half = int(_PX / BIN_PX)
    for c in range(n):
        surface[c, 0], surface[c, 1], bands[c] = 0.0, 0.0, 0
        at = _surface(obstacles[c], least, lowest)
        if at >= 0:
            surface[c, 0] = _mean(obstacles[c], sums[c], at)
            most, mask = 0, 0
            for b in range(in_band.shape[2]):
                m = 0
                for i in range(max(at - half, 0), min(at + half + 1, bins)):
                    m += in_band[c, i, b]
                if m * 4 >= least:
                    mask |= 1 << b
                if m > most:
                    most, top = m, b
            bands[c] = mask | 1 << top
        hit = _surface(slab[c], least, 0)
        if hit >= 0:
            surface[c, 1] = _mean(slab[c], slab_sums[c], hit)


@njit
def refine_surfaces(left, right, rotation, camera, bf, offset, x, z, column, labels, slab_m, surface, sums):  # type: ignore[no-untyped-def]
    """Refine levelled disparities (n,2) of surfaces by all their pixels at once: one step of least squares.

    left, right: images (h,w) of the pair. offset: (5,) error of disparities. A pixel belongs to a surface whose
    disparity it has, if it is labelled so, or lies within slab_m of the camera's height. sums: (n,2,5), zero before:
    pixels, and of them gradient g, g^2, error e, g e. Means are taken off, as brightness may differ.
    """
    h, w = left.shape
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    for v in range(h):
        q = (v - cy) / fy
        for u in range(1, w - 1):
            c = column[v, u]
            if c < 0:
                continue
            d = bf / x[v, u]
            for k in range(2):
                s = surface[c, k]
                if s == 0.0 or abs(d - s) > _PX:
                    continue
                if (k == 0 and labels[v, u] != OBSTACLE) or (k == 1 and abs(z[v, u]) >= slab_m):
                    continue
                p = (u - cx) / fx
                ahead = rotation[0, 0] * p + rotation[0, 1] * q + rotation[0, 2]
                error = offset[0] + offset[1] * p + offset[2] * q + offset[3] * p * p + offset[4] * p * q
                at = u - (s * ahead + error)
                i = int(np.floor(at))
                if i < 1 or i >= w - 2:
                    continue
                f = at - i
                a, b = float(right[v, i]), float(right[v, i + 1])
                before, after = float(right[v, i - 1]), float(right[v, i + 2])
                slope = 0.5 * ((1.0 - f) * (b - before) + f * (after - a))
                slope = 0.5 * slope + 0.25 * (float(left[v, u + 1]) - float(left[v, u - 1]))
                g, e = slope * ahead, float(left[v, u]) - (a + f * (b - a))
                sums[c, k, 0] += 1.0
                sums[c, k, 1] += g
                sums[c, k, 2] += g * g
                sums[c, k, 3] += e
                sums[c, k, 4] += g * e
    for c in range(len(surface)):
        for k in range(2):
            n = sums[c, k, 0]
            if n < 4.0:
                continue
            energy = sums[c, k, 2] - sums[c, k, 1] * sums[c, k, 1] / n
            if energy < _LEAST_ENERGY:
                continue
            step = -(sums[c, k, 4] - sums[c, k, 1] * sums[c, k, 3] / n) / energy
            if abs(step) < _MOST_STEP_PX:
                surface[c, k] += step


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
    grounds, obstacles, falls, fell, steps, least, begin_m, end_m, lowest, bf, sigma_px, gap_m
):
    """From where and up to where ground was seen in counts (bins,), between two ranges; 0, 0 if it was not.

    And whether it ended before a _WALL, a _FALL or _NOTHING, and whether _SOME_FALL pixels up to its end lie below it.
    The longest part with gaps of at most gap_m, or two deviations of the range, and without `least` pixels of obstacles
    (bins,) at the same range: those stand there, or hang above. Nor is a step within it, nor a fall: see `_mark_steps`,
    `_mark_falls`. bf: px m along the column.
    """
    bins = len(grounds)
    half = int(_PX / BIN_PX)
    best_from, best, start, last, ended, below, has_fall = 0.0, 0.0, 0.0, 0.0, _NOTHING, 0, False
    above = 0  # pixels of obstacles around a bin
    for j in range(bins - half, bins):
        above += obstacles[j]
    for j in range(bins - 1, lowest - 1, -1):
        below += falls[j]
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
        apart = near - last > max(gap_m, 2.0 * near * sigma_px / ((j + 1) * BIN_PX))
        if stops:
            if last > 0.0 and last == best:
                ended = _FALL if fell[j] or steps[j] else _NOTHING if apart else _WALL
            last = 0.0
            continue
        if near >= end_m:
            break
        if last == 0.0 or apart:
            start = near
        last = bf / ((j if j else 0.5) * BIN_PX)
        if last - start > best - best_from:
            best_from, best, ended, has_fall = start, last, _NOTHING, below >= _SOME_FALL
    if best > 0.0 and bf / BIN_PX * (1.0 / best_from - 1.0 / best) < _LEAST_BINS - 0.5:
        return 0.0, 0.0, ended, False
    return best_from, min(best, end_m), ended, has_fall


@njit
def collect_scan(  # type: ignore[no-untyped-def]
    grounds, heights, obstacles, falls, least, surface, bands, limits, height, azimuth, bf, lowest, sigma_px, gap_m,
    free_from, free, obstacle, clear,
):  # fmt: skip
    """Ranges (n,) in m of a column scan from ground and obstacles counted over (n, bins) and surfaces (n,2).

    surface: disparities. bands: (n,) of obstacles; limits: of bands. height: of the camera. azimuth: (n,). lowest:
    least bin that counts. Free is the longest part of the ground, before the obstacle or behind; there only where fewer
    than `least` pixels of obstacles have its range, and it was seen over the obstacle, not beside a leg or below a top.
    """
    bins = grounds.shape[1]
    means, fell, steps = np.empty(bins), np.empty(bins, np.bool_), np.empty(bins, np.bool_)
    for c in range(len(grounds)):
        along = 1.0 / np.cos(azimuth[c])
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
            grounds[c], obstacles[c], falls[c], fell, steps, _NEVER, 0.0, obstacle[c], lowest, bf * along, sigma_px,
            gap_m,
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
                    grounds[c], obstacles[c], falls[c], fell, steps, least, max(obstacle[c] + 3.0 * deviation, over),
                    np.inf, lowest, bf * along, sigma_px, gap_m,
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
