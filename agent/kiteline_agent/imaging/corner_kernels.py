"""FAST corners in the free cells of an image (E. Rosten, T. Drummond, 2006): nine pixels in a row on a ring of sixteen.

The same corners as cv2.FastFeatureDetector finds, kept where their score is the greatest of its 3x3 neighbourhood.
Every pixel is scored without a branch, so that the loops become vectors; unsigned indices spare them the check for
negative ones.
"""

import numpy as np

from kiteline_core.jit import helper, njit


@helper
def ring_scores(r0, r1, r2, r3, r4, r5, r6, score):  # type: ignore[no-untyped-def]
    """FAST score: difference from the centre of the weakest pixel of the best arc of nine.

    r0 to r6: rows y-3 to y+3, (n+6,) uint8. score: (n,) uint8 out, of the pixels 3 to n+2 of r3.
    """
    u1, u2, u3, u4, u5, u6 = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4), np.uint64(5), np.uint64(6)
    for i in range(score.shape[0]):
        j = np.uint64(i)
        c = r3[j + u3]
        p0, p1, p2, p3 = r0[j + u3], r0[j + u4], r1[j + u5], r2[j + u6]
        p4, p5, p6, p7 = r3[j + u6], r4[j + u6], r5[j + u5], r6[j + u4]
        p8, p9, p10, p11 = r6[j + u3], r6[j + u2], r5[j + u1], r4[j]
        p12, p13, p14, p15 = r3[j], r2[j], r1[j + u1], r0[j + u2]
        # Darkest pixel of two, of four, then of eight neighbours, and the better of two ninth ones.
        a1, a3, a5, a7 = min(p1, p2), min(p3, p4), min(p5, p6), min(p7, p8)
        a9, a11, a13, a15 = min(p9, p10), min(p11, p12), min(p13, p14), min(p15, p0)
        b1, b3, b5, b7 = min(a1, a3), min(a3, a5), min(a5, a7), min(a7, a9)
        b9, b11, b13, b15 = min(a9, a11), min(a11, a13), min(a13, a15), min(a15, a1)
        high = min(b1, b5, max(p0, p9))
        high = max(high, min(b3, b7, max(p2, p11)))
        high = max(high, min(b5, b9, max(p4, p13)))
        high = max(high, min(b7, b11, max(p6, p15)))
        high = max(high, min(b9, b13, max(p8, p1)))
        high = max(high, min(b11, b15, max(p10, p3)))
        high = max(high, min(b13, b1, max(p12, p5)))
        high = max(high, min(b15, b3, max(p14, p7)))
        a1, a3, a5, a7 = max(p1, p2), max(p3, p4), max(p5, p6), max(p7, p8)
        a9, a11, a13, a15 = max(p9, p10), max(p11, p12), max(p13, p14), max(p15, p0)
        b1, b3, b5, b7 = max(a1, a3), max(a3, a5), max(a5, a7), max(a7, a9)
        b9, b11, b13, b15 = max(a9, a11), max(a11, a13), max(a13, a15), max(a15, a1)
        low = max(b1, b5, min(p0, p9))
        low = min(low, max(b3, b7, min(p2, p11)))
        low = min(low, max(b5, b9, min(p4, p13)))
        low = min(low, max(b7, b11, min(p6, p15)))
        low = min(low, max(b9, b13, min(p8, p1)))
        low = min(low, max(b11, b15, min(p10, p3)))
        low = min(low, max(b13, b1, min(p12, p5)))
        low = min(low, max(b15, b3, min(p14, p7)))
        score[j] = max(np.uint8(max(high, c) - c), np.uint8(c - min(low, c)))


@helper
def peaks(above, at, below, threshold, peak):  # type: ignore[no-untyped-def]
    """Mark scores above a threshold that exceed their eight neighbours.

    above, at, below: rows of scores (n+2,) uint8. peak: (n,) uint8 out, 1 or 0, of the scores 1 to n of `at`.
    """
    u1, u2 = np.uint64(1), np.uint64(2)
    for i in range(peak.shape[0]):
        j = np.uint64(i)
        v = at[j + u1]
        m = max(above[j], above[j + u1], above[j + u2], at[j])
        m = max(m, at[j + u2], below[j], below[j + u1], below[j + u2])
        peak[j] = np.uint8((v > threshold) & (v > m))


@njit
def fast_corners(image, threshold, margin, scale, cell_px, occupied, xy):  # type: ignore[no-untyped-def]
    """Detect corners in free cells, at least `margin` (> 3) px inside the image. Returns their number.

    scale: level-0 px a pixel of this image. cell_px: side of a cell at level 0. occupied: (rows, columns) bool.
    xy: (m,2) int32 out; corners beyond m are left out, which a quarter of the pixels always is enough for.
    """
    h, w = image.shape
    span = w - 6
    scores = np.zeros((3, w), np.uint8)
    padded = (w + 7) // 8 * 8
    peak = np.zeros(padded, np.uint8)
    eights = peak.view(np.uint64)
    n = 0
    for y in range(margin - 1, h - margin + 1):
        ring_scores(
            image[y - 3, 0:w], image[y - 2, 0:w], image[y - 1, 0:w], image[y, 0:w], image[y + 1, 0:w],
            image[y + 2, 0:w], image[y + 3, 0:w], scores[y % 3, 3 : 3 + span],
        )  # fmt: skip
        if y < margin + 1:
            continue
        at = y - 1
        peaks(scores[(y - 2) % 3, 0:w], scores[at % 3, 0:w], scores[y % 3, 0:w], np.uint8(threshold), peak[0 : w - 2])
        row = int(at * scale / cell_px)
        for k in range(eights.shape[0]):
            if eights[k] == 0:
                continue
            for x in range(8 * k + 1, min(8 * k + 9, w - margin)):
                if peak[x - 1] == 0 or x < margin or occupied[row, int(x * scale / cell_px)] or n == xy.shape[0]:
                    continue
                xy[n, 0] = x
                xy[n, 1] = at
                n += 1
    return n
