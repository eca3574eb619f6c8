"""Follows corners from one image to another by pyramidal optical flow, also where light or exposure change."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from kiteline_core.arrays import F64, U8, Bool

_SAME_LIGHT = 1.1  # ratio of the contrasts or means of two images below which flow is as good as in equal light
_LIGHT_STEP = 4  # px between the pixels whose contrast and mean are compared


@dataclass(frozen=True, slots=True)
class Flow:
    """How corners are followed.

    window_px: px of a window. border_px: px that a corner keeps from the image's border. return_px: px by which one
    that is followed back may be off; inf: it is not followed back.
    """

    window_px: int
    border_px: float = 8.0  # a window of 15 px lies inside
    return_px: float = np.inf


def follow(before: U8, after: U8, uv: F64, flow: Flow, levels: int = 3, guess: F64 | None = None) -> tuple[F64, Bool]:
    """Pixels (n,2) of corners uv (n,2) in the next image, and which of them are found (n,).

    before, after: (h,w). levels: above the finest one. guess: (n,2) px where they may be.
    """
    found, good, error = _followed(before, after, uv, flow, levels, guess)
    lit = as_bright_as(before, after)
    if lit is not after:  # light has changed, or the image shows something else: the more similar windows are right
        other, good_there, error_there = _followed(before, lit, uv, flow, levels, guess)
        both = good & good_there
        likelier = error_there[both].sum() < error[both].sum() if both.any() else good_there.any()
        if likelier:
            return other, good_there
    return found, good


def _followed(
    before: U8, after: U8, uv: F64, flow: Flow, levels: int, guess: F64 | None
) -> tuple[F64, Bool, NDArray[np.float32]]:
    """`follow` in images as they are, and the mean difference (n,) of the windows in grey levels."""
    size = {"winSize": (flow.window_px, flow.window_px), "maxLevel": levels}
    flags = 0 if guess is None else cv2.OPTFLOW_USE_INITIAL_FLOW
    start = uv.astype(np.float32)
    there = None if guess is None else guess.astype(np.float32)
    found, ok, error = cv2.calcOpticalFlowPyrLK(before, after, start, there, flags=flags, **size)  # type: ignore[call-overload]
    limit = np.array([after.shape[1], after.shape[0]]) - flow.border_px
    good = (ok.ravel() == 1) & (found >= flow.border_px).all(axis=1) & (found < limit).all(axis=1)
    if flow.return_px < np.inf:
        there = None if guess is None else start.copy()
        back, ok_back, _ = cv2.calcOpticalFlowPyrLK(after, before, found, there, flags=flags, **size)  # type: ignore[call-overload]
        good &= (ok_back.ravel() == 1) & (np.linalg.norm(back - start, axis=1) < flow.return_px)
    return found.astype(np.float64), good, error.ravel()


def as_bright_as(before: U8, after: U8) -> U8:
    """The image `after` (h,w) with the contrast and mean of `before`, if exposure or light has changed."""
    (mean0, std0), (mean1, std1) = (
        (float(part.mean()), float(part.std())) for part in (i[::_LIGHT_STEP, ::_LIGHT_STEP] for i in (before, after))
    )
    if min(mean0, mean1, std0, std1) <= 0.0:
        return after
    gain = std0 / std1
    if max(gain, 1.0 / gain, mean0 / mean1, mean1 / mean0) < _SAME_LIGHT:
        return after
    table = np.clip(np.rint(gain * (np.arange(256) - mean1) + mean0), 0.0, 255.0).astype(np.uint8)
    return np.asarray(cv2.LUT(after, table), np.uint8)
