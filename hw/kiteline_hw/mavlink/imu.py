"""The inertial unit of a flight controller, as samples in the body frame and on our clock. Pure.

MAVLink speaks of f = MAV_FRAME_BODY_FRD (x forward, y right, z down): a vehicle that stands upright feels -9.8 m/s^2
along z. A controller is asked for HIGHRES_IMU, and where it stays silent for the coarser RAW_IMU and SCALED_IMU.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kiteline_core.frame import ImuBatch
from kiteline_core.geometry.se3 import F64
from kiteline_hw.mavlink.messages import HIGHRES_IMU, RAW_IMU, SCALED_IMU, Heartbeat, MavlinkCodec, VehicleImu
from kiteline_hw.mavlink.odometry import StampClock
from kiteline_hw.ports import SourceReport
from kiteline_hw.sensors.imu_buffer import ImuStream

_AUTOPILOT = 1  # MAV_COMP_ID_AUTOPILOT1; a camera on the same bus may have an IMU of its own
_ARDUPILOT = 3  # MAV_AUTOPILOT; its RAW_IMU is in mg and mrad/s, others' in units of the chip
_BEST_FIRST = (HIGHRES_IMU, RAW_IMU, SCALED_IMU)  # floats; whole mg with stamps in us; the same in ms


@dataclass(frozen=True, slots=True)
class ControllerImuConfig:
    """How messages are asked for and kept."""

    ask_ns: int = 2_000_000_000  # ns of silence after which they are asked for again, and coarser ones are taken
    most_samples: int = 4096  # that wait for a frame; 20 s at 200 Hz


class ControllerImu:
    """Messages in, samples out. R_b_f: (3,3) vectors of the controller (FRD) in the body. rate_hz: asked for. report:
    counts what was no use.
    """

    def __init__(
        self, R_b_f: F64, rate_hz: float, report: SourceReport, config: ControllerImuConfig | None = None
    ) -> None:
        self.config = config or ControllerImuConfig()
        self._R_b_f = R_b_f
        self._interval_us = round(1e6 / rate_hz)
        self._stream = ImuStream(report)
        self._clock = StampClock()
        self._chosen = (0, 0)  # message and number of the unit that is listened to
        self._heard_ns: int | None = None
        self._asked_ns: int | None = None

    def questions(self, codec: MavlinkCodec, autopilot: Heartbeat, now_ns: int) -> list[bytes]:
        """What asks a flight controller for its samples: once, and whenever they do not come."""
        since_ns = self._asked_ns if self._heard_ns is None else max(self._heard_ns, self._asked_ns or 0)
        if self._asked_ns is not None and since_ns is not None and now_ns - since_ns < self.config.ask_ns:
            return []
        wanted = _BEST_FIRST[:1] if self._asked_ns is None else _BEST_FIRST
        self._asked_ns = now_ns
        return [
            codec.message_interval(autopilot.system, autopilot.component, number, self._interval_us)
            for number in wanted
        ]  # fmt: skip

    def receive(self, m: VehicleImu, autopilot: Heartbeat | None, now_ns: int) -> None:
        """Take a sample; those of other units and coarser ones than we get are passed over."""
        raw_of_others = m.message == RAW_IMU and (autopilot is None or autopilot.autopilot != _ARDUPILOT)
        if m.component != _AUTOPILOT or raw_of_others:
            return
        if (m.message, m.unit) != self._chosen:
            silent = self._heard_ns is None or now_ns - self._heard_ns > self.config.ask_ns
            if not silent and _BEST_FIRST.index(m.message) >= _BEST_FIRST.index(self._chosen[0]):
                return
            self._chosen, self._clock = (m.message, m.unit), StampClock()
        self._heard_ns = now_ns
        if len(self._stream) < self.config.most_samples:
            row = np.concatenate([self._R_b_f @ m.gyro, self._R_b_f @ m.accel])
            self._stream.add(self._clock.ours(m.t_us * 1000, now_ns), tuple(row.tolist()))

    def take_until(self, t_ns: int) -> ImuBatch | None:
        """The samples up to an instant of our clock, in the body frame."""
        return self._stream.take_until(t_ns)
