"""The IMU of a flight controller, as samples in the body frame and on our clock. Pure.

MAVLink uses f = MAV_FRAME_BODY_FRD (x forward, y right, z down): an upright vehicle at rest measures -9.8 m/s^2 along
z. HIGHRES_IMU is requested, and if it does not come also the coarser RAW_IMU and SCALED_IMU.
"""

from kiteline_core.arrays import F64
from kiteline_core.frame import ImuBatch
from kiteline_hw.mavlink.controller_odometry import StampClock
from kiteline_hw.mavlink.messages import HIGHRES_IMU, RAW_IMU, SCALED_IMU, Heartbeat, MessageInterval, VehicleImu
from kiteline_hw.ports import SourceReport
from kiteline_hw.sensors.imu_buffer import ImuStream

_REQUEST_NS = 2_000_000_000  # ns of silence after which messages are requested again, coarser ones included
_MAX_SAMPLES = 4096  # buffered until the next frame; 20 s at 200 Hz
_AUTOPILOT = 1  # MAV_COMP_ID_AUTOPILOT1; a camera on the same bus may have an IMU of its own
_ARDUPILOT = 3  # MAV_AUTOPILOT; its RAW_IMU is in mg and mrad/s, others' in units of the chip
_BEST_FIRST = (HIGHRES_IMU, RAW_IMU, SCALED_IMU)  # floats; whole mg with stamps in us; the same in ms


class ControllerImu:
    """Converts messages to samples. R_b_f: (3,3) of the controller's axes (FRD) in the body. rate_hz: requested.

    report: counts the samples that were dropped.
    """

    def __init__(self, R_b_f: F64, rate_hz: float, report: SourceReport) -> None:
        self._R_b_f = R_b_f
        self._interval_us = round(1e6 / rate_hz)
        self._stream = ImuStream(report)
        self._clock = StampClock()
        self._chosen: tuple[int, int] | None = None  # message id and sensor number in use
        self._received_ns: int | None = None
        self._requested_ns: int | None = None

    def requests(self, autopilot: Heartbeat, now_ns: int) -> list[MessageInterval]:
        """The requests for samples to send now: at the first call, and whenever none have come for a while."""
        since_ns = self._requested_ns if self._received_ns is None else max(self._received_ns, self._requested_ns or 0)
        if self._requested_ns is not None and since_ns is not None and now_ns - since_ns < _REQUEST_NS:
            return []
        ids = _BEST_FIRST[:1] if self._requested_ns is None else _BEST_FIRST
        self._requested_ns = now_ns
        return [MessageInterval(autopilot.system, autopilot.component, i, self._interval_us) for i in ids]

    def receive(self, m: VehicleImu, autopilot: Heartbeat | None, now_ns: int) -> None:
        """Add a sample; those of other sensors, and coarser ones than already received, are ignored."""
        unscaled = m.message == RAW_IMU and (autopilot is None or autopilot.autopilot != _ARDUPILOT)
        if m.component != _AUTOPILOT or unscaled:
            return
        if (m.message, m.unit) != self._chosen:
            silent = self._received_ns is None or now_ns - self._received_ns > _REQUEST_NS
            better = self._chosen is None or _BEST_FIRST.index(m.message) < _BEST_FIRST.index(self._chosen[0])
            if not silent and not better:
                return
            self._chosen, self._clock = (m.message, m.unit), StampClock()
        self._received_ns = now_ns
        if len(self._stream) < _MAX_SAMPLES:
            self._stream.add(self._clock.to_ours(m.t_us * 1000, now_ns), m.gyro + m.accel)

    def take_until(self, t_ns: int) -> ImuBatch | None:
        """The samples up to a time on our clock, in the body frame."""
        batch = self._stream.take_until(t_ns)
        if batch is None:
            return None
        return ImuBatch(batch.t_ns, batch.gyro @ self._R_b_f.T, batch.accel @ self._R_b_f.T)
