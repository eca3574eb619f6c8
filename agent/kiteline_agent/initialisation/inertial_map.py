"""What a start by images and IMU finds: a map in metres."""

from dataclasses import dataclass

from kiteline_agent.initialisation.corner_tracks import CornerObservations, TrackedKeyframe
from kiteline_agent.initialisation.metric_restart import MetricPoints
from kiteline_agent.initialisation.window.window_state import WindowSolution
from kiteline_agent.tracking.frame_context import FrameContext
from kiteline_agent.tracking.shutter.rolling_shutter import RollingShutter
from kiteline_core.arrays import F64


@dataclass(frozen=True, slots=True)
class InertialMap:
    """The first keyframe of a map in metres, and the state there.

    frame: the newest keyframe of the window. points: new landmarks. solution: its window. cov: (17,17) of the state, as
    in InertialState. scale_sigma: relative deviation of the scale. duration_s: length of the window. accel_noise:
    factor on the accelerometer's noise. lens: (8,) found of the camera (lens_correction), with which the landmarks'
    pixels are corrected. keyframes (K), corners (K,P): of the window. shutters: (K) rolling shutters in motion, one
    of each keyframe; none if it is a global one.
    """

    frame: FrameContext
    points: MetricPoints
    solution: WindowSolution
    cov: F64
    scale_sigma: float
    duration_s: float
    accel_noise: float
    lens: F64
    keyframes: tuple[TrackedKeyframe, ...]
    corners: CornerObservations
    shutters: tuple[RollingShutter, ...]
