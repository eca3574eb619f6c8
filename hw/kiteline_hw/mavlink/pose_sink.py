"""Sends poses to a flight controller over UDP, TCP or a serial port, and carries a tunnel on the same line."""

import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from kiteline_core.arrays import F64
from kiteline_core.frame import ImuBatch, OdometryBatch
from kiteline_hw.mavlink.codec import MavlinkCodec
from kiteline_hw.mavlink.controller_imu import ControllerImu
from kiteline_hw.mavlink.controller_odometry import ControllerOdometry
from kiteline_hw.mavlink.controller_session import ControllerSession, SessionConfig, SessionCounters
from kiteline_hw.mavlink.messages import ComputerStatus, Heartbeat, ObstacleDistance, RadioStatus, Tunnel
from kiteline_hw.mavlink.pose_memory import PoseMemory
from kiteline_hw.mavlink.start_frame import StartFrame
from kiteline_hw.mavlink.transport.connection import Adopt, MavlinkConnection
from kiteline_hw.mavlink.transport.signing import Signing
from kiteline_hw.mavlink.transport.url import parse_mavlink_url
from kiteline_hw.mavlink.tunnel.tunnel_end import TunnelConfig, TunnelEnd
from kiteline_hw.mavlink.tunnel.tunnel_link import TunnelQueue
from kiteline_hw.mavlink.watch.controller_watch import ControllerWatch
from kiteline_hw.mavlink.watch.findings import Finding
from kiteline_hw.ports import ByteLink, Clock, PoseSample
from kiteline_hw.system.closing import Closing
from kiteline_hw.system.computer import ComputerReader

_TICK_S = 0.1  # s between two checks whether a heartbeat is due
_TUNNEL_TICK_S = 0.01  # s between two checks of a tunnel's rate
_MAX_QUEUED = 8  # messages waiting for a slow serial port; the oldest are dropped, because a late pose is of little use
_TUNNEL_QUEUED = 8  # more of them for a tunnel
_COMPUTER_NS = 5_000_000_000  # ns between two messages about the computer, which routers send to the radio too


@dataclass(frozen=True, slots=True)
class SinkOptions:
    """What a sink does beside sending poses. signing: of all messages. start: chooses the frame of the poses.

    memory: keeps the last pose. tunnel: one end of a tunnel on the same connection. computer: send its load.
    """

    signing: Signing | None = None
    start: StartFrame | None = None
    memory: PoseMemory | None = None
    tunnel: TunnelConfig | None = None
    computer: bool = False


class MavlinkPoseSink(Closing):
    """A PoseSink over MAVLink. Its thread sends heartbeats and answers TIMESYNC at once, from the same clock.

    url: see MAVLINK_FORMS. T_b_f: (4,4) mounting, see coordinate_frames. clock: the one that stamps poses. odometry,
    imu: receive the controller's velocities and inertial samples. Raises LinkError.
    """

    def __init__(
        self, url: str, T_b_f: F64, clock: Clock, *, required: bool = True, config: SessionConfig | None = None,
        odometry: ControllerOdometry | None = None, imu: ControllerImu | None = None,
        options: SinkOptions | None = None,
    ) -> None:  # fmt: skip
        address, self._options = parse_mavlink_url(url), options or SinkOptions()
        self.T_b_f = T_b_f
        self._clock = clock
        self._lock = threading.Lock()
        self._watch = ControllerWatch(T_b_f, url, address.port if address.kind == "serial" else 0)
        self._session = ControllerSession(
            T_b_f, config, MavlinkCodec(signing=self._options.signing), odometry, imu, self._options.start, self._watch,
            address.system,
        )  # fmt: skip
        # Samples are parsed together, once a frame: one by one, each after a wait, they cost four times as much.
        self._samples: deque[tuple[bytes, int]] = deque()
        self.refused = 0  # messages that could not be sent
        self._computer = ComputerReader() if self._options.computer else None
        self._computer_due_ns = 0
        tunnel = self._options.tunnel
        self.tunnel = None if tunnel is None else SharedTunnel(tunnel, self._session, self._lock)
        self._connection = MavlinkConnection(
            address, "mavlink", self._on_data, self._on_tick, _TICK_S if tunnel is None else _TUNNEL_TICK_S,
            _MAX_QUEUED + (0 if tunnel is None else _TUNNEL_QUEUED), required=required,
        )  # fmt: skip
        self._connection.start()

    def push(self, pose: PoseSample, now_ns: int) -> None:
        """Send a pose if the rate allows it. Never blocks."""
        with self._lock:
            self._send(self._session.step(pose, now_ns))

    def push_obstacles(self, distance_m: Sequence[float], reach_m: float, now_ns: int) -> None:
        """Send distances to obstacles around the vehicle; see ObstacleDistance. Never blocks."""
        with self._lock:
            self._send([self._session.codec.encode(ObstacleDistance(now_ns // 1000, distance_m, reach_m))])

    def _send(self, messages: list[bytes]) -> None:
        for message in messages:
            self.refused += not self._connection.send(message)

    def _on_data(self, data: bytes, datagram: bool, adopt: Adopt | None) -> None:
        now_ns = self._clock.now_ns()
        if adopt is None and self._session.codec.holds_sample_alone(data):
            self._samples.append((data, now_ns))
            return
        with self._lock:
            self._parse_samples()
            self._send(self._session.receive(data, now_ns, datagram=datagram, adopt=adopt))

    def _parse_samples(self) -> None:
        """Parse the inertial samples that wait. The lock is held."""
        while self._samples:
            data, now_ns = self._samples.popleft()
            self._send(self._session.receive(data, now_ns))

    def _on_tick(self) -> None:
        now_ns = self._clock.now_ns()
        with self._lock:
            self._parse_samples()
            self._send(self._session.step(None, now_ns))
            self._send(self._session.watch(now_ns, self._connection.device_fault))
            if self.tunnel is not None:
                self._send(self.tunnel.poll(now_ns))
            last = self._session.last_pose()
        if self._options.memory is not None:
            self._options.memory.save(last, now_ns)
        if self._computer is not None and now_ns >= self._computer_due_ns:
            self._computer_due_ns = now_ns + _COMPUTER_NS
            c = self._computer.read()
            status = ComputerStatus(
                now_ns // 1000, c.uptime_ms, c.cpu_percent, c.ram_mib, c.ram_total_mib, c.temperature_c
            )
            with self._lock:
                self._send([self._session.codec.encode(status)])

    def take_findings(self) -> list[Finding]:
        """What was found about the controller since the last call."""
        with self._lock:
            return self._watch.take()

    @property
    def counters(self) -> SessionCounters:
        """Messages sent, and poses that were not sent, by reason."""
        return self._session.counters

    def autopilot(self) -> Heartbeat | None:
        """The connected flight controller, or None while it is silent."""
        with self._lock:
            return self._session.autopilot(self._clock.now_ns())

    def take_odometry(self, t_ns: int) -> OdometryBatch | None:
        """The controller's velocities up to a time on our clock; None if there are none."""
        with self._lock:
            return self._session.take_odometry(t_ns)

    def take_imu(self, t_ns: int) -> ImuBatch | None:
        """The controller's inertial samples up to a time on our clock; None if there are none."""
        with self._lock:
            self._parse_samples()
            return self._session.take_imu(t_ns)

    def tunnel_link(self) -> ByteLink | None:
        """The tunnel on the same connection; None if none was asked for."""
        return self.tunnel

    def close(self) -> None:
        """Stop, within a second. May be called twice."""
        self._connection.close()


class SharedTunnel(TunnelQueue):
    """A ByteLink on the connection of a PoseSink, which closes it. lock: of the session."""

    def __init__(self, config: TunnelConfig, session: ControllerSession, lock: threading.Lock) -> None:
        super().__init__(TunnelEnd(config, session.codec), lock)
        session.listen(Tunnel, self._take)
        session.listen(RadioStatus, self._take)

    def _take(self, message: Tunnel | RadioStatus, now_ns: int) -> tuple[()]:
        packet = self._end.take(message, now_ns)
        if packet is not None:
            self._inbox.append(packet)
        return ()

    def poll(self, now_ns: int) -> list[bytes]:
        """The messages to send now; the lock is held."""
        return self._end.poll(now_ns)

    def close(self) -> None:
        """Nothing to close: the PoseSink owns the connection."""
