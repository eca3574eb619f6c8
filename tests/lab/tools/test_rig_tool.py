"""`kiteline rig`: what was found of a rig, shown and in the forms of other tools."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from kiteline_agent.imaging import row_alignment
from kiteline_agent.inertial.calibration.known_imu import KnownImuConfig
from kiteline_agent.known_rig import KnownRigConfig, known_rig
from kiteline_agent.runtime import rig_file
from kiteline_basestation.mapper import Mapper
from kiteline_basestation.mapper_state import MapperState, MapState
from kiteline_basestation.store.saved_map import SavedMap, SavedValues
from kiteline_basestation.store.state_texts import texts_of
from kiteline_basestation.store.store import Store, batch_of
from kiteline_codec.schema import CameraIntrinsics, messages
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import VIRTUAL_BASELINE_M, RectifiedCamera
from kiteline_core.geometry.disparity_offset import terms
from kiteline_core.ids import AgentId
from kiteline_hw.ports import SourceError
from kiteline_lab.tools.rig import KnownCameras, RigError, exported, found_rig, main, summary

T_b_c = se3.from_rt(se3.so3_exp(np.array([0.1, -0.2, 0.3])), np.array([0.05, 0.01, -0.02]))
CAMERA = RectifiedCamera(752, 480, 430.0, 430.0, 363.0, 254.0, 0.11, True, T_b_c)
OFFSET = np.array([0.5, -0.35, -0.1, 0.45, 0.6])


def known(offset: bool = True) -> Mapper:
    mapper = Mapper()
    mapper.map.set_camera(AgentId(0), CAMERA)
    if offset:
        mapper.map.disparity_offset_px[AgentId(0)] = OFFSET
    return mapper


def test_the_rig_that_is_found_has_these_disparities() -> None:
    rig = found_rig(CAMERA, OFFSET, None)
    assert rig.right is not None
    rng = np.random.default_rng(2)
    xyz = np.column_stack([rng.uniform(-0.6, 0.6, (200, 2)), np.ones(200)]) * rng.uniform(8.0, 40.0, (200, 1))
    right = se3.transform(se3.inverse(rig.T_c_r), xyz)
    u = [m.fx * p[:, 0] / p[:, 2] + m.cx for m, p in ((rig.left, xyz), (rig.right, right))]
    at = xyz[:, :2] / xyz[:, 2:] - np.column_stack([CAMERA.baseline_m / xyz[:, 2], np.zeros(200)])
    assert np.allclose(u[0] - u[1] - CAMERA.bf / xyz[:, 2], terms(at) @ OFFSET, atol=0.01)


def test_without_an_offset_it_is_the_rectified_pair() -> None:
    rig = found_rig(CAMERA, np.zeros(5), np.zeros(5))
    assert rig.left == rig.right
    assert rig.T_c_r is not None
    assert np.array_equal(rig.T_c_r, se3.from_rt(np.eye(3), np.array([0.11, 0.0, 0.0])))


def test_both_forms_hold_the_same_rig() -> None:
    mapper = KnownCameras.of_base(known())
    chain = yaml.safe_load(exported(mapper, None, "kalibr")["camchain-imucam.yaml"])
    sensors = [yaml.safe_load(text) for _, text in sorted(exported(mapper, 0, "euroc").items())]
    T_b = [np.array(s["T_BS"]["data"]).reshape(4, 4) for s in sensors]
    assert np.allclose(T_b[0], T_b_c)
    rig = found_rig(CAMERA, OFFSET, None)
    assert np.allclose(np.linalg.inv(T_b[0]) @ T_b[1], rig.T_c_r)
    for k, sensor in enumerate(sensors):
        assert chain[f"cam{k}"]["intrinsics"] == sensor["intrinsics"]
        assert np.allclose(np.array(chain[f"cam{k}"]["T_cam_imu"]) @ T_b[k], np.eye(4))
    assert np.allclose(chain["cam1"]["T_cn_cnm1"], np.linalg.inv(rig.T_c_r))
    assert np.isclose(
        cv2.Rodrigues(np.array(chain["cam1"]["T_cn_cnm1"])[:3, :3])[0][1, 0], -OFFSET[3] / 430.0, rtol=0.01
    )


def test_unknown_agents_are_named() -> None:
    with pytest.raises(RigError, match="no agent 3: expected one of 0"):
        exported(KnownCameras.of_base(known()), 3, "euroc")
    with pytest.raises(RigError, match="no camera is known"):
        exported(KnownCameras(), None, "euroc")


def test_the_command_reads_a_store(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record = CameraIntrinsics(AgentId(0), CAMERA)
    state = MapperState(map=MapState(disparity_offset_px={AgentId(0): OFFSET}))
    store = Store(tmp_path)
    values = SavedValues({messages.key(record): messages.encode(record)}, {})
    store.write(batch_of(SavedMap({AgentId(0): values}, texts_of(state)), SavedMap()))
    store.close()
    assert main(["show", "--json", str(tmp_path)]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown == summary(KnownCameras.of_base(known()))
    assert np.allclose(shown["0"]["disparity_offset_px"], OFFSET)
    assert main(["show", str(tmp_path)]) == 0
    assert "+0.500 -0.350 -0.100 +0.450 +0.600 px" in capsys.readouterr().out
    assert main(["export", str(tmp_path), "--format", "kalibr", "--out", str(tmp_path / "new")]) == 0
    assert (tmp_path / "new" / "camchain-imucam.yaml").exists()


def test_rows_tell_the_pitch_and_roll_of_the_right_camera() -> None:
    f, turn, shift = CAMERA.fx, np.array([9e-4, -6e-4, 7e-4]), np.array([0.4, -0.3])
    x, y = np.meshgrid(np.linspace(-0.8, 0.8, 15), np.linspace(-0.5, 0.5, 11))
    far = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], 1)
    seen = far @ se3.so3_exp(turn)
    moved = f * (seen[:, :2] / seen[:, 2:] - far[:, :2]) + shift
    xy = far[:, :2]
    offset = np.linalg.lstsq(terms(xy), -moved[:, 0], rcond=None)[0]
    rows = np.linalg.lstsq(row_alignment.terms(xy), moved[:, 1], rcond=None)[0]
    rig = found_rig(CAMERA, offset, rows)
    assert np.allclose(se3.so3_log(rig.T_c_r[:3, :3]), turn, atol=4e-5)
    assert np.allclose([rig.right.cx - CAMERA.cx, rig.right.cy - CAMERA.cy], shift, atol=0.02)


def test_a_rig_file_is_shown_and_exported_and_made_of_a_store(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    known = KnownCameras.of_base(known_base := known_mapper())
    (tmp_path / "rig.toml").write_text(exported(known, None, "kiteline")["rig.toml"])
    assert main(["show", str(tmp_path / "rig.toml"), "--json"]) == 0
    shown, wanted = json.loads(capsys.readouterr().out)["0"], summary(KnownCameras.of_base(known_base))["0"]
    for name in ("size_px", "focal_px", "centre_px", "baseline_m"):
        assert shown[name] == wanted[name]
    for name in ("disparity_offset_px", "rows_px"):
        assert np.allclose(shown[name], wanted[name], atol=1e-3)
    assert main(["show", str(tmp_path / "rig.toml")]) == 0
    assert "rows of the right image too low by +0.700" in capsys.readouterr().out
    to_euroc = ["export", str(tmp_path / "rig.toml"), "--format", "euroc", "--out", str(tmp_path / "new")]
    assert main(to_euroc) == 0
    sensor = yaml.safe_load((tmp_path / "new" / "cam0" / "sensor.yaml").read_text())
    assert np.allclose(np.array(sensor["T_BS"]["data"]).reshape(4, 4), T_b_c, atol=1e-8)
    (tmp_path / "new" / "cam0" / "sensor.yaml").unlink()
    (mine := tmp_path / "new" / "cam1" / "sensor.yaml").write_text("mine")
    with pytest.raises(SourceError, match=r"cam1/sensor\.yaml exists already: .*--force"):
        main(to_euroc)
    assert mine.read_text() == "mine" and not (tmp_path / "new" / "cam0" / "sensor.yaml").exists()  # none is written
    assert main([*to_euroc, "--force"]) == 0
    assert mine.read_text() != "mine" and (tmp_path / "new" / "cam0" / "sensor.yaml").exists()


def known_mapper() -> Mapper:
    mapper = known()
    mapper.map.rows_px[AgentId(0)] = np.array([0.7, -0.1, 0.0, 0.3, 0.2])
    return mapper


def test_an_imu_of_a_rig_file_is_shown_and_exported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    turned = (
        se3.so3_exp(np.array([0.0, 0.0, -0.01])) / 1.02
    )  # corrects an IMU that is turned by 0.01 rad, 2 % too large
    imu = KnownImuConfig((-0.004, 0.0003), tuple(turned.ravel().tolist()), (0.002,) * 9)
    path = tmp_path / "rig.toml"
    rig = known_rig(CAMERA, np.zeros(5), OFFSET, rows_read=False)
    path.write_text(rig_file.text_of(replace(rig, imu=imu)))
    assert main(["show", str(path)]) == 0
    shown = capsys.readouterr().out
    assert "camera stamps + -4.00 ms are the IMU's time (deviation 0.30 ms)" in shown
    assert "gyro: scales off by +1.99 +1.99 +2.00 %, turned by +0.00 +0.00 +0.57 degrees" in shown
    assert "accelerometer" not in shown
    known_cameras = KnownCameras.of_file(rig_file.load(str(path)))
    assert "timeshift_cam_imu: -0.004" in exported(known_cameras, None, "kalibr")["camchain-imucam.yaml"]
    assert "[known_rig.imu]" in exported(known_cameras, None, "kiteline")["rig.toml"]


def test_a_rig_file_of_one_camera_has_no_right_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one = replace(CAMERA, baseline_m=VIRTUAL_BASELINE_M, stereo=False)
    known = KnownRigConfig().updated(one, None, KnownImuConfig((-0.004, 0.0003)))
    (tmp_path / "rig.toml").write_text(text := rig_file.text_of(known))
    assert main(["show", str(tmp_path / "rig.toml")]) == 0
    assert "no right camera\n  camera stamps + -4.00 ms" in (shown := capsys.readouterr().out) and "mm" not in shown
    cameras = KnownCameras.of_file(rig_file.load(str(tmp_path / "rig.toml")))
    assert set(yaml.safe_load(exported(cameras, None, "kalibr")["camchain-imucam.yaml"])) == {"cam0"}
    assert set(exported(cameras, None, "euroc")) == {"cam0/sensor.yaml"}
    assert exported(cameras, None, "kiteline")["rig.toml"] == text


def test_the_read_out_of_a_rig_file_is_shown_and_exported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    known = replace(known_rig(CAMERA, np.zeros(5), OFFSET, rows_read=False), readout_s=(0.0231, 0.0006))
    (tmp_path / "rig.toml").write_text(rig_file.text_of(known))
    assert main(["show", str(tmp_path / "rig.toml")]) == 0
    said = "rolling shutter: 23.1 ms from the first row to the last (deviation 0.6 ms)"
    assert said in capsys.readouterr().out
    cameras = KnownCameras.of_file(rig_file.load(str(tmp_path / "rig.toml")))
    chain = yaml.safe_load(exported(cameras, None, "kalibr")["camchain-imucam.yaml"])
    assert [chain[name]["line_delay"] * CAMERA.height for name in ("cam0", "cam1")] == pytest.approx([0.0231] * 2)
    for text in exported(cameras, None, "euroc").values():
        assert yaml.safe_load(text)["readout_s"] == 0.0231
    assert "readout_s = [0.0231, 0.0006]" in exported(cameras, None, "kiteline")["rig.toml"]


def test_what_knows_no_camera_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "rig.toml").write_text(rig_file.text_of(KnownRigConfig()))
    assert main(["show", str(tmp_path / "rig.toml")]) == 0
    assert "no camera is known" in capsys.readouterr().out
    with pytest.raises(RigError, match="no camera is known"):
        main(["export", str(tmp_path / "rig.toml"), "--format", "kalibr", "--out", str(tmp_path)])


def test_a_store_s_rig_file_says_how_well_an_offset_is_known() -> None:
    mapper = known()
    for calibrated, sigma_px in ((False, 0.0), (True, 0.03)):
        if calibrated:
            mapper.map.disparity_calibrated.add(AgentId(0))
        text = exported(KnownCameras.of_base(mapper), None, "kiteline")["rig.toml"]
        assert f"disparity_sigma_px = {sigma_px}\n" in text


def test_a_rig_that_is_not_there_is_told_with_both_of_its_forms(tmp_path: Path) -> None:
    with pytest.raises(RigError, match=r"rig\.toml: no such file or folder; expected a rig file.*base --store"):
        main(["show", str(tmp_path / "rig.toml")])
