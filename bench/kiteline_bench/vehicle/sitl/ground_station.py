"""A pilot at a ground station: commands to the autopilot, and a record of what it says."""

import contextlib
import socket
import time
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from kiteline_hw.system.closing import Closing

GUIDED, LAND = 4, 9  # modes of ArduCopter
USES = "using external nav data"  # it says so when its EKF begins to live on poses
HAS_POSITION = 16  # flag of EKF_STATUS_REPORT
_ARM, _TAKEOFF, _REBOOT, _INTERVAL = 400, 22, 246, 511  # commands
_POSITION_AND_YAW = 0x9F8  # of a target, what does not count
_ARMED = 128


@dataclass(frozen=True, slots=True)
class Said:
    """A text of the autopilot, and the simulated time in s when it came."""

    t_s: float
    severity: int
    text: str


class GroundStation(Closing):
    """A connection by TCP. Bytes are taken and sent by `poll`, in simulated time."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._socket: socket.socket | None = None
        self._mav: Any = dialect.MAVLink(self, srcSystem=255, srcComponent=190)
        self._mav.robust_parsing = True
        self._beat_s = self._stream_s = -1.0
        self.said: list[Said] = []
        self.positions: list[tuple[int, tuple[float, float, float]]] = []  # ms since boot, NED in m
        self.yaws: list[tuple[int, float]] = []  # ms since boot, rad
        self.beats_s: list[float] = []
        self.mode = -1
        self.armed = False
        self.flags = 0  # of EKF_STATUS_REPORT

    def write(self, data: bytes) -> None:
        """Send bytes; called by pymavlink."""
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.sendall(data)

    def poll(self, t_s: float) -> None:
        """Take what came; send what is due."""
        if self._socket is None and not self._connect():
            return
        assert self._socket is not None
        try:
            data = self._socket.recv(65536)
            if not data:
                raise OSError("closed")
        except BlockingIOError:
            data = b""
        except OSError:
            self._socket.close()
            self._socket = None
            return
        for message in self._mav.parse_buffer(bytearray(data)) or ():
            self._take(message, t_s)
        if t_s - self._beat_s >= 1.0:
            self._beat_s = t_s
            self._mav.heartbeat_send(6, 8, 0, 0, 4)
        if t_s - self._stream_s >= 5.0:
            self._stream_s = t_s
            for message, hz in ((30, 25.0), (32, 25.0), (193, 2.0)):
                self.command(_INTERVAL, message, 1e6 / hz)

    def _connect(self) -> bool:
        try:
            self._socket = socket.create_connection(("127.0.0.1", self._port), 1.0)
        except OSError:
            time.sleep(0.02)
            return False
        self._socket.setblocking(False)
        self._stream_s = -1.0
        return True

    def _take(self, m: Any, t_s: float) -> None:
        kind = m.get_type()
        if kind == "HEARTBEAT" and m.get_srcComponent() == 1:
            self.mode, self.armed = m.custom_mode, bool(m.base_mode & _ARMED)
            self.beats_s.append(t_s)
        elif kind == "STATUSTEXT":
            self.said.append(Said(t_s, m.severity, m.text))
        elif kind == "LOCAL_POSITION_NED":
            self.positions.append((m.time_boot_ms, (m.x, m.y, m.z)))
        elif kind == "ATTITUDE":
            self.yaws.append((m.time_boot_ms, m.yaw))
        elif kind == "EKF_STATUS_REPORT":
            self.flags = m.flags

    def command(self, command: int, *parameters: float) -> None:
        """Send COMMAND_LONG; parameters that are not given are 0."""
        self._mav.command_long_send(1, 1, command, 0, *[*parameters, *[0.0] * 7][:7])

    def set_mode(self, mode: int) -> None:
        """Ask for a mode of ArduCopter, by its number."""
        self._mav.set_mode_send(1, 1, mode)

    def arm(self) -> None:
        """Arm, with all checks."""
        self.command(_ARM, 1.0)

    def take_off(self, height_m: float) -> None:
        """Take off, in guided mode."""
        self.command(_TAKEOFF, 0, 0, 0, 0, 0, 0, height_m)

    def reboot(self) -> None:
        """Restart the autopilot."""
        self.command(_REBOOT, 1.0)

    def go_to(self, position_m: tuple[float, float, float], yaw_rad: float) -> None:
        """Fly to a place (NED), in guided mode."""
        self._mav.set_position_target_local_ned_send(
            0, 1, 1, 1, _POSITION_AND_YAW, *position_m, *[0.0] * 6, yaw_rad, 0.0
        )  # fmt: skip

    def sign_with(self, key: bytes, stamp: int) -> None:
        """Give the autopilot a key; from then on it wants signatures on all lines but this one."""
        self._mav.setup_signing_send(1, 1, list(key), stamp)

    def heard(self, word: str, since_s: float = 0.0) -> Said | None:
        """The first text with a word in it since a time; None if there was none."""
        return next((s for s in self.said if s.t_s >= since_s and word.lower() in s.text.lower()), None)

    def close(self) -> None:
        """Close the connection."""
        if self._socket is not None:
            self._socket.close()
