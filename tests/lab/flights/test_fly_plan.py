"""What a command line becomes: options, flight time 0 of several sources, a cleared folder."""

import errno
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kiteline_core.errors import KitelineError
from kiteline_core.frame import Frame
from kiteline_core.geometry.cameras import CameraModel, CameraRig
from kiteline_hw.logs.mcap_log import LogWriter
from kiteline_hw.ports import LinkError, SourceError, SourceReport
from kiteline_lab.flights.fly import clear, fly, link_bytes, options, repair_logs
from kiteline_lab.flights.plan import Options, flight_starts
from kiteline_lab.outputs.out_file import sole_writer


class Stamps:
    """A source of nothing but stamps."""

    def __init__(self, first_ns: int, frames: int, period_ns: int = 50) -> None:
        self.name = "stamps"
        camera = CameraModel(4, 4, 1.0, 1.0, 0.0, 0.0)
        self.rig = CameraRig(camera, None, np.eye(4), None)
        self.imu = self.ground_truth = None
        self.report = SourceReport()
        self.frame_count = frames
        self._stamps = [first_ns + i * period_ns for i in range(frames)]

    def __iter__(self) -> Iterator[Frame]:
        return (Frame(t_ns, np.zeros((4, 4), np.uint8)) for t_ns in self._stamps)

    def close(self) -> None: ...


def test_sources_that_overlap_share_a_clock() -> None:
    assert flight_starts([Stamps(1000, 10), Stamps(1200, 10)]) == [1000, 1000]


def test_sources_of_other_times_start_together() -> None:
    assert flight_starts([Stamps(1000, 10), Stamps(9000, 10)]) == [1000, 9000]


def test_one_source_starts_at_its_first_frame() -> None:
    assert flight_starts([Stamps(1000, 10)]) == [1000]


def test_a_source_without_frames_cannot_be_flown() -> None:
    with pytest.raises(SourceError, match="frame"):
        flight_starts([Stamps(1000, 0)])


@pytest.mark.parametrize(("text", "wanted"), [("1000", (1000, 1000)), ("1000,500", (1000, 500)), ("0,0", (0, 0))])
def test_bytes_of_the_link(text: str, wanted: tuple[int, int]) -> None:
    assert link_bytes(text) == wanted


@pytest.mark.parametrize("text", ["", "fast", "1,2,3", "-5", "1e3"])
def test_bytes_that_are_none(text: str) -> None:
    with pytest.raises(ValueError, match="UP"):
        link_bytes(text)


def test_profiles_and_overrides() -> None:
    radio = options(["a.mcap", "--out", "o", "--profile", "radio"])
    assert (radio.up_bytes_s, radio.down_bytes_s) == (1000, 500)
    own = options(["a.mcap", "--out", "o", "--profile", "radio", "--link-bytes", "700"])
    assert (own.up_bytes_s, own.down_bytes_s) == (700, 700)
    assert options(["a.mcap", "--out", "o"]) == Options(("a.mcap",), Path("o"))


@pytest.mark.parametrize(
    "words",
    [
        ["--link-loss", "1.0"],
        ["--link-delay", "-1"],
        ["--link-delay", "nan"],
        ["--cpu", "-1"],
        ["--mode", "none"],
        ["--link-bytes", "x"],
        ["b.mcap", "--rig", "r.toml"],
    ],
)
def test_a_wrong_word_ends_with_usage(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        options(["a.mcap", "--out", "o", *words])
    assert end.value.code == 2
    assert "usage" in capsys.readouterr().err


def test_a_file_is_no_folder_for_a_flight(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    taken = tmp_path / "taken.txt"
    taken.touch()
    with pytest.raises(SystemExit, match="2"):
        options(["a.mcap", "--out", str(taken)])
    assert "name a folder" in capsys.readouterr().err


def test_clearing_takes_only_what_a_flight_leaves(tmp_path: Path) -> None:
    for name in ("agent0/live.tum", "agent1/log.mcap", "base/agent0.tum", "base/map.ply", "report.json", "notes.txt",
                 "base/grid_storey+1.pgm", "base/grid_0.1-0.5.yaml", "agent0/mine.txt", "base/mine.ply"):  # fmt: skip
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("x")
    clear(tmp_path)
    left = sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file())
    assert left == ["agent0/mine.txt", "base/mine.ply", "notes.txt"]


def test_realtime_needs_processes(tmp_path: Path) -> None:
    with pytest.raises(LinkError, match="mode"):
        fly(Options(("x",), tmp_path, "local", realtime=True), quiet=True)


@pytest.mark.parametrize(
    "wrong",
    [{"up_bytes_s": 10}, {"down_bytes_s": 10}, {"config": "none.toml"}, {"rig": "bad.toml"}, {"link": "pigeon:"}],
)
def test_what_cannot_be_flown_leaves_the_earlier_flight(
    wrong: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.toml").write_text("no rig")
    (tmp_path / "report.json").write_text("{}")
    with pytest.raises((KitelineError, OSError)):
        fly(Options(("sim:room?seconds=0.1&width=64&height=64",), tmp_path, **wrong), quiet=True)
    assert (tmp_path / "report.json").read_text() == "{}"


def test_two_flights_do_not_share_a_folder(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with sole_writer(out), pytest.raises(SourceError, match="another flight"), sole_writer(out):
        pass
    with sole_writer(out):
        pass


def test_a_cut_log_that_cannot_be_mended_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = tmp_path / "agent0" / "log.mcap"
    log.parent.mkdir()
    with LogWriter(log, {"role": "agent"}) as writer:
        writer.json("/step", 1, {})
    log.write_bytes(content := log.read_bytes()[:-20])
    monkeypatch.setattr("kiteline_hw.logs.mcap_repair.Writer.finish", full_disk)
    repair_logs(tmp_path)
    assert [path.name for path in log.parent.iterdir()] == ["log.mcap"]
    assert log.read_bytes() == content


def full_disk(*_: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def test_the_filter_makes_no_images_for_a_grid(recording: Path, tmp_path: Path) -> None:
    with pytest.raises(KitelineError, match="--tracker ekf uses no --grid base"):
        fly(Options((str(recording),), tmp_path, grid="base", tracker="ekf"), quiet=True)


def test_a_camera_is_flown_by_the_agent_which_is_told_before_its_calibration_is_missed(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="a camera is flown with `kiteline agent`"):
        fly(Options(("v4l2:/dev/video0",), tmp_path), quiet=True)
