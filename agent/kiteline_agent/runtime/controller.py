"""A flight controller beside the source: poses out, velocities and IMU samples in."""

from contextlib import ExitStack

from kiteline_agent.onboard import OnboardAgent
from kiteline_agent.runtime.options import AgentOptions, agent_config
from kiteline_agent.runtime.pose_schedule import PoseSchedule
from kiteline_agent.step import Estimate, PredictedPose, StepOutput
from kiteline_hw.ports import ControllerLink, FrameSource, LinkError, PoseSample
from kiteline_hw.sources.overrides import with_other_imu
from kiteline_hw.system import process
from kiteline_hw.system.clock import MonotonicClock

OBSTACLES_HZ = 10.0  # distances to obstacles, a flight controller wants 10 to 15
_UPRIGHT_NS = 3_000_000_000  # ns of poses whose vertical is not known, after which it is said: most take 0.3 s
_NOT_UPRIGHT = (
    "the IMU has not told which way is up: check that its samples come. Without one (--no-imu) a camera counts as "
    "level where its flight begins"
)


def controller_link(
    options: AgentOptions, source: FrameSource, clock: MonotonicClock, stack: ExitStack
) -> ControllerLink | None:
    """The link to a flight controller, which gets poses; None without one. Raises LinkError."""
    if not options.mavlink:
        if options.odometry:
            raise LinkError("--odometry takes velocities from a flight controller: expected --mavlink URL beside it")
        return None
    from kiteline_hw.mavlink.connect import ControllerOptions, connect

    own = agent_config(options.config).controller_imu
    return stack.enter_context(
        connect(
            ControllerOptions(
                options.mavlink, options.axes, options.offset, options.odometry, options.heading,
                options.pose_messages, options.origin, options.mavlink_key, options.link,
                str(process.kept_folder(f"agent{options.agent}")),
            ),
            source.rig, clock, pose_rate_hz=pose_rate_hz(options),
            imu_rate_hz=own.noise.rate_hz if options.imu_of else 0.0,
            body_is_controller=bool(options.imu_of and own.T_f_c), report=source.report,
        )
    )  # fmt: skip


def pose_rate_hz(options: AgentOptions) -> float:
    """Rate of the poses to a flight controller, predicted to the time of sending; 0: those of the frames."""
    return agent_config(options.config).prediction.rate_hz


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


class UnsentPoses:
    """Tells why a flight controller gets no pose while the camera is tracked; each reason when it begins."""

    def __init__(self) -> None:
        self._why = ""
        self._since_ns: int | None = None  # stamp of the first pose in a row whose vertical is not known

    def lines(self, estimate: Estimate | None, *, in_metres: bool) -> list[str]:
        """What has changed. estimate: of the last frame. in_metres: its lengths are metres."""
        if estimate is None or not estimate.tracked:
            return []
        before, self._why = self._why, self._reason(estimate, in_metres)
        if self._why == before:
            return []
        return [f"flight controller: no pose is sent, as {self._why}" if self._why else "flight controller: gets poses"]

    def _reason(self, estimate: Estimate, in_metres: bool) -> str:
        if not in_metres:
            return "lengths are not in metres"
        if estimate.R_l_o is not None:
            self._since_ns = None
            return ""
        self._since_ns = estimate.t_ns if self._since_ns is None else self._since_ns
        return _NOT_UPRIGHT if estimate.t_ns - self._since_ns >= _UPRIGHT_NS else ""


def pose_sample(agent: OnboardAgent, output: StepOutput, t_ns: int, epoch: int) -> PoseSample | None:
    """The pose of a step for a flight controller, as of t_ns of its clock; None without an upright one in metres.

    One that is not tracked is sent too, for its quality; in another unit it would be flown by some settings of PX4.
    """
    pose: Estimate | PredictedPose | None = output.estimate or output.predicted
    if pose is None or pose.T_l_b is None or not agent.in_metres:
        return None
    if isinstance(pose, PredictedPose):
        return PoseSample(t_ns, pose.T_l_b, pose.tracked, pose.quality, epoch, pose.cov_l, pose.velocity_l, pose.rate_b)
    return PoseSample(t_ns, pose.T_l_b, pose.tracked, agent.odometry_quality(pose), epoch, pose.cov_l)


def push_obstacles(
    controller: ControllerLink, agent: OnboardAgent, output: StepOutput | None, due: PoseSchedule, now_ns: int
) -> None:
    """Send what stands around the vehicle if that is due, by the pose of a step, while the vehicle is tracked."""
    pose = None if output is None else output.estimate or output.predicted
    if pose is None or not pose.tracked or not due.take_due(now_ns):
        return
    around = agent.surroundings(pose, controller.T_b_f)
    if around is not None:
        controller.push_obstacles(around.distance_m.tolist(), around.reach_m, now_ns)
