"""Options of one agent process, from the command line or from `fly`; its configuration and channel."""

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.runtime import rig_file
from kiteline_codec.channel import CodedChannel, RecordChannel, coded_channel
from kiteline_codec.sync.archive import Spill
from kiteline_codec.sync.resumption import agent_session
from kiteline_codec.transport.link_traits import LinkTraits
from kiteline_codec.transport.seal import seal_bytes, suite_for
from kiteline_core import config as configuration
from kiteline_core.arguments import count_limit, limit
from kiteline_core.ids import MAX_AGENTS

GRIDS = ("agent", "base", "off")  # who makes scans of ground and obstacles
LOG_STEM = "boot"  # of the names of logs of `kiteline agent --log`
TRACKERS = ("map", "ekf")
LOG_MIB = 8000  # MiB of logs by default: half an hour of flight with images at least


@dataclass(frozen=True, slots=True)
class AgentOptions:
    """Options of one agent process. Plain values, so that it can be sent as JSON."""

    source: str
    folder: str  # for the log and the trajectories
    log_name: str = "log.mcap"  # "": no log and no trajectories
    log_mib: int = 0  # MiB that this log and earlier ones in the folder may take; 0: no limit
    log_optional: bool = False  # fly also where no log can be written
    agent: int = 0
    boot: int = 0  # of the ids that it makes
    submap: int = 0  # number of the first submap
    order: int = 1  # of its starts: higher than that of any before it
    link: str = "none"  # LINK, or lockstep:ENDPOINT
    mono: bool = False
    imu: bool = True
    config: str = ""  # a TOML file
    rig: str = ""  # a rig file; "": none
    with_others: bool = False  # other agents are to be recognised: `keyframe.earlier`
    calibration: str = ""  # FILE[,FILE…] in place of the source's; "": none
    start_ns: int = 0  # the stamp that is flight time 0
    seconds: float = 0.0  # s of flight time to fly; 0: all
    up_bytes_s: int = 0  # B/s that the link takes; 0: any number
    key: str = ""  # a file with this agent's key; "": packets are not sealed
    told: tuple[str, ...] = ()  # lines about that for the user
    profile: str = ""  # what to share of a keyframe: wifi or radio; "": as the link allows
    delay_s: float = 0.0  # s that a packet is under way
    loss: float = 0.0  # probability that a packet is lost
    disorder: float = 0.0  # probability that a packet is duplicated, and that it is delayed
    seed: int = 0
    cpu_percent: float = 0.0  # of one core; 0: all of it
    mavlink: str = ""  # URL of a flight controller
    axes: str = ""  # where the body's axes point; "": flu, or rdf where the source knows no body
    odometry: str = ""  # from the flight controller: controller, wheels, wheels:TRACK_M; "": none
    offset: str = ""  # X,Y,Z in m of the flight controller in the body; "": at its origin
    heading: str = "start"  # of the poses sent: start (0 at the start), controller (as it has it)
    pose_messages: str = "odometry"  # odometry, or vision: the older messages
    origin: str = ""  # LAT,LON,ALT to set in the flight controller; "": none
    obstacles: bool = False  # send OBSTACLE_DISTANCE
    mavlink_key: str = ""  # a file with the key of MAVLink's signatures; "": none
    tracker: str = ""  # map, or ekf; "": what the configuration says
    grid: str = "agent"  # who makes scans of ground and obstacles: agent, base, or off
    imu_of: str = ""  # whose IMU is used: controller; "": the source's, if it has one
    kill_at_s: float | None = None  # end like a crash at this flight time
    await_base_at_s: float | None = None  # look for a base again at this flight time
    await_bases: bool = False  # wait for a new base whenever one ends

    @property
    def trajectory_prefix(self) -> str:
        """What names of trajectories begin with: `bootNNNNN.` beside a numbered log; each start keeps its own."""
        stem = Path(self.log_name).stem
        return f"{stem}." if stem.removeprefix(LOG_STEM).isdecimal() else ""


def options_of(a: argparse.Namespace, folder: Path) -> AgentOptions:
    """Options from the command line, without the numbers of this start. folder: for the log."""
    return AgentOptions(
        source=a.source, folder=str(folder), log_name=f"{LOG_STEM}.mcap" if a.log else "", log_mib=a.log_mib,
        log_optional=True, agent=a.agent,
        link=a.link, mono=a.mono, imu=not a.no_imu, config=a.config, rig=a.rig, calibration=a.calibration,
        up_bytes_s=a.up_bytes, profile=a.profile, key=a.key, told=a.told,
        cpu_percent=a.cpu, mavlink=a.mavlink, axes=a.axes,
        odometry=a.odometry, imu_of=a.imu, offset=a.offset, heading=a.heading, pose_messages=a.pose_messages,
        origin=a.origin, mavlink_key=a.mavlink_key, obstacles=a.obstacles,
        grid=a.grid, tracker=a.tracker,
    )  # fmt: skip


def agent_config(
    path: str, cpu_percent: float = 0.0, rig: str = "", grid: str = "agent", tracker: str = ""
) -> AgentConfig:
    """The configuration, with the [agent] table of a TOML file in place of the defaults. Raises ConfigError.

    cpu_percent: of one core, overrides the governor's budget; 0: what the file says. rig: a rig file.
    grid: "off" for no scans, "base" for those of stereo pairs made by the base, whatever the file says.
    tracker: "map" or "ekf", likewise; "": what the file says.
    """
    config = AgentConfig()
    if path:
        with open(path, "rb") as file:
            config = configuration.load(config, file.read(configuration.MOST_BYTES), "agent", path)
    if rig:
        config = replace(config, known_rig=rig_file.load(rig))
    if grid == "off":
        config = replace(config, scan=replace(config.scan, on=False))
    elif grid == "base":
        config = replace(config, scan=replace(config.scan, by_base=True))
    if tracker:
        config = configuration.apply(config, {"tracker": tracker})
    if cpu_percent <= 0.0:
        return config
    return replace(config, governor=replace(config.governor, cpu_percent=cpu_percent))


def is_filter(config: str, tracker: str) -> bool:
    """True if `--tracker`, or else the TOML file `config`, chooses the Kalman filter. Raises ConfigError."""
    return agent_config(config, tracker=tracker).tracker == "ekf"


def channel_for(options: AgentOptions, link: LinkTraits, spill: Spill | None = None) -> RecordChannel:
    """The agent's end of the codec, or a channel to nowhere without a base.

    spill: keeps what would take too much memory while the link is down.
    """
    if options.link == "none":
        return NoBaseChannel()
    return coded_channel_for(options, link, spill)


def coded_channel_for(options: AgentOptions, link: LinkTraits, spill: Spill | None) -> CodedChannel:
    """The agent's end of the codec."""
    sealed = seal_bytes(suite_for(link), options.agent) if options.key else 0
    session = agent_session(options.order, options.boot)
    return coded_channel(session, options.up_bytes_s, options.profile, sealed, link, spill, bounded=True)


def parser(forms: str = "") -> argparse.ArgumentParser:
    """The arguments of `kiteline agent`. forms: of SOURCE, LINK and URL, for the help text."""
    p = argparse.ArgumentParser(
        prog="kiteline agent",
        description="The onboard half: tracks a camera, sends poses to a flight controller and thin diffs to a base.",
        epilog=forms,
    )
    p.set_defaults(told=())
    p.add_argument("source", metavar="SOURCE", nargs="?")
    _add_tracking(p)
    _add_link(p.add_argument_group("link to the base"))
    _add_controller(p.add_argument_group("flight controller"))
    p.add_argument("--spec", metavar="JSON", default="", help=argparse.SUPPRESS)
    return p


def check(p: argparse.ArgumentParser, a: argparse.Namespace) -> None:
    """End the program with a usage line where an argument has no meaning, or none beside the others."""
    if not a.source:
        p.error("a SOURCE is required")
    if not 0 <= a.agent < MAX_AGENTS:
        p.error(f"--agent {a.agent}: expected 0 to {MAX_AGENTS - 1}")
    if unused := _unused_by_filter(a):
        p.error(f"--tracker ekf uses no {' and no '.join(unused)}: leave them out, or fly --tracker map")
    if a.obstacles and not a.mavlink:
        p.error("--obstacles tells a flight controller: expected --mavlink URL beside it")
    if not a.mavlink and (unused := _unused_without_controller(p, a)):
        p.error(f"{' and '.join(unused)}: of the poses for a flight controller: expected --mavlink URL beside it")


def _unused_without_controller(p: argparse.ArgumentParser, a: argparse.Namespace) -> list[str]:
    """Arguments that have no effect without a flight controller."""
    names = ("axes", "offset", "heading", "pose_messages", "origin", "mavlink_key")
    return [f"--{name.replace('_', '-')}" for name in names if getattr(a, name) != p.get_default(name)]


def _unused_by_filter(a: argparse.Namespace) -> list[str]:
    """Arguments that the Kalman filter has no use for: it makes no scans and reads no IMU. Raises ConfigError."""
    if not is_filter(a.config, a.tracker):
        return []
    given = {"--obstacles": a.obstacles, "--imu": bool(a.imu), "--grid base": a.grid == "base"}
    return [name for name, is_given in given.items() if is_given]


def _add_tracking(p: argparse.ArgumentParser) -> None:
    p.add_argument("--config", metavar="F", default="", help="a TOML file with an [agent] section")
    p.add_argument(
        "--rig", metavar="FILE", default="",
        help="begin with what earlier flights found of cameras and IMU, and write what this one finds",
    )  # fmt: skip
    p.add_argument(
        "--calibration", metavar="FILE[,FILE]", default="",
        help="calibration in place of the source's: YAML of kiteline, Kalibr, EuRoC, ROS, OpenCV or ORB-SLAM",
    )  # fmt: skip
    p.add_argument("--mono", action="store_true", help="the left camera alone")
    p.add_argument("--no-imu", action="store_true", help="without inertial samples")
    p.add_argument(
        "--tracker", choices=TRACKERS, default="",
        help="map (default), or ekf: a Kalman filter over pose and landmarks, for one camera with odometry and hardly "
        "any CPU; it makes no scans and reads no IMU",
    )  # fmt: skip
    p.add_argument(
        "--grid", choices=GRIDS, default="agent",
        help="who looks for ground and obstacles: the agent, where CPU time is left (default); the base, in images of "
        "some 25 kB that a wide link carries (else the agent; obstacles for a flight controller then come from the "
        "base's grid); or nobody",
    )  # fmt: skip
    p.add_argument(
        "--cpu", metavar="PERCENT", type=limit, default=0.0, help="limit to so much of one core (default: no limit)"
    )
    p.add_argument("--log", metavar="DIR", default="", help="log each start to DIR/agentN/bootNNNNN.mcap, …_1.mcap")
    p.add_argument(
        "--log-mib", metavar="N", type=count_limit, default=LOG_MIB,
        help="MiB that the logs of all starts may take: the oldest are deleted, also in flight (default: %(default)s; "
        "0: no limit)",
    )  # fmt: skip


def _add_link(p: argparse._ArgumentGroup) -> None:
    p.add_argument("--link", metavar="LINK", default="none", help="the way to the base (default: none)")
    p.add_argument(
        "--agent", metavar="N", type=int, default=0, help=f"number of this agent in its group, 0 to {MAX_AGENTS - 1}"
    )
    p.add_argument(
        "--up-bytes", metavar="N", type=count_limit, default=0, help="B/s that may be sent, headers included"
    )
    p.add_argument("--profile", choices=("wifi", "radio"), default="", help="default: as the link allows")
    p.add_argument("--key", metavar="FILE", default="", help="seal packets; take none but sealed ones "
                   "(default: the file of `kiteline keys pair`)")  # fmt: skip
    p.add_argument("--insecure", action="store_true", help="use the link without seals")


def _add_controller(p: argparse._ArgumentGroup) -> None:
    p.add_argument("--mavlink", metavar="URL", default="", help="send poses to a flight controller")
    p.add_argument(
        "--odometry", metavar="WHAT", default="",
        help="take velocities from the flight controller too: wheels, wheels:TRACK_M (wheels tell turns as well), or "
        "controller (its filter's, where that does not live on our own poses); of a recording they are taken anyhow",
    )  # fmt: skip
    p.add_argument(
        "--imu", choices=("controller",), default="",
        help="fly on the flight controller's IMU in place of the source's; where the camera sits is said by T_f_c in "
        "[agent.controller_imu] of --config, or by a source that knows its body, with --axes",
    )  # fmt: skip
    p.add_argument(
        "--axes", metavar="XYZ", default="",
        help="where the body's axes point: flu, rdf, urf, … (default: flu; rdf if the source knows no body but the "
        "camera; frd with T_f_c)",
    )  # fmt: skip
    p.add_argument(
        "--offset", metavar="X,Y,Z", default="", help="where the flight controller sits: metres along the body's axes"
    )
    p.add_argument(
        "--heading", choices=("start", "controller"), default="start",
        help="heading of the poses sent: 0 where the flight starts (default), or as the flight controller has it",
    )  # fmt: skip
    p.add_argument(
        "--pose-messages", choices=("odometry", "vision"), default="odometry",
        help="send ODOMETRY (default), or VISION_POSITION_ESTIMATE and VISION_SPEED_ESTIMATE",
    )  # fmt: skip
    p.add_argument(
        "--origin", metavar="LAT,LON,ALT", default="",
        help="set this origin in a flight controller without GPS, while it is disarmed (degrees, metres)",
    )  # fmt: skip
    p.add_argument(
        "--obstacles", action="store_true",
        help="send distances to obstacles around the vehicle (OBSTACLE_DISTANCE)",
    )  # fmt: skip
    p.add_argument("--mavlink-key", metavar="FILE", default="", help="sign MAVLink messages, and take none unsigned")
