"""Flights in this process: every mode flies the same recording, keeps the contract, and does so twice alike."""

import importlib.util
import json
from pathlib import Path

import pytest

from kiteline_bench.harness.contract import check_contract
from kiteline_hw.logs.mcap_log_read import LogReader
from kiteline_lab.flights.flight_report import without_timing
from kiteline_lab.flights.fly import fly, main
from kiteline_lab.flights.plan import Options


@pytest.mark.usefixtures("drawn")
@pytest.mark.parametrize("mode", ["tracker", "local", "monolith"])
def test_each_mode_keeps_the_contract(recording: Path, tmp_path: Path, mode: str) -> None:
    report, outcome = fly(Options((str(recording),), tmp_path, mode), quiet=True)
    assert check_contract(tmp_path) == []
    agent = report["agents"][0]
    assert (agent["frames"], agent["tracked"], agent["lost"]) == (30, 30, 0)
    assert agent["accuracy"]["live"]["ate_m"] < 0.01
    assert not outcome.failed
    if mode == "tracker":
        assert report["base"] is None
        assert agent["bytes_up"] == 0
    else:
        assert report["base"]["keyframes"] == agent["keyframes"] >= 3
        assert agent["accuracy"]["base"]["ate_m"] < 0.01
        assert report["base"]["digest_equal"] is True
    assert (agent["bytes_up"] > 0) == (mode == "local")


@pytest.mark.parametrize(("mode", "base"), [("tracker", False), ("monolith", True)])
def test_kernels_are_compiled_by_a_process_that_says_so(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: str, base: bool
) -> None:
    filled: list[tuple[str, ...]] = []
    monkeypatch.setattr("kiteline_lab.flights.in_process.kernel_cache.fill", filled.append)
    fly(Options((str(recording),), tmp_path, mode, seconds=0.2))
    assert len(filled) == 1
    assert ("kiteline_basestation.runtime.warm" in filled[0]) == base


def test_two_flights_are_alike_to_the_last_byte(recording: Path, tmp_path: Path) -> None:
    for run in "ab":
        fly(Options((str(recording),), tmp_path / run, "local", loss=0.2, seed=3), quiet=True)
    for name in ("agent0/live.tum", "agent0/odometry.tum", "base/agent0.tum", "agent0/log.mcap", "base/log.mcap"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name
    a, b = (json.loads((tmp_path / run / "report.json").read_text()) for run in "ab")
    assert without_timing(a) == without_timing(b)
    assert a["base"]["digest_equal"] is True


def test_the_log_describes_the_link_once_a_second(recording: Path, tmp_path: Path) -> None:
    report, _ = fly(Options((str(recording),), tmp_path, "local"), quiet=True)
    with LogReader(tmp_path / "agent0" / "log.mcap") as log:
        told = [message.json() for message in log.messages(("/link",))]
    assert 2 <= len(told) <= 5
    assert told[-1]["profile"] == report["agents"][0]["link"]["profile"] == "wifi"
    assert {"budget_bytes_s", "backlog_bytes", "outbox_bytes", "archived", "given_up", "rtt_ms"} <= told[-1].keys()


def test_loss_changes_what_arrives_but_not_what_is_held_in_the_end(recording: Path, tmp_path: Path) -> None:
    report, _ = fly(Options((str(recording),), tmp_path, "local", loss=0.3, seed=5), quiet=True)
    assert report["base"]["digest_equal"] is True
    assert report["drain"]["base"]["keyframes"] == report["agents"][0]["keyframes"]


def test_two_agents_fly_together(recording: Path, tmp_path: Path) -> None:
    report, _ = fly(Options((str(recording), str(recording)), tmp_path, "local"), quiet=True)
    assert [agent["tracked"] for agent in report["agents"]] == [30, 30]
    assert check_contract(tmp_path) == []


def test_a_slow_core_drops_frames_and_says_so(recording: Path, tmp_path: Path) -> None:
    report, _ = fly(Options((str(recording),), tmp_path, "tracker", cpu_percent=1.0), quiet=True)
    agent = report["agents"][0]
    assert agent["dropped"] > 5
    assert agent["tracked"] + agent["lost"] + agent["dropped"] == agent["frames"] == 30
    assert check_contract(tmp_path) == []


def test_seconds_end_a_flight_early(recording: Path, tmp_path: Path) -> None:
    report, _ = fly(Options((str(recording),), tmp_path, "tracker", seconds=0.5), quiet=True)
    assert report["agents"][0]["frames"] == 11


def test_the_table_goes_to_stdout(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(recording), "--out", str(tmp_path), "--mode", "local", "--seconds", "0.5"]) == 0
    said = capsys.readouterr()
    out = said.out
    assert said.err.rstrip().splitlines()[-1].startswith("flying: 11 frames")
    assert "ATE live" in out
    assert str(tmp_path / "trajectory.png") in out
    assert "digests equal" in out


def test_without_matplotlib_the_flight_says_so_first_and_leaves_the_plot_out(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    find = importlib.util.find_spec
    absent = ("matplotlib", "gtsam")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name in absent else find(name))
    assert main([str(recording), "--out", str(tmp_path), "--mode", "local", "--seconds", "0.5"]) == 0
    out, err = capsys.readouterr()
    told = [err.index(f"kiteline: note: {name} is not installed") for name in absent]
    assert max(told) < err.index("flying")
    assert "kiteline[lab]" in err
    assert "plot:" not in out
    assert not (tmp_path / "trajectory.png").exists()
    assert (tmp_path / "report.json").exists()


def test_a_limit_covers_the_base_in_the_same_computer(recording: Path, tmp_path: Path) -> None:
    dropped, tracking_ms = {}, {}
    for mode in ("tracker", "local"):
        report, _ = fly(Options((str(recording),), tmp_path / mode, mode, cpu_percent=5.0), quiet=True)
        dropped[mode] = report["agents"][0]["dropped"]
        tracking_ms[mode] = report["agents"][0]["timing"]["tracking_ms"]["mean"]
    assert dropped["local"] > dropped["tracker"]
    assert tracking_ms["local"] > 1.5 * tracking_ms["tracker"]


def test_a_filter_without_odometry_says_what_is_missing(recording: Path, tmp_path: Path) -> None:
    report, _ = fly(Options((str(recording),), tmp_path, "tracker", tracker="ekf"), quiet=True)
    assert [note for note in report["agents"][0]["notes"] if note.startswith("odometer: no samples arrive")]
