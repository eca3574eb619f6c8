"""Watches the flight controller of a flight: what it is, whether it uses the poses, whether attitudes agree. Pure."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from kiteline_core.arrays import F64
from kiteline_hw.mavlink.messages import Attitude, Heartbeat, MavlinkMessage, MessageInterval, TimeSync
from kiteline_hw.mavlink.watch import messages as wire
from kiteline_hw.mavlink.watch.attitude import TOPIC as AXES
from kiteline_hw.mavlink.watch.attitude import AttitudeWatch
from kiteline_hw.mavlink.watch.estimator import EstimatorWatch
from kiteline_hw.mavlink.watch.findings import Finding, FindingLevel, FindingLog
from kiteline_hw.mavlink.watch.latency import LatencyWatch
from kiteline_hw.mavlink.watch.messages import (
    AutopilotVersion,
    CommandAck,
    EkfStatusReport,
    EstimatorStatus,
    FilterStatus,
    StatusText,
)
from kiteline_hw.mavlink.watch.presence import DEVICE_TOPIC as DEVICE
from kiteline_hw.mavlink.watch.presence import TOPIC as CONTROLLER
from kiteline_hw.mavlink.watch.presence import LinkState, PresenceWatch
from kiteline_hw.ports import PoseSample


@dataclass(frozen=True, slots=True)
class ControllerWatchConfig:
    """Which messages are requested, and how texts are sent."""

    report_us: int = 500_000  # us between two reports of the estimator
    attitude_us: int = 100_000  # us between two ATTITUDE; 5 degrees pass in 0.1 s at 50 degrees a second
    request_ns: int = 4_000_000_000  # ns of silence after which a message is requested again
    restart_ms: int = 2_000  # ms by which a controller's clock goes back when it restarts
    waiting: int = 16  # texts for the controller that wait until it is found; the oldest are dropped


class ControllerWatch:
    """Messages, poses and times in; findings, and messages to send, out.

    T_b_f: (4,4) flight controller in the body. url: of the connection, for messages. baud: of its serial port, else 0.
    """

    def __init__(self, T_b_f: F64, url: str = "", baud: int = 0) -> None:
        self.config = ControllerWatchConfig()
        self._log = FindingLog()
        self.presence = PresenceWatch(url, self._log)
        self.estimator = EstimatorWatch(self._log)
        self.attitude = AttitudeWatch(np.ascontiguousarray(T_b_f[:3, :3]), self._log)
        self.latency = LatencyWatch(self._log, baud)
        self._attitude_ms: int | None = None
        self._seen_ns: dict[int, int] = {}  # by message id: when it came or was requested
        self._findings: list[Finding] = []
        self._texts: list[Finding] = []
        self._handlers: dict[type[MavlinkMessage], Callable[[Any, int], None]] = {
            Attitude: self._on_attitude,
            EkfStatusReport: self._on_report,
            EstimatorStatus: self._on_report,
            StatusText: self._on_text,
            CommandAck: lambda m, now_ns: self.presence.answered(),
            AutopilotVersion: lambda m, now_ns: self.presence.receive_version(m),
            TimeSync: lambda m, now_ns: self.presence.answered() if m.tc1_ns != 0 else None,
        }

    def receive(self, m: MavlinkMessage, now_ns: int) -> None:
        """Add a message; those of other systems than the controller's are ignored."""
        if isinstance(m, Heartbeat):
            self.presence.receive_heartbeat(m, now_ns)
            return
        handler = self._handlers.get(type(m))
        if handler is not None and getattr(m, "system", 0) in (0, self.presence.system):
            handler(m, now_ns)

    def sent(self, pose: PoseSample, quality: int, now_ns: int) -> None:
        """Add a pose that was sent."""
        self.attitude.pose(pose)
        if self.presence.heartbeat is not None:
            self.estimator.sent(quality, now_ns)
            self.latency.sent(now_ns - pose.t_ns, self.presence.autopilot)

    def compare(self, pose: PoseSample) -> None:
        """Add a pose that was held back."""
        self.attitude.pose(pose)

    @property
    def axes_are_wrong(self) -> bool:
        """True if the flight controller's attitude contradicts the axes in use, and fits others."""
        return isinstance(self._log.state(AXES), tuple)

    @property
    def axes_fit(self) -> bool:
        """True if the axes in use fit the flight controller's attitude, but for a tilt."""
        return self._log.state(AXES) in ("good", "tilt")

    def report_axes(self, *, held: bool) -> None:
        """Report that poses are held back because the axes are wrong, or that they are sent again."""
        if held:
            self._log.say(
                "held", True, FindingLevel.ERROR, "poses: held back, because --axes are wrong",
                "kiteline: poses held, axes wrong",
                "A vehicle that is in the air already goes on getting them",
            )  # fmt: skip
        elif self._log.state("held"):
            self._log.say("held", False, FindingLevel.INFO, "poses: the axes fit, they are sent", "kiteline: axes fit")

    def report_heading(self, *, held: bool) -> None:
        """Report that poses are held back until the heading is known, or that it is known now."""
        if held:
            self._log.say(
                "heading", True, FindingLevel.WARNING,
                "poses: held back, because the flight controller's heading is not known", "kiteline: waits for heading",
                "It must send ATTITUDE: check that the wire to it carries our requests",
            )  # fmt: skip
        elif self._log.state("heading"):
            self._log.say("heading", False, FindingLevel.INFO, "poses: the heading is known", "kiteline: heading known")

    def tick(self, now_ns: int, link: LinkState) -> list[MavlinkMessage]:
        """Say what has changed; the messages to send: requests, and findings as STATUSTEXT."""
        out: list[MavlinkMessage] = [*self.presence.tick(now_ns, link)]
        if self.presence.heartbeat is not None:
            self.estimator.tick(self.presence.autopilot, now_ns)
            out += self._requests(self.presence.heartbeat, now_ns)
        new = self._log.take()
        self._findings += new
        found = self.presence.heartbeat is not None
        # That nothing is found is no news to a controller that has been found.
        texts = [f for f in new if found or f.topic not in (CONTROLLER, DEVICE)]
        self._texts = (self._texts + texts)[-self.config.waiting :]
        if found:
            out += [StatusText(int(f.level), f.short) for f in self._texts]
            self._texts = []
        return out

    def take(self) -> list[Finding]:
        """The findings since the last call."""
        new, self._findings = self._findings, []
        return new

    def _requests(self, controller: Heartbeat, now_ns: int) -> Sequence[MavlinkMessage]:
        c = self.config
        report = wire.EKF_STATUS_REPORT if controller.autopilot == wire.ARDUPILOT else wire.ESTIMATOR_STATUS
        out = []
        for message, interval_us in ((report, c.report_us), (wire.ATTITUDE, c.attitude_us)):
            if message in self._seen_ns and now_ns - self._seen_ns[message] < c.request_ns:
                continue
            self._seen_ns[message] = now_ns
            out.append(MessageInterval(controller.system, controller.component, message, interval_us))
        return out

    def _on_attitude(self, m: Attitude, now_ns: int) -> None:
        self._seen_ns[wire.ATTITUDE] = now_ns
        before, self._attitude_ms = self._attitude_ms, m.t_ms
        if before is not None and before - m.t_ms > self.config.restart_ms:
            self._log.forget("restart")
            self._log.say(
                "restart",
                m.t_ms,
                FindingLevel.WARNING,
                "flight controller: restarted",
                "kiteline: controller restarted",
            )
            self.attitude.restart()
            self.estimator.restart()
            self._log.forget(AXES)
        self.attitude.receive(m, now_ns)

    def _on_report(self, m: FilterStatus, now_ns: int) -> None:
        message = wire.EKF_STATUS_REPORT if isinstance(m, EkfStatusReport) else wire.ESTIMATOR_STATUS
        self._seen_ns[message] = now_ns
        self.estimator.report(m, now_ns)

    def _on_text(self, m: StatusText, now_ns: int) -> None:
        if m.component == 1:
            self.estimator.text(m)
