"""Clocks, and the kernel's CPU limit where it may be set."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

from kiteline_hw.system.clock import MonotonicClock
from kiteline_hw.system.cpu import CpuQuota, QuotaError

SPIN = "import time; e = time.process_time() + {}\nwhile time.process_time() < e: pass"

pytestmark = pytest.mark.alone


def test_clocks() -> None:
    clock = MonotonicClock()
    assert 0 < clock.now_ns() <= clock.now_ns()


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
        group = quota._group
    assert not group.exists()


def test_limits_that_cannot_be_set(tmp_path: Path) -> None:
    with pytest.raises(QuotaError, match="no cgroup v1 or v2"):
        CpuQuota(50.0, root=tmp_path)
    for percent in (0.0, -1.0, float("nan"), 0.1, 1e9):
        with pytest.raises(QuotaError, match=r"expected 0\.2 to 100 per core"):
            CpuQuota(percent)


def test_the_second_version_of_cgroups(tmp_path: Path) -> None:
    for file, text in (("cgroup.controllers", "memory io"), ("cgroup.subtree_control", "io"), ("cgroup.procs", "")):
        (tmp_path / file).write_text(text)
    assert "no cgroup" in str(CpuQuota.unavailable(tmp_path))
    (tmp_path / "cgroup.controllers").write_text("cpuset cpu io")
    assert CpuQuota.unavailable(tmp_path) is None
    with CpuQuota(25.0, root=tmp_path) as quota:
        assert (tmp_path / "cgroup.subtree_control").read_text() == "+cpu"
        assert (quota._group / "cpu.max").read_text() == "12500 50000"
        quota.add(4711)
        assert (quota._group / "cgroup.procs").read_text() == "4711"
    assert (quota._group / "cpu.max").read_text() == "max"  # files stay here, as this folder is no kernel's
    assert (tmp_path / "cgroup.procs").read_text() == "4711"


@pytest.mark.parametrize(("percent", "period_us", "quota_us"), [(25.0, 50_000, 12_500), (1.0, 100_000, 1_000)])
def test_small_limits_have_long_periods(percent: float, period_us: int, quota_us: int) -> None:
    try:
        quota = CpuQuota(percent)
    except QuotaError as error:
        pytest.skip(str(error))
    with quota:
        assert int((quota._group / "cpu.cfs_period_us").read_text()) == period_us
        assert int((quota._group / "cpu.cfs_quota_us").read_text()) == quota_us


def test_a_small_limit_holds_over_one_second() -> None:
    try:
        quota = CpuQuota(1.5)
    except QuotaError as error:
        pytest.skip(str(error))
    code = f"import sys; print(flush=True); sys.stdin.readline()\n{SPIN.format(0.02)}\nprint(flush=True)"
    process = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    with process, quota:  # the limit is off before Python tears itself down, which may cost a hundred times the spin
        assert process.stdin is not None and process.stdout is not None
        assert process.stdout.readline() == b"\n"  # it has started
        quota.add(process.pid)
        began = time.monotonic()
        process.stdin.write(b"\n")
        process.stdin.flush()
        assert process.stdout.readline() == b"\n"
        assert time.monotonic() - began > 0.7  # 20 ms of CPU at 1.5 percent take 1.3 s less a period or two
