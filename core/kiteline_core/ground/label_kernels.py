"""Kernels that label pixels by their height above the ground, and find the surfaces that columns see."""

import numpy as np

from kiteline_core.ground.level_kernels import BIN_PX
from kiteline_core.jit import njit

UNKNOWN, GROUND, OBSTACLE = 0, 1, 2
_PX = 0.5  # px: half-width of the window in which pixels of one surface lie
_BEHIND_PX = 2.0  # px behind a few pixels in which a real surface explains them as its outliers
_LOWER_M = 0.5  # below the ground where there may be ditches and lawns beside a road
_LEAST_ENERGY = 300.0  # grey levels^2 of a surface's gradients: 0.06 px for an error of one level
_MOST_STEP_PX = 0.4  # px of a refinement: more is another surface
_OVER_M = 0.5  # above the bands, where what hangs into them goes on; ceilings are higher
_OUTLIERS = 0.15  # share of a surface's pixels that are outliers
_FALL_M = 0.12  # below the ground, at least, of a pixel that shows that it falls: a step
_FALL_SIGMAS = 3.0  # the same in standard deviations of its height
_ASTRAY_BINS = 3  # of disparity by which a pixel lies beyond the ground on its ray: it looks into a hole


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
    obstacles, above, falls, astray, heights, sums, in_band, slab, slab_sums,
):  # fmt: skip
    """Label pixels (h,w), and count them by column and bin (n, bins): ground, obstacles, their band, falls, slab.

    ground: (bins+1,) slope -z/x of the ground at the borders of bins; seen: (bins,) whether it was seen there.
    most_m: heights beyond are not ground, however uncertain. bands: (b,) heights. sums: of disparities of obstacles.
    falls: pixels below the ground, where their rays pass through it; astray: those beyond it by _ASTRAY_BINS, however
    little lower. heights: sums of z of ground in m. above: pixels above the bands, up to _OVER_M.
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
            at = j  # bin of the ground on the pixel's ray
            while height < 0.0 and at < bins - 1 and ground[at + 1] * x[v, u] < -z[v, u]:
                at += 1
            if at - j >= _ASTRAY_BINS:
                astray[c, at] += 1
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
                elif 0.0 <= height - bands[last] < _OVER_M:
                    above[c, j] += 1
            elif height < -limit:
                if height < -max(_FALL_M, _FALL_SIGMAS * sigma):
                    falls[c, at] += 1
                if height < -limit - _LOWER_M:
                    under += seen[j]
    return on, under


@njit
def _surface(counts, more, least, lowest):  # type: ignore[no-untyped-def]
    """Bin of the nearest surface in counts (bins,) from bin `lowest` on; -1 if there is none.

    more: (bins,) pixels that do not count, but may tell a surface from outliers of what lies behind it.
    """
    bins = len(counts)
    half, behind = int(_PX / BIN_PX), int(_BEHIND_PX / BIN_PX)
    n, whole = 0, 0  # of the window around bin j
    for i in range(max(bins - half, 0), bins):
        n += counts[i]
        whole += counts[i] + more[i]
    j = bins - 1
    while j >= lowest:
        if j >= half:
            n += counts[j - half]
            whole += counts[j - half] + more[j - half]
        if j + half + 1 < bins:
            n -= counts[j + half + 1]
            whole -= counts[j + half + 1] + more[j + half + 1]
        if n >= least:
            most, most_whole = n, whole
            for k in range(j - 1, max(j - behind, lowest) - 1, -1):
                m, m_whole = 0, 0
                for i in range(max(k - half, 0), min(k + half + 1, bins)):
                    m += counts[i]
                    m_whole += counts[i] + more[i]
                most, most_whole = max(most, m), max(most_whole, m_whole)
            if n >= _OUTLIERS * most or whole >= _OUTLIERS * most_whole:
                best, most = j, n  # no outliers of what lies behind: the summit next to it
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
def find_surfaces(obstacles, above, sums, in_band, slab, slab_sums, least, lowest, surface, bands):  # type: ignore[no-untyped-def]
    """Levelled disparities (n,2) of the nearest obstacle and of what stands at the camera's height; 0 for none.

    Counts are over (n, bins). lowest: least bin in which obstacles count. bands: (n,) mask of the obstacle's.
    """
    n, bins = obstacles.shape
    half = int(_PX / BIN_PX)
    for c in range(n):
        surface[c, 0], surface[c, 1], bands[c] = 0.0, 0.0, 0
        at = _surface(obstacles[c], above[c], least, lowest)
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
        hit = _surface(slab[c], slab[c], least, 0)
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
