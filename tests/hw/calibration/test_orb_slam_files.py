"""Settings files of ORB-SLAM3 and ORB-SLAM2 as calibrations, in the forms that their examples have."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from kiteline_core.frame import Frame
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import Lens
from kiteline_hw.calibration.file_calibration import FileCalibration
from kiteline_hw.calibration.files import FORMS, read_calibration
from kiteline_hw.ports import SourceError
from kiteline_hw.sources.open import open_source
from tests.hw.calibration.test_calibration_files import expect_refusal, told

# OpenCV takes a key without a space behind it, as the examples' last lines have it.
VIEWER = "ORBextractor.nFeatures: 1200\nViewer.PointSize:2\nViewer.CameraSize: 0.08\n"
SIZE = "Camera.width: 752\nCamera.height: 480\nCamera.newWidth: 600\nCamera.newHeight: 350\nCamera.fps: 20\n"
IMU = """\
# Transformation from camera to body-frame (imu)
IMU.T_b_c1: !!opencv-matrix
   rows: 4
   cols: 4
   dt: f
   data: [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975,
         0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768,
        -0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949,
         0.0, 0.0, 0.0, 1.0]
IMU.NoiseGyro: 1.7e-4 #1.6968e-04
IMU.NoiseAcc: 2.0000e-3
IMU.GyroWalk: 1.9393e-05
IMU.AccWalk: 3.e-03
IMU.Frequency: 190.0
"""
HEAD = '%YAML:1.0\n\n#-----\nFile.version: "1.0"\n\n'
INTRINSICS = "Camera{k}.fx: 458.654\nCamera{k}.fy: 457.296\nCamera{k}.cx: 367.215\nCamera{k}.cy: 248.375\n"
RADTAN = "Camera{k}.k1: -0.28340811\nCamera{k}.k2: 0.07395907\nCamera{k}.p1: 0.00019359\nCamera{k}.p2: 1.76e-05\n"
ONE = HEAD + 'Camera.type: "PinHole"\n' + (INTRINSICS + RADTAN).format(k=1) + SIZE + IMU + VIEWER
BETWEEN = """\
Stereo.T_c1_c2: !!opencv-matrix
  rows: 4
  cols: 4
  dt: f
  data: [0.999983, 0.00445005, 0.00385861, 0.0636739954352379,
         -0.00443664, 0.999984, -0.00347621, -0.000252007856033742,
         -0.00387402, 0.00345903, 0.999986, -8.87895439518616e-05,
          0.0, 0.0, 0.0, 1.0]
Stereo.ThDepth: 40.0
"""
FISHEYE = "Camera{k}.k1: -0.0053\nCamera{k}.k2: 0.0423\nCamera{k}.k3: -0.0395\nCamera{k}.k4: 0.0068{k}\n"
PAIR = (
    HEAD + 'Camera.type: "KannalaBrandt8"\n' + "".join((INTRINSICS + FISHEYE).format(k=k) for k in (1, 2))
    + BETWEEN + SIZE + IMU + VIEWER
)  # fmt: skip
RECTIFIED = HEAD + 'Camera.type: "Rectified"\n' + INTRINSICS.format(k=1) + SIZE + "Stereo.b: 0.0499585\n" + VIEWER
# Before version 1.0, and ORB-SLAM2. The baseline stands in `bf`.
OLD = "%YAML:1.0\n" + (INTRINSICS + RADTAN).format(k="") + SIZE + VIEWER
OLD_RECTIFIED = "%YAML:1.0\n" + INTRINSICS.format(k="") + "Camera.k1: 0.0\nCamera.bf: 45.8654\n" + SIZE + VIEWER
OLD_RECTIFIED = OLD_RECTIFIED.replace("k1: 0.0\n", "k1: 0.0\nCamera.k2: 0.0\nCamera.p1: 0.0\nCamera.p2: 0.0\n")
DEPTH = OLD + "Camera.bf: 40.0\nDepthMapFactor: 5000.0\nThDepth: 40.0\n"


def matrix(key: str, rows: int, data: str) -> str:
    columns = len(data.split(",")) // rows
    return f"{key}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data:[{data}]\n"


LEFT_R = (
    "0.999966347530033, -0.001422739138722922, 0.008079580483432283, 0.001365741834644127, 0.9999741760894847, "
    "0.007055629199258132, -0.008089410156878961, -0.007044357138835809, 0.9999424675829176"
)
RIGHT_R = (
    "0.9999633526194376, -0.003625811871560086, 0.007755443660172947, 0.003680398547259526, 0.9999684752771629, "
    "-0.007035845251224894, -0.007729688520722713, 0.007064130529506649, 0.999945173484644"
)
RAW = OLD_RECTIFIED + "".join(
    f"{side}.height: 480\n{side}.width: 752\n"
    + matrix(f"{side}.D", 1, "-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0")
    + matrix(f"{side}.K", 3, "458.654, 0.0, 367.215, 0.0, 457.296, 248.375, 0.0, 0.0, 1.0")
    + matrix(f"{side}.R", 3, rotation)
    + matrix(f"{side}.P", 3, f"458.654, 0, 367.215, {shift}, 0, 458.654, 248.4, 0, 0, 0, 1, 0")
    for side, shift, rotation in (("LEFT", 0, LEFT_R), ("RIGHT", -50.482, RIGHT_R))
)


def test_one_camera_with_its_imu(tmp_path: Path) -> None:
    rig = told(tmp_path, rig=ONE)
    camera = rig.cameras[0]
    assert (camera.width, camera.height, camera.fx, camera.cy) == (752, 480, 458.654, 248.375)
    assert (camera.lens, camera.distortion) == (Lens.RADTAN, (-0.28340811, 0.07395907, 0.00019359, 1.76e-05))
    assert rig.T_b_c is not None and np.allclose(rig.T_b_c[:3, 3], (-0.0216401, -0.0646770, 0.0098107), atol=1e-6)
    assert rig.imu is not None and rig.T_c_r is None and len(rig.cameras) == 1
    assert (rig.imu.gyro_noise, rig.imu.accel_noise, rig.imu.gyro_walk, rig.imu.accel_walk) == (
        1.7e-4, 2e-3, 1.9393e-5, 3e-3,
    )  # fmt: skip
    assert rig.imu.rate_hz == 190.0


def test_a_pair_of_wide_lenses(tmp_path: Path) -> None:
    rig = told(tmp_path, rig=PAIR)
    assert [c.lens for c in rig.cameras] == [Lens.EQUIDISTANT] * 2
    assert [c.distortion[3] for c in rig.cameras] == [0.00681, 0.00682]
    assert rig.T_c_r is not None and np.allclose(rig.T_c_r[:3, 3], (0.063674, -0.000252, -0.0000888), atol=1e-6)
    assert rig.rig().T_c_r is not None


@pytest.mark.parametrize(("text", "baseline_m"), [(RECTIFIED, 0.0499585), (OLD_RECTIFIED, 0.1)])
def test_a_rectified_pair(tmp_path: Path, text: str, baseline_m: float) -> None:
    rig = told(tmp_path, rig=text)
    assert len(rig.cameras) == 2 and rig.cameras[0] == rig.cameras[1] and rig.cameras[0].lens is Lens.NONE
    assert rig.T_c_r is not None and np.allclose(rig.T_c_r[:3, 3], (baseline_m, 0.0, 0.0))
    assert rig.T_b_c is None and rig.imu is None


def test_a_pair_that_orb_slam_rectifies(tmp_path: Path) -> None:
    """Images are raw: lenses and rotation are those of LEFT and RIGHT, not of the rectified camera."""
    rig = told(tmp_path, rig=RAW)
    assert [c.fx for c in rig.cameras] == [458.654] * 2 and rig.cameras[1].lens is Lens.RADTAN
    # EuRoC's extrinsics, from which that rectification was made.
    T_b_l = np.eye(4)
    T_b_l[:3] = [[0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975],
                 [0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768],
                 [-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949]]  # fmt: skip
    T_b_r = np.eye(4)
    T_b_r[:3] = [[0.0125552670891, -0.999755099723, 0.0182237714554, -0.0198435579556],
                 [0.999598781151, 0.0130119051815, 0.0251588363115, 0.0453689425024],
                 [-0.0253898008918, 0.0179005838253, 0.999517347078, 0.00786212447038]]  # fmt: skip
    assert rig.T_c_r is not None
    assert np.allclose(rig.T_c_r, se3.inverse(T_b_l) @ T_b_r, atol=1e-4)


@pytest.mark.parametrize(("old", "new"), [("data:[458.654, 0, ", "data:[435.2, 0, "), ("-50.482", "0.0")])
def test_a_rectification_that_was_left_over_from_an_example_is_not_used(tmp_path: Path, old: str, new: str) -> None:
    assert old in RAW
    rig = told(tmp_path, rig=RAW.replace(old, new))
    assert rig.cameras == told(tmp_path, other=OLD_RECTIFIED).cameras


@pytest.mark.parametrize("factor", ["5000.0", "1.0", "0"])
def test_a_depth_camera_has_no_right_camera(tmp_path: Path, factor: str) -> None:
    rig = told(tmp_path, rig=DEPTH.replace("5000.0", factor))
    assert len(rig.cameras) == 1 and rig.T_c_r is None
    assert rig.depth_scale == (5000.0 if factor == "5000.0" else None)


def test_depths_are_read_in_the_unit_that_the_settings_tell(tmp_path: Path, data_dir: Path) -> None:
    size = "Camera.width: 640\nCamera.height: 480\n"
    text = DEPTH.replace(SIZE, size)
    folder = tmp_path / "flight"
    folder.mkdir()
    for name in ("rgb", "depth", "rgb.txt", "depth.txt"):
        (folder / name).symlink_to(data_dir / "tum_rgbd_xyz" / name)
    depths = []
    for factor in ("5000.0", "1000.0"):
        given_rig = told(tmp_path, rig=text.replace("5000.0", factor))
        frame = next(iter(open_source(f"tum:{folder}", calibration=given_rig)))
        assert isinstance(frame, Frame) and frame.depth_m is not None
        depths.append(float(np.median(frame.depth_m[frame.depth_m > 0])))
    assert np.isclose(depths[1], 5.0 * depths[0], rtol=1e-3)


def test_older_names_of_transforms_and_five_or_eight_coefficients(tmp_path: Path) -> None:
    names = PAIR.replace("Camera1.", "Camera.").replace("Stereo.T_c1_c2", "Tlr").replace("IMU.T_b_c1", "Tbc")
    three_rows = names.replace("  rows: 4\n  cols: 4\n", "  rows: 3\n  cols: 4\n", 1)
    three_rows = three_rows.replace("-8.87895439518616e-05,\n          0.0, 0.0, 0.0, 1.0]", "-8.87895439518616e-05]")
    new, old = told(tmp_path, rig=PAIR), told(tmp_path, rig=three_rows)
    assert old.cameras == new.cameras and old.imu == new.imu
    assert old.T_c_r is not None and np.array_equal(old.T_c_r, new.T_c_r) and np.array_equal(old.T_b_c, new.T_b_c)
    five = told(tmp_path, rig=OLD + "Camera.k3: 0.02\n").cameras[0].distortion
    assert five == (-0.28340811, 0.07395907, 0.00019359, 1.76e-05, 0.02)
    eight = "".join(f"Camera.k{k}: 0.0{k}\n" for k in (3, 4, 5, 6))
    assert told(tmp_path, rig=OLD + eight).cameras[0].distortion[4:] == (0.03, 0.04, 0.05, 0.06)


def test_they_are_exported_in_other_forms(tmp_path: Path) -> None:
    texts = FORMS["kalibr"](told(tmp_path, rig=PAIR))
    assert set(texts) == {"camchain-imucam.yaml", "imu.yaml"}


CHANGES = [
    (ONE, '"PinHole"', '"OmniDirectional"', "Camera.type to be PinHole, KannalaBrandt8 or Rectified.*Omni"),
    (ONE, "Camera1.fy: 457.296\n", "", "Camera1.fy.*focal length.*nothing"),
    (ONE, "Camera1.fx: 458.654", "Camera1.fx: 0", "Camera1.fx.*focal length"),
    (ONE, "Camera1.p2: 1.76e-05\n", "", "Camera1.p2.*nothing"),
    (ONE, "Camera.width: 752\n", "", "Camera.width.*size of the images in px: add it"),
    (ONE, "-0.0257744366974", "-0.5", "IMU.T_b_c1 is no rigid motion"),
    (ONE, "IMU.NoiseAcc: 2.0000e-3", "IMU.NoiseAcc: -1", "IMU.NoiseAcc.*above zero"),
    (PAIR, "Camera2.k4: 0.00682\n", "", "Camera2.k4.*nothing"),
    (PAIR, "Camera2.fx: 458.654\n", "", "Camera2.fx.*nothing"),
    (RECTIFIED, "Stereo.b: 0.0499585", "Stereo.b: -0.05", "Stereo.b.*baseline in m"),
]


@pytest.mark.parametrize(("text", "old", "new", "message"), CHANGES)
def test_each_fault_names_file_key_and_what_was_expected(
    tmp_path: Path, text: str, old: str, new: str, message: str
) -> None:
    expect_refusal(tmp_path, text, old, new, message)


def test_a_pair_without_extrinsics_can_be_flown_with_its_left_camera(tmp_path: Path) -> None:
    rig = told(tmp_path, rig=PAIR.replace(BETWEEN, ""))
    with pytest.raises(SourceError, match=r"Stereo\.T_c1_c2"):
        rig.rig()
    assert rig.rig(mono=True).right is None


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(st.sampled_from([ONE, PAIR, RECTIFIED, RAW, DEPTH]), st.data())
def test_damaged_files_raise_nothing_but_a_source_error(tmp_path: Path, text: str, data: st.DataObject) -> None:
    at = data.draw(st.integers(0, len(text)))
    length = data.draw(st.integers(0, 40))
    put = data.draw(st.text(st.sampled_from("0.-:[]{}&*!%\n \tnae\"'#"), max_size=12))
    path = tmp_path / "rig.yaml"
    path.write_text(text[:at] + put + text[at + length :])
    try:
        back: FileCalibration = read_calibration(str(path))
    except SourceError:
        return
    for c in back.cameras:
        assert np.isfinite((c.fx, c.fy, c.cx, c.cy, *c.distortion)).all() and c.fx > 0 and c.width > 0
    assert back.T_c_r is None or np.isfinite(back.T_c_r).all()
