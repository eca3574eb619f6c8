"""Corners followed from frame to frame before there is a map. Images that would cut or bend tracks are left out."""

import numpy as np

from kiteline_agent.imaging.optical_flow import Flow, follow
from kiteline_core.arrays import F64, I64, U8, Bool

_LEAST_FOLLOWED = 0.08  # share of the corners that an image must show: fewer, and it is black, covered or damaged
_JUMP_PX = 8.0  # px by which the motion of a corner changes from image to image: parallax of no vehicle does
_TORN = 0.2  # share of the corners that jump in a torn image, at least
_FITS = 5  # of a linear motion, each with the weights of the one before
_FEW_FOUND = 0.75  # share of the corners; with fewer found the motion is at the reach of flow, and guides the others
_LEAST_KNOWN = 20  # corners whose motion into the image before is known, to tell jumps


class BadImages:
    """Tells which images to leave out: torn ones and those that show hardly any of the corners before, not for ever."""

    def __init__(self, most: int = 4) -> None:
        """most: in a row that are left out; flow hardly reaches over more than four frames."""
        self._most = most
        self.in_a_row = 0

    def leaves_out(self, found: Bool, *, torn: bool = False) -> bool:
        """True if an image in which these of the corners (n,) were found is to be left out."""
        bad = torn or int(np.count_nonzero(found)) < _LEAST_FOLLOWED * len(found)
        leaves = bad and self.in_a_row < self._most
        self.in_a_row = self.in_a_row + 1 if leaves else 0
        return leaves


class FrameFlow:
    """Corners in the last frame that showed them, followed into the next one.

    image: (h,w) that frame; None before the first. uv: (n,2) px of the corners in it. smooth: their motion into it goes
    on from the one before, so that none of these images is torn.
    """

    def __init__(self, flow: Flow) -> None:
        self._flow = flow
        self.image: U8 | None = None
        self.uv = np.zeros((0, 2))
        self.smooth = False
        self._step = np.zeros((0, 2))  # px by which they moved from frame to frame; NaN: unknown
        self._bad = BadImages()

    def begin(self, image: U8, uv: F64) -> None:
        """Follow these corners (n,2) from this frame on."""
        self.image, self.uv, self._step, self.smooth = image, uv, np.full(uv.shape, np.nan), False

    def replace(self, good: Bool, uv: F64, at: I64) -> None:
        """Of the corners keep the good ones (n,), which are at these rows of uv (m,2) px; the others of uv are new."""
        step = self._step[good]
        self.uv, self._step = uv, np.full(uv.shape, np.nan)
        self._step[at] = step

    def follow(self, image: U8) -> Bool | None:
        """Follow the corners into the next frame. Returns those that are found (n,); None if the image is left out."""
        good = np.zeros(len(self.uv), np.bool_)
        if self.image is not None and len(self.uv):
            uv, good = follow(self.image, image, self.uv, self._flow)
            if np.count_nonzero(good) < _FEW_FOUND * len(good):
                self._find_others(image, uv, good)
            step = (uv - self.uv) / (self._bad.in_a_row + 1)
            torn = is_torn(uv[good], step[good] - self._step[good])
            if self._bad.leaves_out(good, torn=torn is True and self.smooth):  # else the image before may be torn
                return None
            self.smooth = torn is False
            self.uv, self._step = uv[good], step[good]
        self.image = image
        return good

    def _find_others(self, image: U8, uv: F64, good: Bool) -> None:
        """Search corners that were not found (n,) again, from where the motion of the others puts them; write both."""
        lost = np.flatnonzero(~good)
        if self.image is None or len(good) - len(lost) < _LEAST_KNOWN:
            return
        guess = self.uv[lost] + motion_beside(self.uv[good], (uv - self.uv)[good], self.uv[lost])
        uv[lost], good[lost] = follow(self.image, image, self.uv[lost], self._flow, guess=guess)


def is_torn(uv: F64, change: F64) -> bool | None:
    """True if a part of an image jumped: it is torn. None if too little is known.

    uv: (n,2) px of corners. change: (n,2) px of their motions from image to image; NaN where unknown.

    Turns, rolls and steps of the camera change motions by a linear function of the place, which is fitted robustly.
    What it leaves are jumps.
    """
    known = np.isfinite(change).all(axis=1)
    if np.count_nonzero(known) < _LEAST_KNOWN:
        return None
    _, off_px = _linear_fit(uv[known] - uv[known].mean(axis=0), change[known])
    return bool(np.mean(off_px > _JUMP_PX) > _TORN)


def motion_beside(uv: F64, motion: F64, others: F64) -> F64:
    """Motion (m,2) px of `others` (m,2), by the linear function that most motions (n,2) of pixels uv (n,2) follow."""
    middle = uv.mean(axis=0)
    fit = _linear_fit(uv - middle, motion)[0]
    return np.asarray(np.column_stack([np.ones(len(others)), others - middle]) @ fit)


def _linear_fit(uv: F64, motion: F64) -> tuple[F64, F64]:
    """The linear function (3,2) of 1 and the place (n,2) that most motions (n,2) follow, and how far each is off."""
    A = np.column_stack([np.ones(len(uv)), uv])
    off_px = np.linalg.norm(motion - np.median(motion, axis=0), axis=1)
    fit = np.zeros((3, 2))
    for _ in range(_FITS):
        weight = 1.0 / (1.0 + (2.0 * off_px / _JUMP_PX) ** 2)
        fit = np.linalg.lstsq(A * weight[:, None], motion * weight[:, None], rcond=None)[0]
        off_px = np.linalg.norm(motion - A @ fit, axis=1)
    return fit, off_px
