"""A limit on the CPU time of processes by the kernel (cgroup v1 or v2)."""

import contextlib
import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from kiteline_core.errors import KitelineError
from kiteline_hw.system.closing import Closing

_PERIOD_US = 50_000  # us; a twentieth of the one-second window over which the limit must hold
_MAX_PERIOD_US = 500_000  # us; for small limits, whose quota would fall below the minimum in a shorter period
_MIN_QUOTA_US = 1_000  # us; the kernel accepts no less


class QuotaError(KitelineError):
    """A CPU limit that cannot be set on this machine. The text says why."""


@dataclass(frozen=True, slots=True)
class _Controller:
    """How one version of cgroups limits CPU time. marks: files of the root that tell it; limit: what is written."""

    version: str
    root: Path
    marks: tuple[str, ...]
    limit: Callable[[int, int], tuple[tuple[str, str], ...]]  # (quota us, period us) -> files and their texts


_CONTROLLERS = (
    _Controller(
        "v1", Path("/sys/fs/cgroup/cpu"), ("cpu.cfs_quota_us", "cgroup.procs"),
        lambda quota, period: (("cpu.cfs_period_us", str(period)), ("cpu.cfs_quota_us", str(quota))),
    ),
    _Controller(
        "v2", Path("/sys/fs/cgroup"), ("cgroup.controllers", "cgroup.subtree_control", "cgroup.procs"),
        lambda quota, period: (("cpu.max", f"{quota} {period}"),),
    ),
)  # fmt: skip


class CpuQuota(Closing):
    """Limits a group of processes to `percent` of one core with the kernel's CFS bandwidth control.

    Raises QuotaError if the limit cannot be set, or is out of range.
    """

    def __init__(self, percent: float, *, root: Path | None = None) -> None:
        """root: of the cgroups, v1's cpu controller or v2's; None: where Linux has them."""
        min_percent = 100.0 * _MIN_QUOTA_US / _MAX_PERIOD_US
        if not min_percent <= percent <= 100.0 * (os.cpu_count() or 1):
            raise QuotaError(
                f"CPU limit of {percent:g} percent: expected {min_percent:g} to 100 per core of this machine"
            )
        period_us = max(_PERIOD_US, math.ceil(100.0 * _MIN_QUOTA_US / percent))
        quota_us = max(round(percent / 100.0 * period_us), _MIN_QUOTA_US)
        controller, self._root = _controller(root)
        reason = self.unavailable(root)
        if controller is None or reason is not None:
            raise QuotaError(reason)
        self._group = self._root / f"kiteline-{os.getpid()}-{time.monotonic_ns()}"
        try:
            if controller.version == "v2":
                _enable_cpu(self._root)
            self._group.mkdir()
            for file, text in controller.limit(quota_us, period_us):
                (self._group / file).write_text(text)
        except OSError as error:
            self.close()
            raise QuotaError(f"the kernel refused a CPU limit in {self._group}: {error}") from error

    @staticmethod
    def unavailable(root: Path | None = None) -> str | None:
        """The reason why no limit can be set on this machine, or None."""
        controller, found = _controller(root)
        if controller is None:
            return f"no cgroup v1 or v2 cpu controller at {found}: use the virtual CPU (--cpu) or systemd's CPUQuota="
        if not os.access(found, os.W_OK):
            return f"{found} is not writable for this user: run as root, or use systemd's CPUQuota="
        return None

    def add(self, pid: int) -> None:
        """Put a process and its future children under the limit. Raises QuotaError."""
        try:
            (self._group / "cgroup.procs").write_text(str(pid))
        except OSError as error:
            raise QuotaError(f"process {pid} cannot be put under the CPU limit: {error}") from error

    def close(self) -> None:
        """Remove the limit: all processes return to the root group. May be called twice."""
        with contextlib.suppress(OSError):  # processes that the root group does not take stay, without a limit
            if (self._group / "cpu.max").exists():
                (self._group / "cpu.max").write_text("max")
        with contextlib.suppress(OSError):
            for pid in (self._group / "cgroup.procs").read_text().split():
                with contextlib.suppress(OSError):
                    (self._root / "cgroup.procs").write_text(pid)
        with contextlib.suppress(OSError):
            self._group.rmdir()


def _controller(root: Path | None) -> tuple[_Controller | None, Path]:
    """The first version of cgroups whose files are at the root, or where Linux has them; and that root."""
    for controller in _CONTROLLERS:
        at = root or controller.root
        if all((at / mark).exists() for mark in controller.marks):
            if controller.version == "v1" or "cpu" in (at / "cgroup.controllers").read_text().split():
                return controller, at
    return None, root or _CONTROLLERS[0].root


def _enable_cpu(root: Path) -> None:
    """Let groups below a v2 root limit CPU time. Raises OSError."""
    enabled = root / "cgroup.subtree_control"
    if "cpu" not in enabled.read_text().split():
        enabled.write_text("+cpu")
