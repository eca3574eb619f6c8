"""What enters one step of the agent and what leaves it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kiteline_core.frame import Frame, ImuBatch, OdometryBatch
from kiteline_core.ids import AgentId, KeyframeId, SubmapId

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Identity:
    """Who this agent is. boot: counts starts, never reused."""

    agent: AgentId
    boot: int


@dataclass(frozen=True, slots=True)
class StepInput:
    """All that enters a step. imu, odometry: samples since the last frame. cpu_ns: process CPU time that the last frame
    took, as measured or modelled outside.
    """

    frame: Frame | None = None
    imu: ImuBatch | None = None
    packets: tuple[bytes, ...] = ()
    cpu_ns: int = 0
    odometry: OdometryBatch | None = None


@dataclass(frozen=True, slots=True)
class Estimate:
    """What is known of the vehicle at one frame.

    tracked: T_m_b is measured from at least 15 image inliers, or (bridged) carried by the IMU for a short while.
    T_m_b: (4,4) body in the submap frame, or None. T_o_b: (4,4) body in the odometry frame, always continuous.
    keyframe, T_k_c: the same pose relative to a keyframe's camera. T_w_b: (4,4) in the world, once the base has placed
    the submap; before that in the submap set upright, where it began askew.
    quality: how likely, in percent, the pose is good (CertaintyConfig) against where the flight began, at least 1; -1:
    nothing measures the motion. A later submap lies there as odometry says, until it is found how it truly lies.
    cov_m: (6,6) of T_m_b against where its submap began, [translation in m, rotation about the body's axes], m and rad.
    cov_o: (6,6) of T_o_b against where the flight began, [translation in o, rotation about the body's axes].
    R_l_o: (3,3) sets the odometry frame upright, the same for good once it is known; None before, where a flight begins
    in motion.
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

    @property
    def T_l_b(self) -> F64 | None:
        """(4,4) body in the odometry frame set upright: what a flight controller gets. None until that is known."""
        if self.R_l_o is None:
            return None
        T = self.T_o_b.copy()
        T[:3] = self.R_l_o @ T[:3]
        return T

    @property
    def cov_l(self) -> F64:
        """cov_o with translations in the upright frame."""
        turn = np.eye(6)
        turn[:3, :3] = np.eye(3) if self.R_l_o is None else self.R_l_o
        return np.asarray(turn @ self.cov_o @ turn.T)


@dataclass(frozen=True, slots=True)
class StepOutput:
    """All that leaves a step. events: short words for the log, in order."""

    estimate: Estimate | None
    packets: tuple[bytes, ...]
    events: tuple[str, ...]
