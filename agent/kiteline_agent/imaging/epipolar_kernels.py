"""Kernel of the epipolar search for landmarks without depth: template correlation along a line segment."""

import numpy as np

from kiteline_agent.imaging.alignment_kernels import (
    GREY,
    PATCH,
    PATCH_RADIUS,
    STRIDE,
    TEMPLATE_LEVELS,
    WARPED,
    warp_template,
)
from kiteline_agent.imaging.rectification_kernels import ROOM, SIDE, _rectify_patch
from kiteline_core.jit import njit


@njit
def search_segments(  # type: ignore[no-untyped-def]
    pyramid, grid, templates, rows, octave, warp, start, end, step_px, max_steps, min_ncc, distinct, uv, found
):
    """Best correlation of templates[rows] along segments, at the template's octave or, on long segments, one coarser.

    pyramid, grid: as in `align`. templates: (N,3,21,21) uint8. rows: (n,).
    octave: (n,) uint8. warp: (n,2,2), d(pixel here)/d(pixel in the template's image). start, end: (n,2) level-0 px.
    step_px: px of the level between two tries; max_steps: tries at most, the level grows coarser to keep to it.
    min_ncc: least correlation. distinct: the best elsewhere on the segment must stay below this share of the best.
    uv: (n,2) float64 level-0 px out. found: (n,) int8 out: 1 found, 0 nothing alike, -1 not sure which, or out of view.
    """
    levels = len(pyramid)
    around = np.zeros((4, WARPED), np.uint16)
    reference = np.empty((PATCH + 2, STRIDE), np.int16)
    t0 = np.empty((PATCH, PATCH))
    score = np.empty(max_steps + 1)
    count = float(PATCH * PATCH)
    whole = np.empty((SIDE, SIDE), np.uint8)
    for i in range(rows.shape[0]):
        found[i] = -1
        det = warp[i, 0, 0] * warp[i, 1, 1] - warp[i, 0, 1] * warp[i, 1, 0]
        if det < 0.06 or det > 16.0:
            continue
        dx = end[i, 0] - start[i, 0]
        dy = end[i, 1] - start[i, 1]
        length = np.sqrt(dx * dx + dy * dy)
        shift = int(np.floor(0.5 * np.log2(det) + 0.5))
        j = 0
        cut = min(int(octave[i]), levels - 1)
        level = min(max(cut + shift, 0), levels - 1)
        while j < TEMPLATE_LEVELS - 1 and length / (step_px * (1 << level)) > max_steps:
            j += 1
            cut = min(int(octave[i]) + j, levels - 1)
            level = min(max(cut + shift, 0), levels - 1)
        ratio = float(1 << level) / float(1 << cut) / det
        inside = warp_template(
            templates[rows[i], j],
            warp[i, 1, 1] * ratio,
            -warp[i, 0, 1] * ratio,
            -warp[i, 1, 0] * ratio,
            warp[i, 0, 0] * ratio,
            around,
            reference,
        )
        if not inside:
            continue
        mean = 0.0
        for r in range(PATCH):
            for c in range(PATCH):
                t0[r, c] = reference[r + 1, c + 1] / GREY
                mean += t0[r, c]
        mean /= count
        tt = 1e-9
        for r in range(PATCH):
            for c in range(PATCH):
                t0[r, c] -= mean
                tt += t0[r, c] * t0[r, c]
        image = pyramid[level]
        h, w = image.shape
        s = float(1 << level)
        steps = min(int(np.ceil(length / (step_px * s))), max_steps)
        best = -1.0
        best_k = -1
        seen = 0
        raw = grid.shape[0] > 0
        left = -SIDE  # of `whole` in the image
        top = -SIDE
        for k in range(steps + 1):
            part = k / steps if steps > 0 else 0.0
            x = (start[i, 0] + part * dx) / s
            y = (start[i, 1] + part * dy) / s
            score[k] = -1.0
            if x < PATCH_RADIUS or y < PATCH_RADIUS or x >= w - PATCH_RADIUS - 1 or y >= h - PATCH_RADIUS - 1:
                continue
            x0 = int(x)
            y0 = int(y)
            fx = x - x0
            fy = y - y0
            if raw:
                if abs(x0 - left - PATCH_RADIUS - ROOM) > ROOM or abs(y0 - top - PATCH_RADIUS - ROOM) > ROOM:
                    left = x0 - PATCH_RADIUS - ROOM
                    top = y0 - PATCH_RADIUS - ROOM
                    if not _rectify_patch(pyramid[level], grid, s, float(left), float(top), SIDE, SIDE, 14, whole.T):
                        left = -SIDE
                        continue
                x0 -= left
                y0 -= top
                image = whole
            seen += 1
            w00 = (1.0 - fx) * (1.0 - fy)
            w01 = fx * (1.0 - fy)
            w10 = (1.0 - fx) * fy
            w11 = fx * fy
            si = 0.0
            sii = 0.0
            st = 0.0
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
            score[k] = st / np.sqrt(tt * max(sii - si * si / count, 1e-9))
            if score[k] > best:
                best = score[k]
                best_k = k
        if seen == 0:
            continue
        if best < min_ncc:
            found[i] = 0
            continue
        rival = -1.0
        apart = int(np.ceil(PATCH_RADIUS / step_px))
        for k in range(steps + 1):
            if abs(k - best_k) > apart and score[k] > rival:
                rival = score[k]
        if rival > distinct * best:
            continue
        part = best_k / steps if steps > 0 else 0.0
        uv[i, 0] = start[i, 0] + part * dx
        uv[i, 1] = start[i, 1] + part * dy
        found[i] = 1
