"""kiteline on board in simulated time: the agent, its connection to the autopilot, and what it says."""

from dataclasses import dataclass
from pathlib import Path

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.runtime.controller import pose_sample
from kiteline_agent.runtime.pose_schedule import PoseSchedule
from kiteline_agent.step import Identity, StepInput, StepOutput
from kiteline_codec.channel import coded_channel
from kiteline_codec.sync.resumption import agent_session
from kiteline_core.frame import Frame
from kiteline_core.geometry.cameras import CameraRig
from kiteline_core.ids import AgentId
from kiteline_hw.mavlink.connect import ControllerOptions, connect
from kiteline_hw.mavlink.watch.findings import Finding
from kiteline_hw.ports import SourceReport
from kiteline_hw.system.closing import Closing
from kiteline_hw.system.vocabulary import shipped_vocabulary

ORIGIN = "47.3977,8.5456,488"
LATENCY_NS = 20_000_000  # from exposure to the frame's step: readout, transfer and processing
_TUNNEL_BYTES_S = 900  # that the agent sends through the tunnel


@dataclass(slots=True)
class SimulatedClock:
    """A Clock that the simulation sets."""

    t_ns: int = 0

    def now_ns(self) -> int:
        """The simulated time."""
        return self.t_ns


@dataclass(frozen=True, slots=True)
class Setting:
    """What stays from one agent to the next. url: of the autopilot's line. folder: for what agents remember.

    axes: of the body. key: file for signatures, "": none. tunnel: whether packets for a base go through the same line.
    """

    rig: CameraRig
    url: str
    folder: Path
    axes: str
    key: str = ""
    tunnel: bool = False


class Onboard(Closing):
    """One agent, from its start to its end."""

    def __init__(self, setting: Setting, clock: SimulatedClock, boot: int = 0) -> None:
        config, report = AgentConfig(), SourceReport()
        self._clock, self._boot = clock, boot
        self.sink = connect(
            ControllerOptions(
                setting.url, setting.axes, origin=ORIGIN, key=setting.key, folder=str(setting.folder),
                link=f"mavlink:{setting.url}" if setting.tunnel else "",
            ),
            setting.rig, clock, pose_rate_hz=config.prediction.rate_hz,
            imu_rate_hz=config.controller_imu.noise.rate_hz, report=report,
        )  # fmt: skip
        self.link = self.sink.tunnel_link()
        channel = (
            NoBaseChannel()
            if self.link is None
            else coded_channel(agent_session(boot + 1, boot), _TUNNEL_BYTES_S, "radio")
        )
        self.agent = Agent(
            setting.rig, config.controller_imu.noise, config, Identity(AgentId(0), boot), channel, shipped_vocabulary()
        )
        self._schedule = PoseSchedule(config.prediction.rate_hz, clock.now_ns())
        self._frame: Frame | None = None
        self.sends = True  # packets for the base
        self.said: list[tuple[float, Finding]] = []
        self.frames = self.tracked = self.imu_samples = self.packets_up = self.packets_down = 0

    def see(self, frame: Frame) -> None:
        """A frame was exposed now; the agent gets it LATENCY_NS later."""
        self._frame = frame

    def tick(self) -> None:
        """Step if a frame, a pose or a packet is due."""
        now_ns = self._clock.now_ns()
        if self._frame is not None and now_ns >= self._frame.t_ns + LATENCY_NS:
            frame, self._frame = self._frame, None
            output = self._step(frame, frame.t_ns, None)
            self.frames += 1
            self.tracked += output.estimate is not None and output.estimate.tracked
        elif self._schedule.take_due(now_ns):
            output = self._step(None, now_ns, now_ns)
            pose = pose_sample(self.agent, output, now_ns, self._boot)
            if pose is not None:
                self.sink.push(pose, now_ns)
        self.said += [(now_ns * 1e-9, finding) for finding in self.sink.take_findings()]

    def _step(self, frame: Frame | None, imu_until_ns: int, predict_ns: int | None) -> StepOutput:
        imu = self.sink.take_imu(imu_until_ns)
        self.imu_samples += 0 if imu is None else len(imu.t_ns)
        packets = [] if self.link is None else self.link.receive()
        self.packets_down += len(packets)
        output = self.agent.step(StepInput(frame, imu, tuple(packets), 0, None, predict_ns), self._clock.now_ns())
        if self.link is not None and self.sends:
            for packet in output.packets:
                self.packets_up += self.link.send(packet)
        return output

    def close(self) -> None:
        """End like a killed process: nothing is said to anyone."""
        self.sink.close()
