"""Sends poses to a flight controller over UDP or a serial port."""

from __future__ import annotations

import threading

from kiteline_core.frame import ImuBatch, OdometryBatch
from kiteline_core.geometry.se3 import F64
from kiteline_hw.mavlink.connection import MavlinkConnection, parse_mavlink_url
from kiteline_hw.mavlink.controller_imu import ControllerImu
from kiteline_hw.mavlink.controller_odometry import ControllerOdometry
from kiteline_hw.mavlink.controller_session import ControllerSession, OdometryConfig, OdometryCounters
from kiteline_hw.mavlink.messages import Heartbeat
from kiteline_hw.mavlink.watch.controller_watch import ControllerWatch
from kiteline_hw.mavlink.watch.findings import Finding
from kiteline_hw.ports import Clock, PoseSample
from kiteline_hw.system.closing import Closing

_TICK_S = 0.1  # s between two checks whether a heartbeat is due
_MAX_QUEUED = 8  # messages waiting for a slow serial port; the oldest are dropped, because a late pose is of little use


class MavlinkPoseSink(Closing):
    """A PoseSink over MAVLink. Its thread sends heartbeats and answers TIMESYNC at once, from the same clock.

    url: see MAVLINK_FORMS. T_b_f: (4,4) mounting, see coordinate_frames. clock: the one that stamps poses. odometry,
    imu: receive the controller's velocities and inertial samples. Raises LinkError.
    """

    def __init__(
        self, url: str, T_b_f: F64, clock: Clock, *, required: bool = True, config: OdometryConfig | None = None,
        odometry: ControllerOdometry | None = None, imu: ControllerImu | None = None,
    ) -> None:  # fmt: skip
        self._clock = clock
        self._lock = threading.Lock()
        parsed = parse_mavlink_url(url)
        self._watch = ControllerWatch(T_b_f, url, parsed.port if parsed.kind == "serial" else 0)
        self._session = ControllerSession(T_b_f, config, odometry=odometry, imu=imu, watch=self._watch)
        self.refused = 0  # messages that could not be sent
        self._connection = MavlinkConnection(
            url, "mavlink", self._on_data, self._on_tick, _TICK_S, _MAX_QUEUED, required=required
        )
        self._connection.start()

    def push(self, pose: PoseSample, now_ns: int) -> None:
        """Send a pose if the rate allows it. Never blocks."""
        with self._lock:
            self._send(self._session.step(pose, now_ns))

    def _send(self, messages: list[bytes]) -> None:
        for message in messages:
            self.refused += not self._connection.send(message)

    def _on_data(self, data: bytes, datagram: bool) -> None:
        with self._lock:
            self._send(self._session.receive(data, self._clock.now_ns(), datagram=datagram))

    def _on_tick(self) -> None:
        with self._lock:
            now_ns = self._clock.now_ns()
            self._send(self._session.step(None, now_ns))
            self._send(self._session.watch(now_ns, self._connection.device_fault))

    def take_findings(self) -> list[Finding]:
        """What was found about the controller since the last call."""
        with self._lock:
            return self._watch.take()

    @property
    def counters(self) -> OdometryCounters:
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
            return self._session.take_imu(t_ns)

    def close(self) -> None:
        """Stop, within a second. May be called twice."""
        self._connection.close()
