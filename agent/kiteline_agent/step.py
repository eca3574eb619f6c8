"""What enters one step of the agent and what leaves it."""

from dataclasses import dataclass

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.frame import Frame, ImuBatch, OdometryBatch
from kiteline_core.ids import AgentId, KeyframeId, SubmapId


@dataclass(frozen=True, slots=True)
class Identity:
    """Number of an agent. boot: number of its start, never reused. submap: number of the first submap."""

    agent: AgentId
    boot: int
    submap: int = 0


@dataclass(frozen=True, slots=True)
class StepInput:
    """All that enters a step.

    imu, odometry: samples since the last step that had some. cpu_ns: CPU time of the last frame, measured or modelled
    outside. predict_ns: without a frame, the time for which a pose is predicted; None: none.
    """

    frame: Frame | None = None
    imu: ImuBatch | None = None
    packets: tuple[bytes, ...] = ()
    cpu_ns: int = 0
    odometry: OdometryBatch | None = None
    predict_ns: int | None = None


class _InOdometryFrame:
    """A pose in the odometry frame, which may be known to be tilted."""

    __slots__ = ()
    T_o_b: F64
    cov_o: F64
    R_l_o: F64 | None
    p_l_o: F64 | None

    @property
    def T_l_b(self) -> F64 | None:
        """(4,4) body in the gravity-aligned odometry frame, for a flight controller; None until that is known."""
        if self.R_l_o is None:
            return None
        T = self.T_o_b.copy()
        T[:3] = self.R_l_o @ T[:3]
        if self.p_l_o is not None:
            T[:3, 3] += self.p_l_o
        return T

    @property
    def cov_l(self) -> F64:
        """cov_o with translations in the gravity-aligned frame."""
        rotation = np.eye(6)
        rotation[:3, :3] = np.eye(3) if self.R_l_o is None else self.R_l_o
        return np.asarray(rotation @ self.cov_o @ rotation.T)


@dataclass(frozen=True, slots=True)
class Estimate(_InOdometryFrame):
    """Pose of the vehicle at one frame, with covariance and quality.

    tracked: T_m_b is measured from at least 15 image inliers, or (bridged) dead reckoning for at most 1 s.
    T_m_b: (4,4) body in the submap frame, or None. T_o_b: (4,4) body in the odometry frame, always continuous.
    keyframe, T_k_c: camera relative to a keyframe. T_w_b: (4,4) in the world once the base has placed the submap;
    before that in the gravity-aligned submap, if it is tilted, and in the submap itself once the agent moved its map:
    with what moves the map applied in small steps.
    quality: probability in percent, at least 1, that the pose is good (CovarianceConfig) relative to the start of the
    flight; -1: nothing measures the motion. A later submap counts as placed by odometry until it is recognised.
    cov_m: (6,6) of T_m_b relative to the start of its submap, [translation in m, rotation about the body's axes],
    m, rad.
    cov_o: (6,6) of T_o_b relative to the start of the flight, [translation in o, rotation about the body's axes];
    of one camera relative to where its lengths first were metres.
    R_l_o: (3,3) odometry frame to gravity-aligned frame. None before it is known, if a flight begins in motion, from
    when an IMU is left that never agreed with the images, and while it is measured again, because the IMU turned out
    to be mounted otherwise than the calibration says. It changes then, and after a loss over which nothing measured
    how the vehicle turned, once the IMU tells the vertical.
    p_l_o: (3,) m, origin of the odometry frame in the gravity-aligned one: the vehicle stays at its place where R_l_o
    changes. None: the same origin.
    initialising: there is no map yet, or one whose scale nothing has told yet, and so no pose: T_o_b means nothing.
    """

    t_ns: int
    tracked: bool
    bridged: bool
    T_m_b: F64 | None
    T_o_b: F64
    keyframe: KeyframeId
    T_k_c: F64
    submap: SubmapId
    inliers: int
    quality: int
    cov_m: F64
    cov_o: F64
    R_l_o: F64 | None
    T_w_b: F64 | None
    initialising: bool = False
    p_l_o: F64 | None = None


@dataclass(frozen=True, slots=True)
class PredictedPose(_InOdometryFrame):
    """Pose of an instant after the last tracked frame: of a skipped frame, or between frames.

    source: what measured the motion since then: imu, odometer, or velocity (nothing: it is that of the last frames).
    tracked: the last frame was. T_o_b, quality, cov_o, R_l_o, p_l_o: as in Estimate. velocity_o: (3,) m/s of the body's
    origin in o. rate_b: (3,) rad/s in b.
    """

    t_ns: int
    source: str
    tracked: bool
    T_o_b: F64
    velocity_o: F64
    rate_b: F64
    quality: int
    cov_o: F64
    R_l_o: F64 | None
    p_l_o: F64 | None = None

    @property
    def velocity_l(self) -> F64:
        """velocity_o in the gravity-aligned frame."""
        return self.velocity_o if self.R_l_o is None else np.asarray(self.R_l_o @ self.velocity_o)


@dataclass(frozen=True, slots=True)
class StepOutput:
    """All that leaves a step. events: short texts for the log, in order.

    predicted: of a skipped frame, whose estimate is None, or at the time that the step asks for.
    """

    estimate: Estimate | None
    packets: tuple[bytes, ...]
    events: tuple[str, ...]
    predicted: PredictedPose | None = None
