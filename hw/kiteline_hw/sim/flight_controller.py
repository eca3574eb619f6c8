"""A model of how ArduPilot and PX4 process ODOMETRY messages (not of how they fly).

Sources: ArduPilot GCS_Common handle_odometry and AP_VisualOdom; PX4 mavlink_receiver handle_message_odometry and
timesync. Real controllers drop messages silently; the model counts them by reason.
"""

import math
import socket
import threading
import time
from collections import Counter, deque
from dataclasses import dataclass
from typing import Literal

from kiteline_hw.mavlink.codec import MavlinkCodec
from kiteline_hw.mavlink.messages import Heartbeat, MavlinkMessage, Odometry, TimeSync, VehicleImu
from kiteline_hw.system.closing import Closing

Vector = tuple[float, float, float]

_LOCAL_FRAMES_PX4 = {1: "NED", 4: "ENU", 20: "FRD", 21: "FLU"}
_TIMESYNC_NS = {"px4": 100_000_000, "ardupilot": 10_000_000_000}  # ns between requests
_AUTOPILOT = {"px4": 12, "ardupilot": 3}
_HEALTHY_NS = 300_000_000  # ns of silence after which ArduPilot calls a source unhealthy


@dataclass(frozen=True, slots=True)
class VisionSample:
    """The input of the controller's filter: position, attitude and velocity in its local FRD frame."""

    received_ns: int
    t_ns: int  # capture, on the controller's clock, as far as it knows
    position_m: Vector
    q: tuple[float, float, float, float]
    velocity_m_s: Vector
    position_error_m: float | None  # None: unknown, the parameter's default applies
    reset_counter: int
    quality: int


class FlightController:
    """The model: bytes in, answers out, time handed in (its own clock). kind: whose rules apply."""

    def __init__(self, kind: Literal["ardupilot", "px4"], *, system: int = 1) -> None:
        self.kind = kind
        self.system = system
        self.codec = MavlinkCodec(system, 1)
        self.accepted: deque[VisionSample] = deque(maxlen=10_000)
        self.dropped: Counter[str] = Counter()
        self.heartbeats: Counter[tuple[int, int]] = Counter()
        self.resets = 0
        self.clock_offset_ns: int | None = None  # companion's clock less ours
        self._next_heartbeat_ns = 0
        self._next_timesync_ns = 0

    def poll(self, now_ns: int) -> list[bytes]:
        """The messages that it sends by itself: HEARTBEAT at 1 Hz and TIMESYNC requests."""
        out = []
        if now_ns >= self._next_heartbeat_ns:
            self._next_heartbeat_ns = now_ns + 1_000_000_000
            out.append(self.codec.encode(Heartbeat(2, _AUTOPILOT[self.kind])))
        if now_ns >= self._next_timesync_ns:
            self._next_timesync_ns = now_ns + _TIMESYNC_NS[self.kind]
            out.append(self.codec.encode(TimeSync(0, now_ns)))
        return out

    def imu(self, t_us: int, accel: Vector, gyro: Vector) -> bytes:
        """A HIGHRES_IMU message."""
        return self.codec.encode(VehicleImu(t_us, accel, gyro))

    def receive(self, data: bytes, now_ns: int) -> list[bytes]:
        """Process a datagram; returns the answers."""
        return self._process(self.codec.receive(data, datagram=True), now_ns)

    def receive_stream(self, data: bytes, now_ns: int) -> list[bytes]:
        """Process bytes of a stream; returns the answers."""
        return self._process(self.codec.receive(data), now_ns)

    def _process(self, messages: list[MavlinkMessage], now_ns: int) -> list[bytes]:
        out = []
        for message in messages:
            if isinstance(message, Heartbeat):
                self.heartbeats[message.system, message.component] += 1
            elif isinstance(message, TimeSync):
                if message.tc1_ns == 0:
                    out.append(self.codec.encode(TimeSync(now_ns, message.ts1_ns)))
                else:
                    self.clock_offset_ns = message.tc1_ns - (message.ts1_ns + now_ns) // 2
            elif isinstance(message, Odometry):
                self._odometry(message, now_ns)
        return out

    def _odometry(self, m: Odometry, now_ns: int) -> None:
        reason = self._ardupilot_fault(m) if self.kind == "ardupilot" else self._px4_fault(m)
        if reason is not None:
            self.dropped[reason] += 1
            return
        if self.accepted and self.accepted[-1].reset_counter != m.reset_counter:
            self.resets += 1
        q = (m.q[0], m.q[1], m.q[2], m.q[3])
        v = (m.velocity_m_s[0], m.velocity_m_s[1], m.velocity_m_s[2])
        self.accepted.append(
            VisionSample(
                received_ns=now_ns,
                t_ns=m.time_usec * 1000 - (self.clock_offset_ns or 0),
                position_m=(m.position_m[0], m.position_m[1], m.position_m[2]),
                q=q,
                velocity_m_s=_rotate(q, v),
                position_error_m=self._position_error(m),
                reset_counter=m.reset_counter,
                quality=m.quality,
            )
        )

    def _ardupilot_fault(self, m: Odometry) -> str | None:
        """Why ArduPilot drops the message, or None."""
        if m.frame_id != 20 or m.child_frame_id != 12:
            return f"frames {m.frame_id} and {m.child_frame_id} are not LOCAL_FRD and BODY_FRD"
        if m.quality < 0:  # VISO_QUAL_MIN
            return "quality below VISO_QUAL_MIN"
        if not all(map(math.isfinite, (*m.position_m, *m.q, *m.velocity_m_s))):
            return "a filter poisoned by NaN"  # ArduPilot itself would not notice
        if abs(math.hypot(*m.q) - 1.0) > 1e-3:
            return "quaternion is not of unit length"
        return None

    def _px4_fault(self, m: Odometry) -> str | None:
        """Why PX4 drops the message, or None."""
        if m.estimator_type not in (0, 1, 2, 3):
            return f"estimator type {m.estimator_type} is no visual odometry"
        if m.frame_id not in _LOCAL_FRAMES_PX4:
            return f"frame {m.frame_id} is unknown"
        if not all(map(math.isfinite, m.position_m)):
            return "position is not finite"
        if abs(math.hypot(*m.q) - 1.0) > 1e-3:
            return "quaternion is not of unit length"
        if m.quality < 0:  # VISO_QUAL_MIN
            return "quality below EKF2_EV_QMIN"
        return None

    def _position_error(self, m: Odometry) -> float | None:
        c = m.pose_covariance
        if math.isnan(c[0]):
            return None
        if self.kind == "px4":
            return None if m.estimator_type == 1 else math.sqrt(max(c[0], c[6], c[11]))
        return math.cbrt(c[0] ** 2 + c[6] ** 2 + c[11] ** 2)  # sic: ArduPilot takes the cube root of squares

    def healthy(self, now_ns: int) -> bool:
        """True if the last accepted message is recent enough to fly on."""
        return bool(self.accepted) and now_ns - self.accepted[-1].received_ns < _HEALTHY_NS


def _rotate(q: tuple[float, float, float, float], v: Vector) -> Vector:
    """v rotated by q: v + 2w (u x v) + 2 u x (u x v)."""
    w, x, y, z = q
    a = (y * v[2] - z * v[1], z * v[0] - x * v[2], x * v[1] - y * v[0])
    b = (y * a[2] - z * a[1], z * a[0] - x * a[2], x * a[1] - y * a[0])
    return v[0] + 2 * (w * a[0] + b[0]), v[1] + 2 * (w * a[1] + b[1]), v[2] + 2 * (w * a[2] + b[2])


class UdpFlightController(Closing):
    """The model behind a UDP socket on this machine, with a thread. clock_offset_ns: its clock less CLOCK_MONOTONIC."""

    def __init__(self, model: FlightController, *, clock_offset_ns: int = 0) -> None:
        self.model = model
        self.lock = threading.Lock()
        self._offset_ns = clock_offset_ns
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.02)
        self.port: int = self._socket.getsockname()[1]
        self._peer: tuple[str, int] | None = None
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="flight-controller", daemon=True)
        self._thread.start()

    def connect(self, host: str, port: int) -> None:
        """Set the address of a companion that listens."""
        self._peer = (host, port)

    def send(self, data: bytes) -> None:
        """Send raw bytes to the companion, if there is one."""
        if self._peer is not None:
            self._socket.sendto(data, self._peer)

    def _run(self) -> None:
        while not self._closed.is_set():
            data = b""
            try:
                data, self._peer = self._socket.recvfrom(2048)
            except TimeoutError:
                pass
            except OSError:
                continue
            with self.lock:
                now_ns = time.monotonic_ns() + self._offset_ns
                for message in self.model.receive(data, now_ns) + self.model.poll(now_ns):
                    self.send(message)

    def close(self) -> None:
        """Stop the thread."""
        self._closed.set()
        self._thread.join(1.0)
        self._socket.close()
