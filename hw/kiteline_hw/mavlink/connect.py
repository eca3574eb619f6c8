"""The connection to a flight controller as a user asks for it: what is sent, what is taken, how the body is mounted."""

from __future__ import annotations

import numpy as np

from kiteline_core.geometry.cameras import CameraRig
from kiteline_hw.mavlink.frames import mounting
from kiteline_hw.mavlink.imu import ControllerImu
from kiteline_hw.mavlink.odometry import FromController, FromControllerConfig, told_of
from kiteline_hw.mavlink.out import MavlinkPoseSink
from kiteline_hw.ports import Clock, LinkError, SourceReport


def connect(
    url: str, rig: CameraRig, axes: str, clock: Clock, *, odometry: str = "", imu_rate_hz: float = 0.0,
    body_is_controller: bool = False, report: SourceReport,
) -> MavlinkPoseSink:  # fmt: skip
    """Open it. axes: letters of the body, "" for the usual ones. odometry: what to take of its velocity. imu_rate_hz:
    at which its inertial samples are taken; 0: not. body_is_controller: the rig's body frame is the controller's own.
    Raises LinkError.
    """
    if body_is_controller and axes.lower() not in ("", "frd"):
        raise LinkError(
            f"--axes {axes}: with T_f_c in [agent.controller_imu] the body is the controller's, frd: leave it out"
        )
    usual = "frd" if body_is_controller else "flu" if rig.has_body else "rdf"
    wanted = imu = None
    try:
        T_b_f = mounting(axes or usual)
        if odometry:
            told, track_m = told_of(odometry)
            wanted = FromController(told, T_b_f, FromControllerConfig(track_m=track_m))
    except ValueError as error:
        raise LinkError(f"--axes or --odometry: {error}") from error
    if imu_rate_hz > 0.0:
        imu = ControllerImu(np.ascontiguousarray(T_b_f[:3, :3]), imu_rate_hz, report)
    return MavlinkPoseSink(url, T_b_f, clock, required=False, wanted=wanted, imu=imu)
