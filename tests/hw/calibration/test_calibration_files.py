"""Calibration files: what real tools write, round trips of every form, and every fault named with file and key."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, Lens
from kiteline_hw.calibration.file_calibration import FileCalibration
from kiteline_hw.calibration.files import FORMS, read_calibration
from kiteline_hw.ports import SourceError

CHAIN = """\
cam0:
  T_cam_imu:
  - [0.0, 1.0, 0.0, 0.01]
  - [-1.0, 0.0, 0.0, 0.02]
  - [0.0, 0.0, 1.0, 0.03]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [0.0034823894022493434, 0.0007150348452162257, -0.0020532361418706202, 0.00020293673591811182]
  distortion_model: equidistant
  intrinsics: [190.97847715128717, 190.9733070521226, 254.93170605935475, 256.8974428996504]
  resolution: [512, 512]
  rostopic: /cam0/image_raw
  timeshift_cam_imu: 0.0
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.1]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: [0.0034003170790442797, 0.001766278153469831, -0.00266312569781606, 0.0003299517423931039]
  distortion_model: equidistant
  intrinsics: [190.44236969414825, 190.4344384721956, 252.59949716835982, 254.91723064636983]
  resolution: [512, 512]
  rostopic: /cam1/image_raw
"""
IMU = """\
#Accelerometers
accelerometer_noise_density: 1.86e-03   #Noise density (continuous-time)
accelerometer_random_walk:   4.33e-04
gyroscope_noise_density:     1.87e-04
gyroscope_random_walk:       2.66e-05
rostopic:                    /imu0
update_rate:                 190.0
"""
ROS = """\
image_width: 640
image_height: 480
camera_name: {side}
camera_matrix:
  rows: 3
  cols: 3
  data: [436.2, 0, 320.5, 0, 437.1, 240.25, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.36, 0.15, 0.0003, -0.0008, 0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [400, 0, 319, {tx}, 0, 400, 239, 0, 0, 0, 1, 0]
"""
OPENCV = """%YAML:1.0
---
calibration_time: "Sun Nov  1 10:00:00 2020"
nframes: 20
image_width: 1280
image_height: 720
fisheye_model: 0
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 8.0312345678901234e+02, 0., 6.3950000000000000e+02, 0.,
       8.0312345678901234e+02, 3.5950000000000000e+02, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -2.6637260909660682e-01, -3.8588898922304653e-02,
       1.7831947042852964e-03, -2.8122100441115472e-04,
       2.3839153080878486e-01 ]
avg_reprojection_error: 1.8e-01
"""
PAIR = """%YAML:1.0
image_width: 640
image_height: 480
M1: !!opencv-matrix {{ rows: 3, cols: 3, dt: d, data: [500., 0., 320., 0., 501., 240., 0., 0., 1.] }}
D1: !!opencv-matrix {{ rows: 1, cols: 14, dt: d, data: [.1, -.2, 0., 0., .05, 0., 0., 0., 0., 0., 0., 0., 0., 0.] }}
M2: !!opencv-matrix {{ rows: 3, cols: 3, dt: d, data: [502., 0., 322., 0., 503., 241., 0., 0., 1.] }}
D2: !!opencv-matrix {{ rows: 1, cols: 5, dt: d, data: [.1, -.2, 0., 0., .05] }}
R: !!opencv-matrix {{ rows: 3, cols: 3, dt: d, data: [1., 0., 0., 0., 1., 0., 0., 0., 1.] }}
T: !!opencv-matrix {{ rows: 3, cols: 1, dt: d, data: [{t}, 0., 0.] }}
"""
SENSOR = """#Default imu sensor yaml file
sensor_type: imu
T_BS:
  cols: 4
  rows: 4
  data: [0.0, -1.0, 0.0, 0.5,
         1.0, 0.0, 0.0, 0.0,
         0.0, 0.0, 1.0, 0.0,
         0.0, 0.0, 0.0, 1.0]
rate_hz: 200
gyroscope_noise_density: 1.6968e-04
gyroscope_random_walk: 1.9393e-05
accelerometer_noise_density: 2.0000e-3
accelerometer_random_walk: 3.0000e-3
"""


def told(folder: Path, **texts: str) -> FileCalibration:
    for name, text in texts.items():
        (folder / f"{name}.yaml").write_text(text)
    return read_calibration(",".join(str(folder / f"{name}.yaml") for name in texts))


def expect_refusal(folder: Path, text: str, old: str, new: str, message: str) -> None:
    """Fail unless a calibration with `new` in place of `old` is refused with the file's name and a message."""
    assert old in text
    with pytest.raises(SourceError, match=r"rig\.yaml.*" + message):
        told(folder, rig=text.replace(old, new, 1))


def test_a_kalibr_chain_with_its_imu(tmp_path: Path) -> None:
    c = told(tmp_path, camchain=CHAIN, imu=IMU)
    assert c.cameras[0].lens is Lens.EQUIDISTANT and c.cameras[0].fx == 190.97847715128717
    assert (c.cameras[1].width, c.cameras[1].cy) == (512, 254.91723064636983)
    assert c.T_c_r[0, 3] == pytest.approx(0.1)  # T_cn_cnm1 is the left camera in the right one
    np.testing.assert_allclose(c.T_b_c[:3, 3], [0.02, -0.01, -0.03], atol=1e-12)
    assert c.imu == ImuCalibration(1.87e-4, 2.66e-5, 1.86e-3, 4.33e-4, 190.0)
    assert c.topics == ("/cam0/image_raw", "/cam1/image_raw")


def test_a_chain_whose_cameras_know_the_imu_only(tmp_path: Path) -> None:
    text = CHAIN.replace("T_cn_cnm1", "T_cam_imu").replace("[0.0, 1.0, 0.0, 0.01]", "[1.0, 0.0, 0.0, 0.0]")
    text = text.replace("[-1.0, 0.0, 0.0, 0.02]", "[0.0, 1.0, 0.0, 0.0]").replace(
        "[0.0, 0.0, 1.0, 0.03]", "[0, 0, 1, 0]"
    )
    c = told(tmp_path, camchain=text)
    assert c.T_c_r[0, 3] == pytest.approx(0.1)


def test_ros_files_of_a_pair(tmp_path: Path) -> None:
    c = told(tmp_path, left=ROS.format(side="left", tx=0), right=ROS.format(side="right", tx=-48.0))
    assert c.cameras[0].lens is Lens.RADTAN and c.cameras[0].distortion[0] == -0.36
    assert c.T_c_r[0, 3] == pytest.approx(0.12) and c.T_b_c is None
    rig = c.rig()
    assert not rig.has_body and rig.right is not None


def test_two_ros_files_without_a_baseline_are_no_pair(tmp_path: Path) -> None:
    c = told(tmp_path, left=ROS.format(side="left", tx=0), right=ROS.format(side="right", tx=0))
    with pytest.raises(SourceError, match=r"left\.yaml.*baseline.*--mono"):
        c.rig()
    assert c.rig(mono=True).right is None


def test_arrays_of_one_dimension_as_opencv_5_writes_them(tmp_path: Path) -> None:
    """`FileStorage.write` of a flat array has `sizes` in place of rows and cols."""
    usual = PAIR.format(t=-0.1)
    flat = usual.replace("opencv-matrix { rows: 1, cols: 5,", "opencv-nd-matrix { sizes: [ 5 ],")
    flat = flat.replace("opencv-matrix { rows: 3, cols: 1,", "opencv-nd-matrix { sizes: [ 3 ],")
    assert flat.count("sizes") == 2
    found, expected = (told(tmp_path, pair=text).rig() for text in (flat, usual))
    assert found.right == expected.right
    np.testing.assert_array_equal(found.T_c_r, expected.T_c_r)
    with pytest.raises(SourceError, match=r"D2\.sizes to be one or two sizes"):
        told(tmp_path, pair=flat.replace("sizes: [ 5 ]", "sizes: [ ]"))


def test_opencv_files(tmp_path: Path) -> None:
    c = told(tmp_path, camera=OPENCV)
    assert c.cameras[0].fx == 803.12345678901234 and c.cameras[0].distortion[4] == 0.23839153080878486
    fisheye = OPENCV.replace("fisheye_model: 0", "fisheye_model: 1").replace("rows: 5", "rows: 4")
    fisheye = fisheye.replace(",\n       2.3839153080878486e-01", "")
    assert told(tmp_path, camera=fisheye).cameras[0].lens is Lens.EQUIDISTANT
    pair = told(tmp_path, pair=PAIR.format(t=-0.06))
    assert len(pair.cameras[0].distortion) == 8 and pair.T_c_r is not None  # thin prism terms of zero are dropped
    assert pair.T_c_r[0, 3] == pytest.approx(0.06)
    with pytest.raises(SourceError, match=r"pair\.yaml.*T .*in metres"):
        told(tmp_path, pair=PAIR.format(t=-60.0))


def test_an_euroc_imu_turns_the_body(tmp_path: Path) -> None:
    camera = SENSOR.replace("sensor_type: imu", "sensor_type: camera").split("rate_hz")[0].replace("0.5", "0.7")
    camera += "resolution: [752, 480]\ncamera_model: pinhole\nintrinsics: [458.654, 457.296, 367.215, 248.375]\n"
    camera += "distortion_model: radial-tangential\ndistortion_coefficients: [-0.28, 0.07, 0.0002, 1.8e-05]\n"
    c = told(tmp_path, cam0=camera, imu0=SENSOR)
    assert c.T_b_c is not None and c.imu is not None and c.imu.rate_hz == 200.0
    np.testing.assert_allclose(c.T_b_c[:3, 3], [0.0, -0.2, 0.0], atol=1e-12)
    np.testing.assert_allclose(c.T_b_c[:3, :3], np.eye(3), atol=1e-12)


def test_an_euroc_imu_without_noise_is_an_imu(tmp_path: Path) -> None:
    given = told(tmp_path, imu0="".join(line + "\n" for line in SENSOR.splitlines() if "gyro" not in line))
    assert not given.cameras and given.imu is not None and given.imu.gyro_noise == ImuCalibration().gyro_noise


CAMERA = SENSOR.split("rate_hz")[0].replace("imu", "camera") + (
    "resolution: [752, 480]\ncamera_model: pinhole\nintrinsics: [458.654, 457.296, 367.215, 248.375]\n"
    "distortion_model: radial-tangential\ndistortion_coefficients: [-0.28, 0.07, 0.0002, 1.8e-05]\n"
)
CHANGES = [
    (
        CAMERA,
        "distortion_model: radial-tangential\n",
        "",
        "4 coefficients of a lens whose distortion model is not named",
    ),
    (
        CAMERA,
        "distortion_coefficients",
        "distortion_coeffs",
        "distortion_coefficients to be a list of numbers.*nothing",
    ),
    (CHAIN, "distortion_coeffs", "distortion_coefficients", "cam0.distortion_coeffs to be a list of numbers.*nothing"),
    (ROS, "distortion_model: plumb_bob", "distortion_model: ''", "5 coefficients of a lens whose distortion model"),
    (CHAIN, "intrinsics: [190.97", "intrinsics: [.nan, 190.97", "cam0.intrinsics.*4 numbers"),
    (CHAIN, "[190.97847715128717,", "[-190.97847715128717,", "cam0.*fx -190"),
    (CHAIN, "[190.97847715128717,", "[.inf,", "cam0.intrinsics.*finite"),
    (CHAIN, "[190.97847715128717,", "[many,", "cam0.intrinsics.*finite.*many"),
    (CHAIN, "resolution: [512, 512]", "resolution: [512.5, 512]", "cam0.resolution.*whole number"),
    (CHAIN, "resolution: [512, 512]", "resolution: [512]", "cam0.resolution.*width and height"),
    (CHAIN, "  - [0.0, 1.0, 0.0, 0.01]", "  - [0.0, 1.1, 0.0, 0.01]", "cam0.T_cam_imu.*no rigid motion"),
    (CHAIN, "  - [0.0, 1.0, 0.0, 0.01]", "  - [0.0, -1.0, 0.0, 0.01]", "cam0.T_cam_imu.*no rigid motion"),
    (CHAIN, "  - [0.0, 1.0, 0.0, 0.01]\n", "", "cam0.T_cam_imu.*4 rows of 4"),
    (CHAIN, "  - [0.0, 0.0, 0.0, 1.0]", "  - [0.0, 0.0, 0.1, 1.0]", "cam0.T_cam_imu.*last row"),
    (CHAIN, "camera_model: pinhole", "camera_model: ds", "cam0.camera_model.*pinhole.*'ds'"),
    (CHAIN, "distortion_model: equidistant", "distortion_model: fov", "cam0.*lens model 'fov'"),
    (CHAIN, "[0.0034823894022493434, ", "[", "cam0.*3 coefficients: expected 4"),
    (CHAIN, "  timeshift_cam_imu", "  line_delay: -1\n  timeshift_cam_imu", "cam0.*read-out of -512"),
    (IMU, "1.87e-04", "-1.87e-04", "gyroscope_noise_density.*above zero"),
    (IMU, "190.0", "0", "update_rate.*above zero"),
    (ROS, "image_width: 640", "", "image_width.*found nothing"),
    (ROS, "cols: 3", "cols: 4", "camera_matrix.*3x3"),
    (
        ROS,
        "rows: 1\n  cols: 5\n  data: [-0.36, 0.15,",
        "rows: 1\n  cols: 5\n  data: [-0.36,",
        "distortion_coefficients",
    ),
    (OPENCV, "6.3950000000000000e+02", ".Nan", "camera_matrix.data.*finite"),
    (OPENCV, "image_width: 1280\n", "", "image_width.*add both"),
    (SENSOR, "0.0, 0.0, 0.0, 1.0]", "0.0, 0.0, 1.0]", "T_BS.data.*16 numbers"),
    (SENSOR, "0.0, -1.0, 0.0, 0.5", "0.0, -2.0, 0.0, 0.5", "T_BS.*no rigid motion"),
]


@pytest.mark.parametrize(("text", "old", "new", "message"), CHANGES)
def test_each_fault_names_file_key_and_what_was_expected(
    tmp_path: Path, text: str, old: str, new: str, message: str
) -> None:
    expect_refusal(tmp_path, text, old, new, message)


@pytest.mark.parametrize(
    ("text", "message"),
    [("", "expected a calibration file"), ("- 1\n- 2\n", "expected a calibration file"), ("a: [1\nb", "no YAML"),
     ("speed: 3\n", "no calibration that is known.*speed"), ("\x00\x01\x02", "no YAML"),
     *[(text, "nested more than 16 deep") for text in ("[" * 4000, "{" * 60_000, "[1," * 2000, "a: " + "[{" * 900)],
     ("kiteline_calibration: 7\n", "kiteline_calibration to be 1"),
     ("x" * (2 << 20), "far smaller")],
)  # fmt: skip
def test_what_is_no_calibration_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(SourceError, match=r"rig\.yaml.*" + message):
        told(tmp_path, rig=text)


def test_missing_files_and_too_many_cameras(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"nowhere\.yaml: No such file"):
        read_calibration(str(tmp_path / "nowhere.yaml"))
    with pytest.raises(SourceError, match="names no calibration"):
        read_calibration(",")
    with pytest.raises(SourceError, match="3 cameras"):
        told(tmp_path, a=CHAIN, b=OPENCV)


def numbers(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False).map(lambda v: v + 0.0)


@st.composite
def rigs(draw: st.DrawFn) -> FileCalibration:
    width, height = draw(st.integers(64, 4000)), draw(st.integers(64, 4000))
    lens = draw(st.sampled_from([Lens.NONE, Lens.RADTAN, Lens.EQUIDISTANT]))

    def camera() -> CameraModel:
        fx, fy = draw(numbers(100, 3000)), draw(numbers(100, 3000))
        d = tuple(draw(numbers(0.001, 0.05)) for _ in range(4)) if lens is not Lens.NONE else ()
        return CameraModel(width, height, fx, fy, draw(numbers(1, 4000)), draw(numbers(1, 4000)), lens, d)

    turn = st.tuples(*[numbers(-0.1, 0.1)] * 3)
    T_c_r = se3.exp(np.array([draw(numbers(0.05, 0.5)), 0.0, 0.0, *draw(turn)]))
    T_b_c = se3.exp(np.array([*draw(turn), *(10.0 * v for v in draw(turn))]))
    imu = ImuCalibration(*(draw(numbers(1e-6, 1.0)) for _ in range(5)))
    if draw(st.booleans()):
        return FileCalibration("x", (camera(),), None, T_b_c, imu, ('/a: "b" #c',))
    return FileCalibration("x", (camera(), camera()), T_c_r, T_b_c, imu, ("/l", "/r"))


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(rigs(), st.sampled_from(["kiteline", "kalibr", "euroc", "opencv"]))
def test_round_trips(tmp_path: Path, rig: FileCalibration, form: str) -> None:
    names = []
    for name, text in FORMS[form](rig).items():
        path = tmp_path / form / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        names.append(str(path))
    back = read_calibration(",".join(names))
    assert [replace(c, distortion=()) for c in back.cameras] == [replace(c, distortion=()) for c in rig.cameras]
    for mine, its in zip(rig.cameras, back.cameras, strict=True):
        assert mine.distortion == its.distortion
    if rig.T_c_r is not None:
        assert back.T_c_r is not None
        np.testing.assert_allclose(back.T_c_r, rig.T_c_r, atol=1e-12)
    if form != "opencv":
        assert back.imu == rig.imu and back.T_b_c is not None and rig.T_b_c is not None
        np.testing.assert_allclose(back.T_b_c, rig.T_b_c, atol=1e-12)
    if form == "kiteline":
        assert back.topics == rig.topics


def test_ros_round_trip_of_a_pair(tmp_path: Path) -> None:
    camera = CameraModel(640, 480, 436.2, 437.1, 320.5, 240.25, Lens.RADTAN, (-0.36, 0.15, 0.0003, -0.0008))
    T_c_r = se3.exp(np.array([0.11, 0.001, -0.002, 0.01, -0.02, 0.005]))
    rig = FileCalibration("x", (camera, replace(camera, cx=318.0)), T_c_r)
    texts = FORMS["ros"](rig)
    back = told(tmp_path, left=texts["left.yaml"], right=texts["right.yaml"])
    assert back.cameras[1].cx == 318.0 and back.cameras[0].distortion == (*camera.distortion, 0.0)
    assert back.T_c_r is not None
    np.testing.assert_allclose(back.T_c_r, T_c_r, atol=1e-9)


def test_five_coefficients_are_not_cut_to_kalibrs_four() -> None:
    camera = CameraModel(640, 480, 436.2, 437.1, 320.5, 240.25, Lens.RADTAN, (-0.36, 0.15, 0.0003, -0.0008, 0.02))
    with pytest.raises(SourceError, match="5 radial-tangential coefficients"):
        FORMS["kalibr"](FileCalibration("x", (camera,)))


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(st.sampled_from([CHAIN, IMU, ROS, OPENCV, SENSOR, PAIR.format(t=-0.06)]), st.data())
def test_damaged_files_raise_nothing_but_a_source_error(tmp_path: Path, text: str, data: st.DataObject) -> None:
    at = data.draw(st.integers(0, len(text)))
    length = data.draw(st.integers(0, 40))
    put = data.draw(st.text(st.sampled_from("0.-:[]{}&*!%\n \tnae\"'#"), max_size=12))
    path = tmp_path / "rig.yaml"
    path.write_text(text[:at] + put + text[at + length :])
    try:
        back = read_calibration(str(path))
    except SourceError:
        return
    for c in back.cameras:
        assert np.isfinite((c.fx, c.fy, c.cx, c.cy, *c.distortion)).all() and c.fx > 0 and c.width > 0
    for T in (back.T_c_r, back.T_b_c):
        assert T is None or np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
