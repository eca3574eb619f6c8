"""Stereo along the row of a rectified pair: coarse search, then sub-pixel alignment in one dimension."""

from __future__ import annotations

import numpy as np

from kiteline_core.jit import njit

RADIUS = 4
SIDE = 2 * RADIUS + 1


@njit
def search_rows(left, right, uv, octave, max_disparity_px, uniqueness, disparity):  # type: ignore[no-untyped-def]
    """Coarse disparity of pixels by zero-mean SAD over whole rows, at pyramid level max(octave, 1).

    left, right: tuples of uint8 pyramids. uv: (n,2) level-0 px. uniqueness: the second-best cost must exceed this
    factor of the best. disparity: (n,) float64 out, level-0 px, -1 where there is no sure match.
    """
    levels = len(left)
    patch = np.empty((SIDE, SIDE), np.int32)
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
        best = 1 << 30
        second = 1 << 30
        best_d = -1
        for d in range(-1, reach + 1):
            xr = x - d
            if xr + RADIUS >= w:
                continue
            other = 0
            for r in range(SIDE):
                row = y + r - RADIUS
                for c in range(SIDE):
                    other += int(b[row, xr + c - RADIUS])
            shift = mean - other // (SIDE * SIDE)
            cost = 0
            for r in range(SIDE):
                row = y + r - RADIUS
                for c in range(SIDE):
                    cost += abs(patch[r, c] - int(b[row, xr + c - RADIUS]) - shift)
            if cost < best:
                if d - best_d > 2:
                    second = best
                best = cost
                best_d = d
            elif cost < second and d - best_d > 2:
                second = cost
        if best < (1 << 30) and second > uniqueness * best:
            disparity[i] = max(best_d * s, 0.0)


@njit
def refine_rows(left, right, uv, octave, iterations, max_step_px, min_ncc, disparity, found):  # type: ignore[no-untyped-def]
    """Sub-pixel disparity by 1-D Lucas-Kanade, invariant to gain and offset, at level `octave` (and one coarser first).

    disparity: (n,) float64 px at level 0: prediction in (negative: skip), result out. found: (n,) bool out.
    max_step_px: how far the match may lie from the prediction, in px of the level.
    """
    levels = len(left)
    t0 = np.empty((SIDE, SIDE))
    g = np.empty((SIDE, SIDE))
    for i in range(uv.shape[0]):
        found[i] = False
        if disparity[i] < 0.0:
            continue
        start = disparity[i]
        d = start
        ok = False
        for step in range(2):
            level = min(int(octave[i]) + 1 - step, levels - 1)
            a = left[level]
            b = right[level]
            h, w = a.shape
            s = float(1 << level)
            x = uv[i, 0] / s
            y = uv[i, 1] / s
            ok = False
            if x < RADIUS + 1 or y < RADIUS or x >= w - RADIUS - 2 or y >= h - RADIUS - 1:
                continue
            y0 = int(y)
            fy = y - y0
            x0 = int(x)
            fx = x - x0
            mean = 0.0
            mg = 0.0
            for r in range(SIDE):
                ra = y0 + r - RADIUS
                for c in range(SIDE):
                    ca = x0 + c - RADIUS
                    l1 = (1.0 - fy) * a[ra, ca - 1] + fy * a[ra + 1, ca - 1]
                    l2 = (1.0 - fy) * a[ra, ca] + fy * a[ra + 1, ca]
                    l3 = (1.0 - fy) * a[ra, ca + 1] + fy * a[ra + 1, ca + 1]
                    l4 = (1.0 - fy) * a[ra, ca + 2] + fy * a[ra + 1, ca + 2]
                    v = (1.0 - fx) * l2 + fx * l3
                    gv = 0.5 * ((1.0 - fx) * (l3 - l1) + fx * (l4 - l2))
                    t0[r, c] = v
                    g[r, c] = gv
                    mean += v
                    mg += gv
            mean /= SIDE * SIDE
            mg /= SIDE * SIDE
            tt = 1e-9
            tg = 0.0
            for r in range(SIDE):
                for c in range(SIDE):
                    t0[r, c] -= mean
                    g[r, c] -= mg
                    tt += t0[r, c] * t0[r, c]
                    tg += t0[r, c] * g[r, c]
            hess = 0.0
            for r in range(SIDE):
                for c in range(SIDE):
                    g[r, c] -= tg / tt * t0[r, c]
                    hess += g[r, c] * g[r, c]
            if hess < 30.0:
                continue
            xr = x - d / s
            begin = xr
            ncc = 0.0
            converged = False
            for k in range(iterations + 1):
                if xr < RADIUS or xr >= w - RADIUS - 1 or abs(xr - begin) > max_step_px:
                    ncc = -1.0
                    break
                c0 = int(xr)
                fr = xr - c0
                si = 0.0
                sii = 0.0
                st = 0.0
                sg = 0.0
                for r in range(SIDE):
                    ra = y0 + r - RADIUS
                    for c in range(SIDE):
                        ca = c0 + c - RADIUS
                        v1 = (1.0 - fy) * b[ra, ca] + fy * b[ra + 1, ca]
                        v2 = (1.0 - fy) * b[ra, ca + 1] + fy * b[ra + 1, ca + 1]
                        v = v1 + fr * (v2 - v1)
                        si += v
                        sii += v * v
                        st += v * t0[r, c]
                        sg += v * g[r, c]
                ncc = st / np.sqrt(tt * max(sii - si * si / (SIDE * SIDE), 1e-9))
                gain = st / tt
                if gain < 0.1:
                    ncc = -1.0
                    break
                if converged or k == iterations:
                    break
                move = -sg / (hess * gain)
                move = min(max(move, -1.5), 1.5)
                xr += move
                converged = abs(move) < 0.01
            if ncc >= min_ncc or (step == 0 and ncc > 0.6):
                d = (x - xr) * s
                ok = step == 1
        if ok and d > 0.0:
            disparity[i] = d
            found[i] = True
