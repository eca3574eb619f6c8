"""The parts of `kiteline bench agent`: clips, faults, the dearest second, governed flights, their table and figure."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kiteline_hw.cpu import CpuQuota
from kiteline_lab import bench_agent
from kiteline_lab.benchmark import BENCHMARKS
from kiteline_lab.clip import Clip, load
from kiteline_lab.governed import Governed, dearest_window, fly_clip
from kiteline_lab.plot_governor import plot_governor


@pytest.fixture(scope="module")
def clip(recording: Path) -> Clip:
    return load(str(recording))


def test_benchmark_is_registered() -> None:
    assert BENCHMARKS["agent"] == bench_agent.__name__


def test_clip_goes_to_and_fro_without_a_jump(clip: Clip) -> None:
    n = len(clip.items)
    frames = list(clip.to_and_fro(3 * n))
    stamps = np.array([frame.t_ns for frame in frames])
    assert (np.diff(stamps) == clip.period_ns).all()
    assert frames[n].left is clip.items[n - 2][0].left and frames[2 * n - 2].left is clip.items[0][0].left
    order = [next(k for k, item in enumerate(clip.items) if item[0].left is frame.left) for frame in frames]
    assert (np.abs(np.diff(order)) == 1).all()


def test_dearest_window_is_that_of_a_plain_loop() -> None:
    rng = np.random.default_rng(3)
    t_ns = np.cumsum(rng.integers(20_000_000, 200_000_000, 80))
    spent = np.column_stack([t_ns, rng.integers(0, 30_000_000, 80)])
    plain = max(spent[(t_ns > t - 1_000_000_000) & (t_ns <= t), 1].sum() for t in t_ns[t_ns >= t_ns[0] + 3_000_000_000])
    assert dearest_window(spent) == pytest.approx(plain / 1e9)


def test_governed_flight_keeps_its_budget_and_accounts_for_every_frame(clip: Clip) -> None:
    free = fly_clip(clip, 0.0, governor=False, real=False)
    assert free.tracked == free.frames == len(clip.items) and free.ate_m < 0.01
    for governor in (True, False):
        found = fly_clip(clip, 0.4 * free.load, governor=governor, real=False)
        assert found.tracked + found.lost + found.dropped == found.frames == len(clip.items)
        assert found.load < free.load
    assert fly_clip(clip, 0.4 * free.load, governor=True, real=False) == fly_clip(
        clip, 0.4 * free.load, governor=True, real=False
    )


@pytest.mark.parametrize("fault", bench_agent.FAULTS)
def test_faults_change_a_clip_and_no_agent_breaks_on_them(clip: Clip, fault: str) -> None:
    broken = bench_agent.faulty(clip, fault)
    before = [(item[0].t_ns, item[0].left.tobytes(), item[0].right is None) for item in clip.items]
    assert [(item[0].t_ns, item[0].left.tobytes(), item[0].right is None) for item in broken.items] != before
    found = bench_agent._estimates(broken)
    assert len(found) == len(broken.items)
    assert all(np.isfinite(e.T_o_b).all() for e in found)


def test_unknown_fault_is_an_error(clip: Clip) -> None:
    with pytest.raises(ValueError, match="no fault"):
        bench_agent.faulty(clip, "thunder")


def test_table_and_figure_of_flights(clip: Clip, tmp_path: Path) -> None:
    free = fly_clip(clip, 0.0, governor=False, real=False)
    rows: list[tuple[float, Governed]] = [(1.0, free)]
    rows += [(share, replace(free, percent=share * free.load, governor=True)) for share in (0.5, 1.0)]
    lines = bench_agent.governor_table(rows).splitlines()
    assert len(lines) == 2 + len(rows) and len({line.count("|") for line in lines}) == 1
    plot_governor(tmp_path / "governor.png", [flight for _, flight in rows], "wall")
    assert (tmp_path / "governor.png").read_bytes().startswith(b"\x89PNG")


def test_start_to_first_pose_is_measured(recording: Path) -> None:
    command = [sys.executable, "-m", "kiteline_lab.governed", "first-pose", str(recording)]
    assert 0.05 < bench_agent._json(command)["seconds"] < 60.0


def test_memory_is_measured_over_minutes(recording: Path) -> None:
    command = [sys.executable, "-m", "kiteline_lab.governed", "soak", str(recording), "--minutes", "0.1"]
    assert bench_agent._json(command)["rss_mib"] == []  # not one whole minute


@pytest.mark.skipif(CpuQuota.unavailable() is not None, reason="no limit can be set here")
def test_flight_under_the_kernel_s_limit(recording: Path) -> None:
    command = [sys.executable, "-m", "kiteline_lab.governed", "quota", str(recording), "--percent", "20", "--governor"]
    found = Governed(**bench_agent._json(command))
    assert found.real and found.tracked + found.lost + found.dropped == found.frames and found.tracked > 0
