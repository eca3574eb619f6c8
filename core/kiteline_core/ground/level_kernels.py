"""Kernels that correct disparities, turn them into points of the levelled camera frame, and count these by column."""

import numpy as np

from kiteline_core.jit import helper, njit

BIN_PX = 0.25  # px of levelled disparity to a bin
_MATCHED = 0.2  # of an image column's pixels below the horizon that have a disparity: else one camera did not see it
NO_COLUMN = -1
_HALF_PX = 4  # px to each side of a pixel in its row that are compared
_NEARER_PX = 1.5  # px by which another disparity is larger, at least: less is the error of a slanted surface
_LEAST_ERROR = 4.0  # grey levels: mean difference from which a disparity is in doubt
_BETTER = 0.5  # of that difference that another disparity leaves, at most
_FITS = 3.0  # grey levels that another disparity leaves, at most: noise leaves two. Poor fits are found by chance
_SUPPORT = 15  # of 26 pixels within one row and _HALF_PX columns, that have the new disparity to a pixel: of three rows


@njit
def unlock(raw, first, table, out):  # type: ignore[no-untyped-def]
    """Disparities (h,w) in px of raw ones (h,first+w) int16, in 1/16 px; 0 where they are not positive.

    table: (16,) float32 px, what parts of -8..7 steps beside a whole pixel stand for.
    """
    for v in range(out.shape[0]):
        for u in range(out.shape[1]):
            at = np.int64(raw[v, first + u]) + 8
            out[v, u] = np.float32(at >> 4) + table[at & 15] if at > 8 else np.float32(0.0)


@njit
def correct_thin_surfaces(left, right, most_px, disparity, errors, best, least, lowest, difference, doubted, better):  # type: ignore[no-untyped-def]
    """Replace disparities (h,w) in px of surfaces that are thinner than a matched block by those that the rows show.

    Semi-global matching gives such a surface the disparity of what lies behind. A disparity is in doubt where a row of
    2 _HALF_PX + 1 pixels does not fit, and a larger one, up to most_px, fits well: it takes that one, or becomes
    unknown (0) if too few pixels around have it.
    left, right: (h,w) uint8. errors: (2,w) float32, best, least, lowest, difference: (w,) int16, doubted: (k,) int32,
    better: (k,) float32, for the kernel's own use. At most k pixels are changed. Returns how many.
    """
    h, w = left.shape
    n = 0
    for v in range(h):
        _errors_of_row(left[v], right[v], disparity[v], errors[0])
        first, last = _search_row(
            left[v], right[v], most_px, disparity[v], errors[0], errors[1], best, least, lowest, difference
        )  # fmt: skip
        for u in range(first, last + 1):
            if best[u] >= 0 and n < len(doubted):
                doubted[n], better[n] = v * w + u, best[u]
                n += 1
    for k in range(n):
        disparity[doubted[k] // w, doubted[k] % w] = better[k]
    for k in range(n):
        v, u, support = doubted[k] // w, doubted[k] % w, -1
        for y in range(max(v - 1, 0), min(v + 2, h)):
            for x in range(max(u - _HALF_PX, 0), min(u + _HALF_PX + 1, w)):
                support += abs(disparity[y, x] - better[k]) <= 1.0
        if support < _SUPPORT:
            doubted[k] = -1 - doubted[k]
    for k in range(n):
        if doubted[k] < 0:
            disparity[(-1 - doubted[k]) // w, (-1 - doubted[k]) % w] = 0.0
    return n


@helper
def _errors_of_row(left, right, disparity, errors):  # type: ignore[no-untyped-def]
    """Differences (w,) in grey levels of a row of the left image from the right one, by disparities (w,) in px."""
    for u in range(len(left)):
        d = disparity[u]
        errors[u] = np.float32(0.0)
        if d > 0.0:
            at = np.float32(u) - d
            i = int(np.floor(at))
            if i >= 0 and i + 1 < len(left):
                part = at - np.float32(i)
                a, b = np.float32(right[i]), np.float32(right[i + 1])
                errors[u] = abs(np.float32(left[u]) - (a + part * (b - a)))


@helper
def _search_row(left, right, most_px, disparity, errors, sums, best, least, lowest, difference):  # type: ignore[no-untyped-def]
    """The larger disparity that fits a row best at each pixel whose disparity is in doubt.

    sums: (w,) out, errors over 2 _HALF_PX + 1 pixels. best: (w,) out, that disparity in px, -1 where none fits far
    better. Returns the first and the last pixel in doubt; none if the first is not below the last. All disparities of
    a row are searched together in loops without branches, of which the compiler takes many pixels at a time; so sums
    over _HALF_PX are written out, and numbers are short.
    """
    w = len(left)
    first, last, begin_q = w, -1, most_px
    for u in range(_HALF_PX, w - _HALF_PX):
        best[u] = -1
        error = errors[u - 4] + errors[u - 3] + errors[u - 2] + errors[u - 1] + errors[u]
        error = error + errors[u + 1] + errors[u + 2] + errors[u + 3] + errors[u + 4]
        sums[u] = error
    for u in range(_HALF_PX, w - _HALF_PX):
        least[u], lowest[u] = 0, most_px
        error = sums[u]
        if error > _LEAST_ERROR * (2 * _HALF_PX + 1) and disparity[u] > 0.0:
            least[u] = int(np.ceil(min(_BETTER * error, np.float32(_FITS * (2 * _HALF_PX + 1)))))
            lowest[u] = int(disparity[u] + _NEARER_PX) + 1
            first, last, begin_q = min(first, u), u, min(begin_q, lowest[u])
    for q in range(begin_q, most_px):
        begin, nearer = max(first, q + _HALF_PX), np.int16(q)
        for k in range(begin - _HALF_PX, last + _HALF_PX + 1):
            difference[k] = abs(np.int16(np.int16(left[k]) - np.int16(right[k - q])))
        for u in range(begin, last + 1):
            other = difference[u - 4] + difference[u - 3] + difference[u - 2] + difference[u - 1] + difference[u]
            other += difference[u + 1] + difference[u + 2] + difference[u + 3] + difference[u + 4]
            other = np.int16(other)
            is_better = (other < least[u]) & (nearer >= lowest[u])
            least[u] = other if is_better else least[u]
            best[u] = nearer if is_better else best[u]
    return first, last


@helper
def _matched_columns(disparity, x, rotation, camera):  # type: ignore[no-untyped-def]
    """First and last image column that both cameras saw; none if the first is not below the last.

    x: (3,w) what its column adds to a pixel's ray in the levelled frame.
    """
    h, w = disparity.shape
    known, pixels = np.zeros(w, np.int32), np.zeros(w, np.int32)
    for v in range(h):
        below = rotation[2, 1] * ((v - camera[3]) / camera[1])
        for u in range(w):
            is_below = x[2, u] + below + rotation[2, 2] < 0.0
            pixels[u] += is_below
            known[u] += is_below & (disparity[v, u] > 0.0)
    first, last = w, -1
    for u in range(w):
        if known[u] > _MATCHED * pixels[u]:
            first, last = min(first, u), u
    return first, last


@njit
def level_points(disparity, rotation, camera, bf, offset, far_px, slopes, x_out, z_out, column_out, known_out):  # type: ignore[no-untyped-def]
    """Points of pixels in the levelled frame: ahead x_out, up z_out (h,w) m, and their column (h,w), NO_COLUMN without.

    disparity: (h,w) px, <= 0 unknown. rotation: (3,3) camera to levelled frame. camera: fx, fy, cx, cy in px. bf: px m.
    offset: (5,) error of disparities over normalised image coordinates. far_px: least disparity; smaller ones
    are taken as far. slopes: (n+1,) y/x of the borders of columns, increasing; column n-1 is the last. known_out: (n,2)
    of a column's pixels below the horizon that both cameras saw: how many have a disparity, and how many there are;
    zero before.
    """
    h, w = disparity.shape
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    n = len(slopes) - 1
    low = slopes[0]
    table = np.empty(1024, np.int16)
    scale = 1024.0 / (slopes[n] - low)
    at = 0
    for i in range(1024):
        while at < n - 1 and slopes[at + 1] <= low + (i + 0.5) / scale:
            at += 1
        table[i] = at
    x_image, x_level = np.empty(w), np.empty((3, w))  # what its column adds to a pixel's ray: in the camera; levelled
    for u in range(w):
        x_image[u] = (u - cx) / fx
        for i in range(3):
            x_level[i, u] = rotation[i, 0] * x_image[u]
    first, last = _matched_columns(disparity, x_level, rotation, camera)
    one_ahead, one_left, one_up = rotation[0, 2], rotation[1, 2], rotation[2, 2]
    o0, o1, o2, o3, o4 = offset[0], offset[1], offset[2], offset[3], offset[4]
    for v in range(h):
        y = (v - cy) / fy
        y_ahead, y_left, y_up = rotation[0, 1] * y, rotation[1, 1] * y, rotation[2, 1] * y
        for u in range(w):
            column_out[v, u] = NO_COLUMN
            d = disparity[v, u]
            up = x_level[2, u] + y_up + one_up
            below = (first <= u <= last) & (up < 0.0)
            if not (d > 0.0 or below):
                continue
            ahead = x_level[0, u] + y_ahead + one_ahead
            if ahead < 0.2:
                continue
            slope = (x_level[1, u] + y_left + one_left) / ahead
            i = int((slope - low) * scale)
            if slope < low or i >= 1024:
                continue
            known_out[table[i], 1] += below
            if not d > 0.0:
                continue
            known_out[table[i], 0] += below
            x = x_image[u]
            d -= o0 + o1 * x + o2 * y + o3 * x * x + o4 * x * y
            depth = bf / max(d, far_px)
            x_out[v, u] = ahead * depth
            z_out[v, u] = up * depth
            column_out[v, u] = table[i]


@njit
def count_columns(x, z, column, bf, counts, heights):  # type: ignore[no-untyped-def]
    """u-disparity: pixels (n, bins) of each column and levelled disparity, and sums of their z; zero before."""
    bins = counts.shape[1]
    for v in range(x.shape[0]):
        for u in range(x.shape[1]):
            c = column[v, u]
            if c >= 0:
                j = int(bf / (x[v, u] * BIN_PX))
                if j < bins:
                    counts[c, j] += 1
                    heights[c, j] += z[v, u]


@njit
def find_upright(counts, heights, widths, rows, rows_m, upright):  # type: ignore[no-untyped-def]
    """Mark cells (n, bins) of the u-disparity with more rows than level ground has there, by more than `rows`.

    widths: (n,) px of a column. Level ground at height z fills |z| rows_m rows with each pixel of disparity.
    """
    n, bins = counts.shape
    for c in range(n):
        for j in range(bins):
            k = counts[c, j]
            upright[c, j] = False
            if k:
                ground = abs(heights[c, j] / k) * rows_m * BIN_PX
                upright[c, j] = k / widths[c] > rows + 1.5 * ground


@njit
def count_heights(x, z, column, upright, bf, below, steepest, step_m, counts, disparities, slopes):  # type: ignore[no-untyped-def]
    """v-disparity of what does not stand upright, over (bins, heights): pixels, sums of disparity and of slope -z/x.

    A pixel and the one at `below` (du, dv) from it, which lies lower in the levelled frame, are on level ground if
    their heights are the same, on a wall if their distances are: those with more than `steepest` of a wall's difference
    are left out. Row k holds points from k step_m to (k + 1) step_m below the camera. All three are zero before.
    """
    bins, heights = counts.shape
    h, w = x.shape
    du, dv = below
    for v in range(max(0, -dv), min(h, h - dv)):
        for u in range(max(0, -du), min(w, w - du)):
            c = column[v, u]
            if c < 0 or z[v, u] >= 0.0 or column[v + dv, u + du] < 0:
                continue
            ahead, down, other = x[v, u], -z[v, u], -z[v + dv, u + du]
            wall = ahead * other / x[v + dv, u + du] - down  # difference of height of two points of a wall
            if wall <= 0.0 or abs(other - down) > steepest * wall:
                continue
            d = bf / ahead
            j = int(d / BIN_PX)
            k = int(down / step_m)
            if j < bins and k < heights and not upright[c, j]:
                counts[j, k] += 1
                disparities[j, k] += d
                slopes[j, k] += down / ahead


@njit
def count_depths(x, z, column, farthest, slope, height_px, step_m, counts):  # type: ignore[no-untyped-def]
    """Count pixels by their depth below the camera in steps of step_m (depths,), zero before.

    farthest: m ahead up to which pixels count, and m of their height's deviation at most: height_px is that of a pixel
    1 m ahead and 1 m down. slope: m of depth taken off for each metre ahead: ground may fall.
    """
    for v in range(x.shape[0]):
        for u in range(x.shape[1]):
            if column[v, u] < 0 or x[v, u] > farthest[0] or abs(z[v, u]) * x[v, u] * height_px > farthest[1]:
                continue
            k = int((-z[v, u] - slope * x[v, u]) / step_m)
            if 0 < k < len(counts):
                counts[k] += 1
