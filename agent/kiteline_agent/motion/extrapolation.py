"""The motion since the last frame, for a pose between frames or of a frame that was skipped."""

from dataclasses import dataclass
from enum import StrEnum

from kiteline_core.arrays import F64
from kiteline_core.geometry import se3

LEAST_PREDICTION_PERCENT = 10.0  # of a core: with less, predictions of skipped frames would take half of it
MAX_PREDICTION_S = 1.0  # s after the last processed frame: later no pose is predicted


class MotionSource(StrEnum):
    """What measured the motion since the last frame; VELOCITY: nothing, it is that of the last frames."""

    IMU = "imu"
    ODOMETER = "odometer"
    VELOCITY = "velocity"


@dataclass(frozen=True, slots=True)
class Extrapolation:
    """Body of an instant after the last frame.

    T_m_b: (4,4). velocity: (3,) m/s of the body's origin in m. rate: (3,) rad/s in b. growth: (6,6) covariance of the
    motion since the last frame, [translation in m, rotation about the body's axes]; None if no sensor measured it.
    """

    T_m_b: F64
    velocity: F64
    rate: F64
    growth: F64 | None
    source: MotionSource


def along_twist(T_m_b: F64, twist: F64, dt_s: float, growth: F64 | None, source: MotionSource) -> Extrapolation:
    """The body dt_s after T_m_b (4,4), at a constant twist (6,) [m/s, rad/s] in b."""
    T = se3.orthonormalise(T_m_b @ se3.exp(dt_s * twist))
    return Extrapolation(T, T[:3, :3] @ twist[:3], twist[3:].copy(), growth, source)
