"""What flights found of a rig is kept in a file, and the next flight begins with it."""

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.inertial.calibration.known_imu import KnownImuConfig
from kiteline_agent.known_rig import KnownRigConfig, known_rig
from kiteline_agent.local_map.disparity_alignment import DisparityAlignment
from kiteline_agent.runtime import rig_file
from kiteline_agent.runtime.options import agent_config
from kiteline_agent.runtime.rig_file import RigFile
from kiteline_agent.step import Identity
from kiteline_codec.schema import Record, StereoAlignment
from kiteline_core import config as configuration
from kiteline_core.config import ConfigError
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import VIRTUAL_BASELINE_M, CameraModel, CameraRig, Lens, RectifiedCamera, Rectifier
from kiteline_core.ids import AgentId

LEFT = CameraModel(640, 400, 420.0, 421.0, 318.0, 203.0, Lens.RADTAN, (-0.25, 0.06, 0.0, 0.0))
RIG = CameraRig(LEFT, LEFT, np.eye(4), se3.from_rt(np.eye(3), np.array([0.11, 0.0, 0.0])))
CAMERA = Rectifier(RIG).camera
ROWS = np.array([0.8, -0.3, 0.1, 0.4, -0.2])
DISPARITY = np.array([-1.3, 0.1, 0.2, -1.2, 0.5])
UNIT = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
IMU = KnownImuConfig((-0.004, 0.0003), tuple(v + 0.01 for v in UNIT), (0.001,) * 9, tuple(UNIT), (0.009,) * 9)
numbers = st.lists(st.floats(-8.0, 8.0), min_size=5, max_size=5).map(np.array)


class Told(NoBaseChannel):
    """Keeps what was put."""

    def __init__(self) -> None:
        super().__init__()
        self.records: list[Record] = []

    def put(self, record: Record) -> Record:
        self.records.append(record)
        return super().put(record)


def flown(known: KnownRigConfig, rig: CameraRig = RIG) -> tuple[Agent, Told]:
    told = Told()
    return Agent(rig, None, AgentConfig(known_rig=known), Identity(AgentId(2), 0), told), told


@given(numbers, numbers)
def test_a_file_holds_what_was_known(rows: np.ndarray, disparity: np.ndarray) -> None:
    known = known_rig(CAMERA, rows, disparity, rows_read=False)
    table = tomllib.loads(rig_file.text_of(known))
    assert configuration.apply(KnownRigConfig(), table["known_rig"]) == known
    assert known.is_of(CAMERA)
    assert np.allclose(known.rows, rows, atol=6e-4)
    back = known.rectified()
    assert (back.width, back.fx, back.baseline_m) == (CAMERA.width, CAMERA.fx, CAMERA.baseline_m)


def test_an_agent_begins_with_it_and_tells_the_base() -> None:
    agent, told = flown(known_rig(CAMERA, ROWS, DISPARITY, 0.03, rows_read=True))
    said = [r for r in told.records if isinstance(r, StereoAlignment)]
    assert len(said) == 1
    assert said[0].agent == 2
    assert np.allclose(said[0].rows_px, ROWS)
    assert np.allclose(said[0].disparity_px, DISPARITY)
    assert np.allclose(agent.map.disparity_offset, DISPARITY)
    known = agent.known_rig()
    assert known is not None
    assert replace(known, disparity_sigma_px=0.0) == known_rig(CAMERA, ROWS, DISPARITY, rows_read=True)
    as_they_came, _ = flown(known_rig(CAMERA, ROWS, DISPARITY, rows_read=False))
    assert as_they_came.known_rig() == known_rig(CAMERA, ROWS, DISPARITY, rows_read=False)


def test_an_offset_that_was_not_found_is_not_known_to_be_zero() -> None:
    known = known_rig(CAMERA, ROWS, np.zeros(5), rows_read=True)
    assert known.disparity_px == ()
    found, vague = (known_rig(CAMERA, ROWS, DISPARITY, sigma, rows_read=True) for sigma in (0.03, 0.3))
    # within a good calibration's, as a base said: no knowledge, but where the flight begins
    small = known_rig(CAMERA, ROWS, 0.1 * DISPARITY, None, rows_read=True)
    rigs = (known, KnownRigConfig(), small, vague, found)
    again, fresh, started, held, begun = (disparities(flown(rig)[0]) for rig in rigs)
    assert np.array_equal(again.cov, fresh.cov)
    assert np.array_equal(started.cov, fresh.cov)
    assert begun.sigma_px < held.sigma_px < fresh.sigma_px
    assert np.allclose(flown(small)[0].map.disparity_offset, 0.1 * DISPARITY, atol=6e-4)
    kept = flown(small)[0].known_rig()
    assert kept == small
    for rig, sigma_px in ((found, begun.sigma_px), (vague, held.sigma_px)):
        kept = flown(rig)[0].known_rig()
        assert kept.disparity_sigma_px == pytest.approx(sigma_px, abs=1e-4)


def disparities(agent: Agent) -> DisparityAlignment:
    assert agent.right_camera.disparities is not None
    return agent.right_camera.disparities


def test_without_knowledge_or_with_another_calibration_nothing_changes() -> None:
    other = RectifiedCamera(640, 400, CAMERA.fx + 0.01, CAMERA.fy, CAMERA.cx, CAMERA.cy, 0.11, True, np.eye(4))
    for known in (KnownRigConfig(), known_rig(other, ROWS, DISPARITY, rows_read=True)):
        agent, told = flown(known)
        assert not any(isinstance(r, StereoAlignment) for r in told.records)
        assert not agent.map.disparity_offset.any()
        assert agent.known_rig() is None  # nothing was measured yet
    agent, _ = flown(known_rig(CAMERA, ROWS, DISPARITY, rows_read=True), CameraRig(LEFT, None, np.eye(4), None))
    assert agent.known_rig() is None


def test_an_agent_begins_with_the_read_out_of_its_rolling_shutter() -> None:
    known = replace(known_rig(CAMERA, ROWS, DISPARITY, rows_read=True), readout_s=(0.0231, 0.0006))
    agent, _ = flown(known)
    assert agent.motion_reports()["readout"] == {"ms": 23.1, "sigma_ms": 0.6}
    kept = agent.known_rig()
    assert kept is not None and kept.readout_s == known.readout_s
    told = replace(RIG, left=replace(LEFT, readout_s=0.01))  # the calibration says it: that is used
    agent, _ = flown(known, told)
    assert agent.motion_reports()["readout"] is None
    moved, _ = flown(replace(known, camera=(*known.camera[:2], 400.0, *known.camera[3:])))
    assert moved.motion_reports()["readout"] is None


def test_the_read_out_of_one_camera_without_imu_is_kept() -> None:
    one = replace(CAMERA, baseline_m=VIRTUAL_BASELINE_M, stereo=False)
    known = KnownRigConfig().updated(one, None, None, (-0.02, 0.001))
    assert known is not None and known.is_of(one) and known.readout_of(CAMERA) == ()
    assert known.updated(one, None, None, (-0.021, 0.0005)).readout_s == (-0.021, 0.0005)
    assert known.updated(one, None, IMU).readout_s == known.readout_s


def test_the_file_is_replaced_as_a_whole(tmp_path: Path) -> None:
    path = tmp_path / "new" / "rig.toml"
    assert agent_config("", rig=str(path)).known_rig == KnownRigConfig()  # the first flight
    keeper = RigFile(str(path))
    keeper.save(None)
    assert not path.exists()
    known = known_rig(CAMERA, ROWS, DISPARITY, rows_read=True)
    keeper.save(known)
    assert agent_config("", rig=str(path)).known_rig == known
    assert [p.name for p in path.parent.iterdir()] == ["rig.toml"]
    path.unlink()
    keeper.save(known)  # unchanged
    assert not path.exists()
    with pytest.raises(ConfigError, match="cannot write"):
        RigFile(str(tmp_path)).save(known)


def test_what_was_found_with_another_calibration_is_kept_beside_the_file(tmp_path: Path) -> None:
    """A flight with one of two cameras, or after a new calibration, must not lose what was found of the pair."""
    path, old = tmp_path / "rig.toml", tmp_path / "rig.toml.old"
    of_pair = known_rig(CAMERA, ROWS, DISPARITY, rows_read=True)
    RigFile(str(path)).save(of_pair)
    one = CameraRig(LEFT, None, np.eye(4), None)
    agent, _ = flown(of_pair, one)
    assert agent.rig_is_of_another
    assert not flown(of_pair)[0].rig_is_of_another and not flown(KnownRigConfig(), one)[0].rig_is_of_another
    keeper = RigFile(str(path))
    line = keeper.put_aside()
    assert line.startswith(f"rig: {path} was found with another calibration") and old.name in line
    keeper.save(None)
    assert not old.exists()  # until something else is known
    of_one = of_pair.updated(Rectifier(one).camera, None, IMU)
    keeper.save(of_one)
    keeper.save(replace(of_one, imu=replace(IMU, offset_s=(0.0, 0.001))))
    assert rig_file.load(str(old)) == of_pair
    assert rig_file.load(str(path)).imu.offset_s == (0.0, 0.001)


def test_an_imu_is_kept_with_the_cameras(tmp_path: Path) -> None:
    known = replace(known_rig(CAMERA, ROWS, DISPARITY, rows_read=True), imu=IMU)
    path = tmp_path / "rig.toml"
    RigFile(str(path)).save(known)
    assert rig_file.load(str(path)) == known
    with_imu = Agent(RIG, ImuCalibration(), AgentConfig(known_rig=known), Identity(AgentId(0), 0), NoBaseChannel())
    reports = with_imu.motion_reports()
    assert reports["time_offset"]["applied_ms"] == -4.0
    axes = reports["imu_calibration"]
    assert axes["gyro"]["applied"] and not axes["accel"]["applied"]
    # a flight without an IMU keeps what others found, one that has measured nothing yet writes the same again
    assert flown(known)[0].known_rig() == known
    assert with_imu.known_rig() == known


def test_an_imu_is_compared_with_one_place_of_the_camera() -> None:
    known = replace(known_rig(CAMERA, ROWS, DISPARITY, rows_read=True), imu=IMU)
    moved = CameraRig(LEFT, LEFT, se3.from_rt(se3.so3_exp(np.array([0.0, 0.01, 0.0])), np.zeros(3)), RIG.T_c_r)
    agent = Agent(moved, ImuCalibration(), AgentConfig(known_rig=known), Identity(AgentId(0), 0), NoBaseChannel())
    assert agent.motion_reports()["time_offset"]["applied_ms"] == 0.0
    found = agent.known_rig()
    assert found.imu == KnownImuConfig()
    assert found.rows_px == known.rows_px


def test_one_eye_keeps_its_imu() -> None:
    mono = CameraRig(LEFT, None, np.eye(4), None)
    camera = Rectifier(mono).camera
    known = KnownRigConfig().updated(camera, None, IMU)
    assert known.rows_px == ()
    agent = Agent(mono, ImuCalibration(), AgentConfig(known_rig=known), Identity(AgentId(0), 0), NoBaseChannel())
    assert agent.motion_reports()["time_offset"]["applied_ms"] == -4.0


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "expected the table"),
        ("[agent]\n", "expected the table"),
        ("[known_rig]\nspeed = 1\n", "unknown key 'speed'"),
        ("[known_rig]\nrows_px = [1.0]\n", "rows_px has 1 numbers"),
        ("[known_rig]\nrows_px = [nan, 0.0, 0.0, 0.0, 0.0]\n", "finite"),
        ("[known_rig]\ndisparity_px = [0.0, 0.0, 0.0, 0.0, 9.5]\n", "at most 8"),
        ("[known_rig]\ndisparity_sigma_px = -0.1\n", "from 0 to 8"),
        ("[known_rig.imu]\noffset_s = [0.004]\n", "offset_s has 1 numbers"),
        ("[known_rig.imu]\noffset_s = [0.004, 0.0]\n", "not positive"),
        (f"[known_rig.imu]\ngyro = {UNIT}\n", "belong together"),
        (f"[known_rig.imu]\ngyro = {[2.0, *UNIT[1:]]}\ngyro_sigma = {[0.01] * 9}\n", "by more than"),
        ("[known_rig\n", "no readable"),
        ("\udcff", "no readable"),
    ],
)
def test_another_file_is_refused(tmp_path: Path, text: str, why: str) -> None:
    path = tmp_path / "rig.toml"
    path.write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(ConfigError, match=why):
        rig_file.load(str(path))


def test_an_imu_is_kept_with_the_place_of_the_camera_that_it_was_compared_with() -> None:
    """The rig file is of another mounting, and the right camera was not measured."""
    known = replace(known_rig(CAMERA, ROWS, DISPARITY, rows_read=True), imu=IMU)
    moved = replace(CAMERA, T_b_c=se3.from_rt(se3.so3_exp(np.array([0.0, 0.01, 0.0])), np.zeros(3)))
    found = replace(IMU, offset_s=(0.002, 0.0003))
    updated = known.updated(moved, None, found)
    assert updated.imu == found and updated.knows_imu_of(moved)
    assert not updated.knows_imu_of(CAMERA)
    assert updated.rows_px == known.rows_px
