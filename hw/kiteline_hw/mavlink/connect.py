"""Opens the connection to a flight controller from the user's options."""

from __future__ import annotations

import numpy as np

from kiteline_core.geometry.cameras import CameraRig
from kiteline_hw.mavlink.controller_imu import ControllerImu
from kiteline_hw.mavlink.controller_odometry import (
    ControllerOdometry,
    ControllerOdometryConfig,
    parse_odometry_option,
)
from kiteline_hw.mavlink.controller_session import OdometryConfig
from kiteline_hw.mavlink.coordinate_frames import mounting
from kiteline_hw.mavlink.pose_sink import MavlinkPoseSink
from kiteline_hw.ports import Clock, LinkError, SourceReport


def connect(
    url: str, rig: CameraRig, axes: str, clock: Clock, *, odometry: str = "", pose_rate_hz: float = 0.0,
    imu_rate_hz: float = 0.0, body_is_controller: bool = False, report: SourceReport,
) -> MavlinkPoseSink:  # fmt: skip
    """Open the connection. Raises LinkError.

    axes: letters of the body axes, "" for the default of the rig. odometry: which of the controller's velocities to
    use. pose_rate_hz: at which poses are sent at most; 0: the default. imu_rate_hz: at which its inertial samples are
    requested; 0: not used. body_is_controller: the rig's body frame is the controller's.
    """
    if body_is_controller and axes.lower() not in ("", "frd"):
        raise LinkError(
            f"--axes {axes}: with T_f_c in [agent.controller_imu] the body is the controller's, frd: leave it out"
        )
    default = "frd" if body_is_controller else "flu" if rig.has_body else "rdf"
    velocities = imu = None
    try:
        T_b_f = mounting(axes or default)
        if odometry:
            source, track_m = parse_odometry_option(odometry)
            velocities = ControllerOdometry(source, T_b_f, ControllerOdometryConfig(track_m=track_m))
    except ValueError as error:
        raise LinkError(f"--axes or --odometry: {error}") from error
    if imu_rate_hz > 0.0:
        imu = ControllerImu(np.ascontiguousarray(T_b_f[:3, :3]), imu_rate_hz, report)
    config = OdometryConfig(rate_hz=pose_rate_hz) if pose_rate_hz > 0.0 else OdometryConfig()
    return MavlinkPoseSink(url, T_b_f, clock, required=False, config=config, odometry=velocities, imu=imu)
