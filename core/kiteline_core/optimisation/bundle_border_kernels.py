"""Kernels for unknowns that many observations of a bundle share: what disparities are off by, as a border.

Arrays as in `bundle_kernels`. group (m,) int32: whose offset an observation's disparity has, -1 none. terms (m,t): its
offset is terms @ c[group], to be taken off what was measured. c: (g,t), numbered row by row behind the free cameras.
"""

import numpy as np

from kiteline_core.jit import njit
from kiteline_core.optimisation.bundle_kernels import NEAR_M


@njit
def correct(raw, group, terms, c, measured):  # type: ignore[no-untyped-def]
    """Disparities less their offsets into measured (m,3), never negative; raw (m,3)."""
    for o in range(raw.shape[0]):
        measured[o, 2] = raw[o, 2]
        if group[o] >= 0 and raw[o, 2] >= 0.0:
            off = 0.0
            for t in range(terms.shape[1]):
                off += terms[o, t] * c[group[o], t]
            measured[o, 2] = max(raw[o, 2] - off, 0.0)


@njit
def accumulate(  # type: ignore[no-untyped-def]
    cameras, lens, points, starts, camera, measured, weight, active, bound, free, group, terms, hbb, bb, hbc, hp
):
    """The border's blocks at the present estimate, filled from nothing: hbb (b,b) upper triangle, bb (b,), hbc (b,6f).

    hp (m,3): of each observation, weight times the gradient of its disparity by the point; terms times it is its block.
    """
    hbb[:], bb[:], hbc[:], hp[:] = 0.0, 0.0, 0.0, 0.0
    nt = terms.shape[1]
    for i in range(points.shape[0]):
        p0, p1, p2 = points[i, 0], points[i, 1], points[i, 2]
        for o in range(starts[i], starts[i + 1]):
            g = group[o]
            if active[o] == 0 or g < 0 or measured[o, 2] < 0.0:
                continue
            c = camera[o]
            x = cameras[c, 0] * p0 + cameras[c, 1] * p1 + cameras[c, 2] * p2 + cameras[c, 9]
            y = cameras[c, 3] * p0 + cameras[c, 4] * p1 + cameras[c, 5] * p2 + cameras[c, 10]
            d = cameras[c, 6] * p0 + cameras[c, 7] * p1 + cameras[c, 8] * p2 + cameras[c, 11]
            if d < NEAR_M:
                continue
            inv = 1.0 / d
            e0 = lens[c, 0] * x * inv + lens[c, 2] - measured[o, 0]
            e1 = lens[c, 1] * y * inv + lens[c, 3] - measured[o, 1]
            e2 = lens[c, 4] * inv - measured[o, 2]
            square = weight[o, 0] * (e0 * e0 + e1 * e1) + weight[o, 1] * e2 * e2
            w = weight[o, 1]
            if square > bound[1]:
                w *= np.sqrt(bound[1] / square)
            slope = -lens[c, 4] * inv * inv
            for k in range(3):
                hp[o, k] = w * slope * cameras[c, 6 + k]
            f = 6 * free[c]
            for a in range(nt):
                row = g * nt + a
                bb[row] -= terms[o, a] * w * e2
                for b in range(a, nt):
                    hbb[row, g * nt + b] += w * terms[o, a] * terms[o, b]
                if f >= 0:
                    hbc[row, f + 2] += w * terms[o, a] * slope
                    hbc[row, f + 3] += w * terms[o, a] * slope * y
                    hbc[row, f + 4] -= w * terms[o, a] * slope * x


@njit
def reduce_border(  # type: ignore[no-untyped-def]
    starts, camera, active, free, damping, hbb, bb, hbc, hp, bp, hcp, inv, group, terms, s, rhs
):
    """Add the border to the camera system that `bundle_kernels.reduce` left in s (6f+b,6f+b) and rhs (6f+b,)."""
    border, cameras = hbc.shape
    nt = terms.shape[1]
    for a in range(border):
        rhs[cameras + a] = bb[a]
        for b in range(a, border):
            s[cameras + a, cameras + b] = hbb[a, b]
        s[cameras + a, cameras + a] = hbb[a, a] * (1.0 + damping) + 1e-9
        for k in range(cameras):
            s[k, cameras + a] = hbc[a, k]
    block, y = np.zeros((border, 3)), np.zeros((border, 3))
    for i in range(starts.shape[0] - 1):
        low, high = border, 0
        for o in range(starts[i], starts[i + 1]):
            g = group[o]
            if active[o] == 0 or g < 0:
                continue
            low, high = min(low, g * nt), max(high, g * nt + nt)
            for a in range(nt):
                for k in range(3):
                    block[g * nt + a, k] += terms[o, a] * hp[o, k]
        for a in range(low, high):
            w0, w1, w2 = block[a, 0], block[a, 1], block[a, 2]
            y[a, 0] = w0 * inv[i, 0] + w1 * inv[i, 1] + w2 * inv[i, 2]
            y[a, 1] = w0 * inv[i, 1] + w1 * inv[i, 3] + w2 * inv[i, 4]
            y[a, 2] = w0 * inv[i, 2] + w1 * inv[i, 4] + w2 * inv[i, 5]
            rhs[cameras + a] -= y[a, 0] * bp[i, 0] + y[a, 1] * bp[i, 1] + y[a, 2] * bp[i, 2]
        for a in range(low, high):
            for b in range(a, high):
                s[cameras + a, cameras + b] -= y[a, 0] * block[b, 0] + y[a, 1] * block[b, 1] + y[a, 2] * block[b, 2]
        if low < high:
            for o in range(starts[i], starts[i + 1]):
                if active[o] == 0 or free[camera[o]] < 0:
                    continue
                f = 6 * free[camera[o]]
                for k in range(6):
                    for a in range(low, high):
                        s[f + k, cameras + a] -= (
                            hcp[o, k, 0] * y[a, 0] + hcp[o, k, 1] * y[a, 1] + hcp[o, k, 2] * y[a, 2]
                        )
        for a in range(low, high):
            for k in range(3):
                block[a, k] = 0.0


@njit
def points_for(starts, active, group, terms, hp, bp, dc, out):  # type: ignore[no-untyped-def]
    """The points' right-hand side (n,3) when the border moves by dc (b,): what `bundle_kernels.step` is to be given."""
    nt = terms.shape[1]
    for i in range(starts.shape[0] - 1):
        for k in range(3):
            out[i, k] = bp[i, k]
        for o in range(starts[i], starts[i + 1]):
            if active[o] == 0 or group[o] < 0:
                continue
            moved = 0.0
            for a in range(nt):
                moved += terms[o, a] * dc[group[o] * nt + a]
            for k in range(3):
                out[i, k] -= hp[o, k] * moved
