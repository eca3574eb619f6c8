"""Asks a flight controller all that decides whether it can fly on poses: `kiteline doctor --mavlink`. Pure.

Streams are measured on a disarmed vehicle only, and set back to their own rates at the end.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from kiteline_core.wording import counted
from kiteline_hw.mavlink.messages import (
    HIGHRES_IMU,
    Attitude,
    Heartbeat,
    MavlinkMessage,
    MessageInterval,
    RadioStatus,
    TimeSync,
    VehicleImu,
)
from kiteline_hw.mavlink.watch import messages as wire
from kiteline_hw.mavlink.watch import parameters
from kiteline_hw.mavlink.watch.findings import Finding, FindingLevel, FindingLog
from kiteline_hw.mavlink.watch.messages import (
    AutopilotVersion,
    CommandAck,
    EkfStatusReport,
    EstimatorStatus,
    FilterStatus,
    ParamRequest,
    ParamValue,
    StatusText,
)
from kiteline_hw.mavlink.watch.presence import LinkState, PresenceWatch
from kiteline_hw.mavlink.watch.stream_rates import StreamRate


@dataclass(frozen=True, slots=True)
class SurveyConfig:
    """How long is asked and listened."""

    absent_ns: int = 6_000_000_000  # ns until a controller that is not heard is given up
    measure_ns: int = 6_000_000_000  # ns of streams and TIMESYNC
    parameters_at_once: int = 4  # requests on the way; a radio link loses more
    parameter_ns: int = 500_000_000  # ns until a parameter is asked for again
    parameter_tries: int = 3  # after which it counts as not there
    stream_ns: int = 700_000_000  # ns until a stream that does not come is asked for again; the slowest takes 500 ms
    stream_tries: int = 4  # after which it counts as refused
    heartbeat_ns: int = 1_000_000_000  # ns between two of our heartbeats, by which routers learn the way to us
    timesync_ns: int = 200_000_000  # ns between two requests
    imu_hz: float = 200.0  # as a flight on the controller's IMU asks for
    attitude_hz: float = 20.0
    report_hz: float = 2.0
    rate_share: float = 0.9  # of the requested rate that is good enough
    least_imu_hz: float = 100.0  # below which a flight on the controller's IMU is not worth it
    jitter_ms: float = 20.0  # ms; a frame passes in 50
    round_trip_ms: float = 20.0  # ms of a TIMESYNC
    least_txbuf: int = 50  # percent of a radio's buffer that should be free
    least_margin: int = 15  # of a radio's signal above its noise, in its units


class ControllerSurvey:
    """Messages and times in, messages to send out, and at the end findings. url: for messages."""

    def __init__(self, url: str) -> None:
        self.config = SurveyConfig()
        self._log = FindingLog()
        self.presence = PresenceWatch(url, self._log)
        self._presence_findings: list[Finding] = []
        self._start_ns: int | None = None
        self._found_ns: int | None = None
        self._now_ns = 0
        self._values: dict[str, float] = {}
        self._open: deque[str] = deque()  # parameters to ask for
        self._asked: dict[str, tuple[int, int]] = {}  # on the way: when, how often
        self._rates: dict[str, StreamRate] = {}
        self._refused: set[int] = set()  # results of commands
        self._next_streams_ns = self._stream_tries = 0
        self._next_timesync_ns = 0
        self._next_heartbeat_ns = 0
        self._round_trips_ms: list[float] = []
        self._sync_requests = 0  # of the controller
        self._radio: RadioStatus | None = None
        self._texts: dict[str, int] = {}  # texts of the controller: severity
        self._report: FilterStatus | None = None
        self._handlers: dict[type[MavlinkMessage], Callable[[Any], None]] = {
            AutopilotVersion: self.presence.receive_version,
            CommandAck: self._on_ack,
            ParamValue: self._on_parameter,
            StatusText: self._on_text,
            TimeSync: self._on_timesync,
            RadioStatus: self._on_radio,
            EkfStatusReport: self._on_report,
            EstimatorStatus: self._on_report,
            Attitude: lambda m: self._count("ATTITUDE"),
            VehicleImu: lambda m: self._count("HIGHRES_IMU") if m.message == HIGHRES_IMU else None,
        }

    @property
    def done(self) -> bool:
        """True if nothing more is expected."""
        c = self.config
        if self._start_ns is None:
            return False
        if self._found_ns is None:
            return self._now_ns - self._start_ns >= c.absent_ns
        return self._now_ns - self._found_ns >= c.measure_ns and not self._open and not self._asked

    def receive(self, m: MavlinkMessage, now_ns: int) -> list[MavlinkMessage]:
        """Add a message; the answers."""
        self._now_ns = now_ns
        if isinstance(m, Heartbeat):
            self.presence.receive_heartbeat(m, now_ns)
            return []
        if isinstance(m, TimeSync) and m.tc1_ns == 0:
            self._sync_requests += 1
            return [TimeSync(now_ns, m.ts1_ns)]
        handler = self._handlers.get(type(m))
        if handler is not None and (isinstance(m, RadioStatus) or getattr(m, "system", 0) in (0, self.presence.system)):
            handler(m)
        return []

    def step(self, now_ns: int, link: LinkState) -> list[MavlinkMessage]:
        """The messages to send now."""
        self._now_ns = now_ns
        if self._start_ns is None:
            self._start_ns = now_ns
        out: list[MavlinkMessage] = [*self.presence.tick(now_ns, link)]
        self._presence_findings += self._log.take()
        if now_ns >= self._next_heartbeat_ns:
            self._next_heartbeat_ns = now_ns + self.config.heartbeat_ns
            out.append(Heartbeat())
        controller = self.presence.heartbeat
        if controller is None:
            return out
        if self._found_ns is None:
            self._found_ns = now_ns
            self._open.extend(parameters.names(controller.autopilot))
        out += self._stream_requests(controller, now_ns)
        return out + self._parameter_requests(controller, now_ns) + self._timesync(now_ns)

    def stop(self) -> list[MavlinkMessage]:
        """The messages that set the streams back."""
        controller = self.presence.heartbeat
        if controller is None or controller.armed:
            return []
        target = controller.system, controller.component
        wanted = self._wanted(controller)
        return [MessageInterval(*target, message, 0) for _, message, _ in wanted]

    def _stream_requests(self, controller: Heartbeat, now_ns: int) -> list[MavlinkMessage]:
        c = self.config
        if controller.armed or now_ns < self._next_streams_ns or self._stream_tries >= c.stream_tries:
            return []
        self._next_streams_ns = now_ns + c.stream_ns
        self._stream_tries += 1
        target = controller.system, controller.component
        return [
            MessageInterval(*target, message, round(1e6 / hz))
            for name, message, hz in self._wanted(controller)
            if name not in self._rates
        ]

    def _wanted(self, controller: Heartbeat) -> list[tuple[str, int, float]]:
        """Name, id and rate of the measured streams."""
        c = self.config
        ardupilot = controller.autopilot == wire.ARDUPILOT
        report = wire.EKF_STATUS_REPORT if ardupilot else wire.ESTIMATOR_STATUS
        return [
            ("HIGHRES_IMU", HIGHRES_IMU, c.imu_hz),
            ("ATTITUDE", wire.ATTITUDE, c.attitude_hz),
            ("EKF_STATUS_REPORT" if ardupilot else "ESTIMATOR_STATUS", report, c.report_hz),
        ]

    def _parameter_requests(self, controller: Heartbeat, now_ns: int) -> list[MavlinkMessage]:
        c = self.config
        out: list[MavlinkMessage] = []
        for name, (asked_ns, tries) in list(self._asked.items()):
            if now_ns - asked_ns < c.parameter_ns:
                continue
            if tries >= c.parameter_tries:
                del self._asked[name]
            else:
                self._asked[name] = now_ns, tries + 1
                out.append(ParamRequest(controller.system, controller.component, name))
        while self._open and len(self._asked) < c.parameters_at_once:
            name = self._open.popleft()
            self._asked[name] = now_ns, 1
            out.append(ParamRequest(controller.system, controller.component, name))
        return out

    def _timesync(self, now_ns: int) -> list[MavlinkMessage]:
        if now_ns < self._next_timesync_ns:
            return []
        self._next_timesync_ns = now_ns + self.config.timesync_ns
        return [TimeSync(0, now_ns)]

    def _on_ack(self, m: CommandAck) -> None:
        self.presence.answered()
        if m.command == wire.SET_MESSAGE_INTERVAL and m.result != 0:
            self._refused.add(m.result)

    def _on_parameter(self, m: ParamValue) -> None:
        self.presence.answered()
        self._values[m.name] = m.number(self.presence.autopilot)
        self._asked.pop(m.name, None)

    def _on_timesync(self, m: TimeSync) -> None:
        if 0 <= self._now_ns - m.ts1_ns < 10_000_000_000:  # an answer to us, not to another
            self.presence.answered()
            self._round_trips_ms.append((self._now_ns - m.ts1_ns) * 1e-6)

    def _on_text(self, m: StatusText) -> None:
        self._texts.setdefault(m.text, m.severity)

    def _on_radio(self, m: RadioStatus) -> None:
        self._radio = m

    def _on_report(self, m: FilterStatus) -> None:
        self._report = m
        self._count(m.NAMES[0])

    def _count(self, name: str) -> None:
        self._rates.setdefault(name, StreamRate()).add(self._now_ns)

    def findings(self) -> list[Finding]:
        """What was found; topics are the names of the checks."""
        out = [Finding("heartbeat", f.level, f.text, "", f.remedy) for f in self._presence_findings]
        controller = self.presence.heartbeat
        if controller is None:
            return out or [Finding("heartbeat", FindingLevel.ERROR, "flight controller: not found", "")]
        out += parameters.compare(controller.autopilot, self._values)
        out += parameters.compare_forwarding(controller.autopilot, self._values)
        return [*out, *self._streams(controller), self._sync(controller), self._radio_finding(), *self._said()]

    def _streams(self, controller: Heartbeat) -> Sequence[Finding]:
        c = self.config
        if controller.armed:
            text = "the vehicle is armed: no streams were asked for"
            return [Finding("streams", FindingLevel.WARNING, text, "", "disarm it, and check again")]
        slow = "use a faster baud rate, or look for fixed stream rates (SRx_, MAV_x_RATE)"
        out = []
        for name, _, wanted_hz in self._wanted(controller):
            stream = self._rates.get(name)
            if stream is None or stream.rate_hz is None:
                text = f"{name}: none came" + (", the request was refused" if self._refused else "")
                out.append(Finding("streams", FindingLevel.WARNING, text, "", slow))
                continue
            text = f"{name}: {stream.rate_hz:.0f} Hz of {wanted_hz:.0f}, jitter {stream.jitter_ms:.1f} ms (95 %)"
            if name == "HIGHRES_IMU" and stream.rate_hz < c.least_imu_hz:
                out.append(Finding("streams", FindingLevel.WARNING, text, "", f"too slow for --imu controller: {slow}"))
            elif stream.rate_hz < c.rate_share * wanted_hz or stream.jitter_ms > c.jitter_ms:
                out.append(Finding("streams", FindingLevel.WARNING, text, "", slow))
            else:
                out.append(Finding("streams", FindingLevel.INFO, text, ""))
        return out

    def _sync(self, controller: Heartbeat) -> Finding:
        asked = f"it asked {counted(self._sync_requests, 'time')} itself"
        if not self._round_trips_ms:
            level = FindingLevel.ERROR if controller.autopilot == wire.PX4 else FindingLevel.WARNING
            remedy = "PX4 needs it to convert stamps: is the wire to it good?" if level is FindingLevel.ERROR else ""
            return Finding("timesync", level, f"no answer; {asked}", "", remedy)
        trips = sorted(self._round_trips_ms)
        middle, high = trips[len(trips) // 2], trips[round(0.95 * (len(trips) - 1))]
        text = f"{counted(len(trips), 'answer')}, round trip {middle:.1f} ms, 95 % within {high:.1f} ms; {asked}"
        if controller.autopilot == wire.PX4 and self._sync_requests == 0:
            return Finding(
                "timesync", FindingLevel.ERROR, text, "", "PX4 must ask, to convert stamps: set MAV_x_MODE to onboard"
            )
        if high > self.config.round_trip_ms:
            return Finding("timesync", FindingLevel.WARNING, text, "", "a slow or busy port: raise its baud rate")
        return Finding("timesync", FindingLevel.INFO, text, "")

    def _radio_finding(self) -> Finding:
        c, m = self.config, self._radio
        if m is None:
            text = "no RADIO_STATUS heard: none on this port, and ArduPilot never forwards it"
            return Finding("radio", FindingLevel.INFO, text, "")
        text = f"signal {m.rssi}, remote {m.remote_rssi}, noise {m.noise}; buffer {m.txbuf} % free"
        if m.txbuf < c.least_txbuf:
            return Finding(
                "radio", FindingLevel.WARNING, text, "", "it is overloaded: keep ODOMETRY off it (forwarding)"
            )
        if min(m.rssi, m.remote_rssi) - m.noise < c.least_margin:
            return Finding("radio", FindingLevel.WARNING, text, "", "weak: mend antennas, or come nearer")
        return Finding("radio", FindingLevel.INFO, text, "")

    def _said(self) -> list[Finding]:
        bad = [text for text, severity in self._texts.items() if severity <= int(FindingLevel.WARNING)]
        return [Finding("it says", FindingLevel.WARNING, text, "") for text in bad[:8]]
