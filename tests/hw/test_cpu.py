"""CPU time, memory, clocks, and the kernel's limit where it may be set."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from kiteline_hw.clock import ManualClock, MonotonicClock
from kiteline_hw.cpu import CpuQuota, QuotaError, children_cpu_ns, peak_rss_mib, process_cpu_ns, rss_mib

SPIN = "import time; e = time.process_time() + {}\nwhile time.process_time() < e: pass"


def test_cpu_time_counts_other_threads_and_no_sleep() -> None:
    before_ns = process_cpu_ns()
    time.sleep(0.05)
    assert process_cpu_ns() - before_ns < 40_000_000

    def spin() -> None:
        end_ns = time.thread_time_ns() + 50_000_000
        while time.thread_time_ns() < end_ns:
            pass

    before_ns = process_cpu_ns()
    thread = threading.Thread(target=spin)
    thread.start()
    thread.join()
    assert process_cpu_ns() - before_ns >= 50_000_000
    before_ns = children_cpu_ns()
    subprocess.run([sys.executable, "-c", SPIN.format(0.1)], check=True)
    assert children_cpu_ns() - before_ns >= 95_000_000


def test_memory_now_and_at_most() -> None:
    before_mib = rss_mib()
    block = np.ones(64 << 17)  # 64 MiB
    assert 60.0 < rss_mib() - before_mib < 70.0
    peak_mib = peak_rss_mib()
    assert peak_mib >= before_mib + 60.0
    del block
    assert rss_mib() < before_mib + 10.0
    assert peak_rss_mib() > peak_mib - 5.0  # some kernels round differently each time


def test_clocks() -> None:
    clock = MonotonicClock()
    assert 0 < clock.now_ns() <= clock.now_ns()
    manual = ManualClock(5)
    manual.set(7)
    assert manual.now_ns() == 7
    with pytest.raises(ValueError, match="set back"):
        manual.set(6)


def test_the_kernel_limits_a_process() -> None:
    try:
        quota = CpuQuota(20.0)
    except QuotaError as error:
        pytest.skip(str(error))
    with quota:
        code = f"import sys; sys.stdin.readline()\n{SPIN.format(0.15)}"
        process = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE)
        quota.add(process.pid)
        began = time.monotonic()
        process.communicate(b"\n")
        assert time.monotonic() - began > 0.45  # 0.15 s of CPU at 20 percent take 0.75 s less the first period
        assert quota.throttled_periods() > 3
        group = quota._group
    assert not group.exists()


def test_reasons_why_not(tmp_path: Path) -> None:
    with pytest.raises(QuotaError, match="no cgroup v1"):
        CpuQuota(50.0, root=tmp_path)
    for percent in (0.0, -1.0, float("nan"), 1.0, 1e9):
        with pytest.raises(ValueError, match="expected 2 to 100 per core"):
            CpuQuota(percent)
