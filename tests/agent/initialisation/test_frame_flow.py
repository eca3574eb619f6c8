"""Corners followed from frame to frame before there is a map."""

import cv2
import numpy as np
import pytest

from kiteline_agent.imaging.optical_flow import Flow
from kiteline_agent.initialisation.frame_flow import FrameFlow
from kiteline_core.arrays import U8

SIZE = (300, 600)


def scene() -> U8:
    grey = cv2.GaussianBlur(np.random.default_rng(0).normal(128.0, 80.0, (SIZE[0], SIZE[1] + 100)), (0, 0), 1.5)
    return cv2.normalize(grey, None, 0.0, 255.0, cv2.NORM_MINMAX).astype(np.uint8)  # type: ignore[call-overload]


@pytest.mark.parametrize("shift_px", [4, 15, 30])
def test_corners_are_followed_through_a_fast_turn(shift_px: int) -> None:
    wide = scene()
    before, after = (np.ascontiguousarray(wide[:, k : k + SIZE[1]]) for k in (0, shift_px))
    uv = cv2.goodFeaturesToTrack(before, 200, 0.01, 15.0).reshape(-1, 2).astype(np.float64)
    in_view = np.count_nonzero(uv[:, 0] > shift_px + 8)
    flow = FrameFlow(Flow(window_px=15, border_px=4.0, return_px=1.0))
    flow.begin(before, uv)
    found = flow.follow(after)
    assert found is not None
    right = np.linalg.norm(flow.uv - (uv[found] - (shift_px, 0.0)), axis=1) < 0.5
    assert np.count_nonzero(right) > 0.85 * in_view
