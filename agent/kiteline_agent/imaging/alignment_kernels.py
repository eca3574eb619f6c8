"""Kernels of sub-pixel template alignment.

Inverse-compositional Lucas-Kanade over position, invariant to gain and offset of brightness (S. Baker, I. Matthews,
"Lucas-Kanade 20 years on", 2004): the template's gradients are made orthogonal to the template and to a constant, so
both drop out of the normal equations. Templates are warped by the affine map of the predicted pose.

All sums over patches are integer sums (values in 1/16 grey level, positions in 1/128 px), which are exact in any order,
so that the compiler can vectorise them.
"""

import numpy as np

from kiteline_agent.imaging.rectification_kernels import _raw_at
from kiteline_core.jit import helper, njit

PATCH_RADIUS = 4  # a patch is 9x9 px of the level at which it is compared
PATCH = 2 * PATCH_RADIUS + 1
TEMPLATE_RADIUS = 10  # a template is 21x21 px: fits a 9x9 patch rotated by 45 degrees and scaled by 1.5
TEMPLATE = 2 * TEMPLATE_RADIUS + 1
STRIDE = 16  # of a patch's rows: 9 pixels, padded to full vectors
LANES = PATCH * STRIDE
WARPED = (PATCH + 2) * STRIDE  # lanes of a warped template: a patch and a pixel around it
GREY = 16  # steps per grey level of integer patches
CURVED = (PATCH_RADIUS + 1) / (6.0 * PATCH_RADIUS)  # mean of c^2 / 2 over a patch, over the square of its radius
TEMPLATE_LEVELS = 3  # octave of the corner, and two coarser ones for convergence
ALIGN_ITERATIONS = 8  # Gauss-Newton steps of an alignment on a level
FINE_STEP_PX = 3.0  # px of a level: error that a coarse pass leaves
MIN_NCC = 0.80  # correlation of template and patch, at least


@helper
def sample(image, x, y):  # type: ignore[no-untyped-def]
    """Bilinear value of `image` at (x, y), with 0 <= x < w-1 and 0 <= y < h-1."""
    x0 = int(x)
    y0 = int(y)
    fx = x - x0
    fy = y - y0
    a = float(image[y0, x0])
    b = float(image[y0, x0 + 1])
    c = float(image[y0 + 1, x0])
    d = float(image[y0 + 1, x0 + 1])
    top = a + fx * (b - a)
    bottom = c + fx * (d - c)
    return top + fy * (bottom - top)


@njit
def _cut_inside(image, left, top, template):  # type: ignore[no-untyped-def]
    """Cut a template (21,21) uint8 that is fully inside the image, with its first pixel at (left, top)."""
    u1 = np.uint64(1)
    x0 = int(left)
    y0 = int(top)
    fx = left - x0
    fy = top - y0
    for r in range(TEMPLATE):
        upper = image[y0 + r, x0 : x0 + TEMPLATE + 1]
        lower = image[y0 + r + 1, x0 : x0 + TEMPLATE + 1]
        out = template[r]
        for c in range(TEMPLATE):
            j = np.uint64(c)
            a = float(upper[j])
            b = float(lower[j])
            above = a + fx * (float(upper[j + u1]) - a)
            below = b + fx * (float(lower[j + u1]) - b)
            out[j] = np.uint8(np.int32(above + fy * (below - above) + 0.5))


@njit
def cut_templates(pyramid, uv, octave, templates):  # type: ignore[no-untyped-def]
    """Cut templates around pixels. uv: (n,2) level-0 px. octave: (n,). templates: (n,3,21,21) uint8, out.

    Pixels outside the image repeat its border.
    """
    levels = len(pyramid)
    for i in range(uv.shape[0]):
        for j in range(TEMPLATE_LEVELS):
            level = min(octave[i] + j, levels - 1)
            image = pyramid[level]
            h, w = image.shape
            scale = 1.0 / (1 << level)
            left = uv[i, 0] * scale - TEMPLATE_RADIUS
            top = uv[i, 1] * scale - TEMPLATE_RADIUS
            if left >= 0.0 and top >= 0.0 and left + TEMPLATE < w and top + TEMPLATE < h:
                _cut_inside(image, left, top, templates[i, j])
                continue
            for r in range(TEMPLATE):
                y = min(max(top + r, 0.0), h - 1.001)
                for c in range(TEMPLATE):
                    x = min(max(left + c, 0.0), w - 1.001)
                    templates[i, j, r, c] = np.uint8(sample(image, x, y) + 0.5)


@helper
def warp_template(template, w00, w01, w10, w11, around, reference):  # type: ignore[no-untyped-def]
    """Sample the warped template. Returns False if the warp exceeds it.

    template: (21,21) uint8. around: (4, WARPED) uint16, for what is read before it is interpolated: pairs of pixels
    above and below each place, and the place. reference: (11,STRIDE) int16 in 1/GREY grey levels, out. In 1/128 px.
    """
    n = PATCH + 2
    reach = (PATCH_RADIUS + 1.0) * (abs(w00) + abs(w01))
    reach = max(reach, (PATCH_RADIUS + 1.0) * (abs(w10) + abs(w11)))
    if reach >= TEMPLATE_RADIUS - 0.01:
        return False
    half = PATCH_RADIUS + 1
    step_x = int(w00 * 65536.0)
    step_y = int(w10 * 65536.0)
    grey = template.reshape(-1)
    above, below, along, down = around[0], around[1], around[2], around[3]
    for r in range(n):
        x = int((TEMPLATE_RADIUS - half * w00 + (r - half) * w01) * 65536.0) + 256
        y = int((TEMPLATE_RADIUS - half * w10 + (r - half) * w11) * 65536.0) + 256
        for c in range(n):
            j = np.uint64(r * STRIDE + c)
            at = np.uint64((y >> 16) * TEMPLATE + (x >> 16))
            above[j] = np.uint16(grey[at]) | np.uint16(grey[at + np.uint64(1)]) << 8
            at += np.uint64(TEMPLATE)
            below[j] = np.uint16(grey[at]) | np.uint16(grey[at + np.uint64(1)]) << 8
            along[j] = x >> 9
            down[j] = y >> 9
            x += step_x
            y += step_y
    out = reference.reshape(-1)
    for k in range(WARPED):
        j = np.uint64(k)
        fx = np.int32(along[j] & 127)
        fy = np.int32(down[j] & 127)
        a = np.int32(above[j] & 255)
        b = np.int32(below[j] & 255)
        top = np.int32((a << 7) + fx * (np.int32(above[j] >> 8) - a))
        bottom = np.int32((b << 7) + fx * (np.int32(below[j] >> 8) - b))
        out[j] = np.int32((top << 7) + fy * (bottom - top) + 512) >> 10
    return True


@helper
def template_gradients(reference, patches):  # type: ignore[no-untyped-def]
    """Write the template (row 1 of patches) and twice its gradients along x (2) and y (3)."""
    grey = reference.reshape(-1)
    for k in range(LANES - 2):
        j = np.uint64(k)
        used = patches[4, j]
        patches[1, j] = grey[np.uint64(k + STRIDE + 1)] * used
        patches[2, j] = (grey[np.uint64(k + STRIDE + 2)] - grey[np.uint64(k + STRIDE)]) * used
        patches[3, j] = (grey[np.uint64(k + 2 * STRIDE + 1)] - grey[np.uint64(k + 1)]) * used


@helper
def dot(a, b):  # type: ignore[no-untyped-def]
    """Sum of products of two rows (LANES,) int16; 81 products of 12 and 13 bits fit into 31."""
    total = np.int32(0)
    for k in range(LANES):
        j = np.uint64(k)
        total = np.int32(total + np.int32(a[j]) * np.int32(b[j]))
    return total


@helper
def eight_pixels(image, row, left):  # type: ignore[no-untyped-def]
    """Pixels `left` to left + 7 of a row of an image in one number, the first one lowest: they are read at once.

    row, left: uint64, so that no index is checked for being negative.
    """
    eight = np.uint64(0)
    for c in range(8):
        eight |= np.uint64(image[row, left + np.uint64(c)]) << np.uint64(8 * c)
    return eight


@helper
def sample_patch(image, x, y, raw, across, seen):  # type: ignore[no-untyped-def]
    """Sample the patch around (x, y) in 1/GREY grey levels, with (x, y) rounded to 1/128 px.

    raw: (2 * PATCH + 2,) uint64, for rows of STRIDE pixels, the first one lowest. across: (LANES + STRIDE,) int16, for
    the rows interpolated along x. seen: (LANES,) int16, out. Padding columns are undefined.
    """
    x0 = int(x)
    y0 = int(y)
    fx = np.int32((x - x0) * 128.0 + 0.5)
    fy = np.int32((y - y0) * 128.0 + 0.5)
    left = np.uint64(x0 - PATCH_RADIUS)
    for r in range(PATCH + 1):
        row = np.uint64(y0 + r - PATCH_RADIUS)
        raw[2 * r] = eight_pixels(image, row, left)
        raw[2 * r + 1] = np.uint64(image[row, left + np.uint64(8)]) | np.uint64(image[row, left + np.uint64(9)]) << 8
    grey = raw.view(np.uint8)
    for k in range(LANES + STRIDE - 1):
        j = np.uint64(k)
        a = np.int32(grey[j])
        across[j] = np.int16((a << 7) + fx * (np.int32(grey[np.uint64(k + 1)]) - a))
    for k in range(LANES - 1):
        j = np.uint64(k)
        a = np.int32(across[j])
        seen[j] = np.int32((a << 7) + (np.int32(across[np.uint64(k + STRIDE)]) - a) * fy + 512) >> 10


@njit
def _align_level(image, patches, raw, across, x, y, iterations, max_step):  # type: ignore[no-untyped-def]
    """Gauss-Newton on (x, y) until the patch matches the template. Returns (x, y, ncc, inside).

    patches: (5, LANES) int16: the current patch (out), the template, its gradients (see template_gradients), and ones.
    The steps use gradients made orthogonal to the template and to a constant; their sums follow from the exact sums
    over the plain ones.
    """
    h, w = image.shape
    seen, t, gx, gy, ones = patches[0], patches[1], patches[2], patches[3], patches[4]
    count = float(PATCH * PATCH)
    mean = dot(t, ones) / count
    mean_x = dot(gx, ones) / count
    mean_y = dot(gy, ones) / count
    tt = dot(t, t) - count * mean * mean + 1e-9
    share_x = (dot(t, gx) - count * mean * mean_x) / tt
    share_y = (dot(t, gy) - count * mean * mean_y) / tt
    h00 = dot(gx, gx) - count * mean_x * mean_x - share_x * share_x * tt
    h01 = dot(gx, gy) - count * mean_x * mean_y - share_x * share_y * tt
    h11 = dot(gy, gy) - count * mean_y * mean_y - share_y * share_y * tt
    det = h00 * h11 - h01 * h01
    # The gradients are twice the slope: hence 2 GREY to the square, and a factor 2 in each step.
    if det < 1e-3 * (h00 + h11) ** 2 * 0.25 or h00 + h11 < 4.0 * GREY * GREY:
        return x, y, 0.0, False
    start_x = x
    start_y = y
    ncc = 0.0
    converged = False
    for k in range(iterations + 1):
        if x < PATCH_RADIUS or y < PATCH_RADIUS or x >= w - PATCH_RADIUS - 1 or y >= h - PATCH_RADIUS - 1:
            return x, y, 0.0, False
        sample_patch(image, x, y, raw, across, seen)
        total = float(dot(seen, ones))
        st = dot(seen, t) - mean * total
        gain = st / tt
        if gain < 0.1:
            return x, y, 0.0, False
        if converged or k == iterations:
            for j in range(LANES):
                seen[j] *= ones[j]
            spread = dot(seen, seen) - total * total / count
            ncc = st / np.sqrt(tt * max(spread, 1e-9))
            break
        sx = dot(seen, gx) - mean_x * total - share_x * st
        sy = dot(seen, gy) - mean_y * total - share_y * st
        move_x = -2.0 * (h11 * sx - h01 * sy) / (det * gain)
        move_y = -2.0 * (h00 * sy - h01 * sx) / (det * gain)
        norm = np.sqrt(move_x * move_x + move_y * move_y)
        if norm > 2.0:  # beyond the patch's linear range: shorten the step
            move_x *= 2.0 / norm
            move_y *= 2.0 / norm
        x += move_x
        y += move_y
        converged = norm < 0.02
        if abs(x - start_x) > max_step or abs(y - start_y) > max_step:
            return x, y, 0.0, False
    return x, y, ncc, True


@njit
def _raw_slopes(grid, x, y, reach):  # type: ignore[no-untyped-def]
    """Raw pixel of the rectified pixel (x, y), its derivatives by x and by y over a patch that reaches so far, and by
    how much the patch's mean position is off the pixel, since distortion is curved.
    """
    u, v = _raw_at(grid, x, y)
    u1, v1 = _raw_at(grid, x + reach, y)
    u0, v0 = _raw_at(grid, x - reach, y)
    u3, v3 = _raw_at(grid, x, y + reach)
    u2, v2 = _raw_at(grid, x, y - reach)
    s = 0.5 / reach
    off_u = CURVED * (u0 + u1 + u2 + u3 - 4.0 * u)
    off_v = CURVED * (v0 + v1 + v2 + v3 - 4.0 * v)
    return u, v, (u1 - u0) * s, (v1 - v0) * s, (u3 - u2) * s, (v3 - v2) * s, off_u, off_v


@helper
def level_here(det, cut, levels):  # type: ignore[no-untyped-def]
    """Level on which a template cut at level `cut` is compared: det is that of its warp at level 0."""
    return min(max(cut + int(np.floor(np.log2(np.sqrt(det)) + 0.5)), 0), levels - 1)


@helper
def to_template(warp, det, cut, level):  # type: ignore[no-untyped-def]
    """Map (by rows) from pixels of a level here to those of the template, cut at level `cut`. warp: (2,2), its det."""
    ratio = float(1 << level) / float(1 << cut) / det
    return warp[1, 1] * ratio, -warp[0, 1] * ratio, -warp[1, 0] * ratio, warp[0, 0] * ratio


@helper
def through_lens(m00, m01, m10, m11, xu, xv, yu, yv):  # type: ignore[no-untyped-def]
    """A map (by rows) of rectified pixels as one of raw ones. xu … yv: derivatives of rectified pixels by these."""
    return m00 * xu + m01 * yu, m00 * xv + m01 * yv, m10 * xu + m11 * yu, m10 * xv + m11 * yv


@njit
def align(  # type: ignore[no-untyped-def]
    pyramid, grid, templates, rows, octave, warp, uv, first, last, iterations, max_step_px, min_ncc, found, ncc
):
    """Align templates[rows] in `pyramid`, coarse (template level `first`) to fine (`last`).

    pyramid: tuple of uint8 images, each half the size of the one before. grid: (0,0,2), or the grid of raw pixels
    (gh,gw,2) float32 if the images are raw. templates: (N,3,21,21) uint8.
    rows: (n,) int64 into templates. octave: (n,) uint8, level at which each template was cut.
    warp: (n,2,2) float64, d(pixel here) / d(pixel in the template's image), both at level 0.
    uv: (n,2) float64 px at level 0: prediction in, result out (unchanged where not found).
    max_step_px: how far a level may move the patch, in px of that level. found: (n,) bool out. ncc: (n,) float64 out.
    """
    levels = len(pyramid)
    height, width = pyramid[0].shape
    is_raw = grid.shape[0] > 0
    reference = np.zeros((PATCH + 2, STRIDE), np.int16)
    around = np.zeros((4, WARPED), np.uint16)
    raw = np.zeros(2 * (PATCH + 1), np.uint64)
    across = np.zeros(LANES + STRIDE, np.int16)
    patches = np.zeros((5, LANES), np.int16)
    for r in range(PATCH):
        for c in range(PATCH):
            patches[4, r * STRIDE + c] = 1
    for i in range(rows.shape[0]):
        found[i] = False
        ncc[i] = 0.0
        det = warp[i, 0, 0] * warp[i, 1, 1] - warp[i, 0, 1] * warp[i, 1, 0]
        if det < 0.06 or det > 16.0:
            continue
        x = uv[i, 0]
        y = uv[i, 1]
        ok = False
        score = 0.0
        for j in range(first, last - 1, -1):
            cut = min(octave[i] + j, levels - 1)
            level = level_here(det, cut, levels)
            m00, m01, m10, m11 = to_template(warp[i], det, cut, level)
            s = float(1 << level)
            begin_x = x / s
            begin_y = y / s
            if is_raw:
                reach = PATCH_RADIUS * s
                if x < reach or y < reach or x >= width - reach - s or y >= height - reach - s:
                    ok = False
                    continue
                # The template is warped into the raw image: over a patch, distortion is affine to 0.02 px.
                u, v, ux, vx, uy, vy, off_u, off_v = _raw_slopes(grid, x, y, reach)
                begin_x = (u + off_u) / s
                begin_y = (v + off_v) / s
                part = 1.0 / (ux * vy - uy * vx)
                xu, xv, yu, yv = vy * part, -uy * part, -vx * part, ux * part
                m00, m01, m10, m11 = through_lens(m00, m01, m10, m11, xu, xv, yu, yv)
            if not warp_template(templates[rows[i], j], m00, m01, m10, m11, around, reference):
                continue
            template_gradients(reference, patches)
            px, py, score, ok = _align_level(
                pyramid[level], patches, raw, across, begin_x, begin_y, iterations, max_step_px
            )
            if is_raw and ok:
                at_x, at_y = x, y
                for _ in range(2):  # Newton steps from the raw pixel back to the rectified one
                    du, dv = px * s - off_u - u, py * s - off_v - v
                    at_x += xu * du + xv * dv
                    at_y += yu * du + yv * dv
                    u, v = _raw_at(grid, at_x, at_y)
                px = at_x / s
                py = at_y / s
            if ok and (score >= min_ncc or j > last):
                if score > 0.5:
                    x = px * s
                    y = py * s
            elif j == last:
                ok = False
        if ok and score >= min_ncc:
            uv[i, 0] = x
            uv[i, 1] = y
            found[i] = True
            ncc[i] = score
