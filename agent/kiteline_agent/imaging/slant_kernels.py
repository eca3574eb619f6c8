"""Kernels that measure how the surface around a landmark is slanted, from a patch that was aligned.

The warp of a template assumes a surface. If that is slanted otherwise, the patch is sheared against the template along
the landmark's parallax: by one vector times a linear function of the place in the patch. Its two coefficients are
solved for together with shift, gain and offset of brightness, linearised once (S. Baker, I. Matthews, "Lucas-Kanade 20
years on", 2004). As in `alignment_kernels`, sums over patches are sums of integers.
"""

import numpy as np

from kiteline_agent.imaging.alignment_kernels import (
    GREY,
    LANES,
    PATCH,
    PATCH_RADIUS,
    STRIDE,
    WARPED,
    _raw_slopes,
    dot,
    level_here,
    sample_patch,
    template_gradients,
    through_lens,
    to_template,
    warp_template,
)
from kiteline_core.jit import njit

_TINY = 1e-12  # of information: nothing
_NUISANCES = 4  # constant, template, shift along x and y: eliminated before the shear
_DIRECTION_BITS = 8  # of a direction's components
_SHORTER_BITS = 2  # by which shear images are shortened: sums of their squares fit into 31 bits
_LEAST_GAIN = 0.2  # of brightness; with less there is nothing to compare
_LEAST_PIVOT = 1e-3  # share of a contrast that template and gradients leave of one another; less is no equation


@njit
def _fill_shears(patches, direction_x, direction_y):  # type: ignore[no-untyped-def]
    """Write the images by which shears along a direction change the template, times column (6) and row (7).

    patches: (10, LANES) int16; 2, 3: twice the gradients of the template; 8, 9: column and row from the centre.
    """
    x = np.int32(direction_x * (1 << _DIRECTION_BITS))
    y = np.int32(direction_y * (1 << _DIRECTION_BITS))
    for k in range(LANES):
        j = np.uint64(k)
        along = np.int32(patches[2, j]) * x + np.int32(patches[3, j]) * y
        along = (along + (1 << (_DIRECTION_BITS - 1))) >> _DIRECTION_BITS
        patches[6, j] = (along * np.int32(patches[8, j]) + (1 << (_SHORTER_BITS - 1))) >> _SHORTER_BITS
        patches[7, j] = (along * np.int32(patches[9, j]) + (1 << (_SHORTER_BITS - 1))) >> _SHORTER_BITS


@njit
def _normal_equations(patches, images, sums):  # type: ignore[no-untyped-def]
    """Sums of products (7,7), upper triangle, of the images of a patch; False if shift and gain are not determined.

    images: (7,) rows of patches: constant, template, its gradients along x and y, shears, and what was seen. The first
    four are eliminated.
    """
    for p in range(7):
        for q in range(p, 7):
            sums[p, q] = dot(patches[images[p]], patches[images[q]])
    for p in range(_NUISANCES):
        if not sums[p, p] > 1e-6:
            return False
        for q in range(p + 1, 7):
            share = sums[p, q] / sums[p, p]
            before = sums[q, q]
            for t in range(q, 7):
                sums[q, t] -= share * sums[p, t]
            if p > 0 and q < _NUISANCES and sums[q, q] < _LEAST_PIVOT * before:
                return False
    return True


@njit
def measure_slants(  # type: ignore[no-untyped-def]
    pyramid, grid, templates, rows, octave, warp, parallax, uv, focal_x, focal_y, least_grey, equations
):
    """Equations of the error in the slants of landmarks, from where their templates were aligned.

    pyramid, grid, templates, rows, octave, warp: see `alignment_kernels.align`. parallax: (n,2) px, derivative
    of the pixel here by the logarithm of inverse depth. uv: (n,2) px at level 0, aligned. focal_x, focal_y: px, of the
    template's image. A slant is the gradient of the logarithm of inverse depth by the bearing (x/z, y/z) in that image.
    least_grey: grey levels; deviation of a pixel, at least.
    equations: (n,5) out: information (xx, xy, yy) on the error of the slant that the warp assumed, and its product with
    that error (x, y). Zero where nothing was measured.
    """
    levels = len(pyramid)
    height, width = pyramid[0].shape
    is_raw = grid.shape[0] > 0
    reference = np.zeros((PATCH + 2, STRIDE), np.int16)
    around = np.zeros((4, WARPED), np.uint16)
    raw = np.zeros(2 * (PATCH + 1), np.uint64)
    across = np.zeros(LANES + STRIDE, np.int16)
    patches = np.zeros((10, LANES), np.int16)
    for r in range(PATCH):
        for c in range(PATCH):
            patches[4, r * STRIDE + c] = 1
            patches[8, r * STRIDE + c] = c - PATCH_RADIUS
            patches[9, r * STRIDE + c] = r - PATCH_RADIUS
    images = np.array((4, 1, 2, 3, 6, 7, 0))
    sums = np.zeros((7, 7))
    for i in range(rows.shape[0]):
        for k in range(5):
            equations[i, k] = 0.0
        det = warp[i, 0, 0] * warp[i, 1, 1] - warp[i, 0, 1] * warp[i, 1, 0]
        if not (det >= 0.06 and det <= 16.0):  # nor if it is not a number
            continue
        # 1. The level, and the map from its pixels to those of the template, as in the alignment.
        cut = min(int(octave[i]), levels - 1)
        level = level_here(det, cut, levels)
        s = float(1 << level)
        m00, m01, m10, m11 = to_template(warp[i], det, cut, level)
        x, y = uv[i, 0] / s, uv[i, 1] / s
        e0, e1 = parallax[i, 0] / s, parallax[i, 1] / s
        if is_raw:
            reach = PATCH_RADIUS * s
            if min(uv[i, 0], uv[i, 1]) < reach or uv[i, 0] >= width - reach - s or uv[i, 1] >= height - reach - s:
                continue
            u, v, ux, vx, uy, vy, off_u, off_v = _raw_slopes(grid, uv[i, 0], uv[i, 1], reach)
            x, y = (u + off_u) / s, (v + off_v) / s
            part = 1.0 / (ux * vy - uy * vx)
            xu, xv, yu, yv = vy * part, -uy * part, -vx * part, ux * part
            m00, m01, m10, m11 = through_lens(m00, m01, m10, m11, xu, xv, yu, yv)
            e0, e1 = ux * e0 + uy * e1, vx * e0 + vy * e1
        h, w = pyramid[level].shape
        if x < PATCH_RADIUS or y < PATCH_RADIUS or x >= w - PATCH_RADIUS - 1 or y >= h - PATCH_RADIUS - 1:
            continue
        length = np.sqrt(e0 * e0 + e1 * e1)
        if not length >= 1e-3 or not warp_template(templates[rows[i], 0], m00, m01, m10, m11, around, reference):
            continue
        # 2. What was seen, the template, and what shift and shear would change.
        sample_patch(pyramid[level], x, y, raw, across, patches[0])
        for k in range(LANES):
            patches[0, k] *= patches[4, k]
        template_gradients(reference, patches)
        _fill_shears(patches, e0 / length, e1 / length)
        # 3. Gain, and what is left of the residuals after all unknowns.
        if not _normal_equations(patches, images, sums):
            continue
        gain = sums[1, 6] / sums[1, 1]
        a00, a01, a11, b0, b1 = sums[4, 4], sums[4, 5], sums[5, 5], sums[4, 6], sums[5, 6]
        part = a00 * a11 - a01 * a01
        if gain < _LEAST_GAIN or part < 1e-6 * a00 * a11 or part <= 0.0:
            continue
        left = sums[6, 6] - (a11 * b0 * b0 - 2.0 * a01 * b0 * b1 + a00 * b1 * b1) / part
        variance = max(left / (PATCH * PATCH - 6), (least_grey * GREY) ** 2)
        # 4. From shears of the patch to the slant in the template's image: shear = (j) slant.
        unit_x, unit_y = float(1 << cut) / focal_x, float(1 << cut) / focal_y
        j00, j01, j10, j11 = m00 * unit_x, m10 * unit_y, m01 * unit_x, m11 * unit_y
        size = -0.5 * (1 << _SHORTER_BITS) * gain * length
        h00, h01, h11 = a00 * size * size, a01 * size * size, a11 * size * size
        g0, g1 = b0 * size, b1 * size
        k00, k01, k10, k11 = h00 * j00 + h01 * j10, h00 * j01 + h01 * j11, h01 * j00 + h11 * j10, h01 * j01 + h11 * j11
        equations[i, 0] = (j00 * k00 + j10 * k10) / variance
        equations[i, 1] = (j00 * k01 + j10 * k11) / variance
        equations[i, 2] = (j01 * k01 + j11 * k11) / variance
        equations[i, 3] = (j00 * g0 + j10 * g1) / variance
        equations[i, 4] = (j01 * g0 + j11 * g1) / variance


@njit
def fuse_slants(  # type: ignore[no-untyped-def]
    rows, octave, equations, most_forgotten, prior, focal, most_change, known, slant
):
    """Take over measurements of landmarks: the most probable slants after them.

    rows: (n,) int64, all different, into known and slant. octave: (n,) uint8, of the templates. equations: (n,5), see
    `measure_slants`. most_forgotten: share of what was known that is forgotten, at most. prior: information about each
    component. focal: px, of the template's image. most_change: of the inverse depth, from the middle of a patch to its
    edge. known: (N,5) information (xx, xy, yy) on slants, and its product with them (x, y). slant: (N,2). Both in and
    out.
    """
    for i in range(rows.shape[0]):
        row = rows[i]
        # 1. What is told of the slant itself, not of its error.
        xx, xy, yy = equations[i, 0], equations[i, 1], equations[i, 2]
        sx, sy = slant[row, 0], slant[row, 1]
        bx, by = equations[i, 3] + xx * sx + xy * sy, equations[i, 4] + xy * sx + yy * sy
        # 2. No more is forgotten than is told: where a vehicle hovers nothing is, and its disparities need the slants.
        share = (xx + yy) / max(known[row, 0] + known[row, 2], xx + yy + _TINY)
        kept = 1.0 - min(most_forgotten, share)
        xx, xy, yy = kept * known[row, 0] + xx, kept * known[row, 1] + xy, kept * known[row, 2] + yy
        bx, by = kept * known[row, 3] + bx, kept * known[row, 4] + by
        known[row, 0], known[row, 1], known[row, 2], known[row, 3], known[row, 4] = xx, xy, yy, bx, by
        # 3. The most probable slant, no steeper than an edge.
        xx, yy = xx + prior, yy + prior
        det = xx * yy - xy * xy
        steepest = most_change / (float(PATCH_RADIUS << octave[i]) / focal)
        slant[row, 0] = min(max((yy * bx - xy * by) / det, -steepest), steepest)
        slant[row, 1] = min(max((xx * by - xy * bx) / det, -steepest), steepest)
