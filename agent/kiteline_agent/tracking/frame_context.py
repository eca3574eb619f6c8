"""What every stage may read of the frame in work."""

from dataclasses import dataclass

from kiteline_agent.config import AgentConfig
from kiteline_agent.tracking.frame_images import FrameImages
from kiteline_agent.tracking.shutter.rolling_shutter import RollingShutter
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuBatch
from kiteline_core.geometry import se3


@dataclass(frozen=True, slots=True)
class FrameContext:
    """One frame, rectified, with its predicted pose.

    number: counts processed frames from 1. dt_s: time since the last processed frame; 0 for the first. T_m_c: (4,4)
    predicted pose of the camera in the active submap. repeated: the image equals the one before. config: at the effort
    that the governor allows. shutter: None for a global one, and while the motion is unknown.
    """

    number: int
    t_ns: int
    dt_s: float
    imu: ImuBatch | None
    images: FrameImages
    T_m_c: F64
    repeated: bool
    config: AgentConfig
    shutter: RollingShutter | None = None

    @property
    def T_c_m(self) -> F64:
        """(4,4) predicted pose of the active submap in the camera."""
        return se3.inverse(self.T_m_c)
