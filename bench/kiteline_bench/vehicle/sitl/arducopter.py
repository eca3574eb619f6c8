"""The process of a built ArduCopter, driven step by step over its JSON interface."""

import os
import signal
import socket
import struct
import subprocess
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from kiteline_bench.vehicle.sitl.copter import Copter
from kiteline_hw.system.closing import Closing

VARIABLE = "KITELINE_SITL"
STEP_S = 0.00125  # of the physics: twice the rate of its loop, or it does not arm
_MAGIC = 18458
_STATE = struct.Struct("<HHI16H")
_SILENT_S = 60.0  # s of wall time after which the process counts as dead

PARAMETERS: Mapping[str, float] = {
    "FRAME_CLASS": 1, "FRAME_TYPE": 1, "AHRS_EKF_TYPE": 3, "EK3_ENABLE": 1, "VISO_TYPE": 3, "VISO_DELAY_MS": 0,
    "EK3_SRC1_POSXY": 6, "EK3_SRC1_VELXY": 6, "EK3_SRC1_POSZ": 6, "EK3_SRC1_VELZ": 6, "EK3_SRC1_YAW": 6,
    "GPS1_TYPE": 0, "SIM_GPS1_ENABLE": 0, "BATT_MONITOR": 0, "RPM1_TYPE": 0, "LOG_BACKEND_TYPE": 0,
    "SERIAL1_PROTOCOL": 2, "SERIAL2_PROTOCOL": 2, "FS_THR_ENABLE": 0, "FS_GCS_ENABLE": 0, "FS_EKF_ACTION": 1,
    "DISARM_DELAY": 0, "WP_YAW_BEHAVIOR": 0,
}  # fmt: skip


def binary() -> Path | None:
    """The ArduCopter that KITELINE_SITL names; None if it names none."""
    named = os.environ.get(VARIABLE, "")
    return Path(named) if named else None


class ArduCopter(Closing):
    """A running autopilot. folder: for its memory. serial: TCP ports of SERIAL0, SERIAL1 and SERIAL2."""

    def __init__(self, program: Path, folder: Path, copter: Copter) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.copter = copter
        self.reboots = 0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(_SILENT_S)
        self._since_s = copter.t_s
        self._count = -1
        self.serial = _free_ports(3)
        defaults = folder / "defaults.parm"
        defaults.write_text("".join(f"{name} {value:g}\n" for name, value in PARAMETERS.items()))
        words = [str(program.resolve()), "--model", "JSON:127.0.0.1", "--defaults", defaults.name,
                 "--instance", str(os.getpid() % 89 + 10), "--sim-port-out", str(self._socket.getsockname()[1]),
                 "--home", "47.3977,8.5456,488,0", "--wipe"]  # fmt: skip
        for k, port in enumerate(self.serial):
            words += [f"--serial{k}", f"tcp:{port}"]
        self._text = (folder / "arducopter.txt").open("wb")
        self._process = subprocess.Popen(words, cwd=folder, stdout=self._text, stderr=self._text)

    def url(self, k: int) -> str:
        """The URL of SERIALk for kiteline."""
        return f"tcp:127.0.0.1:{self.serial[k]}"

    def step(self) -> None:
        """Take the motors' commands, fly one step, give the state. Raises TimeoutError."""
        data, peer = self._socket.recvfrom(256)
        magic, _, count, *pwm = _STATE.unpack_from(data)
        if magic != _MAGIC:
            return
        if count < self._count:  # it began anew, and its time too
            self.reboots += 1
            self._since_s = self.copter.t_s
        self._count = count
        self.copter.step(np.array(pwm[:4], np.uint16), STEP_S)
        self._socket.sendto(self.copter.message(self._since_s), peer)

    def boot_s(self, t_ms: int) -> float:
        """Simulated time of one of its stamps, in ms since its start."""
        return self._since_s + t_ms * 1e-3

    def close(self) -> None:
        """End the process."""
        self._process.send_signal(signal.SIGKILL)
        self._process.wait()
        self._socket.close()
        self._text.close()


def _free_ports(n: int) -> list[int]:
    taken = [socket.socket() for _ in range(n)]
    for one in taken:
        one.bind(("127.0.0.1", 0))
    ports = [int(one.getsockname()[1]) for one in taken]
    for one in taken:
        one.close()
    return ports
