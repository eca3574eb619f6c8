"""`--calibration FILE`: sources with what a file says of their cameras, and TUM-VI's folders."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from kiteline_core.frame import Frame, ImuBatch
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import Lens, Rectifier
from kiteline_hw.calibration.file_calibration import UNCALIBRATED
from kiteline_hw.calibration.files import read_calibration
from kiteline_hw.cameras.live_options import LiveOptions, read_rig
from kiteline_hw.ports import SourceError
from kiteline_hw.sources.open import open_source
from tests.hw.calibration.test_calibration_files import CHAIN, IMU
from tests.hw.sources.ros2_bags import stereo_bag
from tests.hw.sources.test_folders import add_imu, euroc

T_ns = 1520530308199447626


def put(path: Path, seed: int, size: tuple[int, int] = (512, 512), bits: int = 8) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    kind = np.uint16 if bits == 16 else np.uint8
    image = np.random.default_rng(seed).integers(0, 2**bits, size).astype(kind)
    assert cv2.imwrite(str(path), image)


def tum_vi(root: Path, chain: str = "dso/camchain.yaml") -> Path:
    """A folder as TUM-VI ships it: 16-bit images, no sensor.yaml, ground truth in mocap0."""
    for side in ("cam0", "cam1"):
        lines = ["#timestamp [ns],filename"]
        for i in range(3):
            t = T_ns + i * 50_000_000
            put(root / "mav0" / side / "data" / f"{t}.png", i, bits=16)
            lines.append(f"{t},{t}.png")
        (root / "mav0" / side / "data.csv").write_text("\n".join(lines) + "\n")
    for name, rows in (
        ("imu0", [f"{T_ns + k * 5_000_000},0.1,0.2,0.3,9.7,0.1,0.2" for k in range(20)]),
        ("mocap0", [f"{T_ns + k * 8_000_000},{0.1 * k},0,1,1,0,0,0" for k in range(12)]),
    ):
        (root / "mav0" / name).mkdir()
        (root / "mav0" / name / "data.csv").write_text("#head\n" + "\n".join(rows) + "\n")
    if chain:
        (root / chain).parent.mkdir(exist_ok=True)
        (root / chain).write_text(CHAIN)
    return root


def test_tum_vi_folder(tmp_path: Path) -> None:
    root = tum_vi(tmp_path)
    (root / "dso" / "imu_config.yaml").write_text(IMU)
    source = open_source(str(root))
    items = list(source)
    frames = [i for i in items if isinstance(i, Frame)]
    assert len(frames) == 3 and frames[0].left.dtype == np.uint8 and frames[0].right is not None
    assert 100 < frames[0].left.mean() < 155  # 16 bits are scaled, not cut
    assert sum(len(i.t_ns) for i in items if isinstance(i, ImuBatch)) == 20
    assert source.rig.left.lens is Lens.EQUIDISTANT and source.rig.has_body
    assert source.imu.rate_hz == 190.0
    assert source.ground_truth.T_w_b[3, 0, 3] == pytest.approx(0.3)
    camera = Rectifier(source.rig).camera
    # 120 degrees are left of a lens of 195: more cannot be drawn on a plane
    assert np.degrees(2.0 * np.arctan(0.5 * camera.width / camera.fx)) > 100.0


def test_tum_vi_folder_without_its_chain_needs_one_told(tmp_path: Path) -> None:
    root = tum_vi(tmp_path / "corridor", chain="")
    with pytest.raises(SourceError, match=r"camchain\.yaml beside mav0.*--calibration FILE"):
        open_source(str(root))
    chain = tmp_path / "chain.yaml"
    chain.write_text(CHAIN)
    source = open_source(str(root), calibration=str(chain))
    assert source.rig.right is not None and source.imu is not None and len(list(source)) == 6
    assert open_source(str(root), mono=True, calibration=str(chain)).rig.right is None
    chain.write_text(CHAIN.replace("T_cam_imu", "T_unused"))
    with pytest.raises(SourceError, match=r"against the IMU.*--no-imu"):
        open_source(str(root), calibration=str(chain))
    assert not open_source(str(root), imu=False, calibration=str(chain)).rig.has_body


def test_images_without_camera_yaml(tmp_path: Path) -> None:
    for i in range(2):
        put(tmp_path / "l" / f"{i}.png", i)
        put(tmp_path / "r" / f"{i}.png", i)
    chain = tmp_path / "chain.yaml"
    chain.write_text(CHAIN)
    pair = f"images:{tmp_path}/l/*.png,{tmp_path}/r/*.png"
    source = open_source(pair, calibration=str(chain))
    assert source.rig.right.lens is Lens.EQUIDISTANT
    assert len([f for f in source if isinstance(f, Frame)]) == 2
    chain.write_text(CHAIN.split("cam1:")[0])
    assert open_source(f"images:{tmp_path}/l/*.png", calibration=str(chain)).rig.right is None
    with pytest.raises(SourceError, match=r"one camera.*--mono"):
        open_source(pair, calibration=str(chain))
    plain = open_source(pair, calibration=UNCALIBRATED)
    assert (plain.rig.left.width, plain.rig.left.height) == (512, 512) and len(list(plain)) == 2


def test_a_calibration_replaces_that_of_a_source_and_its_body_stays(tmp_path: Path) -> None:
    root = tum_vi(tmp_path)
    before = open_source(str(root))
    other = tmp_path / "other.yaml"
    other.write_text(
        "kiteline_calibration: 1\nleft:\n  width: 512\n  height: 512\n  fx: 200\n  fy: 200\n  cx: 255\n  cy: 255\n"
        "  lens: radtan\n  distortion: [0.1, 0.01, 0, 0]\nimu:\n  gyro_noise: 0.5\n"
    )
    source = open_source(str(root), mono=True, calibration=str(other))
    assert source.rig.left.fx == 200.0 and source.imu is not None and source.imu.gyro_noise == 0.5
    with pytest.raises(SourceError, match="has two"):
        open_source(f"euroc:{before.name.partition(':')[2]}", calibration=str(other))


def test_another_size_is_refused(data_dir: Path, tmp_path: Path) -> None:
    chain = tmp_path / "chain.yaml"
    chain.write_text(CHAIN)
    with pytest.raises(SourceError, match=r"chain\.yaml: left camera is calibrated at 512x512 px.*has 752x480"):
        open_source(str(data_dir / "euroc_v101_start"), calibration=str(chain))


def test_own_calibration_of_a_recording_told_again_changes_nothing(data_dir: Path) -> None:
    root = data_dir / "euroc_v101_start"
    names = ",".join(str(root / "mav0" / n / "sensor.yaml") for n in ("cam0", "cam1", "imu0"))
    plain, given = open_source(str(root)), open_source(str(root), calibration=names)
    assert (given.rig.left, given.rig.right, given.imu) == (plain.rig.left, plain.rig.right, plain.imu)
    assert given.rig.T_c_r is not None and plain.rig.T_c_r is not None
    np.testing.assert_array_equal(given.rig.T_c_r, plain.rig.T_c_r)
    np.testing.assert_allclose(given.rig.T_b_c, plain.rig.T_b_c, atol=1e-15)
    np.testing.assert_array_equal(given.ground_truth.T_w_b, plain.ground_truth.T_w_b)


@pytest.mark.parametrize("names", [("cam0",), ("cam0", "cam1")])
def test_cameras_of_an_euroc_folder_told_again_stay_where_its_imu_is(tmp_path: Path, names: tuple[str, ...]) -> None:
    """Their T_BS are in a frame in which the IMU need not be at the origin."""
    root = euroc(tmp_path)
    T_s_i = se3.exp(np.array([0.1, 0.2, 0.3, 0.4, -0.5, 0.6]))
    add_imu(root, T_s_i, [f"{1000 + i * 5_000_000},0,0,0,0,0,9.8" for i in range(40)])
    source = open_source(str(root), mono=len(names) == 1)
    told = ",".join(str(root / "mav0" / name / "sensor.yaml") for name in names)
    again = open_source(str(root), mono=len(names) == 1, calibration=told)
    np.testing.assert_allclose(again.rig.T_b_c, source.rig.T_b_c, atol=1e-12)


def test_truth_of_camera_poses_becomes_that_of_the_told_body(data_dir: Path, tmp_path: Path) -> None:
    plain = open_source(str(data_dir / "tum_rgbd_xyz"))
    T_b_c = se3.exp(np.array([0.1, 0.2, 0.3, 0.5, -0.4, 0.3]))
    file = tmp_path / "rig.yaml"
    file.write_text(
        "kiteline_calibration: 1\nleft: {width: 640, height: 480, fx: 517, fy: 516, cx: 318, cy: 255, lens: none}\n"
        f"T_b_c: {T_b_c.tolist()}\n"
    )
    given = open_source(str(data_dir / "tum_rgbd_xyz"), calibration=str(file))
    assert (
        given.rig.has_depth and given.rig.has_body and plain.ground_truth is not None and given.ground_truth is not None
    )
    np.testing.assert_allclose(given.ground_truth.T_w_b @ T_b_c, plain.ground_truth.T_w_b, atol=1e-12)


def test_a_bag_without_calibration(tmp_path: Path) -> None:
    bag = stereo_bag(info=lambda bag: None, tf=False)
    path = bag.write(tmp_path / "bag.mcap")
    with pytest.raises(SourceError, match=r"no calibration.*--calibration FILE"):
        open_source(str(path))
    chain = tmp_path / "chain.yaml"
    chain.write_text(CHAIN.replace("[512, 512]", "[64, 48]").replace("/cam0/image_raw", "/none"))
    source = open_source(str(path), calibration=str(chain))
    assert source.rig.right is not None and source.imu is not None and source.rig.has_body
    assert len([i for i in source if isinstance(i, Frame) and i.right is not None]) == 6
    chain.write_text(chain.read_text().replace("T_cam_imu", "T_unused"))
    without = open_source(str(path), calibration=str(chain))
    assert without.imu is None
    list(without)
    assert any("imu left out" in note for note in without.report.notes)
    raw = open_source(str(path), imu=False, calibration=UNCALIBRATED)
    assert (raw.rig.left.width, raw.rig.left.height) == (64, 48) and raw.rig.right is not None


def test_a_live_pair_by_a_calibration_file(tmp_path: Path) -> None:
    chain = tmp_path / "chain.yaml"
    chain.write_text(CHAIN)
    options = LiveOptions(calibration=str(chain))
    by_option = read_rig("v4l2", options, stereo=True)
    by_flag = read_rig("v4l2", LiveOptions(calibration="none.yaml"), stereo=True, given=read_calibration(str(chain)))
    for rig in (by_option, by_flag):
        assert rig.right.fx == 190.44236969414825 and rig.has_body
    assert read_rig("v4l2", options, stereo=False).right is None
    chain.write_text(CHAIN.split("cam1:")[0])
    with pytest.raises(SourceError, match="one camera"):
        read_rig("v4l2", options, stereo=True)
    with pytest.raises(SourceError, match="size of the images is not known"):
        read_rig("v4l2", LiveOptions(), stereo=True, given=UNCALIBRATED)
    rough = tmp_path / "camera.yaml"
    rough.write_text("fx: 1\nfy: 1\ncx: 1\ncy: 1\nwidth: 640\nheight: 480\nbaseline_m: 0.1\n")
    rig = read_rig("v4l2", LiveOptions(calibration=str(rough)), stereo=True, given=UNCALIBRATED)
    assert rig.right is not None and (rig.left.width, rig.left.height) == (640, 480)
