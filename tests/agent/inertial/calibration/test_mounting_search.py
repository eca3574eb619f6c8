"""Calibrations that are off by degrees, tenths of a second and decimetres are found in flight, on simulated samples."""

from dataclasses import replace

import numpy as np
import pytest

from kiteline_agent.inertial.calibration.lever_search import LeverSearch
from kiteline_agent.inertial.calibration.self_calibration import SelfCalibration
from kiteline_agent.inertial.inertial_config import SelfCalibrationConfig
from kiteline_agent.inertial.preintegration import Samples
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from tests.agent.inertial.calibration.test_imu_self_calibration import (
    ACCEL,
    CALIBRATION,
    GYRO,
    P_B_C,
    Flight,
    applied,
    calibrated,
    flight,
)


def turned(axis: tuple[float, float, float], degrees: float) -> F64:
    unit = np.array(axis) / np.linalg.norm(axis)
    return se3.so3_exp(np.radians(degrees) * unit)


def told_elsewhere(f: Flight, by_m: F64) -> Flight:
    """The flight of a body whose origin is told at -by_m in the IMU: the camera seems to be off by that."""
    return replace(f, seen=f.seen @ se3.from_rt(np.eye(3), -by_m))


def used(calibration: SelfCalibration) -> list[str]:
    return [event for event in calibration.take_events() if "used from now on" in event]


@pytest.mark.parametrize(
    ("axis", "degrees", "late_ms"),
    [((0, 0, 1), 5.0, 0), ((1, -1, 1), 10.0, 40), ((0, 1, 1), 3.0, 0), ((1, 0, 0), 0.0, 100), ((1, 0, 0), 0.0, -100)],
)
def test_a_turned_camera_and_a_late_one_are_found(
    axis: tuple[float, float, float], degrees: float, late_ms: int
) -> None:
    R = turned(axis, degrees)
    calibration = calibrated(flight(5.0, 0, R, R, 1_000_000 * late_ms))
    assert used(calibration) and not calibration.contradicts
    for matrix in applied(calibration):
        assert np.degrees(np.linalg.norm(se3.so3_log(matrix @ R))) < 0.5
    assert calibration.offset_s == pytest.approx(-1e-3 * late_ms, abs=2e-3)
    np.testing.assert_allclose(calibration.gyro.bias, 0.0, atol=0.02)


@pytest.mark.parametrize("by_m", [(0.2, -0.1, 0.1), (-0.3, 0.3, 0.0)])
def test_a_lever_arm_is_found(by_m: tuple[float, float, float]) -> None:
    lever_m = np.array(by_m)
    calibration = calibrated(told_elsewhere(flight(10.0, 0), lever_m), p_b_c=P_B_C + lever_m)
    assert used(calibration)
    samples = Samples(np.array([0.0, 0.1, 0.2]), np.array([[0.0, 0.0, 1.0]] * 3), np.zeros((3, 3)))
    about_z = calibration.correct(samples).accel[1]
    # the body is told to have its origin at -lever_m in the IMU, and is pulled inwards by the turn
    np.testing.assert_allclose(about_z[:2], lever_m[:2], atol=0.05)


def test_a_sound_rig_and_a_worn_one_are_not_searched() -> None:
    for seed in range(4):
        assert used(calibrated(flight(12.0, seed))) == []
        assert used(calibrated(flight(12.0, seed, GYRO, ACCEL, 4_000_000))) == []


def test_an_imu_that_no_mounting_explains_contradicts_the_images() -> None:
    f = flight(8.0)
    slow = replace(f.samples, t_ns=np.asarray(1.2 * f.samples.t_ns, np.int64))
    mirrored = replace(f.samples, gyro=f.samples.gyro * [-1.0, 1.0, 1.0])
    for samples in (slow, mirrored):
        assert calibrated(replace(f, samples=samples)).contradicts
    R = turned((0, 0, 1), 30.0)
    beyond = calibrated(flight(8.0, 0, R, R))
    assert beyond.contradicts and used(beyond) == []


def test_the_search_may_be_off() -> None:
    R = turned((0, 0, 1), 5.0)
    assert used(calibrated(flight(5.0, 0, R, R), replace(SelfCalibrationConfig(), apply_axes=False))) == []
    assert used(calibrated(flight(5.0, 0, R, R), metric=False)) == []


def test_the_next_flight_begins_with_a_found_mounting() -> None:
    R = turned((1, 0, 1), 6.0)
    known = calibrated(flight(6.0, 0, R, R, 50_000_000)).known()
    assert known is not None
    begun = SelfCalibration(CALIBRATION, SelfCalibrationConfig(), P_B_C, 9.81)
    begun.begin_with(known)
    for matrix in applied(begun):
        assert np.degrees(np.linalg.norm(se3.so3_log(matrix @ R))) < 1.0
    assert begun.offset_s == pytest.approx(-50e-3, abs=2e-3)
    assert used(calibrated(flight(6.0, 1, R, R, 50_000_000), known=known)) == []


def test_a_lever_search_in_a_map_that_is_turned_goes_on() -> None:
    rng = np.random.default_rng(3)
    lever_m, gravity, bias = np.array([0.2, -0.1, 0.3]), np.array([0.1, 0.2, -9.8]), np.array([0.05, -0.02, 0.1])
    search, R = LeverSearch(), np.eye(3)
    for k in range(16):
        if k == 8:
            turn = se3.so3_exp(np.array([0.4, -0.3, 1.0]))
            search.rotate_map(turn)
            R, gravity = turn, turn @ gravity
        by_lever, by_bias = R @ rng.normal(size=(3, 3)), -0.6 * R @ se3.so3_exp(rng.normal(size=3))
        error = by_lever @ lever_m + 0.6 * gravity + by_bias @ bias + 1e-3 * rng.normal(size=3)
        search.add(by_lever, 0.6, by_bias, error, 0.6)
    found = search.find()
    assert found is not None
    np.testing.assert_allclose(found, lever_m, atol=5e-3)
    search.clear()
    assert search.find() is None
