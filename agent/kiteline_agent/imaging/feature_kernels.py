"""Kernels of corner scores, orientations and binary descriptors."""

import numpy as np

from kiteline_agent.imaging.alignment_kernels import LANES, STRIDE, dot, eight_pixels
from kiteline_core.jit import njit

DESCRIPTOR_RADIUS = 15  # px around a corner used by orientation and descriptor
_WINDOW = 7  # px; side of the window of a corner's score
BORDER = 18  # least distance of a corner from the image border, px of its level


@njit
def corner_scores(image, xy, score):  # type: ignore[no-untyped-def]
    """Smaller eigenvalue of the structure tensor over 7x7 px (J. Shi, C. Tomasi, 1994), per pixel of the window.

    xy: (n,2) int32 pixels at least 5 px inside. score: (n,) float64 out. The sums are exact: of integers.
    """
    rows = np.zeros(2 * (_WINDOW + 3), np.uint64)  # of STRIDE pixels each
    grey = rows.view(np.uint8)
    inside = np.zeros(LANES, np.int16)  # the window, of the rows' columns
    for r in range(_WINDOW):
        for q in range(_WINDOW):
            inside[r * STRIDE + q] = 1
    dx, dy = np.zeros(LANES, np.int16), np.zeros(LANES, np.int16)
    for i in range(xy.shape[0]):
        left = np.uint64(xy[i, 0] - 4)
        for r in range(_WINDOW + 2):
            y = np.uint64(xy[i, 1] - 4 + r)
            rows[2 * r] = eight_pixels(image, y, left)
            rows[2 * r + 1] = image[y, left + np.uint64(8)]
        for k in range(_WINDOW * STRIDE):
            j = np.uint64(k)
            used = np.int32(inside[j])
            dx[j] = (np.int32(grey[np.uint64(k + STRIDE + 2)]) - np.int32(grey[np.uint64(k + STRIDE)])) * used
            dy[j] = (np.int32(grey[np.uint64(k + 2 * STRIDE + 1)]) - np.int32(grey[np.uint64(k + 1)])) * used
        a, b, c = dot(dx, dx), dot(dx, dy), dot(dy, dy)
        # each slope is twice the derivative
        half = 0.125 * (a + c)
        apart = 0.25 * (a - c)
        across = 0.25 * b
        score[i] = (half - np.sqrt(0.25 * apart * apart + across * across)) / 49.0


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
        m01 = 0
        m10 = 0
        for r in range(-radius, radius + 1):
            reach = int(np.sqrt(radius * radius - r * r))
            line = image[xy[i, 1] + r, xy[i, 0] - reach : xy[i, 0] + reach + 1]
            row = 0
            moment = 0
            for q in range(line.shape[0]):
                v = int(line[np.uint64(q)])
                moment += q * v
                row += v
            m10 += moment - reach * row
            m01 += r * row
        angle[i] = np.arctan2(float(m01), float(m10))


@njit
def _blur(image, x, y, across, patch):  # type: ignore[no-untyped-def]
    """Smooth the patch (31, 32) around (x, y) as cv2.GaussianBlur(image, (7, 7), 2.0) does, to the last bit.

    across: (37, 32) uint16 buffer of the rows smoothed along x. Weights are in 1/256. Unsigned indices (no check for
    negative ones) allow vectorisation.
    """
    u1, u2, u3, u4, u5, u6 = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4), np.uint64(5), np.uint64(6)
    side = 2 * DESCRIPTOR_RADIUS + 1
    for r in range(side + 6):
        line = image[y - BORDER + r, x - BORDER : x + BORDER + 1]
        for half in range(2):  # twice 16 columns, one of them in both: full vectors
            for c in range(16):
                j = np.uint64(15 * half + c)
                across[r, j] = np.uint16(
                    18 * (np.int32(line[j]) + line[j + u6]) + 34 * (np.int32(line[j + u1]) + line[j + u5])
                    + 48 * (np.int32(line[j + u2]) + line[j + u4]) + 56 * np.int32(line[j + u3])
                )  # fmt: skip
    for r in range(side):
        for c in range(side + 1):
            j = np.uint64(c)
            total = (
                18 * (np.int32(across[r, j]) + across[r + 6, j]) + 34 * (np.int32(across[r + 1, j]) + across[r + 5, j])
                + 48 * (np.int32(across[r + 2, j]) + across[r + 4, j]) + 56 * np.int32(across[r + 3, j])
            )  # fmt: skip
            patch[r, j] = np.uint8((total + 32768) >> 16)


@njit
def steer(pattern, angle, tests):  # type: ignore[no-untyped-def]
    """Turn the pattern of the binary tests by angles (a,) rad.

    pattern: (256,4) float64, x1 y1 x2 y2 within 10 px per axis of the centre. tests: (a,2,256) int16 out, places of the
    first and the second pixel of each test in the smoothed patch of `describe`.
    """
    side = 2 * DESCRIPTOR_RADIUS + 1
    centre = DESCRIPTOR_RADIUS * (side + 1) + DESCRIPTOR_RADIUS
    for i in range(angle.shape[0]):
        ca = np.cos(angle[i])
        sa = np.sin(angle[i])
        for k in range(256):
            for end in range(2):
                px, py = pattern[k, 2 * end], pattern[k, 2 * end + 1]
                x = int(np.floor(ca * px - sa * py + 0.5))
                y = int(np.floor(sa * px + ca * py + 0.5))
                tests[i, end, k] = centre + y * (side + 1) + x


@njit
def describe(image, xy, turn, tests, descriptor):  # type: ignore[no-untyped-def]
    """Steered binary tests on the smoothed image. xy: (n,2) int32, BORDER px inside. turn: (n,) int64 into tests.

    tests: see `steer`. descriptor: (n,32) uint8 out.
    """
    side = 2 * DESCRIPTOR_RADIUS + 1
    across = np.zeros((side + 6, side + 1), np.uint16)
    patch = np.empty((side, side + 1), np.uint8)
    grey = patch.reshape(-1)
    for i in range(xy.shape[0]):
        _blur(image, xy[i, 0], xy[i, 1], across, patch)
        first, second = tests[turn[i], 0], tests[turn[i], 1]
        for byte in range(32):
            bits = 0
            for bit in range(8):
                k = np.uint64(byte * 8 + bit)
                bits |= int(grey[first[k]] < grey[second[k]]) << bit
            descriptor[i, byte] = bits
