"""The parts of `kiteline bench agent`: clips, faults, losses, the dearest second, governed flights, table, figure."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kiteline_bench.agent import flights as bench_agent
from kiteline_bench.agent.faults import estimates
from kiteline_bench.agent.governor import governor_table
from kiteline_bench.benchmark import BENCHMARKS
from kiteline_bench.harness import trials
from kiteline_bench.harness.clip import Clip, load
from kiteline_bench.harness.faults import FAULTS, blind, faulty, fitting, rearranged
from kiteline_bench.harness.governed import Governed, dearest_window, fly_clip
from kiteline_bench.harness.plot_governor import plot_governor
from kiteline_hw.system.cpu import CpuQuota


@pytest.fixture(scope="module")
def clip(recording: Path) -> Clip:
    return load(str(recording))


def test_benchmark_is_registered() -> None:
    assert BENCHMARKS["agent"] == bench_agent.__name__


def test_clip_goes_to_and_fro_without_a_jump(clip: Clip) -> None:
    n = len(clip.items)
    frames = [frame for frame, _ in clip.to_and_fro(3 * n)]
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


def test_a_flight_backward_turns_the_other_way(data_dir: Path) -> None:
    clip = load(str(data_dir / "euroc_v101_start"), frames=12)
    there_and_back = list(clip.to_and_fro(23))
    stamps = np.concatenate([imu.t_ns for _, imu in there_and_back if imu is not None])
    assert (np.diff(stamps) > 0).all()
    turn = sum(float(imu.gyro.sum()) for _, imu in there_and_back if imu is not None)
    once = sum(float(imu.gyro.sum()) for _, imu in clip.items[1:] if imu is not None)
    assert abs(turn) < 0.2 * abs(once)
    for frame, imu in there_and_back[1:]:
        assert imu is not None and abs(int(imu.t_ns[-1]) - frame.t_ns) <= 5_000_000
    force = np.concatenate([imu.accel for _, imu in there_and_back if imu is not None])
    assert abs(np.linalg.norm(force.mean(axis=0)) - 9.8) < 0.3


def test_calm_part_begins_and_ends_at_rest(data_dir: Path) -> None:
    clip = load(str(data_dir / "room_flight.mcap"), frames=120)
    calm = clip.calm()
    assert 60 <= len(calm.items) <= 120
    assert calm.items[0][0].t_ns >= clip.items[0][0].t_ns and calm.items[-1][0].t_ns <= clip.items[-1][0].t_ns


def test_saved_clip_is_read_again(clip: Clip, tmp_path: Path) -> None:
    again = load(str(clip.save(tmp_path / "clip.mcap")))
    assert [frame.t_ns for frame, _ in again.items] == [frame.t_ns for frame, _ in clip.items]
    assert np.abs(again.items[3][0].left.astype(int) - clip.items[3][0].left).mean() < 4.0
    assert again.truth is not None and len(again.truth.t_ns) == len(clip.items)


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_change_a_clip_and_no_agent_breaks_on_them(clip: Clip, fault: str) -> None:
    if fault not in fitting(clip):
        assert fault == "no depth"
        return
    broken = faulty(clip, fault)
    before = [(item[0].t_ns, item[0].left.tobytes(), item[0].right is None) for item in clip.items]
    assert [(item[0].t_ns, item[0].left.tobytes(), item[0].right is None) for item in broken.items] != before
    found = estimates(broken)
    assert len(found) == len(broken.items)
    assert all(np.isfinite(e.T_o_b).all() for e in found)


def test_unknown_fault_is_an_error(clip: Clip) -> None:
    with pytest.raises(ValueError, match="no fault"):
        faulty(clip, "thunder")


def test_sight_is_lost_for_the_frames_that_were_named(clip: Clip) -> None:
    for black in (False, True):
        found = blind(clip, 2, 4, black=black)
        spread = [float(frame.left.std()) for frame, _ in found.items]
        assert [k for k, s in enumerate(spread) if s < 3.0] == [2, 3]


def test_rearranged_clip_goes_on_in_time_with_the_truth_of_what_is_seen(clip: Clip) -> None:
    found = rearranged(clip, [0, 1, None, None, 5, 4])
    assert (np.diff([frame.t_ns for frame, _ in found.items]) == clip.period_ns).all()
    assert found.items[4][0].left is clip.items[5][0].left and found.items[2][0].left.std() < 3.0
    assert found.truth is not None and clip.truth is not None and found.imu is None
    true = [int(np.argmin(np.abs(clip.truth.t_ns - clip.items[k][0].t_ns))) for k in (0, 1, 1, 1, 5, 4)]
    assert np.array_equal(found.truth.T_w_b, clip.truth.T_w_b[true])


def test_table_and_figure_of_flights(clip: Clip, tmp_path: Path) -> None:
    free = fly_clip(clip, 0.0, governor=False, real=False)
    rows: list[tuple[float, Governed]] = [(1.0, free)]
    rows += [(share, replace(free, percent=share * free.load, governor=True)) for share in (0.5, 1.0)]
    lines = governor_table(rows).splitlines()
    assert len(lines) == 2 + len(rows) and len({line.count("|") for line in lines}) == 1
    plot_governor(tmp_path / "governor.png", [flight for _, flight in rows], "wall")
    assert (tmp_path / "governor.png").read_bytes().startswith(b"\x89PNG")


def test_start_to_first_pose_is_measured(recording: Path) -> None:
    assert 0.05 < trials.start("first-pose", str(recording))["seconds"] < 60.0


@pytest.mark.parametrize("options", [[], ["--link"]])
def test_memory_is_measured_over_minutes(recording: Path, options: list[str]) -> None:
    found = trials.start("soak", str(recording), "--minutes", "0.1", *options)
    assert found["rss_mib"] == [] and found["lost"] == 0  # not one whole minute


def test_trial_that_fails_says_why(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="first-pose"):
        trials.start("first-pose", str(tmp_path / "nothing"))


@pytest.mark.skipif(CpuQuota.unavailable() is not None, reason=str(CpuQuota.unavailable()))
def test_flight_under_the_kernel_s_limit(recording: Path) -> None:
    found = Governed(**trials.start("quota", str(recording), "--percent", "20", "--governor"))
    assert found.real and found.tracked + found.lost + found.dropped == found.frames and found.tracked > 0


@pytest.mark.skipif(CpuQuota.unavailable() is not None, reason=str(CpuQuota.unavailable()))
def test_governor_keeps_a_real_flight_within_the_kernel_s_limit(data_dir: Path) -> None:
    source = str(data_dir / "room_flight.mcap")
    found = Governed(**trials.start("quota", source, "--percent", "3.5", "--governor", "--frames", "140"))
    assert found.peak <= 3.5 * 1.02 and found.lost == 0 and found.submaps == 1
    assert found.tracked > 30 and found.ate_m < 0.02
