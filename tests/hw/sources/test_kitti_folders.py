"""Folders of KITTI: odometry sequences and raw drives, with every fault that they have."""

from pathlib import Path

import numpy as np
import pytest

from kiteline_core.geometry.cameras import Lens
from kiteline_hw.ports import SourceError
from kiteline_hw.sources.open import open_source
from tests.hw.sources.folder_files import picture, put, read

BASELINE_M = 379.8145 / 707.0912


def test_kitti_recordings(data_dir: Path) -> None:
    source = open_source(str(data_dir / "kitti_straight"))
    frames, batches = read(source)
    assert len(frames) == 51 and not batches and source.imu is None
    assert (frames[0].t_ns, frames[-1].t_ns) == (0, 5_000_000_000)  # no times.txt: 10 Hz
    assert source.rig.T_c_r[0, 3] == pytest.approx(BASELINE_M)
    assert not source.rig.has_body and source.rig.left.lens is Lens.NONE
    assert len(source.ground_truth.t_ns) == 51
    mono = open_source(f"kitti:{data_dir / 'kitti07_mono'}")
    frames, _ = read(mono)
    assert len(frames) == 80 and mono.rig.right is None
    assert (frames[0].t_ns, frames[1].t_ns, frames[-1].t_ns) == (0, 103_875_200, 8_211_004_000)


ROW = "700 0 32 {x} 0 700 24 {y} 0 0 1 {z}"


def kitti(root: Path, left: str, right: str | None, calib: str, n: int = 3, colour: bool = False) -> Path:
    for side in filter(None, (left, right)):
        for i in range(n):
            image = picture(i)
            put(root / side / f"{i:06d}.png", np.dstack([image] * 3) if colour else image)
    (root / "calib.txt").write_text(calib)
    return root


NAMED = "\n".join(
    f"P{i}: " + ROW.format(x=x, y=y, z=z)
    for i, (x, y, z) in enumerate([(0, 0, 0), (-350, 0, 0), (47, 0.1, 0.006), (-303, 1.9, 0.003)])
)


@pytest.mark.parametrize(
    ("left", "right", "calib", "baseline_m"),
    [
        ("image_0", "image_1", NAMED, 0.5),
        ("image_2", "image_3", NAMED, (350 - 32 * 0.003) / 700),
        ("image_l", "image_r", f"{ROW.format(x=0, y=0, z=0)}\n{ROW.format(x=-350, y=0, z=0)}", 0.5),
        ("image_0", "image_1", f"{ROW.format(x=10, y=0, z=0)}\n{ROW.format(x=-340, y=0, z=0)}\n", 0.5),
        ("image_0", None, NAMED, None),
    ],
)
def test_kitti_layouts(tmp_path: Path, left: str, right: str | None, calib: str, baseline_m: float | None) -> None:
    source = open_source(str(kitti(tmp_path, left, right, calib, colour=left == "image_2")))
    frames, _ = read(source)
    assert len(frames) == 3 and frames[0].left.shape == (48, 64)
    assert (source.rig.right is not None) == (baseline_m is not None)
    if baseline_m is not None:
        assert source.rig.T_c_r[0, 3] == pytest.approx(baseline_m)
        np.testing.assert_array_equal(source.rig.T_c_r[1:, 3], [0, 0, 1])


RAW = "calib_time: 09-Jan-2012 13:57:47\n" + "\n".join(
    f"S_0{i}: 80 60\nS_rect_0{i}: 64 48\nP_rect_0{i}: " + ROW.format(x=x, y=0, z=0)
    for i, x in enumerate([0, -350, 35, -315])
)


def kitti_raw(day: Path, sides: tuple[str, ...], size: tuple[int, int] = (48, 64)) -> Path:
    drive = day / "2011_09_26_drive_0001_sync"
    for side in sides:
        for i in range(3):
            put(drive / f"image_{side}" / "data" / f"{i:010d}.png", picture(i, size))
        times = [f"2011-09-26 13:02:25.{594360375 + 103_000_000 * i}" for i in range(3)]
        (drive / f"image_{side}" / "timestamps.txt").write_text("\n".join(times) + "\n")
    (day / "calib_cam_to_cam.txt").write_text(RAW)
    return drive


@pytest.mark.parametrize(("sides", "pair"), [(("00", "01", "02", "03"), True), (("02", "03"), True), (("02",), False)])
def test_raw_drives_of_kitti(tmp_path: Path, sides: tuple[str, ...], pair: bool) -> None:
    source = open_source(str(kitti_raw(tmp_path, sides)))
    frames, _ = read(source)
    assert len(frames) == 3 and (source.rig.right is not None) == pair
    assert (frames[0].right is not None) == pair
    assert frames[0].t_ns == 1_317_042_145_594_360_375 and frames[1].t_ns - frames[0].t_ns == 103_000_000
    assert source.rig.left.fx == 700.0
    if source.rig.T_c_r is not None:
        assert source.rig.T_c_r[0, 3] == pytest.approx(0.5)


def test_raw_drives_of_kitti_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="_extract"):
        open_source(str(kitti_raw(tmp_path, ("00", "01"), (60, 80))))
    (tmp_path / "calib_cam_to_cam.txt").unlink()
    with pytest.raises(SourceError, match=r"calibration of the same day"):
        open_source(str(tmp_path / "2011_09_26_drive_0001_sync"))


def test_kitti_missing_right_images_and_numbered_rows(tmp_path: Path) -> None:
    root = kitti(tmp_path, "image_0", "image_1", NAMED, n=5)
    (root / "image_1/000002.png").unlink()
    (root / "image_0/000003.png").unlink()
    (root / "times.txt").write_text("\n".join(str(0.1 * i) for i in range(5)))
    source = open_source(str(root))
    frames = read(source)[0]
    assert [(f.t_ns, f.right is None) for f in frames] == [
        (0, False), (100_000_000, False), (200_000_000, True), (400_000_000, False),
    ]  # fmt: skip
    assert source.report.skipped == {"missing right image": 1, "missing left image": 1}


def test_kitti_errors(tmp_path: Path) -> None:
    (tmp_path / "empty/image_0").mkdir(parents=True)
    with pytest.raises(SourceError, match="no images: expected KITTI's layout"):
        open_source(str(tmp_path / "empty"))
    no_calib = kitti(tmp_path / "a", "image_0", "image_1", NAMED)
    (no_calib / "calib.txt").unlink()
    with pytest.raises(SourceError, match=r"calib\.txt"):
        open_source(str(no_calib))
    same = f"{ROW.format(x=0, y=0, z=0)}\n{ROW.format(x=0, y=0, z=0)}"
    with pytest.raises(SourceError, match="baseline between left and right camera is 0 m"):
        open_source(str(kitti(tmp_path / "b", "image_0", "image_1", same)))
    assert open_source(str(tmp_path / "b"), mono=True).rig.right is None
    with pytest.raises(SourceError, match="one row, but two image folders"):
        open_source(str(kitti(tmp_path / "c", "image_0", "image_1", ROW.format(x=0, y=0, z=0))))
    with pytest.raises(SourceError, match="12 numbers a row"):
        open_source(str(kitti(tmp_path / "d", "image_0", "image_1", "1 2 3")))
    (kitti(tmp_path / "e", "image_0", None, NAMED) / "times.txt").write_text("0\n0.1\n")
    with pytest.raises(SourceError, match="2 times for 3 images"):
        open_source(str(tmp_path / "e"))


def test_a_sequence_without_times_tells_its_rate(tmp_path: Path) -> None:
    for i in range(3):
        put(tmp_path / "image_0" / f"{i:06d}.png", picture(i))
    (tmp_path / "calib.txt").write_text("P0: 60 0 32 0 0 60 24 0 0 0 1 0\n")
    source = open_source(f"kitti:{tmp_path}")
    assert len(list(source)) == 3
    assert len(source.report.notes) == 1 and "times.txt" in source.report.notes[0]
    (tmp_path / "times.txt").write_text("0\n0.1\n0.2\n")
    source = open_source(f"kitti:{tmp_path}")
    assert len(list(source)) == 3 and source.report.notes == []
