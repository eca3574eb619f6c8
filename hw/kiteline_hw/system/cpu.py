"""CPU time of this process, and a limit on processes by the kernel (cgroup v1)."""

from __future__ import annotations

import contextlib
import math
import os
import time
from pathlib import Path

from kiteline_hw.system.closing import Closing

_CGROUP = Path("/sys/fs/cgroup/cpu")
_PERIOD_US = 50_000  # us; a twentieth of the one-second window over which the limit must hold
_MAX_PERIOD_US = 500_000  # us; for small limits, whose quota would fall below the minimum in a shorter period
_MIN_QUOTA_US = 1_000  # us; the kernel accepts no less


def process_cpu_ns() -> int:
    """CPU time of this process over all its threads, user and system, ended threads included."""
    return time.process_time_ns()


class QuotaError(OSError):
    """A CPU limit that cannot be set on this machine. The text says why."""


class CpuQuota(Closing):
    """Limits a group of processes to `percent` of one core with the kernel's CFS bandwidth control.

    Raises QuotaError if the limit cannot be set, ValueError if the percentage is out of range.
    """

    def __init__(self, percent: float, *, root: Path = _CGROUP) -> None:
        min_percent = 100.0 * _MIN_QUOTA_US / _MAX_PERIOD_US
        if not min_percent <= percent <= 100.0 * (os.cpu_count() or 1):
            raise ValueError(
                f"CPU limit of {percent:g} percent: expected {min_percent:g} to 100 per core of this machine"
            )
        period_us = max(_PERIOD_US, math.ceil(100.0 * _MIN_QUOTA_US / percent))
        quota_us = max(round(percent / 100.0 * period_us), _MIN_QUOTA_US)
        reason = self.unavailable(root)
        if reason is not None:
            raise QuotaError(reason)
        self._root = root
        self._group = root / f"kiteline-{os.getpid()}-{time.monotonic_ns()}"
        try:
            self._group.mkdir()
            (self._group / "cpu.cfs_period_us").write_text(str(period_us))
            (self._group / "cpu.cfs_quota_us").write_text(str(quota_us))
        except OSError as error:
            self.close()
            raise QuotaError(f"the kernel refused a CPU limit in {self._group}: {error}") from error

    @staticmethod
    def unavailable(root: Path = _CGROUP) -> str | None:
        """The reason why no limit can be set on this machine, or None."""
        if not (root / "cpu.cfs_quota_us").exists() and not (root / "cgroup.procs").exists():
            return f"no cgroup v1 cpu controller at {root}: use the virtual CPU (replay --cpu) or systemd's CPUQuota="
        if not os.access(root, os.W_OK):
            return f"{root} is not writable for this user: run as root, or use systemd's CPUQuota="
        return None

    def add(self, pid: int) -> None:
        """Put a process and its future children under the limit. Raises QuotaError."""
        try:
            (self._group / "cgroup.procs").write_text(str(pid))
        except OSError as error:
            raise QuotaError(f"process {pid} cannot be put under the CPU limit: {error}") from error

    def close(self) -> None:
        """Remove the limit: all processes return to the root group. May be called twice."""
        with contextlib.suppress(OSError):
            for pid in (self._group / "cgroup.procs").read_text().split():
                with contextlib.suppress(OSError):
                    (self._root / "cgroup.procs").write_text(pid)
        with contextlib.suppress(OSError):
            self._group.rmdir()
