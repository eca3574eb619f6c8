"""The guided motion of camera and IMU: which motion is wanted, and the verdict."""

from dataclasses import replace

import numpy as np
import pytest

from kiteline_agent.inertial.calibration.known_imu import KnownImuConfig
from kiteline_core.geometry import se3
from kiteline_lab.calibration.imu_guide import ImuProgress
from kiteline_lab.calibration.verdict import overall

UNIT = tuple(np.eye(3).ravel().tolist())
R_c_b = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # the body: forward, left, up


def sigma(*columns: float) -> tuple[float, ...]:
    return tuple(np.tile(columns, (3, 1)).ravel().tolist())


GOOD = ImuProgress(
    KnownImuConfig((0.004, 2e-4), UNIT, sigma(2e-3, 2e-3, 2e-3), UNIT, sigma(3e-3, 3e-3, 3e-3)), R_c_b, True, 300, 299
)


def but(**fields: object) -> ImuProgress:
    assert GOOD.known is not None
    return replace(GOOD, known=replace(GOOD.known, **fields))


def test_nothing_is_wanted_once_all_is_known() -> None:
    assert GOOD.wanted() == "" and overall(GOOD.findings()) == "good"
    assert any("+4.00 ms" in f.text for f in GOOD.findings())


@pytest.mark.parametrize(
    ("progress", "word"),
    [
        (replace(GOOD, known=None), "hold it still"),
        (but(gyro_sigma=sigma(2e-3, 4e-3, 3e-3)), "nod"),  # the body's left is the camera's right axis
        (but(gyro_sigma=sigma(4e-3, 2e-3, 3e-3)), "roll"),  # forward
        (but(gyro_sigma=sigma(2e-3, 2e-3, 3e-3)), "pan"),  # up
        (but(offset_s=(0.004, 2e-3)), "to and fro quickly"),
        (but(accel_sigma=sigma(9e-3, 3e-3, 3e-3)), "look up, then down"),
        (but(accel_sigma=sigma(3e-3, 9e-3, 3e-3)), "left side"),
        (but(accel=(), accel_sigma=()), "hold it still there"),
        (replace(GOOD, tracked=100), "texture"),
    ],
)
def test_the_motion_that_tells_most_is_wanted(progress: ImuProgress, word: str) -> None:
    assert word in progress.wanted() and word in progress.note()
    if progress.known is None:
        assert overall(progress.findings()) == "bad"
    else:
        assert overall(progress.findings()) == "poor" and all(f.mend for f in progress.findings() if f.level != "good")


def test_one_eye_is_not_asked_for_what_it_cannot_tell() -> None:
    progress = replace(but(accel=(), accel_sigma=()), metric=False)
    assert progress.wanted() == ""
    assert [f.text for f in progress.findings() if f.level == "poor"] == ["accelerometer: not compared"]


def test_a_rig_that_is_turned_otherwise_than_told_is_not_kept() -> None:
    turned = se3.so3_exp(np.radians([0.0, 7.0, 2.0]))
    progress = but(gyro=tuple(turned.ravel().tolist()))
    assert overall(progress.findings()) == "bad" and any(
        "7.2" in f.text or "7.3" in f.text for f in progress.findings()
    )
