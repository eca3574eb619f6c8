"""Corners followed from frame to frame by optical flow, with an id each."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from kiteline_agent.ekf_config import EkfConfig
from kiteline_agent.imaging import features
from kiteline_agent.imaging.features import DetectorConfig, Pyramid

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Bools = NDArray[np.bool_]
U8 = NDArray[np.uint8]

_BORDER_PX = 8.0  # a window of the flow and its gradients lie inside


class CornerFlow:
    """Follows corners; ids increase and are never used again."""

    def __init__(self, detector: DetectorConfig, config: EkfConfig) -> None:
        self._detector, self._config = detector, config
        self._last: Pyramid | None = None
        self._anchor: Pyramid | None = None  # an earlier frame, to which corners are compared
        self._anchor_ids: I64 = np.zeros(0, np.int64)
        self._anchor_uv = np.zeros((0, 2))
        self._frame = 0
        self._next_id = 0
        self.ids: I64 = np.zeros(0, np.int64)  # (n,) increasing
        self.uv = np.zeros((0, 2))  # (n,2) px of the newest frame
        self.octave: U8 = np.zeros(0, np.uint8)  # (n,) of the frame in which the corner was found

    def add(self, left: Pyramid) -> None:
        """Follow the corners into a frame, and find new ones where few are left."""
        if self._last is not None and len(self.ids):
            uv, good = self._followed(self._last, left, self.uv)
            self.ids, self.uv, self.octave = self.ids[good], uv[good], self.octave[good]
        self._last = left
        self._frame += 1
        is_anchor = self._frame % self._config.anchor_frames == 1
        if is_anchor:
            self._drop_sliding(left)
        if len(self.ids) < self._config.replenish * self._config.corners:
            found = features.detect(left, self.uv, self._detector)
            n = min(len(found.uv), self._config.corners - len(self.ids))
            self.uv = np.concatenate([self.uv, found.uv[:n]])
            self.octave = np.concatenate([self.octave, found.octave[:n]])
            self.ids = np.concatenate([self.ids, self._next_id + np.arange(n)])
            self._next_id += n
        if is_anchor:
            self._anchor, self._anchor_ids, self._anchor_uv = left, self.ids.copy(), self.uv.copy()

    def drop(self, ids: I64) -> None:
        """Forget corners."""
        keep = ~np.isin(self.ids, ids)
        self.ids, self.uv, self.octave = self.ids[keep], self.uv[keep], self.octave[keep]

    def _drop_sliding(self, left: Pyramid) -> None:
        """Drop corners that the anchor finds elsewhere: they slide along edges or before what lies behind them."""
        if self._anchor is None:
            return
        _, at, now = np.intersect1d(self._anchor_ids, self.ids, assume_unique=True, return_indices=True)
        if not len(at):
            return
        uv, good = self._followed(self._anchor, left, self._anchor_uv[at])
        good &= np.linalg.norm(uv - self.uv[now], axis=1) < self._config.slide_px
        self.drop(self.ids[now[~good]])

    def _followed(self, before: Pyramid, after: Pyramid, uv: F64) -> tuple[F64, Bools]:
        """Pixels (n,2) of corners (n,2) in a later image, and which of them are found, forward and backward."""
        size = {"winSize": (self._config.window_px, self._config.window_px), "maxLevel": 3}
        start = uv.astype(np.float32)
        found, ok, _ = cv2.calcOpticalFlowPyrLK(before[0], after[0], start, None, **size)  # type: ignore[call-overload]
        back, ok_back, _ = cv2.calcOpticalFlowPyrLK(after[0], before[0], found, start.copy(), **size)  # type: ignore[call-overload]
        limit = np.array([after[0].shape[1], after[0].shape[0]]) - _BORDER_PX
        inside = (found >= _BORDER_PX).all(axis=1) & (found < limit).all(axis=1)
        same = np.linalg.norm(back - start, axis=1) < self._config.backward_px
        return found.astype(np.float64), (ok.ravel() == 1) & (ok_back.ravel() == 1) & inside & same
