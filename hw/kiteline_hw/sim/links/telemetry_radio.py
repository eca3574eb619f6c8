"""A model of a flight controller that routes MAVLink between a companion and its telemetry radio. Pure.

The radio is a half-duplex pair like SiK's: the two sides transmit in turns, each from a buffer whose free share is
reported in RADIO_STATUS. The controller also sends its own telemetry; like ArduPilot's and PX4's routers it forwards
without priorities, first come, first served.
"""

from collections import deque
from dataclasses import dataclass

from kiteline_hw.mavlink.codec import MavlinkCodec
from kiteline_hw.mavlink.messages import RadioStatus


@dataclass(frozen=True, slots=True)
class RadioConfig:
    """A pair of telemetry radios."""

    air_bytes_s: int = 8000  # during a side's turn: 64 kb/s
    window_ns: int = 130_000_000  # ns of a turn (SiK: about 130 ms at full load)
    gap_ns: int = 10_000_000  # ns between turns
    buffer_bytes: int = 4096  # of each side; messages that do not fit are lost
    status_ns: int = 500_000_000  # ns between RADIO_STATUS
    forwards_status: bool = True  # the controller hands RADIO_STATUS on to its companion, as PX4 does; ArduPilot not


@dataclass(frozen=True, slots=True)
class TelemetryConfig:
    """The controller's own telemetry."""

    bytes_s: int = 500
    message_bytes: int = 50  # of one message, about an ATTITUDE or a GLOBAL_POSITION_INT


class _Side:
    """One radio's send buffer."""

    def __init__(self, config: RadioConfig, turn: int) -> None:
        self._config = config
        self._turn = turn  # 0: first half of the period, 1: second
        self._waiting: deque[tuple[int, bytes, bool]] = deque()  # ns handed in, message, whether it is telemetry
        self._bytes = 0
        self._air_ns = 0  # until when the air is in use
        self.telemetry_delay_ns: list[int] = []

    @property
    def free_percent(self) -> int:
        return max(0, 100 - 100 * self._bytes // self._config.buffer_bytes)

    def push(self, message: bytes, now_ns: int, telemetry: bool = False) -> None:
        if self._bytes + len(message) > self._config.buffer_bytes:
            return
        self._waiting.append((now_ns, message, telemetry))
        self._bytes += len(message)

    def advance(self, now_ns: int) -> list[bytes]:
        """The messages that have been sent by now."""
        out = []
        while self._waiting:
            since_ns, message, telemetry = self._waiting[0]
            end_ns = self._end_of_sending(max(self._air_ns, since_ns), len(message))
            if end_ns > now_ns:
                break
            self._air_ns = end_ns
            self._waiting.popleft()
            self._bytes -= len(message)
            if telemetry:
                self.telemetry_delay_ns.append(end_ns - since_ns)
            out.append(message)
        return out

    def _end_of_sending(self, begin_ns: int, n_bytes: int) -> int:
        """The time at which n_bytes, begun at begin_ns, have been sent in this side's turns."""
        c = self._config
        left_ns = n_bytes * 1_000_000_000 // c.air_bytes_s
        half_ns = c.window_ns + c.gap_ns
        at = begin_ns
        while True:
            start = (at - self._turn * half_ns) // (2 * half_ns) * (2 * half_ns) + self._turn * half_ns
            if at < start + c.window_ns:
                used = min(left_ns, start + c.window_ns - at)
                left_ns -= used
                at += used
                if left_ns == 0:
                    return at
            at = start + 2 * half_ns


class RoutingController:
    """A router with the companion on one port and, over a pair of radios, the ground station on the other."""

    def __init__(self, radio: RadioConfig | None = None, telemetry: TelemetryConfig | None = None) -> None:
        self.radio = radio or RadioConfig()
        self.telemetry = telemetry or TelemetryConfig()
        self.up = _Side(self.radio, 0)
        self.down = _Side(self.radio, 1)
        self._codec = MavlinkCodec(1, 1)
        self._telemetry_due_ns = 0
        self._status_due_ns = 0

    def step(
        self, from_companion: list[bytes], from_ground: list[bytes], now_ns: int
    ) -> tuple[list[bytes], list[bytes]]:
        """Forward messages; returns those for the companion and those for the ground."""
        t = self.telemetry
        if t.bytes_s:
            period_ns = t.message_bytes * 1_000_000_000 // t.bytes_s
            while self._telemetry_due_ns <= now_ns:
                self.up.push(bytes(t.message_bytes), self._telemetry_due_ns, telemetry=True)
                self._telemetry_due_ns += period_ns
        for message in from_companion:
            self.up.push(message, now_ns)
        for message in from_ground:
            self.down.push(message, now_ns)
        to_ground = [m for m in self.up.advance(now_ns) if m[0] == 0xFD]
        to_companion = self.down.advance(now_ns)
        if now_ns >= self._status_due_ns:
            self._status_due_ns = now_ns + self.radio.status_ns
            # Each radio reports to its own side; the controller may forward its own to the companion.
            if self.radio.forwards_status:
                to_companion.append(self._codec.encode(RadioStatus(self.up.free_percent)))
            to_ground.append(self._codec.encode(RadioStatus(self.down.free_percent)))
        return to_companion, to_ground
