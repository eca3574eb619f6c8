"""Calibration of the IMU in flight, on simulated samples of worn and true IMUs."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from kiteline_agent.inertial.calibration.gyro_calibration import GyroCalibration
from kiteline_agent.inertial.calibration.known_imu import KnownImuConfig
from kiteline_agent.inertial.calibration.self_calibration import (
    _EXACTLY_S,
    _KEPT_OFFSET_SIGMA_S,
    _OFFSET_TRUSTED_S,
    SelfCalibration,
)
from kiteline_agent.inertial.calibration.window import Window
from kiteline_agent.inertial.inertial_config import SelfCalibrationConfig
from kiteline_agent.inertial.preintegration import Samples, TimeOffset, preintegrate
from kiteline_agent.inertial.samples.sample_buffer import SampleBuffer
from kiteline_core.arrays import F64, I64
from kiteline_core.frame import ImuBatch, ImuCalibration
from kiteline_core.geometry import se3
from kiteline_hw.sim.sensors import imu as sim_imu
from kiteline_hw.sim.world.built_in_paths import built_in_path
from kiteline_hw.sim.world.path import Path

CALIBRATION = ImuCalibration()
T_B_C = se3.from_rt(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.1, 0.03, -0.02]))
P_B_C = T_B_C[:3, 3].copy()
FRAME_NS, STEP_NS = 50_000_000, 5_000_000
HASTE = 0.4  # the course in so much of its time
GYRO = np.array([[1.010, 0.006, -0.004], [-0.007, 0.991, 0.005], [0.003, 0.006, 1.008]])
ACCEL = np.array([[0.990, -0.006, 0.005], [0.004, 1.011, 0.007], [-0.006, 0.003, 1.009]])


@dataclass
class Flight:
    """Poses by images at the stamps of frames, and all samples."""

    t_ns: I64
    seen: F64
    truth: F64
    samples: ImuBatch


def flight(
    seconds: float, seed: int = 0, gyro: F64 | None = None, accel: F64 | None = None, late_ns: int = 0,
    at_rest: bool = False, position_m: float = 5e-4,
) -> Flight:  # fmt: skip
    """A lively flight. gyro, accel: (3,3) with which the IMU measures. late_ns: stamps of frames after the exposure.

    position_m: error of a position by images.
    """
    rng = np.random.default_rng([seed, 5])
    path = built_in_path("room", (seconds + 3.0) / HASTE, T_B_C, 0)
    rest_s = seconds + 2.0 if at_rest else 0.0
    path = Path(path.coefficients, path.knot_s * HASTE, path.length_s * HASTE, 0.7, rest_s)
    exposed = np.arange(2, int(seconds * 1e9) // FRAME_NS, dtype=np.int64) * FRAME_NS
    stamps = np.arange(0, int(seconds * 1e9), STEP_NS, dtype=np.int64)
    measured = sim_imu.measure(path, stamps, 0, CALIBRATION, seed)
    rate = measured.gyro if gyro is None else measured.gyro @ gyro.T
    force = measured.accel if accel is None else measured.accel @ accel.T
    truth = path.motion(exposed * 1e-9).T_w_b
    errors = np.concatenate(
        [position_m * rng.normal(size=(len(exposed), 3)), 2e-4 * rng.normal(size=(len(exposed), 3))], 1
    )
    seen = np.array([T @ se3.exp(e) for T, e in zip(truth, errors, strict=True)])
    return Flight(exposed + late_ns, seen, truth, ImuBatch(stamps, rate, force))


def calibrated(
    f: Flight, config: SelfCalibrationConfig | None = None, turn_map_at: int | None = None,
    known: KnownImuConfig | None = None, *, metric: bool = True, p_b_c: F64 = P_B_C, depth_m: float = 3.0,
    corrected_at: int | None = None,
) -> SelfCalibration:  # fmt: skip
    """A calibration after a flight, in a map that is turned at a frame. known: from earlier flights. p_b_c: told.

    depth_m: of what the images see. corrected_at: frame at which the camera turns out to have been wrong until then.
    """
    calibration = SelfCalibration(CALIBRATION, config or SelfCalibrationConfig(), p_b_c, 9.81, metric=metric)
    if known is not None:
        calibration.begin_with(known)
    buffer, done, moved = SampleBuffer(3.0, 0.2), 0, np.eye(4)
    for k, (t_ns, T) in enumerate(zip(f.t_ns, f.seen, strict=True)):
        end = int(np.searchsorted(f.samples.t_ns, t_ns, "right"))
        buffer.push(ImuBatch(f.samples.t_ns[done:end], f.samples.gyro[done:end], f.samples.accel[done:end]))
        done = end
        if k == turn_map_at:
            moved = se3.from_rt(se3.so3_exp(np.array([0.2, -0.3, 1.0])), np.array([3.0, 1.0, -2.0]))
            calibration.move_map(moved)
        if k == corrected_at:
            calibration.forget_turns()
        calibration.add(int(t_ns), moved @ T, depth_m)
        calibration.update(buffer, moved[:3, :3] @ np.array([0.0, 0.0, -9.81]), 0.05)
    return calibration


def applied(calibration: SelfCalibration) -> tuple[F64, F64]:
    """The matrices (3,3) with which samples are corrected."""
    unit = Samples(np.arange(3.0), np.eye(3), np.eye(3))
    corrected = calibration.correct(unit)
    return corrected.gyro.T, corrected.accel.T


def test_window_integrals_agree_with_sums_of_matrices() -> None:
    rng = np.random.default_rng(1)
    n = 31
    t_s = np.concatenate([[0.0], np.cumsum(rng.uniform(0.003, 0.007, n - 1))])
    gyro, accel, bias = rng.normal(size=(n, 3)), rng.normal(size=(n, 3)), 0.1 * rng.normal(size=3)
    window = Window.of(Samples(t_s, gyro, accel), GYRO, bias, gyro[0], gyro[-1])
    r, by_rate, by_force, time = np.eye(3), np.zeros((3, 9)), np.zeros((2, 3, 9)), np.zeros((2, 3, 3))
    for k in range(n - 1):
        dt, rate, force = t_s[k + 1] - t_s[k], 0.5 * (gyro[k] + gyro[k + 1]), 0.5 * (accel[k] + accel[k + 1])
        after = r @ se3.so3_exp((GYRO @ rate - bias) * dt)
        mean = 0.5 * (r + after) * dt
        for weight, row in ((1.0, 0), (0.5 * (t_s[k] + t_s[k + 1]) / t_s[-1], 1)):
            by_force[row] += weight * np.kron(mean, force)
            time[row] += weight * mean
        by_rate += np.kron(mean, rate)
        r = after
    np.testing.assert_allclose(window.turn, r, atol=1e-12)
    np.testing.assert_allclose(window.by_rate, by_rate, atol=1e-12)
    np.testing.assert_allclose(window.by_force, by_force, atol=1e-12)
    np.testing.assert_allclose(window.time, time, atol=1e-12)


def test_window_integrals_are_the_derivative_of_the_rotation() -> None:
    samples = Samples(np.arange(31) * 0.005, np.random.default_rng(2).normal(size=(31, 3)), np.zeros((31, 3)))
    window = Window.of(samples, np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3))
    for i in range(9):
        step = np.zeros(9)
        step[i] = 1e-5
        turned = Samples(samples.t_s, samples.gyro @ (np.eye(3) + step.reshape(3, 3)).T, samples.accel)
        change = se3.so3_log(window.turn.T @ preintegrate(turned, np.zeros(6), CALIBRATION).turn) / 1e-5
        np.testing.assert_allclose(change, window.turn.T @ window.by_rate[:, i], atol=2e-3)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_worn_imu_is_found_and_corrected(seed: int) -> None:
    calibration = calibrated(flight(25.0, seed, GYRO, ACCEL, 4_000_000))
    gyro, _ = applied(calibration)
    wear = np.linalg.inv(GYRO) - np.eye(3)
    assert np.linalg.norm(gyro - np.eye(3) - wear) < np.linalg.norm(wear) / 3.0
    assert calibration.offset_s == pytest.approx(-4e-3, abs=1e-3)
    # the accelerometer's errors along gravity look like its bias: as wrong as it believes to be
    error = (calibration.accel.matrix - np.linalg.inv(ACCEL)).ravel()
    assert error @ np.linalg.solve(calibration.accel.axes_cov, error) < 33.7  # 99.99 % of 9 degrees of freedom
    error = (calibration.gyro.matrix - np.linalg.inv(GYRO)).ravel()
    assert error @ np.linalg.solve(calibration.gyro.axes_cov, error) < 33.7


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_camera_that_turned_against_the_imu_is_found(seed: int) -> None:
    """The camera defines the body's axes, so both sensors seem to have turned."""
    turned = se3.so3_exp(np.array([4e-3, -3e-3, 2e-3]))
    calibration = calibrated(flight(25.0, seed, turned, turned))
    gyro, _ = applied(calibration)
    assert np.linalg.norm(se3.so3_log(gyro @ turned)) < 1.8e-3
    assert calibration.camera_rotation_rad == pytest.approx(np.linalg.norm(se3.so3_log(turned)), rel=0.3)


@pytest.mark.parametrize("seed", range(4))
def test_a_true_imu_is_left_alone(seed: int) -> None:
    calibration = calibrated(flight(25.0, seed))
    samples = Samples(np.arange(3.0), np.eye(3), np.eye(3))
    assert calibration.correct(samples).gyro is samples.gyro
    assert calibration.correct(samples).accel is samples.accel
    assert abs(calibration.offset_s) < 5e-4
    assert calibration.camera_rotation_rad < 5e-4  # a rotation that is not clear is most likely none


def test_positions_by_far_landmarks_say_little_of_an_accelerometer() -> None:
    """At 40 m a tenth of a pixel is 9 mm, which says nothing against a true IMU."""
    believed_near = []
    for seed in range(3):
        f = flight(25.0, seed, position_m=9e-3)
        far, near = calibrated(f, depth_m=40.0), calibrated(f)
        assert far.report()["accel"]["applied"] is False and far.accel.disagreement.agrees
        believed_near.append(near.report()["accel"]["applied"] or not near.accel.disagreement.agrees)
        assert far.accel.scale[1] > near.accel.scale[1]
    assert any(believed_near)


def test_without_motion_nothing_is_learned() -> None:
    config = SelfCalibrationConfig()
    calibration = calibrated(flight(10.0, 1, GYRO, ACCEL, at_rest=True))
    samples = Samples(np.arange(3.0), np.eye(3), np.eye(3))
    assert calibration.correct(samples).gyro is samples.gyro
    assert calibration.offset_s == 0.0
    assert np.abs(calibration.gyro.matrix - np.eye(3)).max() < 0.2 * config.misalignment_sigma
    assert (np.sqrt(np.diag(calibration.gyro.axes_cov)) / config.axes_sigma).min() > 0.9
    assert calibration.gyro.offset_sigma_s > _OFFSET_TRUSTED_S  # gyro noise looks like some motion


def test_a_flight_begins_with_the_deviations_of_the_data_sheet() -> None:
    config = SelfCalibrationConfig(sensor_scale_sigma=0.03, misalignment_sigma=0.02)
    gyro = SelfCalibration(CALIBRATION, config, P_B_C, 9.81).gyro
    sigma = np.sqrt(np.diag(gyro.axes_cov)).reshape(3, 3)
    np.testing.assert_allclose(sigma, np.where(np.eye(3) > 0.0, 0.03, 0.02))


def test_a_map_that_is_moved_changes_nothing() -> None:
    f = flight(12.0, 3, GYRO, ACCEL)
    still, turned = calibrated(f), calibrated(f, turn_map_at=120)
    np.testing.assert_allclose(turned.gyro.matrix, still.gyro.matrix, atol=1e-9)
    # a pair of windows across the move is left out
    np.testing.assert_allclose(turned.accel.matrix, still.accel.matrix, atol=4e-3)


def test_the_report_names_what_was_found() -> None:
    calibration = calibrated(flight(25.0, 0, GYRO, ACCEL))
    report = calibration.report()
    assert report["gyro"]["applied"]
    np.testing.assert_allclose(report["gyro"]["scale"], np.diag(GYRO), atol=4e-3)
    np.testing.assert_allclose(report["gyro"]["matrix"], GYRO, atol=6e-3)
    events = calibration.take_events()
    assert [event.split(":")[0] for event in events] == ["gyro", "accelerometer"]
    assert "scale off by up to" in events[0]
    assert calibration.take_events() == []
    turned = se3.so3_exp(np.array([4e-3, -3e-3, 2e-3]))
    found = calibrated(flight(25.0, 0, turned, turned)).report()
    np.testing.assert_allclose(found["camera_rotation_deg"], np.degrees([4e-3, -3e-3, 2e-3]), atol=0.1)


def test_one_window_that_speaks_against_the_gyro_does_not_correct_it(monkeypatch: pytest.MonkeyPatch) -> None:
    measured = iter([0.0, 27.7, 17.7, 26.0, 9.0, *[0.0] * 1000])
    monkeypatch.setattr(GyroCalibration, "significance", lambda self: next(measured))
    assert not calibrated(flight(8.0)).report()["gyro"]["applied"]
    measured = iter([0.0, 27.7, 26.0, *[0.0] * 1000])
    assert calibrated(flight(8.0)).report()["gyro"]["applied"]


def test_a_map_begins_with_the_time_offset_of_its_start() -> None:
    """One that differs significantly is applied at once; not where only the configured one may be used."""
    for apply, found_s, applied_s in ((True, 0.02, 0.02), (True, 5e-4, 0.0), (False, 0.02, 0.0)):
        config = SelfCalibrationConfig(apply_offset=apply)
        calibration = SelfCalibration(CALIBRATION, config, P_B_C, 9.81, metric=False)
        assert calibration.applied_offset == TimeOffset(0.0, config.offset_sigma_s if apply else _EXACTLY_S)
        calibration.begin_with_offset(TimeOffset(found_s, 5e-4))
        assert calibration.offset_s == applied_s and calibration.gyro.offset_s == (found_s if apply else 0.0)
        sigma_s = np.hypot(5e-4, _KEPT_OFFSET_SIGMA_S) if apply else config.offset_sigma_s
        assert calibration.gyro.offset_sigma_s == pytest.approx(sigma_s)
        if apply:  # what is not applied may be off by that
            assert calibration.applied_offset.sigma_s >= found_s - applied_s


def test_the_offset_of_a_rig_file_is_doubted_until_a_flight_has_shown_it() -> None:
    config = SelfCalibrationConfig()
    calibration = SelfCalibration(CALIBRATION, config, P_B_C, 9.81, metric=False)
    calibration.begin_with(KnownImuConfig((0.01, 2e-4), *(tuple(np.eye(3).ravel()), (1e-3,) * 9)))
    assert calibration.applied_offset == TimeOffset(0.01, config.offset_sigma_s)
    calibration.begin_with_offset(TimeOffset(0.0, 5e-4))
    assert calibration.offset_s == 0.0
    assert calibration._unprimed_gyro is not None  # it knows nothing of the file, nor of a start that began with it
    assert calibration._unprimed_gyro.offset_sigma_s == config.offset_sigma_s


def test_axes_can_be_held() -> None:
    f = flight(12.0, 3, GYRO, ACCEL)
    held = calibrated(f, replace(SelfCalibrationConfig(), apply_axes=False))
    samples = Samples(np.arange(3.0), np.eye(3), np.eye(3))
    assert held.correct(samples).gyro is samples.gyro
    assert np.linalg.norm(held.gyro.matrix - np.eye(3)) > 0.01


def left(calibration: SelfCalibration, gyro: F64) -> float:
    """Share of the gyro's error that is left."""
    wear = np.linalg.inv(gyro) - np.eye(3)
    return float(np.linalg.norm(calibration.gyro.matrix - np.eye(3) - wear) / np.linalg.norm(wear))


def test_the_next_flight_begins_with_what_was_found_and_adds_to_it() -> None:
    short = [calibrated(flight(6.0, seed, GYRO, ACCEL, 4_000_000)) for seed in (4, 5)]
    known = short[0].known()
    begun = SelfCalibration(CALIBRATION, SelfCalibrationConfig(), P_B_C, 9.81)
    begun.begin_with(known)
    np.testing.assert_allclose(applied(begun)[0], short[0].gyro.matrix, atol=1e-5)
    assert begun.offset_s == pytest.approx(known.offset_s[0])
    second = calibrated(flight(6.0, 5, GYRO, ACCEL, 4_000_000), known=known)
    assert left(second, GYRO) < min(left(flown, GYRO) for flown in short)
    found = second.known()
    assert np.mean(np.square(found.gyro_sigma)) < np.mean(np.square(known.gyro_sigma))


def test_an_imu_that_was_replaced_is_found_anew() -> None:
    known = calibrated(flight(25.0, 0, GYRO, ACCEL, 4_000_000)).known()
    other = np.linalg.inv(GYRO)
    fresh, begun = (calibrated(flight(25.0, 1, other, late_ns=-3_000_000), known=k) for k in (None, known))
    assert any("calibrated anew" in event for event in begun.take_events())
    np.testing.assert_allclose(begun.gyro.matrix, fresh.gyro.matrix, atol=2e-3)
    assert begun.offset_s == pytest.approx(3e-3, abs=5e-4)
    np.testing.assert_allclose(applied(begun)[0], begun.gyro.matrix, atol=1e-3)
    # the same IMU is not refuted
    again = calibrated(flight(25.0, 1, GYRO, ACCEL, 4_000_000), known=known)
    assert not any("calibrated anew" in event for event in again.take_events())


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("wrong", [16, 24, 40])
def test_turns_by_a_camera_that_was_wrong_do_not_refute_the_imu(seed: int, wrong: int) -> None:
    known = calibrated(flight(25.0, 0, GYRO, ACCEL, 4_000_000)).known()
    again = flight(12.0, seed, GYRO, ACCEL, 4_000_000)
    first = again.seen[0, :3, :3].copy()
    for T in again.seen[:wrong]:
        T[:3, :3] = first @ se3.so3_exp(1.012 * se3.so3_log(first.T @ T[:3, :3]))
    left_in = calibrated(again, known=known)
    forgotten = calibrated(again, known=known, corrected_at=wrong)
    assert left(forgotten, GYRO) < min(0.2, left(left_in, GYRO))
    assert np.allclose(forgotten.accel.matrix, np.reshape(known.accel, (3, 3)), atol=3e-3)


def test_without_a_rig_file_what_was_learned_is_kept() -> None:
    lively = flight(12.0, 1, GYRO, ACCEL, 4_000_000)
    assert left(calibrated(lively, corrected_at=180), GYRO) < left(calibrated(lively), GYRO) + 0.05


def test_a_true_imu_is_left_alone_in_later_flights() -> None:
    known = None
    for _ in range(4):  # the same flight: its errors add up
        calibration = calibrated(flight(12.0, 2), known=known)
        known = calibration.known()
        assert calibration.take_events() == []


def test_what_a_flight_cannot_tell_is_kept() -> None:
    known = calibrated(flight(25.0, 0, GYRO, ACCEL)).known()
    assert SelfCalibration(CALIBRATION, SelfCalibrationConfig(), P_B_C, 9.81).known() is None
    monocular = calibrated(flight(12.0, 1, GYRO, ACCEL), known=known, metric=False).known()
    assert monocular.accel == known.accel
    resting = calibrated(flight(6.0, 1, GYRO, ACCEL, at_rest=True), known=known).known()
    np.testing.assert_allclose(resting.gyro, known.gyro, atol=5e-4)
    assert np.all(np.array(resting.gyro_sigma) > 0.9 * np.array(known.gyro_sigma))


def test_a_refuted_imu_leaves_nothing_behind() -> None:
    """Monocular, whose flights do not calibrate the accelerometer: what the file said of it was of another IMU."""
    known = calibrated(flight(25.0, 0, GYRO, ACCEL, 4_000_000)).known()
    assert known.accel
    replaced = calibrated(flight(25.0, 1, np.linalg.inv(GYRO), late_ns=-3_000_000), known=known, metric=False)
    assert any("calibrated anew" in event for event in replaced.take_events())
    found = replaced.known()
    assert found.accel == ()


def test_what_no_imu_can_be_is_not_kept() -> None:
    """Axes that are a quarter turn off, or a filter that has diverged: nothing is known, and nothing is raised."""
    calibration = calibrated(flight(6.0, 4, GYRO, ACCEL))
    known = calibration.known()
    assert known is not None
    calibration.accel._x[0] = 0.5
    found = calibration.known()
    assert found.accel == () and found.gyro == known.gyro
    for index, value in ((0, 0.3), (9, -0.7), (4, np.nan)):
        calibration.gyro._x[:] = 0.0
        calibration.gyro._x[index] = value
        assert calibration.known() is None
