"""Poses to a flight controller over UDP or a serial port."""

from __future__ import annotations

import threading
from types import TracebackType
from typing import Self

from kiteline_core.frame import ImuBatch, OdometryBatch
from kiteline_core.geometry.se3 import F64
from kiteline_hw.mavlink.imu import ControllerImu
from kiteline_hw.mavlink.messages import Heartbeat, MavlinkCodec, Signing
from kiteline_hw.mavlink.odometry import FromController
from kiteline_hw.mavlink.odometry_stream import OdometryConfig, OdometryCounters, OdometryStream
from kiteline_hw.mavlink.wire import MavlinkWire
from kiteline_hw.ports import Clock, PoseSample

_TICK_S = 0.1  # s between looks at the heartbeat's time
_OUTBOX = 8  # messages that wait for a slow serial port; the oldest are dropped, a pose is worth little when late


class MavlinkPoseSink:
    """A PoseSink that speaks MAVLink. Its thread sends heartbeats and answers TIMESYNC at once, from the same clock.

    url: see MAVLINK_FORMS. T_b_f: (4,4) mounting, see mavlink_frames. clock: the one that stamps poses. wanted:
    takes what the controller says of its own velocity, imu: what its inertial unit feels. Raises LinkError.
    """

    def __init__(
        self,
        url: str,
        T_b_f: F64,
        clock: Clock,
        *,
        config: OdometryConfig | None = None,
        system: int = 1,
        signing: Signing | None = None,
        required: bool = True,
        wanted: FromController | None = None,
        imu: ControllerImu | None = None,
    ) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._stream = OdometryStream(T_b_f, config, MavlinkCodec(system, signing=signing), wanted, imu)
        self.refused = 0  # messages that nobody took
        self._wire = MavlinkWire(url, "mavlink", self._on_data, self._turn, _TICK_S, _OUTBOX, required=required)
        self._wire.start()

    def push(self, pose: PoseSample, now_ns: int) -> None:
        """Send a pose if it is its turn. Never blocks."""
        with self._lock:
            self._send(self._stream.step(pose, now_ns))

    def _send(self, messages: list[bytes]) -> None:
        for message in messages:
            self.refused += not self._wire.send(message)

    def _on_data(self, data: bytes, whole: bool) -> None:
        with self._lock:
            self._send(self._stream.receive(data, self._clock.now_ns(), datagram=whole))

    def _turn(self) -> None:
        with self._lock:
            self._send(self._stream.step(None, self._clock.now_ns()))

    @property
    def counters(self) -> OdometryCounters:
        """What was sent and why poses were not."""
        return self._stream.counters

    def autopilot(self) -> Heartbeat | None:
        """The flight controller at the other end, or None while it is silent."""
        with self._lock:
            return self._stream.autopilot(self._clock.now_ns())

    def take_odometry(self, t_ns: int) -> OdometryBatch | None:
        """What the controller said of its velocity up to an instant of our clock; None where nobody asked."""
        with self._lock:
            return self._stream.take_odometry(t_ns)

    def take_imu(self, t_ns: int) -> ImuBatch | None:
        """What the controller's inertial unit felt up to an instant of our clock; None where nobody asked."""
        with self._lock:
            return self._stream.take_imu(t_ns)

    def close(self) -> None:
        """Stop, within a second. May be called twice."""
        self._wire.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
