"""Which way is up: at once, after a few frames in motion, and who is told."""

import numpy as np
import pytest

from kiteline_agent.inertial import gravity_alignment
from kiteline_agent.inertial.gravity_alignment import GravityAligner, level_rotation
from kiteline_agent.inertial.inertial_tracker import InertialTracker
from kiteline_agent.step import Estimate
from kiteline_codec.schema import GravityAlignment, SubmapPlacement, messages
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuBatch, ImuCalibration
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import KeyframeId, SubmapId

CAMERA = RectifiedCamera(640, 480, 400.0, 400.0, 320.0, 240.0, 0.1, True, np.eye(4))


class Knows(InertialTracker):
    """An inertial tracker of which only what it knows of gravity counts."""

    def __init__(self) -> None:
        super().__init__(CAMERA, ImuCalibration(), _config())
        self.up: np.ndarray[tuple[int, ...], np.dtype[np.float64]] | None = None

    def gravity_rotation(self) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]] | None:
        return self.up


def _config():  # type: ignore[no-untyped-def]
    from kiteline_agent.inertial.inertial_config import InertialConfig

    return InertialConfig()


def test_the_accelerometer_alone_sets_the_body_upright() -> None:
    for up in ([0.0, 0.0, 9.8], [9.8, 0.0, 0.0], [1.0, -3.0, 9.0], [0.0, 0.0, -9.8]):
        u = np.array(up)
        np.testing.assert_allclose(level_rotation(u) @ u, [0.0, 0.0, np.linalg.norm(u)], atol=1e-9)


def test_without_an_imu_gravity_is_not_awaited() -> None:
    aligner = GravityAligner(CAMERA, None)
    np.testing.assert_array_equal(aligner.R_l_o, np.eye(3))
    assert aligner.update(0, np.eye(4), np.eye(4), SubmapId(0), continued=True) is None
    ahead = aligner.first_pose(None)[:3, :3]
    np.testing.assert_allclose(ahead @ [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], atol=1e-12)


def test_the_base_is_told_once_and_the_place_stays() -> None:
    knows = Knows()
    aligner = GravityAligner(CAMERA, knows)
    T_m_b = se3.from_rt(np.eye(3), np.array([1.0, 2.0, 3.0]))
    assert aligner.update(0, T_m_b, np.eye(4), SubmapId(0), continued=True) is None
    assert aligner.R_l_o is None
    lean = se3.so3_exp(np.array([0.2, -0.3, 0.0]))
    knows.up = lean.T
    level = aligner.update(10**8, T_m_b, np.eye(4), SubmapId(0), continued=True)
    np.testing.assert_allclose((level.T_l_m @ T_m_b)[:3, 3], T_m_b[:3, 3], atol=1e-4)  # rounded as on the wire
    told = messages.decode(messages.key(level), messages.encode(level))
    assert isinstance(told, GravityAlignment)
    np.testing.assert_array_equal(told.T_l_m, level.T_l_m)
    placed = SubmapPlacement(SubmapId(0), told.T_l_m)
    echo = messages.decode(messages.key(placed), messages.encode(placed))
    assert isinstance(echo, SubmapPlacement)
    np.testing.assert_array_equal(echo.S_w_m, level.T_l_m)
    np.testing.assert_allclose(aligner.R_l_o @ lean @ [0.0, 0.0, 1.0], [0.0, 0.0, 1.0], atol=1e-9)
    assert aligner.tilt_rad == pytest.approx(np.hypot(0.2, 0.3))
    assert aligner.update(2 * 10**8, T_m_b, np.eye(4), SubmapId(0), continued=True) is None


def test_what_leans_hardly_is_left_and_patience_ends() -> None:
    knows = Knows()
    hardly = GravityAligner(CAMERA, knows)
    knows.up = se3.so3_exp(np.array([0.02, 0.0, 0.0]))
    assert hardly.update(0, np.eye(4), np.eye(4), SubmapId(0), continued=True) is None
    assert abs(hardly.R_l_o[2, 1]) > 0.01  # the flight controller gets even this
    knows.up = None
    patient = GravityAligner(CAMERA, knows)
    patient.first_pose(ImuBatch(np.array([0]), np.zeros((1, 3)), np.array([[0.0, 0.0, 9.8]])))
    for t_s in (0.0, 1.0, 1.9):
        patient.update(int(t_s * 1e9), np.eye(4), np.eye(4), SubmapId(0), continued=True)
        assert patient.R_l_o is None
    patient.update(int(2.1e9), np.eye(4), np.eye(4), SubmapId(0), continued=True)
    np.testing.assert_array_equal(patient.R_l_o, np.eye(3))
    knows.up = se3.so3_exp(np.array([0.0, 0.3, 0.0]))  # the accelerometer's first guess was wrong
    patient.update(int(2.2e9), np.eye(4), np.eye(4), SubmapId(0), continued=True)
    np.testing.assert_allclose(patient.R_l_o, knows.up, atol=1e-9)


def test_no_controller_gets_poses_before_samples_that_begin_late(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing has told where up is: the camera may be mounted at any angle."""
    knows = Knows()
    aligner = GravityAligner(CAMERA, knows)
    aligner.first_pose(None)
    for t_s in (0.0, 2.1, 30.0):
        assert aligner.update(round(1e9 * t_s), np.eye(4), np.eye(4), SubmapId(0), continued=True) is None
        assert aligner.R_l_o is None
    first, later = se3.so3_exp(np.array([0.2, 0.0, 0.0])), se3.so3_exp(np.array([0.3, 0.0, 0.0]))
    knows.up = first
    level = aligner.update(round(31e9), np.eye(4), np.eye(4), SubmapId(0), continued=True)
    assert level is not None and aligner.tilt_rad == pytest.approx(0.2)
    np.testing.assert_allclose(level.T_l_m[:3, :3], first, atol=1e-4)
    np.testing.assert_allclose(aligner.R_l_o, first, atol=1e-9)  # a vehicle in flight cannot wait for more
    monkeypatch.setattr(Knows, "running", True)
    monkeypatch.setattr(Knows, "state", "a state")
    knows.up = later
    for sigma_rad, told in ((0.03, first), (0.01, later)):  # it turns once more is known
        monkeypatch.setattr(gravity_alignment, "up_of", lambda _state, sigma_rad=sigma_rad: (np.zeros(3), sigma_rad))
        assert aligner.update(round(40e9), np.eye(4), np.eye(4), SubmapId(0), continued=True) is None
        np.testing.assert_allclose(aligner.R_l_o, told, atol=1e-9)
    knows.up = first
    assert aligner.update(round(50e9), np.eye(4), np.eye(4), SubmapId(0), continued=True) is None
    np.testing.assert_allclose(aligner.R_l_o, later, atol=1e-9)  # and that is all


def test_gravity_is_known_after_five_frames_in_motion() -> None:
    rng = np.random.default_rng(4)
    errors = []
    for _ in range(10):
        turn, accel, v0 = 0.8 * rng.normal(size=3), 3.0 * rng.normal(size=3), rng.normal(size=3)
        lean = se3.so3_exp(np.array([0.3, -0.2, 0.0]))
        tracker = InertialTracker(CAMERA, ImuCalibration(), _config())
        first = None
        for k in range(6):
            now = 0.05 * k
            stamps = np.arange(0, 11) * 5_000_000 + (k - 1) * 50_000_000
            turns = [se3.so3_exp(turn * t * 1e-9) for t in stamps]
            felt = np.array([r.T @ (accel + [0.0, 0.0, 9.81]) for r in turns])
            tracker.predict(ImuBatch(stamps, np.tile(turn, (11, 1)), felt), k * 50_000_000)
            T = se3.from_rt(lean @ se3.so3_exp(turn * now), lean @ (v0 * now + 0.5 * accel * now * now))
            T[:3, 3] += 3e-4 * rng.normal(size=3)
            tracker.update(k * 50_000_000, T, _nothing())
            if first is None and tracker.gravity_rotation() is not None:
                first = k
        assert first is not None and first <= 5
        up = tracker.gravity_rotation() @ lean @ [0.0, 0.0, 1.0]
        errors.append(np.degrees(np.arccos(min(up[2], 1.0))))
    assert np.mean(errors) < 1.0 and max(errors) < 2.5


def _nothing():  # type: ignore[no-untyped-def]
    from kiteline_agent.inertial.fixed_lag import VisualPoints

    none = np.zeros((0, 3))
    return VisualPoints(none, none, none, np.zeros(0), np.zeros(0, np.bool_))


def test_a_flight_controller_gets_upright_poses() -> None:
    T = se3.exp(np.array([1.0, 0.0, 0.0, 0.1, 0.2, 0.0]))
    R = se3.so3_exp(np.array([0.0, np.pi / 2, 0.0]))
    cov = np.diag([4.0, 1.0, 1.0, 0.1, 0.2, 0.3])
    e = Estimate(0, True, False, T, T, KeyframeId(0), np.eye(4), SubmapId(0), 100, 90, cov, cov, R, None)
    np.testing.assert_allclose(e.T_l_b, se3.from_rt(R, np.zeros(3)) @ T, atol=1e-12)
    np.testing.assert_allclose(np.diag(e.cov_l), [1.0, 1.0, 4.0, 0.1, 0.2, 0.3], atol=1e-12)


def test_poses_are_upright_again_after_a_loss_over_which_nothing_measured_the_turns(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    knows, upright = Knows(), se3.so3_exp(np.array([0.0, 0.4, 0.0]))
    aligner = GravityAligner(CAMERA, knows)
    knows.up = upright
    aligner.doubt()  # frames before there is a map
    T_m_b, T_o_m, cov = se3.from_rt(np.eye(3), np.array([1.0, 2.0, 3.0])), np.eye(4), np.eye(6)
    aligner.update(0, T_m_b, T_o_m, SubmapId(0), continued=True)
    lean = se3.from_rt(se3.so3_exp(np.array([0.3, -0.1, 0.9])), np.array([5.0, 0.0, 1.0]))  # of the next submap in o

    def frame(t_s: int) -> F64:
        t_ns = 1_000_000_000 * t_s
        assert aligner.update(t_ns, T_m_b, lean, SubmapId(1), continued=False) is None
        pose = Estimate(
            t_ns, True, False, T_m_b, lean @ T_m_b, KeyframeId(0), np.eye(4), SubmapId(1), 100, 90, cov, cov,
            aligner.R_l_o, None, p_l_o=aligner.p_l_o,
        )  # fmt: skip
        assert pose.T_l_b is not None
        return pose.T_l_b

    before = frame(1)
    monkeypatch.setattr(Knows, "running", True)
    np.testing.assert_array_equal(frame(2), before)  # nothing was lost: what the IMU says walks, too
    aligner.doubt()
    monkeypatch.setattr(Knows, "running", False)
    np.testing.assert_array_equal(frame(3), before)
    monkeypatch.setattr(Knows, "running", True)
    np.testing.assert_array_equal(frame(4), before)
    after = frame(5)
    np.testing.assert_allclose(after[:3, :3].T[:, 2], upright[2], atol=1e-9)  # up in the body is as the IMU says
    np.testing.assert_allclose(after[:3, 3], before[:3, 3], atol=1e-9)
    turn = se3.so3_log(after[:3, :3] @ before[:3, :3].T)
    assert abs(turn[2]) < 1e-9 and np.linalg.norm(turn) > 0.3  # the heading stays
    lean = se3.from_rt(se3.so3_exp(np.array([0.0, 0.2, 0.0])), np.zeros(3)) @ lean
    leaning = frame(6)
    aligner.doubt()
    monkeypatch.setattr(Knows, "running", False)
    np.testing.assert_array_equal(frame(7), leaning)
    monkeypatch.setattr(Knows, "running", True)
    aligner.settle(8_000_000_000)
    again = frame(8)
    np.testing.assert_allclose(again[:3, :3].T[:, 2], upright[2], atol=1e-9)  # at once
    np.testing.assert_allclose(again[:3, 3], leaning[:3, 3], atol=1e-9)  # also the second time


def test_the_vertical_of_the_first_frames_slowly_follows_what_is_found_later(monkeypatch: pytest.MonkeyPatch) -> None:
    knows, found = Knows(), se3.so3_exp(np.array([0.04, -0.03, 0.0]))
    aligner = GravityAligner(CAMERA, knows)
    knows.up = np.eye(3)  # by a few frames of a shaken IMU
    monkeypatch.setattr(Knows, "state", "a state")
    off, place, step_s = [], [], 0.05
    for k in range(640):
        sigma_rad = 0.02 if k < 40 else 0.01
        monkeypatch.setattr(gravity_alignment, "up_of", lambda _state, sigma_rad=sigma_rad: (np.zeros(3), sigma_rad))
        T_o_b = se3.from_rt(np.eye(3), np.array([5.0 * k * step_s, 1.0, 0.0]))
        before = None if aligner.R_l_o is None else (aligner.R_l_o, aligner.p_l_o)
        aligner.update(round(1e9 * k * step_s), T_o_b, np.eye(4), SubmapId(0), continued=True)
        knows.up = found
        monkeypatch.setattr(Knows, "running", True)
        assert aligner.R_l_o is not None
        off.append(float(np.linalg.norm(se3.so3_log(aligner.R_l_o @ found.T))))
        if before is not None and before[1] is not None:
            assert aligner.p_l_o is not None
            here = T_o_b[:3, 3]
            place.append(np.linalg.norm(aligner.R_l_o @ here + aligner.p_l_o - before[0] @ here - before[1]))
    assert len(set(off[:40])) == 1 < len(set(off[:46]))  # not before it is known to a degree
    assert (
        off[0] - np.array(off) < 0.005 * (step_s * np.arange(len(off)) + 0.2)
    ).all()  # too slow to be seen as motion
    assert np.diff(off).min() > -0.0012
    assert off[-1] < 1e-3
    assert max(place) < 1e-9  # about the vehicle, which does not move by it
    assert abs(se3.so3_log(aligner.R_l_o)[2]) < 1e-6  # nor turn


def test_the_vehicle_stays_at_its_place_where_the_imu_was_mounted_otherwise() -> None:
    knows = Knows()
    aligner = GravityAligner(CAMERA, knows)
    here = se3.from_rt(np.eye(3), np.array([4.0, 2.0, 1.0]))
    knows.up = np.eye(3)
    aligner.update(0, here, np.eye(4), SubmapId(0), continued=True)
    aligner.renew()
    knows.up = None
    aligner.update(1, here, np.eye(4), SubmapId(0), continued=True)
    assert aligner.R_l_o is None
    knows.up = se3.so3_exp(np.array([0.3, 0.0, 0.0]))
    aligner.update(2, here, np.eye(4), SubmapId(0), continued=True)
    assert aligner.R_l_o is not None and aligner.p_l_o is not None
    np.testing.assert_allclose(aligner.R_l_o, knows.up, atol=1e-9)
    np.testing.assert_allclose(aligner.R_l_o @ here[:3, 3] + aligner.p_l_o, here[:3, 3], atol=1e-9)
