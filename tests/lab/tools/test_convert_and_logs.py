"""`kiteline convert` and `kiteline log`: nothing half-written, nothing lost."""

import errno
import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from kiteline_core.frame import Frame, ImuBatch, ImuCalibration
from kiteline_core.geometry.cameras import CameraModel, CameraRig
from kiteline_hw.logs.mcap_log import IMU, LogReader, LogWriter
from kiteline_hw.logs.mcap_repair import REPAIRED
from kiteline_hw.ports import SourceError
from kiteline_hw.sources.open import open_source
from kiteline_lab.flights.progress import Progress
from kiteline_lab.tools import convert, logs

T0 = 10_000_000_000
STEP_NS = 50_000_000


def flight(path: Path, frames: int = 40, start_ns: int = T0) -> Path:
    """A log of a two-second flight; the grey value of each picture tells its number."""
    eye = CameraModel(64, 48, 60.0, 60.0, 32.0, 24.0)
    path.parent.mkdir(exist_ok=True)
    with LogWriter(path, {"role": "agent", "name": path.stem}) as log:
        log.rig(start_ns, CameraRig(eye, None, np.eye(4), None), ImuCalibration())
        for i in range(frames):
            t_ns = start_ns + i * STEP_NS
            log.imu(IMU, t_ns, ImuBatch(np.array([t_ns], np.int64), np.zeros((1, 3)), np.full((1, 3), float(i))))
            log.frame(Frame(t_ns, np.full((48, 64), i, np.uint8)))
    return path


def numbers(path: Path) -> list[int]:
    return [int(i.left[0, 0]) for i in open_source(str(path)) if isinstance(i, Frame)]


def test_convert_keeps_every_frame_and_sample(
    data_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "euroc.mcap"
    assert convert.main([str(data_dir / "euroc_v101_start"), str(out)]) == 0
    assert "40 frames, 391 imu samples" in capsys.readouterr().out
    before, after = open_source(str(data_dir / "euroc_v101_start")), open_source(str(out))
    for a, b in zip(before, after, strict=True):
        if isinstance(a, Frame) and isinstance(b, Frame):
            assert a.t_ns == b.t_ns and a.encoded == b.encoded
            np.testing.assert_array_equal(a.left, b.left)
        else:
            assert isinstance(a, ImuBatch) and isinstance(b, ImuBatch)
            np.testing.assert_array_equal(a.accel, b.accel)
    assert (before.imu, before.rig.left, before.rig.right) == (after.imu, after.rig.left, after.rig.right)
    np.testing.assert_array_equal(before.rig.T_b_c, after.rig.T_b_c)
    np.testing.assert_array_equal(before.ground_truth.t_ns, after.ground_truth.t_ns)
    np.testing.assert_allclose(before.ground_truth.T_w_b, after.ground_truth.T_w_b, atol=1e-12)


def test_convert_leaves_nothing_half_written(tmp_path: Path) -> None:
    folder = tmp_path / "kitti"
    (folder / "image_0").mkdir(parents=True)
    (folder / "calib.txt").write_text("P0: 60 0 32 0 0 60 24 0 0 0 1 0\n")
    cv2.imwrite(str(folder / "image_0/0.png"), np.zeros((48, 64), np.uint8))
    out = tmp_path / "out.mcap"
    assert convert.main([str(folder), str(out)]) == 0
    whole = out.read_bytes()
    with pytest.raises(SourceError, match="exists already: choose another name, or overwrite it with --force"):
        convert.main([str(folder), str(out)])
    (folder / "image_0/0.png").write_text("gone")
    with pytest.raises(SourceError):
        convert.main([str(folder), str(out), "--force"])
    assert out.read_bytes() == whole
    with pytest.raises(SourceError, match="expected a file name in a folder that exists"):
        convert.main([str(folder), str(tmp_path / "no/out.mcap")])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["kitti", "out.mcap"]


def test_convert_reports_what_it_passed_over(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "kitti"
    (folder / "image_0").mkdir(parents=True)
    (folder / "calib.txt").write_text("P0: 60 0 32 0 0 60 24 0 0 0 1 0\n")
    for i in range(3):
        cv2.imwrite(str(folder / f"image_0/{i}.png"), np.zeros((48, 64), np.uint8))
    (folder / "image_0/1.png").write_text("no picture")
    convert.main([str(folder), str(tmp_path / "out.mcap")])
    text = capsys.readouterr().out
    assert "2 frames" in text and "1 x unreadable image" in text and "1.png" in text


def test_info_shows_what_a_file_holds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = flight(tmp_path / "a.mcap")
    assert logs.main(["info", str(path)]) == 0
    text = capsys.readouterr().out
    assert "whole, with index" in text and "foxglove.CompressedImage" in text and "kiteline.role: agent" in text
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    logs.main(["info", "--json", str(path)])
    facts = json.loads(capsys.readouterr().out)
    assert "cut after" in facts["cut"] and not facts["indexed"]
    counts = {t["topic"]: t["messages"] for t in facts["topics"]}
    assert 10 <= counts["/left/image"] < 40
    with pytest.raises(SourceError, match="No such file"):
        logs.main(["info", str(tmp_path / "none.mcap")])


def test_recover_makes_a_cut_file_whole(tmp_path: Path) -> None:
    path = flight(tmp_path / "a.mcap")
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    before = numbers(path)
    out = tmp_path / "b.mcap"
    assert logs.main(["recover", str(path), str(out)]) == 0
    with LogReader(out) as log:
        assert log.cut is None and {**log.metadata, REPAIRED: ""} == {"role": "agent", "name": "a", REPAIRED: ""}
        assert "cut after" in log.metadata[REPAIRED]  # a replay leaves out the last step, which may be incomplete
    assert numbers(out) == before == list(range(len(before))) and len(before) > 10


def test_a_full_disk_is_told_before_the_rest_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = open_source(str(flight(tmp_path / "a.mcap", frames=200)))
    write, room, shown = os.pwrite, [20_000], list[int]()

    def small(fd: int, data: bytes, offset: int) -> int:
        room[0] -= len(data)
        if room[0] < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(fd, data, offset)

    monkeypatch.setattr(os, "pwrite", small)
    monkeypatch.setattr(Progress, "update", lambda _, frames: shown.append(frames))
    with pytest.raises(SourceError, match="No space left on device: free some room"):
        convert.record(source, tmp_path / "b.mcap")
    assert len(shown) < 190


def test_cut_takes_the_stretch_and_its_calibration(tmp_path: Path) -> None:
    path, out = flight(tmp_path / "a.mcap"), tmp_path / "b.mcap"
    assert logs.main(["cut", str(path), str(out), "--from", "0.5", "--to", "1.0"]) == 0
    assert numbers(out) == list(range(10, 21))
    assert open_source(str(out)).imu == ImuCalibration()
    with LogReader(out) as log:
        assert log.topics["/tf_static"] == 1 and log.topics["/left/calibration"] == 1
        assert min(m.t_ns for m in log.messages()) == T0 + 10 * STEP_NS
    with pytest.raises(SourceError, match=r"ends after 2\.0 s"):
        logs.main(["cut", str(path), str(out), "--from", "7", "--force"])
    with pytest.raises(SourceError, match="expected --from before --to"):
        logs.main(["cut", str(path), str(out), "--from", "2", "--to", "1", "--force"])
    for begin in ("-1e308", "1e308", "inf", "nan"):
        with pytest.raises(SourceError, match="nothing"):
            logs.main(["cut", str(path), str(out), f"--from={begin}", "--to=1e308", "--force"])
    with pytest.raises(SourceError, match="exists already"):
        logs.main(["cut", str(path), str(out)])
    assert numbers(out) == list(range(10, 21))


def test_merge_joins_the_parts_of_a_recording(tmp_path: Path) -> None:
    path = flight(tmp_path / "a.mcap")
    logs.main(["cut", str(path), str(tmp_path / "1.mcap"), "--to", "0.99"])
    logs.main(["cut", str(path), str(tmp_path / "2.mcap"), "--from", "1.0"])
    logs.main(["merge", str(tmp_path / "m.mcap"), str(tmp_path / "2.mcap"), str(tmp_path / "1.mcap")])
    assert numbers(tmp_path / "m.mcap") == list(range(40))


def test_merge_keeps_two_flights_apart(tmp_path: Path) -> None:
    first, second = flight(tmp_path / "agent0" / "log.mcap"), flight(tmp_path / "agent1" / "log.mcap", 20)
    logs.main(["merge", str(tmp_path / "m.mcap"), str(first), str(second)])
    with LogReader(tmp_path / "m.mcap") as log:
        assert (log.topics["/agent0/left/image"], log.topics["/agent1/left/image"]) == (40, 20)
        times = [m.t_ns for m in log.messages()]
    assert times == sorted(times)
    with pytest.raises(SourceError, match="merges several recordings"):
        open_source(str(tmp_path / "m.mcap"))
