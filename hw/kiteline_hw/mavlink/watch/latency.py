"""Measures how late poses leave, and says the delay to set in the flight controller. Pure."""

from collections import deque
from dataclasses import dataclass

from kiteline_hw.mavlink.watch.findings import FindingLevel, FindingLog
from kiteline_hw.mavlink.watch.messages import PX4

_FRAME_BYTES = 245  # of ODOMETRY on the wire
_BITS_PER_BYTE = 10  # of a serial port, with start and stop bit


@dataclass(frozen=True, slots=True)
class LatencyConfig:
    """When the latency is said."""

    poses: int = 150  # of a measurement: 5 s at 30 Hz
    change_ms: float = 8.0  # ms; a smaller change of the delay is not worth a new parameter
    jitter_ms: float = 20.0  # ms between the 5th and 95th percentile that are said as a fault


class LatencyWatch:
    """Ages of sent poses in, findings out. baud: of the serial port to the controller; 0: not serial."""

    def __init__(self, log: FindingLog, baud: int = 0) -> None:
        self.config = LatencyConfig()
        self._log = log
        self._wire_ms = 1e3 * _FRAME_BYTES * _BITS_PER_BYTE / baud if baud > 0 else 0.0
        self._ages_ms: deque[float] = deque(maxlen=self.config.poses)
        self._said_ms: float | None = None

    def sent(self, age_ns: int, autopilot: int) -> None:
        """Add a pose that left age_ns after its capture, to a controller of this kind (MAV_AUTOPILOT)."""
        self._ages_ms.append(age_ns * 1e-6)
        if len(self._ages_ms) < self.config.poses:
            return
        ages = sorted(self._ages_ms)
        self._ages_ms.clear()
        # ArduPilot converts stamps by the message that came with the least delay, so that one is the delay to set.
        low, high = (ages[round(share * (len(ages) - 1))] + self._wire_ms for share in (0.05, 0.95))
        if self._said_ms is not None and abs(low - self._said_ms) < self.config.change_ms:
            return
        self._said_ms = low
        delay_ms = round(low)
        setting = "EKF2_EV_DELAY 0, as stamps are of the capture" if autopilot == PX4 else f"VISO_DELAY_MS {delay_ms}"
        jittery = high - low > self.config.jitter_ms
        self._log.say(
            "latency", delay_ms, FindingLevel.WARNING if jittery else FindingLevel.INFO,
            f"latency of poses: {low:.0f} ms, 95 % within {high:.0f} ms; to set: {setting}",
            f"kiteline: set {setting.split(',')[0]}",
            "It varies too much for one value: raise --cpu, or lower the frame rate" if jittery else "",
        )  # fmt: skip
