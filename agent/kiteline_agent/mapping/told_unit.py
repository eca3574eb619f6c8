"""Metres in a unit of two views that begin a map after a loss, by the way between them that a sensor told."""

from dataclasses import dataclass

import numpy as np

from kiteline_agent.initialisation.two_view_start import TwoViewMap
from kiteline_agent.mapping.camera_state import CameraState
from kiteline_agent.motion.odometer_scale import LEAST_MOVED_M
from kiteline_agent.tracking.frame_context import FrameContext

_YOUNG = 0.1  # relative; a map of two views drifts by 5 to 9 % in its first seconds


@dataclass(frozen=True, slots=True)
class ToldUnit:
    """metres: in one unit of two views. sigma: relative deviation of lengths in the map that they begin."""

    metres: float
    sigma: float


def told_unit(camera: CameraState, ctx: FrameContext, views: TwoViewMap) -> ToldUnit | None:
    """The unit of two views, the second of which is this frame; None if no sensor told the way between them.

    Roughly: the odometry frame does not jump, and there are poses, until IMU or odometer tell the scale.
    """
    if not (camera.submaps.any and camera.had_metres and camera.motion.told):
        return None
    told_m = float(np.linalg.norm(ctx.T_m_c[:3, 3] - views.T_m_a[:3, 3]))
    seen = float(np.linalg.norm(views.T_a_b[:3, 3]))
    if told_m <= LEAST_MOVED_M or seen <= 0.0:
        return None
    off_m = camera.motion.velocity_sigma * (ctx.t_ns - views.t_ns) * 1e-9
    return ToldUnit(told_m / seen, float(np.hypot(off_m / told_m, _YOUNG)))
