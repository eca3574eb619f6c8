"""Runs the kernels of ground segmentation once, on level ground that ends at a wall."""

import numpy as np

from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ground.column_scan import ColumnScan
from kiteline_core.ground.config import GroundConfig
from kiteline_core.ground.disparity import DisparityStripes
from kiteline_core.ground.segmentation import ExpectedGround, GroundSegmenter

_WALL_PX = 2.6  # disparity of the wall
_HEIGHT_M = 1.0  # of the camera


def warm_ground(camera: RectifiedCamera) -> tuple[GroundSegmenter, ColumnScan]:
    """Run every kernel with the types of flights; the segmenter, and the scan that it made.

    camera: of a level stereo pair, rectified.
    """
    segmenter = GroundSegmenter(camera, GroundConfig())
    view = segmenter.camera
    image = np.zeros((view.height, view.width), np.uint8)
    stripes = DisparityStripes(view, GroundConfig())
    stripes.begin_reduced((image, image))
    stripes.measure_begun()
    rows = (np.arange(view.height) - view.cy) / view.fy
    disparity = np.broadcast_to(np.maximum(rows * view.bf, _WALL_PX)[:, None], image.shape)
    up_c = np.array([0.0, -1.0, 0.0])
    measured = np.ascontiguousarray(disparity, np.float32), (image, image), up_c
    segmenter.segment(*measured, expected=ExpectedGround(_HEIGHT_M, 0.1))
    return segmenter, segmenter.segment(*measured).scan
