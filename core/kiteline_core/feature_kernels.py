"""Corners, their orientation and their binary descriptors."""

from __future__ import annotations

import numpy as np

from kiteline_core.jit import njit

DESCRIPTOR_RADIUS = 15  # px around a corner that orientation and descriptor look at
BORDER = 18  # px a corner stays away from the image border, at its own level


@njit
def corner_scores(image, xy, score):  # type: ignore[no-untyped-def]
    """Smaller eigenvalue of the structure tensor over 7x7 px (J. Shi, C. Tomasi, 1994), per pixel of the window.

    xy: (n,2) int32 pixels at least 5 px inside. score: (n,) float64 out.
    """
    for i in range(xy.shape[0]):
        x = xy[i, 0]
        y = xy[i, 1]
        a = 0.0
        b = 0.0
        c = 0.0
        for r in range(-3, 4):
            for q in range(-3, 4):
                dx = 0.5 * (float(image[y + r, x + q + 1]) - float(image[y + r, x + q - 1]))
                dy = 0.5 * (float(image[y + r + 1, x + q]) - float(image[y + r - 1, x + q]))
                a += dx * dx
                b += dx * dy
                c += dy * dy
        score[i] = (0.5 * (a + c) - np.sqrt(0.25 * (a - c) * (a - c) + b * b)) / 49.0


@njit
def occupy(uv, cell_px, occupied):  # type: ignore[no-untyped-def]
    """Mark the cells in which pixels (n,2) at level 0 lie. occupied: (rows, columns) bool, in and out."""
    for i in range(uv.shape[0]):
        r = int(uv[i, 1] / cell_px)
        c = int(uv[i, 0] / cell_px)
        if 0 <= r < occupied.shape[0] and 0 <= c < occupied.shape[1]:
            occupied[r, c] = True


@njit
def best_per_cell(xy, score, level, cell_px, min_score, occupied, best_score, best_xy, best_level):  # type: ignore[no-untyped-def]
    """Keep the best corner of each free cell over the levels. best_*: (rows, columns[, 2]) in and out."""
    s = 1 << level
    for i in range(xy.shape[0]):
        if score[i] < min_score:
            continue
        r = int(xy[i, 1] * s / cell_px)
        c = int(xy[i, 0] * s / cell_px)
        if occupied[r, c]:
            continue
        if score[i] > best_score[r, c]:
            best_score[r, c] = score[i]
            best_xy[r, c, 0] = xy[i, 0] * s
            best_xy[r, c, 1] = xy[i, 1] * s
            best_level[r, c] = level


@njit
def orientations(image, xy, angle):  # type: ignore[no-untyped-def]
    """Direction of the intensity centroid in radians (E. Rublee et al., "ORB", 2011, section 3.2).

    xy: (n,2) int32 at this level, DESCRIPTOR_RADIUS inside. angle: (n,) float64 out, in [-pi, pi].
    """
    radius = DESCRIPTOR_RADIUS
    for i in range(xy.shape[0]):
        m01 = 0.0
        m10 = 0.0
        for r in range(-radius, radius + 1):
            reach = int(np.sqrt(radius * radius - r * r))
            row = 0.0
            for q in range(-reach, reach + 1):
                v = float(image[xy[i, 1] + r, xy[i, 0] + q])
                m10 += q * v
                row += v
            m01 += r * row
        angle[i] = np.arctan2(m01, m10)


@njit
def describe(blurred, xy, angle, pattern, descriptor):  # type: ignore[no-untyped-def]
    """Steered binary tests. blurred: smoothed image of the level. xy: (n,2) int32. angle: (n,) rad.

    pattern: (256,4) float64, x1 y1 x2 y2 within 12 px of the centre. descriptor: (n,32) uint8 out.
    """
    for i in range(xy.shape[0]):
        ca = np.cos(angle[i])
        sa = np.sin(angle[i])
        x = xy[i, 0]
        y = xy[i, 1]
        for byte in range(32):
            bits = 0
            for bit in range(8):
                p = pattern[byte * 8 + bit]
                x1 = x + int(np.floor(ca * p[0] - sa * p[1] + 0.5))
                y1 = y + int(np.floor(sa * p[0] + ca * p[1] + 0.5))
                x2 = x + int(np.floor(ca * p[2] - sa * p[3] + 0.5))
                y2 = y + int(np.floor(sa * p[2] + ca * p[3] + 0.5))
                if blurred[y1, x1] < blurred[y2, x2]:
                    bits |= 1 << bit
            descriptor[i, byte] = bits
