"""A flight controller beside the source: poses out, velocities and IMU samples in."""

from __future__ import annotations

from contextlib import ExitStack

from kiteline_agent.runtime.options import (
    AgentOptions,
    agent_config,
)
from kiteline_hw.ports import ControllerLink, FrameSource, LinkError
from kiteline_hw.sources.overrides import with_other_imu
from kiteline_hw.system.clock import MonotonicClock


def controller_link(
    options: AgentOptions, source: FrameSource, clock: MonotonicClock, stack: ExitStack
) -> ControllerLink | None:
    """The link to a flight controller, which gets poses; None without one. Raises LinkError."""
    if not options.mavlink:
        if options.odometry:
            raise LinkError("--odometry takes velocities from a flight controller: expected --mavlink URL beside it")
        return None
    from kiteline_hw.mavlink.connect import connect

    own = agent_config(options.config).controller_imu
    return stack.enter_context(
        connect(
            options.mavlink, source.rig, options.axes, clock, odometry=options.odometry,
            imu_rate_hz=own.noise.rate_hz if options.imu_of else 0.0,
            body_is_controller=bool(options.imu_of and own.T_f_c), report=source.report,
        )
    )  # fmt: skip


def with_controller_imu(options: AgentOptions, source: FrameSource) -> FrameSource:
    """The source, with the flight controller's IMU in place of its own if the options say so. Raises LinkError."""
    if not options.imu_of:
        return source
    if options.imu_of != "controller" or not options.mavlink:
        raise LinkError("--imu controller takes a flight controller's samples: expected --mavlink URL beside it")
    if not options.imu:
        raise LinkError("--imu controller and --no-imu: expected one of them")
    own = agent_config(options.config).controller_imu
    if not own.T_f_c and not (source.rig.has_body and options.axes):
        raise LinkError(
            f"--imu controller: nobody says where the camera of {source.name} sits in the vehicle: expected T_f_c, the "
            "camera in the flight controller's frame, in [agent.controller_imu] of --config (or --axes, for a source "
            "that knows its body)"
        )
    return with_other_imu(source, own.noise, own.camera())
