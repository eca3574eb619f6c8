"""A simulated worn rig, mounted degrees off, is turned by hand: what `kiteline calibrate imu` finds and writes."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kiteline_agent.config import AgentConfig
from kiteline_agent.inertial.calibration.known_imu import KnownImuConfig
from kiteline_agent.known_rig import KnownRigConfig
from kiteline_agent.runtime import rig_file
from kiteline_agent.runtime.options import AgentOptions
from kiteline_bench.vehicle import guided
from kiteline_core.geometry import se3
from kiteline_hw.calibration import own
from kiteline_hw.calibration.file_calibration import FileCalibration
from kiteline_hw.ports import SourceError
from kiteline_hw.sources.open import open_source
from kiteline_lab.calibration import calibrate, imu
from kiteline_lab.calibration.imu import ImuMissing
from kiteline_lab.calibration.imu_guide import ImuProgress, rotation_deg

Look = tuple[ImuProgress, KnownRigConfig | None]
TURNS = ((0.2, 2.4, 0, 0.3, 0.9), (2.4, 4.6, 1, 0.3, 0.9), (4.6, 6.8, 2, 0.5, 0.9))


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("guided") / "guided.mcap"
    return guided.record(out, 5, TURNS, (), "room?scale=0.4&texture_bits=8")


def test_a_camera_that_was_mounted_by_a_ruler_is_found_by_turns(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[Look] = []
    follow = imu.follow

    def noted(options: AgentOptions, config: AgentConfig) -> Iterator[Look]:
        for look in follow(options, config):
            looks.append(look)
            yield look

    monkeypatch.setattr(imu, "follow", noted)
    source = open_source(str(flight))
    assert source.rig.right is not None and source.rig.T_c_r is not None
    T_b_c = source.rig.T_b_c.copy()
    T_b_c[:3, :3] = T_b_c[:3, :3] @ se3.so3_exp(np.radians([1.5, -1.0, 1.5]))
    told = FileCalibration("", (source.rig.left, source.rig.right), source.rig.T_c_r, T_b_c, source.imu)
    calibration, rig = tmp_path / "calibration.yaml", tmp_path / "rig.toml"
    calibration.write_text(own.texts(told)["calibration.yaml"])
    command = ["imu", str(flight), "--calibration", str(calibration), "--rig", str(rig)]
    assert calibrate.main([*command, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["verdict"] == "poor" and said["wanted"]  # it was not laid on its sides

    known = rig_file.load(str(rig)).imu
    truth = json.loads(flight.with_suffix(".rig_truth.json").read_text())
    assert known.offset_s == tuple(said["offset_s"]) and known.gyro_sigma == tuple(said["gyro_sigma"])
    assert known.offset_s[0] == pytest.approx(-truth["frame_stamps_late_s"], abs=1e-3)
    true_R = np.reshape(truth["true"]["T_b_c"], (4, 4))[:3, :3]
    wanted = T_b_c[:3, :3] @ true_R.T @ np.linalg.inv(np.array(truth["gyro_matrix"]))
    gyro = np.reshape(known.gyro, (3, 3))
    assert np.linalg.norm(gyro - wanted) < 0.35 * np.linalg.norm(wanted - np.eye(3))
    assert rotation_deg(gyro) == pytest.approx(rotation_deg(wanted), abs=0.5)
    assert np.sqrt(np.mean(((gyro - wanted).ravel() / np.array(known.gyro_sigma)) ** 2)) < 4.0

    begun: list[AgentConfig] = []

    def again(_: AgentOptions, config: AgentConfig) -> Iterator[Look]:
        begun.append(config)
        yield from looks

    monkeypatch.setattr(imu, "follow", again)
    assert calibrate.main(command) == 0
    assert "usable" in capsys.readouterr().out and rig_file.load(str(rig)).imu == known
    (config,) = begun
    assert config.known_rig.imu == KnownImuConfig()  # it begins without the IMU of the file
    assert config.known_rig == replace(rig_file.load(str(rig)), imu=KnownImuConfig())  # and with all else of it


def test_a_recording_without_an_imu_is_refused(recording: Path, tmp_path: Path) -> None:
    with pytest.raises(ImuMissing, match="has no IMU"):
        calibrate.main(["imu", str(recording), "--rig", str(tmp_path / "rig.toml")])
    assert not (tmp_path / "rig.toml").exists()


def test_a_file_that_cannot_be_written_is_refused_before_anybody_moves(recording: Path, tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="folder that exists"):
        calibrate.main(["imu", str(recording), "--rig", str(tmp_path / "nowhere" / "rig.toml")])


def test_the_camera_turns_as_asked() -> None:
    T_b_c = se3.from_rt(se3.so3_exp(np.array([0.3, -0.2, 0.1])), np.array([0.05, 0.0, 0.02]))
    rows = guided.trajectory(T_b_c, guided.TURNS + guided.RESTS, guided.SHAKES)
    poses = np.array([se3.from_quaternion(row[[7, 4, 5, 6]], row[1:4]) for row in rows]) @ T_b_c
    turned = np.degrees([np.linalg.norm(se3.so3_log(poses[0][:3, :3].T @ pose[:3, :3])) for pose in poses])
    assert 45.0 < turned.max() < 55.0 and turned[0] == turned[40] == 0.0
    assert np.abs(poses[:, :3, 3] - poses[0, :3, 3]).max() == pytest.approx(0.12, abs=0.01)
