"""Patch alignment: where in a new image does a template lie, to a fraction of a pixel.

Inverse-compositional Lucas-Kanade over position, invariant to gain and offset of brightness (S. Baker, I. Matthews,
"Lucas-Kanade 20 years on", 2004): the template's gradients are made orthogonal to the template and to a constant, so
both drop out of the normal equations. Templates are warped by the affine map that the predicted pose gives.
"""

from __future__ import annotations

import numpy as np

from kiteline_core.jit import njit

PATCH_RADIUS = 4  # a patch is 9x9 px of the level at which it is compared
PATCH = 2 * PATCH_RADIUS + 1
TEMPLATE_RADIUS = 10  # a template is 21x21 px: room for a 9x9 patch turned by 45 degrees and scaled by 1.5
TEMPLATE = 2 * TEMPLATE_RADIUS + 1
TEMPLATE_LEVELS = 3  # octave of the corner, and two coarser ones for convergence


@njit
def sample(image, x, y):  # type: ignore[no-untyped-def]
    """Bilinear value of `image` at (x, y); the caller keeps 0 <= x < w-1, 0 <= y < h-1."""
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
    """Cut a template (21,21) uint8 whose first pixel is at (left, top), all of it inside: one weight for all pixels."""
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

    Pixels outside of the image repeat its border.
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


@njit
def warp_template(template, w00, w01, w10, w11, reference, gx, gy):  # type: ignore[no-untyped-def]
    """Sample the warped template and its gradients. Returns False where the warp leaves the template."""
    n = PATCH + 2
    reach = (PATCH_RADIUS + 1.0) * (abs(w00) + abs(w01))
    reach = max(reach, (PATCH_RADIUS + 1.0) * (abs(w10) + abs(w11)))
    if reach >= TEMPLATE_RADIUS - 0.001:
        return False
    for r in range(n):
        dy = r - PATCH_RADIUS - 1.0
        for c in range(n):
            dx = c - PATCH_RADIUS - 1.0
            reference[r, c] = sample(
                template, TEMPLATE_RADIUS + w00 * dx + w01 * dy, TEMPLATE_RADIUS + w10 * dx + w11 * dy
            )
    for r in range(PATCH):
        for c in range(PATCH):
            gx[r, c] = 0.5 * (reference[r + 1, c + 2] - reference[r + 1, c])
            gy[r, c] = 0.5 * (reference[r + 2, c + 1] - reference[r, c + 1])
    return True


@njit
def _prepare(reference, gx, gy, t0):  # type: ignore[no-untyped-def]
    """Zero-mean template t0 and gradients orthogonal to it and to a constant. Returns (sum t0^2, h00, h01, h11)."""
    count = PATCH * PATCH
    mean = 0.0
    mx = 0.0
    my = 0.0
    for r in range(PATCH):
        for c in range(PATCH):
            mean += reference[r + 1, c + 1]
            mx += gx[r, c]
            my += gy[r, c]
    mean /= count
    mx /= count
    my /= count
    tt = 1e-9
    tx = 0.0
    ty = 0.0
    for r in range(PATCH):
        for c in range(PATCH):
            t = reference[r + 1, c + 1] - mean
            t0[r, c] = t
            gx[r, c] -= mx
            gy[r, c] -= my
            tt += t * t
            tx += t * gx[r, c]
            ty += t * gy[r, c]
    h00 = 0.0
    h01 = 0.0
    h11 = 0.0
    for r in range(PATCH):
        for c in range(PATCH):
            a = gx[r, c] - tx / tt * t0[r, c]
            b = gy[r, c] - ty / tt * t0[r, c]
            gx[r, c] = a
            gy[r, c] = b
            h00 += a * a
            h01 += a * b
            h11 += b * b
    return tt, h00, h01, h11


@njit
def _iterate(image, t0, gx, gy, tt, h00, h01, h11, x, y, iterations, max_step):  # type: ignore[no-untyped-def]
    """Move (x, y) until the patch there looks like t0. Returns (x, y, ncc, whether it stayed inside)."""
    h, w = image.shape
    det = h00 * h11 - h01 * h01
    if det < 1e-3 * (h00 + h11) ** 2 * 0.25 or h00 + h11 < 1.0:
        return x, y, 0.0, False
    start_x = x
    start_y = y
    ncc = 0.0
    converged = False
    for k in range(iterations + 1):
        if x < PATCH_RADIUS or y < PATCH_RADIUS or x >= w - PATCH_RADIUS - 1 or y >= h - PATCH_RADIUS - 1:
            return x, y, 0.0, False
        x0 = int(x)
        y0 = int(y)
        fx = x - x0
        fy = y - y0
        w00 = (1.0 - fx) * (1.0 - fy)
        w01 = fx * (1.0 - fy)
        w10 = (1.0 - fx) * fy
        w11 = fx * fy
        si = 0.0
        sii = 0.0
        st = 0.0
        sx = 0.0
        sy = 0.0
        for r in range(PATCH):
            row = y0 + r - PATCH_RADIUS
            for c in range(PATCH):
                col = x0 + c - PATCH_RADIUS
                v = (
                    w00 * image[row, col]
                    + w01 * image[row, col + 1]
                    + w10 * image[row + 1, col]
                    + w11 * image[row + 1, col + 1]
                )
                si += v
                sii += v * v
                st += v * t0[r, c]
                sx += v * gx[r, c]
                sy += v * gy[r, c]
        spread = sii - si * si / (PATCH * PATCH)
        ncc = st / np.sqrt(tt * max(spread, 1e-9))
        gain = st / tt
        if gain < 0.1:
            return x, y, ncc, False
        if converged or k == iterations:
            break
        dx = -(h11 * sx - h01 * sy) / (det * gain)
        dy = -(h00 * sy - h01 * sx) / (det * gain)
        norm = np.sqrt(dx * dx + dy * dy)
        if norm > 2.0:  # beyond the patch's linear range: go only part of the way
            dx *= 2.0 / norm
            dy *= 2.0 / norm
        x += dx
        y += dy
        converged = norm < 0.02
        if abs(x - start_x) > max_step or abs(y - start_y) > max_step:
            return x, y, 0.0, False
    return x, y, ncc, True


@njit
def align(pyramid, templates, rows, octave, warp, uv, first, last, iterations, max_step_px, min_ncc, found, ncc):  # type: ignore[no-untyped-def]
    """Align templates[rows] in `pyramid`, coarse (template level `first`) to fine (`last`).

    pyramid: tuple of uint8 images, each half the size of the one before. templates: (N,3,21,21) uint8.
    rows: (n,) int64 into templates. octave: (n,) uint8, level at which each template was cut.
    warp: (n,2,2) float64, d(pixel here) / d(pixel in the template's image), both at level 0.
    uv: (n,2) float64 px at level 0: prediction in, result out (unchanged where not found).
    max_step_px: how far a level may move the patch, in px of that level. found: (n,) bool out. ncc: (n,) float64 out.
    """
    levels = len(pyramid)
    reference = np.empty((PATCH + 2, PATCH + 2))
    gx = np.empty((PATCH, PATCH))
    gy = np.empty((PATCH, PATCH))
    t0 = np.empty((PATCH, PATCH))
    for i in range(rows.shape[0]):
        found[i] = False
        ncc[i] = 0.0
        det = warp[i, 0, 0] * warp[i, 1, 1] - warp[i, 0, 1] * warp[i, 1, 0]
        if det < 0.06 or det > 16.0:
            continue
        scale = np.sqrt(det)
        shift = int(np.floor(np.log2(scale) + 0.5))
        x = uv[i, 0]
        y = uv[i, 1]
        ok = False
        score = 0.0
        for j in range(first, last - 1, -1):
            cut = min(octave[i] + j, levels - 1)
            level = min(max(cut + shift, 0), levels - 1)
            ratio = float(1 << level) / float(1 << cut) / det
            inside = warp_template(
                templates[rows[i], j],
                warp[i, 1, 1] * ratio,
                -warp[i, 0, 1] * ratio,
                -warp[i, 1, 0] * ratio,
                warp[i, 0, 0] * ratio,
                reference,
                gx,
                gy,
            )
            if not inside:
                continue
            tt, h00, h01, h11 = _prepare(reference, gx, gy, t0)
            s = float(1 << level)
            px, py, score, ok = _iterate(
                pyramid[level], t0, gx, gy, tt, h00, h01, h11, x / s, y / s, iterations, max_step_px
            )
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
