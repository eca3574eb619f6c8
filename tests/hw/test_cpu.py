"""CPU time, memory, clocks, and the kernel's limit where it may be set."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from kiteline_hw.system.clock import ManualClock, MonotonicClock
from kiteline_hw.system.cpu import CpuQuota, QuotaError, children_cpu_ns, clean_mappings, process_cpu_ns

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


MEMORY = """
import numpy as np
from kiteline_hw.system.cpu import peak_rss_mib, rss_mib
before = rss_mib()
block = np.ones(64 << 17)  # 64 MiB
held, peak = rss_mib(), peak_rss_mib()
del block
print(before, held, peak, rss_mib(), peak_rss_mib())
"""


def test_memory_now_and_at_most() -> None:
    """In a process of its own: in this one, what other tests left goes back to the system at any time."""
    done = subprocess.run([sys.executable, "-c", MEMORY], check=True, capture_output=True, text=True)
    before_mib, held_mib, peak_mib, after_mib, last_peak_mib = map(float, done.stdout.split())
    assert 60.0 < held_mib - before_mib < 70.0
    assert peak_mib >= before_mib + 60.0
    assert after_mib < before_mib + 10.0
    assert last_peak_mib > peak_mib - 5.0  # some kernels round differently each time


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
    for percent in (0.0, -1.0, float("nan"), 0.1, 1e9):
        with pytest.raises(ValueError, match=r"expected 0\.2 to 100 per core"):
            CpuQuota(percent)


@pytest.mark.parametrize(("percent", "period_us", "quota_us"), [(25.0, 50_000, 12_500), (1.0, 100_000, 1_000)])
def test_small_limits_have_long_periods(percent: float, period_us: int, quota_us: int) -> None:
    try:
        quota = CpuQuota(percent)
    except QuotaError as error:
        pytest.skip(str(error))
    with quota:
        assert int((quota._group / "cpu.cfs_period_us").read_text()) == period_us
        assert int((quota._group / "cpu.cfs_quota_us").read_text()) == quota_us


def test_a_small_limit_holds_over_a_second() -> None:
    try:
        quota = CpuQuota(1.5)
    except QuotaError as error:
        pytest.skip(str(error))
    with quota:
        code = f"import sys; sys.stdin.readline()\n{SPIN.format(0.02)}"
        process = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE)
        time.sleep(0.3)  # it has started
        quota.add(process.pid)
        began = time.monotonic()
        process.communicate(b"\n")
        assert time.monotonic() - began > 0.7  # 20 ms of CPU at 1.5 percent take 1.3 s less a period or two


def test_memory_that_only_the_start_needed_is_given_back() -> None:
    code = (
        "import cv2, numpy as np\nfrom kiteline_hw.system.cpu import release_memory, rss_mib\n"
        "image = np.arange(40000, dtype=np.uint8).reshape(200, 200)\nwanted = cv2.GaussianBlur(image, (5, 5), 1.0)\n"
        "before = rss_mib()\nrelease_memory()\nprint(before - rss_mib())\n"
        "assert (cv2.GaussianBlur(image, (5, 5), 1.0) == wanted).all()\nimport zlib, decimal\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    if Path("/proc/self/smaps").exists():
        assert float(done.stdout) > 10.0


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the system does not tell what memory is resident")
def test_freed_arrays_go_back_to_the_system() -> None:
    """Arrays that outgrow each other, with small things that live on between them."""
    code = (
        "import numpy as np\nfrom kiteline_hw.system.cpu import return_large_arrays, rss_mib\n"
        "return_large_arrays()\nkept = []\nbefore = rss_mib()\n"
        "for k in range(60):\n"
        "    a, small = np.ones((k + 1) << 16), np.ones(3000)\n    b = np.ones((k + 1) << 15)\n"
        "    kept.append(np.ones(3000))\n    del a, small\ndel b\n"
        "print(rss_mib() - before)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) < 5.0  # 1.4 MiB are still in use; of a heap left to itself some 40 MiB stay


def test_only_unchanged_pages_of_files_are_dropped() -> None:
    def mapping(first: int, mode: str, name: str, **sizes: int) -> str:
        head = f"{first:x}-{first + 0x1000:x} {mode} 00000000 fe:00 7 {name}\n"
        known = {"Rss": 4, "Shared_Dirty": 0, "Private_Dirty": 0, "Anonymous": 0, **sizes}
        return head + "".join(f"{key}: {value} kB\n" for key, value in known.items()) + "VmFlags: rd mr mw me\n"

    smaps = "".join(
        (
            mapping(0x10000, "r-xp", "/lib/code.so"),
            mapping(0x20000, "r--p", "/lib/code.so", Private_Dirty=4, Anonymous=4),
            mapping(0x30000, "rw-p", "/lib/code.so"),
            mapping(0x40000, "r-xp", ""),
            mapping(0x50000, "r-xp", "[vdso]"),
            mapping(0x60000, "r--p", "/a folder/data (1).so"),
        )
    )
    assert clean_mappings(smaps) == [(0x10000, 0x11000), (0x60000, 0x61000)]
