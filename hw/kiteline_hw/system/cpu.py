"""What a process costs, and a limit on it by the kernel (cgroup v1)."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import math
import os
import resource
import time
from pathlib import Path
from types import TracebackType
from typing import Self

_MIB = 1024.0 * 1024.0
_MADV_DONTNEED = 4  # Linux, on every architecture
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # names of mallopt in the GNU C library
_LARGE_BYTES = 256 << 10  # a mapping of its own costs a few microseconds: little beside what is done with so much
_SPARE_BYTES = 2 << 20  # of freed heap that is kept for what comes next
_CHANGED = ("Private_Dirty:", "Shared_Dirty:", "Anonymous:")  # lines of smaps that count pages unlike their file's
_CGROUP = Path("/sys/fs/cgroup/cpu")
_PERIOD_US = 50_000  # us; a twentieth of the one-second window in which the limit has to hold
_LONGEST_PERIOD_US = 500_000  # us; for small limits, whose quota would be too small in a shorter one
_LEAST_QUOTA_US = 1_000  # us; what the kernel accepts at least


def process_cpu_ns() -> int:
    """CPU time of this process over all its threads, user and system, ended threads included."""
    return time.process_time_ns()


def children_cpu_ns() -> int:
    """CPU time of the child processes that have ended and were waited for."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return round((used.ru_utime + used.ru_stime) * 1e9)


def _status_mib(field: str) -> float:
    with contextlib.suppress(OSError, ValueError, IndexError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith(field + ":"):
                return int(line.split()[1]) * 1024.0 / _MIB
    return 0.0


def rss_mib() -> float:
    """Resident memory of this process now, in MiB; 0 where the system does not tell."""
    return _status_mib("VmRSS")


def peak_rss_mib() -> float:
    """The most resident memory that this process has had, in MiB; 0 where the system does not tell."""
    return _status_mib("VmHWM")


def release_memory() -> None:
    """Give back what only the start needed: freed heap, and pages of libraries and their code.

    Pages are dropped only where they are backed by their file and unchanged: what is used again is there again, at a
    quarter of a microsecond a page. Objects that live by now are no longer looked at by the garbage collector, whose
    full rounds would take as long as three frames. Does nothing where the system has no such calls.
    """
    gc.collect()
    gc.freeze()
    with contextlib.suppress(OSError, AttributeError, ValueError):
        libc = ctypes.CDLL(None, use_errno=True)
        libc.malloc_trim(0)
        for begin, end in clean_mappings(Path("/proc/self/smaps").read_text()):
            libc.madvise(ctypes.c_void_p(begin), ctypes.c_size_t(end - begin), _MADV_DONTNEED)


def return_large_arrays() -> None:
    """From here on the memory of large arrays goes back to the system as soon as they are freed.

    The GNU C library keeps ever larger freed blocks for later ones (M_MMAP_THRESHOLD grows by itself, up to 32 MiB):
    where sizes grow with what a process holds, hardly any fits the next, and the holes add up. Does nothing where the
    system has no such call.
    """
    with contextlib.suppress(OSError, AttributeError):
        libc = ctypes.CDLL(None)
        libc.mallopt(_M_MMAP_THRESHOLD, _LARGE_BYTES)
        libc.mallopt(_M_TRIM_THRESHOLD, _SPARE_BYTES)


def clean_mappings(smaps: str) -> list[tuple[int, int]]:
    """Begin and end of the mappings in /proc/PID/smaps that show files, cannot be written, and are unchanged."""
    found: list[tuple[int, int]] = []
    mapping: tuple[int, int] | None = None
    for line in smaps.splitlines():
        name, _, value = line.partition(" ")
        if not name.endswith(":"):
            fields = line.split(maxsplit=5)
            begin, end = (int(text, 16) for text in name.split("-"))
            is_file = len(fields) == 6 and fields[5].startswith("/") and fields[1] in ("r-xp", "r--p")
            mapping = (begin, end) if is_file else None
        elif mapping is not None and name in _CHANGED and int(value.split()[0]) > 0:
            mapping = None  # relocated when it was loaded: that stands in no file
        elif mapping is not None and name == "VmFlags:":
            found.append(mapping)
    return found


class QuotaError(OSError):
    """A CPU limit that the kernel does not let us set. The text says why."""


class CpuQuota:
    """Limits processes to `percent` of one core, together, with the kernel's CFS bandwidth control.

    Raises QuotaError where that cannot be done, ValueError for a percentage that is none.
    """

    def __init__(self, percent: float, *, root: Path = _CGROUP) -> None:
        least = 100.0 * _LEAST_QUOTA_US / _LONGEST_PERIOD_US
        if not least <= percent <= 100.0 * (os.cpu_count() or 1):
            raise ValueError(f"CPU limit of {percent:g} percent: expected {least:g} to 100 per core of this machine")
        period_us = max(_PERIOD_US, math.ceil(100.0 * _LEAST_QUOTA_US / percent))
        quota_us = max(round(percent / 100.0 * period_us), _LEAST_QUOTA_US)
        reason = self.unavailable(root)
        if reason is not None:
            raise QuotaError(reason)
        self._root = root
        self._pids: list[int] = []
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
        """Why no limit can be set on this machine, or None when it can."""
        if not (root / "cpu.cfs_quota_us").exists() and not (root / "cgroup.procs").exists():
            return f"no cgroup v1 cpu controller at {root}: use the virtual CPU (replay --cpu) or systemd's CPUQuota="
        if not os.access(root, os.W_OK):
            return f"{root} is not writable for this user: run as root, or use systemd's CPUQuota="
        return None

    def add(self, pid: int) -> None:
        """Put a process, and the children it will have, under the limit. Raises QuotaError."""
        try:
            (self._group / "cgroup.procs").write_text(str(pid))
        except OSError as error:
            raise QuotaError(f"process {pid} cannot be put under the CPU limit: {error}") from error
        self._pids.append(pid)

    def throttled_periods(self) -> int:
        """In how many periods the limit has stopped someone."""
        with contextlib.suppress(OSError, ValueError):
            for line in (self._group / "cpu.stat").read_text().splitlines():
                if line.startswith("nr_throttled "):
                    return int(line.split()[1])
        return 0

    def close(self) -> None:
        """Lift the limit: everyone goes back to the root group. May be called twice."""
        with contextlib.suppress(OSError):
            for pid in (self._group / "cgroup.procs").read_text().split():
                with contextlib.suppress(OSError):
                    (self._root / "cgroup.procs").write_text(pid)
        with contextlib.suppress(OSError):
            self._group.rmdir()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
