"""Runs the filter's kernels before the first frame."""

import numpy as np

from kiteline_agent.ekf.corner_flow import CornerFlow
from kiteline_agent.ekf.ekf_slam import EkfSlam
from kiteline_agent.ekf.filter_state import OdometryMotion
from kiteline_agent.ekf_config import EkfConfig
from kiteline_agent.imaging.features import DetectorConfig, build_pyramid
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera

_STEP_M = 0.1
_STEPS = 12


def warm_filter(detector: DetectorConfig) -> None:
    """Move a camera sideways along a wall of points until these have entered and are updated; follow corners."""
    camera = RectifiedCamera(320, 240, 200.0, 200.0, 159.5, 119.5, 0.1, False, np.eye(4))
    slam = EkfSlam(camera, EkfConfig())
    x, y = np.meshgrid(np.arange(-1.0, 2.0, 0.5), np.arange(-1.0, 1.5, 0.5))
    wall = np.stack([x.ravel(), y.ravel(), np.full(x.size, 4.0)], axis=1)
    step = np.array([_STEP_M, 0.0, 0.0])
    motion = OdometryMotion(se3.from_rt(np.eye(3), step), step, 1e-6 * np.eye(6))
    for k in range(_STEPS):
        if k > 0:
            slam.predict(motion)
        local = wall - k * step
        slam.update(np.arange(len(wall)), 200.0 * local[:, :2] / local[:, 2:] + [camera.cx, camera.cy])
    flow = CornerFlow(camera, detector, EkfConfig())
    squares = np.kron(np.indices((15, 20)).sum(axis=0) % 2 * 200, np.ones((16, 16))).astype(np.uint8)
    pyramid = build_pyramid(squares, detector.levels)
    flow.replenish(pyramid, np.eye(4))
    flow.follow(pyramid)
    flow.align(pyramid, np.eye(4), np.zeros(len(flow.ids)))
