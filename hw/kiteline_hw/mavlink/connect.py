"""Opens the connection to a flight controller from the user's options."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.geometry.cameras import CameraRig
from kiteline_hw.mavlink.controller_imu import ControllerImu
from kiteline_hw.mavlink.controller_odometry import ControllerOdometry, ControllerOdometryConfig, parse_odometry_option
from kiteline_hw.mavlink.controller_session import SessionConfig
from kiteline_hw.mavlink.coordinate_frames import mounting
from kiteline_hw.mavlink.messages import GlobalOrigin
from kiteline_hw.mavlink.pose_memory import PoseMemory
from kiteline_hw.mavlink.pose_sink import MavlinkPoseSink, SinkOptions
from kiteline_hw.mavlink.start_frame import StartConfig, StartFrame
from kiteline_hw.mavlink.transport.signing import Signing, StampFile, read_key
from kiteline_hw.mavlink.transport.url import parse_mavlink_url
from kiteline_hw.mavlink.tunnel.tunnel_end import AGENT_END, TunnelConfig
from kiteline_hw.ports import Clock, LinkError, SourceReport
from kiteline_hw.system import process

HEADINGS = ("start", "controller")  # of the frame of the poses
POSE_MESSAGES = ("odometry", "vision")


@dataclass(frozen=True, slots=True)
class ControllerOptions:
    """What users say about a flight controller.

    axes: letters of the body axes, "" for the default of the rig. offset: "X,Y,Z" of the controller in the body in m,
    "": at its origin. odometry: which of the controller's velocities to use. heading, messages: of HEADINGS and
    POSE_MESSAGES. origin: "LAT,LON,ALT" in degrees and m, "": none is set. key: a file for signatures, "": none.
    link: LINK of the agent, whose tunnel may be on the same connection. folder: for what outlives this process, "":
    nothing does.
    """

    url: str
    axes: str = ""
    offset: str = ""
    odometry: str = ""
    heading: str = "start"
    messages: str = "odometry"
    origin: str = ""
    key: str = ""
    link: str = ""
    folder: str = ""


def connect(
    options: ControllerOptions, rig: CameraRig, clock: Clock, *, pose_rate_hz: float = 0.0, imu_rate_hz: float = 0.0,
    body_is_controller: bool = False, report: SourceReport,
) -> MavlinkPoseSink:  # fmt: skip
    """Open the connection. Raises LinkError.

    pose_rate_hz: at which poses are sent at most; 0: the default. imu_rate_hz: at which the controller's inertial
    samples are requested; 0: not used. body_is_controller: the rig's body frame is the controller's.
    """
    axes = options.axes
    if body_is_controller and axes.lower() not in ("", "frd"):
        raise LinkError(
            f"--axes {axes}: with T_f_c in [agent.controller_imu] the body is the controller's, frd: leave it out"
        )
    if body_is_controller and options.offset:
        raise LinkError("--offset: with T_f_c in [agent.controller_imu] the body is the controller's: leave it out")
    default = "frd" if body_is_controller else "flu" if rig.has_body else "rdf"
    velocities = imu = None
    option = "--axes"
    try:
        T_b_f = mounting(axes or default, _offset(options.offset))
        if options.odometry:
            option = "--odometry"
            source, track_m = parse_odometry_option(options.odometry)
            velocities = ControllerOdometry(source, T_b_f, ControllerOdometryConfig(track_m=track_m))
    except ValueError as error:
        raise LinkError(f"{option}: {error}") from error
    if imu_rate_hz > 0.0:
        imu = ControllerImu(np.ascontiguousarray(T_b_f[:3, :3]), imu_rate_hz, report)
    config = SessionConfig(
        rate_hz=pose_rate_hz if pose_rate_hz > 0.0 else SessionConfig().rate_hz,
        vision=options.messages == "vision",
        origin=_origin(options.origin),
    )
    return MavlinkPoseSink(
        options.url, T_b_f, clock, required=False, config=config, odometry=velocities, imu=imu,
        options=_sink_options(options, T_b_f, clock),
    )  # fmt: skip


def _sink_options(options: ControllerOptions, T_b_f: F64, clock: Clock) -> SinkOptions:
    if options.heading not in HEADINGS:
        raise LinkError(f"--heading {options.heading}: expected {' or '.join(HEADINGS)}")
    if options.messages not in POSE_MESSAGES:
        raise LinkError(f"--pose-messages {options.messages}: expected {' or '.join(POSE_MESSAGES)}")
    memory = PoseMemory(Path(options.folder) / "last_pose.json") if options.folder else None
    last = None if memory is None else memory.load(clock.now_ns())
    start = StartFrame(T_b_f, StartConfig(north=options.heading == "controller"), last)
    signing = None
    if options.key:
        stamps = StampFile(Path(options.folder or Path(options.key).parent) / "mavlink_stamp")
        signing = Signing(read_key(Path(options.key)), stamps)
        if stamps.fault:  # the vehicle flies all the same
            process.print_lines([f"{stamps.fault}: after a start without a clock, signed messages may be refused"])
    return SinkOptions(signing, start, memory, shared_tunnel(options.url, options.link), computer=True)


def shared_tunnel(url: str, link: str) -> TunnelConfig | None:
    """The tunnel that LINK asks for on the connection of the controller at url; None if it uses another one.

    Raises LinkError if both name one serial port in different ways.
    """
    scheme, _, address = link.partition(":")
    if not url:
        return None
    ours = parse_mavlink_url(url)
    if scheme == "serial" and ours.kind == "serial" and address.rpartition(":")[0] == ours.address:
        raise LinkError(
            f"--link {link} and --mavlink {url} name one port. Packets for a base go through a flight controller as a "
            f"tunnel: expected --link mavlink:{url}"
        )
    if scheme != "mavlink":
        return None
    theirs = parse_mavlink_url(address)
    if not ours.same_port(theirs):
        return None
    if ours.port != theirs.port:
        raise LinkError(f"--link {link} and --mavlink {url}: expected one baud rate for one port")
    return AGENT_END


def _offset(text: str) -> tuple[float, float, float]:
    if not text:
        return 0.0, 0.0, 0.0
    x, y, z = _three(text, "--offset", "X,Y,Z in metres along the body's axes, for instance 0.1,0,-0.03")
    if max(abs(x), abs(y), abs(z)) > 10.0:
        raise LinkError(f"--offset {text}: more than 10 m from the body's origin to the flight controller: metres?")
    return x, y, z


def _origin(text: str) -> GlobalOrigin | None:
    if not text:
        return None
    latitude, longitude, altitude_m = _three(text, "--origin", "LAT,LON,ALT in degrees and metres")
    if abs(latitude) > 90.0 or abs(longitude) > 180.0 or abs(altitude_m) > 20_000.0:
        raise LinkError(f"--origin {text}: no place on earth: expected LAT,LON,ALT in degrees and metres")
    return GlobalOrigin(round(latitude * 1e7), round(longitude * 1e7), round(altitude_m * 1000))


def _three(text: str, option: str, form: str) -> tuple[float, float, float]:
    """The three finite numbers of an option. Raises LinkError."""
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError as error:
        raise LinkError(f"{option} {text}: expected {form}") from error
    if not all(map(math.isfinite, (x, y, z))):
        raise LinkError(f"{option} {text}: expected {form}")
    return x, y, z
