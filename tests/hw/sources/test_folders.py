"""Data set folders: the recordings, and small ones with every fault that folders have."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import Lens
from kiteline_hw.ports import SourceError
from kiteline_hw.sources.open import open_source
from tests.hw.sources.folder_files import picture, put, read

# --- the recordings


def test_euroc_recording(data_dir: Path) -> None:
    source = open_source(str(data_dir / "euroc_v101_start"))
    frames, batches = read(source)
    assert len(frames) == source.frame_count == 40
    assert (frames[0].t_ns, frames[-1].t_ns) == (1403715273262142976, 1403715275212143104)
    assert frames[0].left.shape == (480, 752)
    assert frames[0].right is not None and [e.format for e in frames[0].encoded] == ["png", "png"]
    assert sum(len(b.t_ns) for b in batches) == 391
    assert 9.0 < np.linalg.norm(batches[0].accel[0]) < 10.5
    rig = source.rig
    assert rig.left.lens is Lens.RADTAN and rig.left.distortion == (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)
    assert rig.right.fx == 457.587
    assert rig.has_body and rig.T_c_r is not None
    assert rig.T_c_r[0, 3] == pytest.approx(0.110074, abs=1e-6)
    assert rig.T_b_c[:3, 3] == pytest.approx([-0.0216401454975, -0.064676986768, 0.00981073058949])
    assert source.imu.gyro_noise == 1.6968e-4 and source.imu.rate_hz == 200
    assert len(source.ground_truth.t_ns) == 64
    assert not source.report.skipped


def test_tum_recording(data_dir: Path) -> None:
    source = open_source(str(data_dir / "tum_rgbd_xyz"))
    frames, _ = read(source)
    assert len(frames) == 10 and source.rig.has_depth and not source.rig.has_body
    assert frames[0].t_ns == 1305031102175304000
    depth = frames[0].depth_m
    assert depth.dtype == np.float32
    raw = cv2.imread(str(data_dir / "tum_rgbd_xyz/depth/1305031102.175304.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_allclose(depth, raw / 5000.0, rtol=1e-6)
    assert [e.format for e in frames[0].encoded] == ["png", "png/5000"]
    grey = open_source(str(data_dir / "tum_rgbd_xyz"), mono=True)
    assert not grey.rig.has_depth and read(grey)[0][0].depth_m is None


# --- EuRoC

SENSOR = """%YAML:1.0
# a comment: with a colon
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [{T}]
resolution: [64, 48]
camera_model: pinhole
intrinsics: [60.0, 61.0, 32.0, 24.0] #fu, fv, cu, cv
distortion_model: {model}
distortion_coefficients: [{d}]
"""


def euroc(
    root: Path, *, n: int = 4, model: str = "radial-tangential", d: str = "0.1, 0.01, 0, 0", baseline: float = 0.1
) -> Path:
    for side, x in (("cam0", 0.0), ("cam1", baseline)):
        t = np.eye(4)
        t[0, 3] = x
        folder = root / "mav0" / side
        lines = ["#timestamp [ns],filename"]
        for i in range(n):
            put(folder / "data" / f"{1000 + i * 50_000_000}.png", picture(i))
            lines.append(f"{1000 + i * 50_000_000},{1000 + i * 50_000_000}.png")
        (folder / "data.csv").write_text("\r\n".join(lines) + "\r\n")
        text = SENSOR.format(T=",\n   ".join(str(v) for v in t.ravel()), model=model, d=d)
        (folder / "sensor.yaml").write_text(text)
    return root


@pytest.mark.parametrize(
    ("text", "readout_s"),
    [("readout_s: 0.02", 0.02), ("line_delay: 0.0005", 0.024), ("readout_s: -0.02", -0.02), ("", 0.0)],
)
def test_the_read_out_of_a_rolling_shutter_is_part_of_the_calibration(
    tmp_path: Path, text: str, readout_s: float
) -> None:
    root = euroc(tmp_path)
    for name in ("cam0", "cam1"):
        with (root / "mav0" / name / "sensor.yaml").open("a") as file:
            file.write(text + "\n")
    left = open_source(str(tmp_path)).rig.left
    assert left.readout_s == pytest.approx(readout_s)
    with (tmp_path / "mav0/cam0/sensor.yaml").open("a") as file:
        file.write("readout_s: 20\n")
    with pytest.raises(SourceError, match="read-out"):
        open_source(str(tmp_path))


def add_imu(root: Path, t_b_i: np.ndarray, rows: list[str]) -> None:
    folder = root / "mav0" / "imu0"
    folder.mkdir()
    (folder / "sensor.yaml").write_text(f"%YAML:1.0\nT_BS:\n  data: [{', '.join(str(v) for v in t_b_i.ravel())}]\n")
    (folder / "data.csv").write_text("#t,wx,wy,wz,ax,ay,az\n" + "\n".join(rows) + "\n")


def test_euroc_body_becomes_the_imu_frame(tmp_path: Path) -> None:
    root = euroc(tmp_path)
    t_b_i = se3.exp(np.array([0.1, 0.2, 0.3, 0.0, 0.0, np.pi / 2]))
    add_imu(root, t_b_i, [f"{1000 + i * 5_000_000},0,0,0,0,0,9.8" for i in range(40)])
    (root / "gt.tum").write_text("0.000001 1 2 3 0 0 0 1\n")
    source = open_source(str(root))
    np.testing.assert_allclose(t_b_i @ source.rig.T_b_c, np.eye(4), atol=1e-9)  # the camera sat at the old body frame
    np.testing.assert_allclose(source.ground_truth.T_w_b[0, :3, 3], np.array([1, 2, 3]) + t_b_i[:3, 3])
    frames, batches = read(source)
    assert len(frames) == 4 and sum(len(b.t_ns) for b in batches) == 31
    without = open_source(str(root), imu=False)
    assert without.imu is None and not read(without)[1]
    np.testing.assert_array_equal(without.rig.T_b_c, source.rig.T_b_c)


def test_euroc_samples_of_another_form_are_refused(tmp_path: Path) -> None:
    root = euroc(tmp_path)
    add_imu(root, np.eye(4), [f"{0.001 + 0.005 * i:.6f},0,0,0,0,0,9.8" for i in range(40)])  # seconds
    with pytest.raises(
        SourceError, match=r"data\.csv: not one line can be read: expected .*t_ns a whole number.*0\.196"
    ):
        read(open_source(str(root)))
    assert len(read(open_source(str(root), imu=False))[0])


def test_euroc_bad_imu_samples_are_dropped_and_counted(tmp_path: Path) -> None:
    root = euroc(tmp_path)
    rows = [f"{1000 + i * 5_000_000},0,0,0,0,0,9.8" for i in range(10)]
    rows[3] = rows[3].replace("9.8", "nan")
    rows[5] = rows[4]
    rows[7] = "5,0,0,0,0,0,9.8"
    rows[8] = "text"
    add_imu(root, np.eye(4), rows)
    source = open_source(str(root))
    _, batches = read(source)
    assert sum(len(b.t_ns) for b in batches) == 6
    assert all(np.isfinite(b.accel).all() for b in batches)
    assert source.report.skipped == {
        "imu sample not finite": 1, "imu stamp not increasing": 2, "unreadable imu line": 1,
    }  # fmt: skip
    read(source)
    assert source.report.skipped["imu sample not finite"] == 1  # counts belong to one reading


def test_images_of_another_size_are_told_also_behind_many_bad_samples(tmp_path: Path) -> None:
    """The samples' notes had filled the list, and the error said nothing of the images."""
    root = euroc(tmp_path)
    add_imu(root, np.eye(4), [f"{1000 - i * 5_000_000 if i % 2 else 1000 + i},0,0,0,0,0,9.8" for i in range(40)])
    for path in (root / "mav0/cam0/data").iterdir():
        put(path, picture(0, (40, 64)))
    with pytest.raises(SourceError, match=r"64x40 px, calibration says 64x48, and 3 more"):
        read(open_source(str(root)))


def test_euroc_broken_images_are_skipped_and_counted(tmp_path: Path) -> None:
    root = euroc(tmp_path, n=8)
    stamps = [1000 + i * 50_000_000 for i in range(8)]
    cam0, cam1 = root / "mav0/cam0", root / "mav0/cam1"
    (cam0 / f"data/{stamps[1]}.png").write_text("this is no picture\n")
    (cam0 / f"data/{stamps[2]}.png").write_bytes(b"")
    put(cam1 / f"data/{stamps[3]}.png", picture(0, (40, 64)))
    (cam1 / f"data/{stamps[4]}.png").unlink()
    half = (cam1 / f"data/{stamps[5]}.png").read_bytes()
    (cam1 / f"data/{stamps[5]}.png").write_bytes(half[:30])
    csv = (cam1 / "data.csv").read_text().splitlines()
    (cam1 / "data.csv").write_text("\n".join(line for line in csv if str(stamps[6]) not in line))
    source = open_source(str(root))
    frames, _ = read(source)
    assert [f.t_ns for f in frames] == [stamps[0], *stamps[3:]]
    assert [f.right is None for f in frames] == [False, *4 * [True], False]
    assert source.report.skipped == {"unreadable image": 4, "image of another size": 1, "missing right image": 1}
    assert any("64x40" in note and "64x48" in note for note in source.report.notes)


def test_intrinsics_of_another_size_are_doubted(tmp_path: Path) -> None:
    source = open_source(str(euroc(tmp_path)))
    read(source)
    assert source.report.notes == []
    sensor = tmp_path / "mav0/cam1/sensor.yaml"
    sensor.write_text(re.sub(r"intrinsics: .*", "intrinsics: [60.0, 60.0, 12.0, 8.0]", sensor.read_text()))
    source = open_source(str(tmp_path))
    for _ in range(2):  # once in each reading
        read(source)
        assert len(source.report.notes) == 1
    assert source.report.notes[0].startswith("calibration: the centre of the right camera, (12, 8) px, is far from")


@pytest.mark.parametrize(
    "spec", ["images:a/*.png,a/*.png", "v4l2:/dev/video0,/dev/video0?fps=20", "ros2:/left,/left", "stream:u,u"]
)
def test_one_camera_named_twice_is_no_pair(spec: str) -> None:
    """Its images flew as a pair: the rows of the right one were found 12 px off, and depths meant nothing."""
    with pytest.raises(SourceError, match="left and right are the same"):
        open_source(spec)


def test_euroc_left_and_right_are_paired_by_time(tmp_path: Path) -> None:
    root = euroc(tmp_path)
    late = (root / "mav0/cam1/data.csv").read_text().splitlines()
    shifted = [
        line if line.startswith("#") else f"{int(line.split(',')[0]) + 900_000},{line.split(',')[1]}" for line in late
    ]
    (root / "mav0/cam1/data.csv").write_text("\n".join(shifted))
    assert len(read(open_source(str(root)))[0]) == 4
    shifted = [
        line if line.startswith("#") else f"{int(line.split(',')[0]) + 9_000_000},{line.split(',')[1]}" for line in late
    ]
    (root / "mav0/cam1/data.csv").write_text("\n".join(shifted))
    source = open_source(str(root))
    with pytest.raises(SourceError, match="not one usable pair of images") as told:
        read(source)
    assert str(told.value).count("missing right image") == 1 and "and 3 more" in str(told.value)
    assert source.report.skipped == {"missing right image": 4, "missing left image": 4}


@pytest.mark.parametrize(
    ("model", "d", "lens"),
    [
        ("equidistant", "0.1, 0.01, 0.001, 0", Lens.EQUIDISTANT),
        ("radial-tangential", "0.1, 0.01, 0, 0, 0.5", Lens.RADTAN),
        ("none", "", Lens.NONE),
    ],
)
def test_euroc_lenses(tmp_path: Path, model: str, d: str, lens: Lens) -> None:
    assert open_source(str(euroc(tmp_path, model=model, d=d))).rig.left.lens is lens


def test_euroc_left_alone_and_mono(tmp_path: Path) -> None:
    root = euroc(tmp_path)
    mono = open_source(str(root), mono=True)
    assert mono.rig.right is None and all(f.right is None and len(f.encoded) == 1 for f in read(mono)[0])
    (root / "mav0/cam1").rename(tmp_path / "elsewhere")
    assert open_source(f"euroc:{root}").rig.right is None


def test_euroc_errors(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="baseline"):
        open_source(str(euroc(tmp_path / "flat", baseline=0.0)))
    (tmp_path / "empty").mkdir()
    with pytest.raises(SourceError, match="expected EuRoC's layout"):
        open_source(f"euroc:{tmp_path / 'empty'}")
    with pytest.raises(SourceError, match="lens model 'omni'"):
        open_source(str(euroc(tmp_path / "omni", model="omni")))
    broken = euroc(tmp_path / "broken")
    (broken / "mav0/cam0/sensor.yaml").write_text("intrinsics: [1, 2]\n")
    with pytest.raises(SourceError, match="intrinsics to be 4 numbers"):
        open_source(str(broken))
    (broken / "mav0/cam0/sensor.yaml").unlink()
    with pytest.raises(SourceError, match=r"sensor\.yaml.*no such file"):
        open_source(str(broken))


def test_a_sensor_file_of_another_form_says_what_one_holds_and_another_calibration_replaces_it(tmp_path: Path) -> None:
    told = tmp_path / "told.yaml"
    told.write_text((euroc(tmp_path / "flat") / "mav0/cam0/sensor.yaml").read_text())
    other = euroc(tmp_path / "other")
    for text in ("T_cam0_body: !!opencv-matrix\n   rows: 4 cols: 4 dt: d\n", "intrinsics: [fx: 400.0, fy: 400.0]\n"):
        (other / "mav0/cam0/sensor.yaml").write_text(text)
        with pytest.raises(SourceError, match=r"cam0/sensor\.yaml.*holds T_BS.*--calibration FILE"):
            open_source(str(other))
        source = open_source(str(other), mono=True, calibration=str(told))
        assert source.rig.left == open_source(str(tmp_path / "flat"), mono=True).rig.left


def test_layouts_that_are_not_read_say_what_helps(tmp_path: Path) -> None:
    fpv, seasons = tmp_path / "indoor_forward_3", tmp_path / "recording"
    fpv.mkdir()
    for name in ("left_images.txt", "right_images.txt", "imu.txt"):
        (fpv / name).write_text("# id timestamp image_name\n")
    (seasons / "undistorted_images" / "cam0").mkdir(parents=True)
    with pytest.raises(SourceError, match=r"UZH-FPV.*rosbags-convert"):
        open_source(str(fpv))
    with pytest.raises(SourceError, match=r"4Seasons.*undistorted_images/cam0"):
        open_source(str(seasons))


# --- TUM and plain images


def tum(root: Path, offset_s: float = 0.0, n: int = 4) -> Path:
    rgb, depth = ["# timestamp filename"], ["# timestamp filename"]
    for i in range(n):
        put(root / "rgb" / f"{i}.png", np.dstack([picture(i)] * 3))
        put(root / "depth" / f"{i}.png", np.full((48, 64), 5000, np.uint16))
        rgb.append(f"{100 + i * 0.1:.6f} rgb/{i}.png")
        depth.append(f"{100 + offset_s + i * 0.1:.6f} depth/{i}.png")
    (root / "rgb.txt").write_text("\n".join(rgb))
    (root / "depth.txt").write_text("\n".join(depth))
    (root / "camera.yaml").write_text("fx: 60\nfy: 60\ncx: 32\ncy: 24\nwidth: 64\nheight: 48\ndepth_scale: 2500\n")
    return root


def test_tum_association_and_scale(tmp_path: Path) -> None:
    source = open_source(str(tum(tmp_path, offset_s=0.015)))
    frames, _ = read(source)
    assert [f.t_ns for f in frames] == [100_000_000_000 + i * 100_000_000 for i in range(4)]
    assert frames[0].depth_m is not None and (frames[0].depth_m == 2.0).all()
    (tmp_path / "depth/1.png").write_text("no depth")
    put(tmp_path / "depth/2.png", picture())  # 8 bits are no depth
    (tmp_path / "depth/3.png").unlink()
    frames, _ = read(source)
    assert [f.depth_m is not None for f in frames] == [True, False, False, False], (
        "a frame is tracked without its depth"
    )
    assert source.report.skipped == {"unreadable image": 3}
    (tmp_path / "depth.txt").write_text("100.015 depth/0.png")
    frames, _ = read(source := open_source(str(tmp_path)))
    assert [f.depth_m is not None for f in frames] == [True, False, False, False]
    assert source.report.skipped == {"missing depth image": 3}
    (tmp_path / "depth.txt").write_text("110.0 depth/0.png")
    with pytest.raises(SourceError, match="not one usable image with its depth"):
        read(open_source(str(tmp_path)))


def test_tum_stamps_that_jump_back_and_forth_are_an_error(tmp_path: Path) -> None:
    root = tum(tmp_path)
    lines = (root / "rgb.txt").read_text().splitlines()
    (root / "rgb.txt").write_text("\n".join(lines[:2] + lines[:1:-1] + [f"{200 + i} rgb/0.png" for i in range(20)]))
    assert len(read(open_source(str(root)))[0]) == 24, "a few lines that changed places are sorted"
    for name in ("rgb", "depth"):
        steps = [f"{0.016 + 0.001 * (-1) ** i:.3f} {name}/{i}.png" for i in range(4)]  # times since the image before
        (root / f"{name}.txt").write_text("\n".join(steps))
        with pytest.raises(SourceError, match=rf"{name}\.txt.*earlier than that of the line before.*time of each"):
            open_source(str(root))
        tum(tmp_path)


def test_tum_defaults_by_name_else_an_error(tmp_path: Path) -> None:
    root = tmp_path / "rgbd_dataset_freiburg3_long_office"
    for name in ("1.5", "1.6"):
        put(root / "rgb" / f"{name}.png", picture(0, (480, 640)))
    source = open_source(str(root))
    assert source.rig.left.fx == 535.4 and [f.t_ns for f in read(source)[0]] == [1_500_000_000, 1_600_000_000]
    assert source.rig.left.readout_s == 0.0
    for kinect in ("rgbd_dataset_freiburg1_rpy", "fr2_desk"):
        root = root.rename(tmp_path / kinect)
        assert open_source(str(root)).rig.left.readout_s == 0.027
    root.rename(tmp_path / "office")
    with pytest.raises(SourceError, match=r"no calibration: expected camera\.yaml"):
        open_source(str(tmp_path / "office"))


def test_images_by_pattern(tmp_path: Path) -> None:
    for i in range(3):
        put(tmp_path / "left" / f"{i}.png", picture(i))
        put(tmp_path / "right" / f"{i}.png", picture(i))
    with pytest.raises(SourceError, match="no calibration"):
        open_source(f"images:{tmp_path}/left/*.png")
    calib = "fx: 60\nfy: 60\ncx: 32\ncy: 24\nwidth: 64\nheight: 48\nrate_hz: 20\n"
    (tmp_path / "camera.yaml").write_text(calib)
    source = open_source(f"{tmp_path}/left/*.png")
    assert [f.t_ns for f in read(source)[0]] == [0, 50_000_000, 100_000_000] and source.rig.right is None
    pair = f"images:{tmp_path}/left/*.png,{tmp_path}/right/*.png"
    with pytest.raises(SourceError, match="baseline_m"):
        open_source(pair)
    (tmp_path / "camera.yaml").write_text(calib + "baseline_m: 0.12\n")
    stereo = open_source(pair)
    assert stereo.rig.T_c_r[0, 3] == 0.12 and len(read(stereo)[0]) == 3
    with pytest.raises(SourceError, match="no file matches"):
        open_source(f"images:{tmp_path}/none/*.png")


# --- recognising


def test_unknown_sources_name_what_was_expected(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="layout not recognised: expected mav0/"):
        open_source(str(tmp_path))
    with pytest.raises(SourceError, match="no such file or folder"):
        open_source(str(tmp_path / "missing"))
    with pytest.raises(SourceError, match="no such file or folder"):
        open_source(f"euroc:{tmp_path / 'missing'}")
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(SourceError, match="expected an MCAP file"):
        open_source(str(tmp_path / "notes.txt"))
    with pytest.raises(SourceError, match="names nothing"):
        open_source("kitti:")
