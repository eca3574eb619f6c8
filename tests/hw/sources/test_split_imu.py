"""Bags whose gyroscope and accelerometer have topics of their own, and inertial topics that cannot be used."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from kiteline_core.frame import Frame, ImuBatch
from kiteline_hw.ports import SourceReport
from kiteline_hw.sensors.split_imu import ImuJoiner, join_imu
from kiteline_hw.sources.open import open_source
from tests.hw.sources.camera_messages import START_NS, STEP_NS, T_B_L, T_L_R, read, xyz
from tests.hw.sources.ros2_bags import Bag, check_stereo, stereo_bag

MS = 1_000_000
GYRO, ACCEL = "/camera/gyro/sample", "/camera/accel/sample"


def half(bag: Bag, topic: str, frame: str, t_ns: int, rate: np.ndarray, accel: np.ndarray, lag_ns: int = 0) -> None:
    """As RealSense's driver sends it: the other half is zero, and there is no orientation."""
    nine = [0.01, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.01]
    bag.add(
        t_ns, topic, "sensor_msgs/msg/Imu", frame, lag_ns, orientation={"x": 0.0, "y": 0.0, "z": 0.0, "w": 0.0},
        orientation_covariance=[-1.0, *nine[1:]], angular_velocity=xyz(rate), angular_velocity_covariance=nine,
        linear_acceleration=xyz(accel), linear_acceleration_covariance=nine,
    )  # fmt: skip


def rate_at(t_ns: int) -> np.ndarray:
    return np.array([0.1, 0.2, 0.3]) + (t_ns - START_NS) * 1e-9


def accel_at(t_ns: int) -> np.ndarray:
    """Linear in time, so that interpolation is exact."""
    return np.array([1.0, -2.0, 9.8]) + np.array([3.0, 5.0, -4.0]) * (t_ns - START_NS) * 1e-9


def images(n: int, tf: bool = True) -> Bag:
    bag = Bag()
    if tf:
        bag.tf(START_NS, "gyro", "left_optical", T_B_L)
        bag.tf(START_NS, "left_optical", "right_optical", T_L_R)
    bag.info(START_NS, "left", tx=0.0)
    bag.info(START_NS, "right", tx=-6.6)
    for i in range(n):
        bag.image(START_NS + i * STEP_NS, "right", 100 + i)
        bag.image(START_NS + i * STEP_NS, "left", i)
    return bag


def split_bag(
    n: int = 10, gap: range = range(0), gyro: bool = True, accel: bool = True, accel_lag_ns: int = 0, turn: bool = False
) -> Bag:
    """n images at 20 Hz, rates at 400 Hz from 1 ms on, accelerations at 63 Hz. gap: missing ones by number."""
    bag = images(n)
    zero = np.zeros(3)
    R = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]) if turn else np.eye(3)
    T = np.eye(4)
    T[:3, :3] = R
    bag.tf(START_NS, "gyro", "accel", T)
    end_ns = START_NS + (n - 1) * STEP_NS
    if gyro:
        for t in range(START_NS + MS, end_ns, 2_500_000):
            half(bag, GYRO, "gyro", t, rate_at(t), zero)
    if accel:
        for k, t in enumerate(range(START_NS + 4 * MS, end_ns, 15_873_000)):
            if k not in gap:
                half(bag, ACCEL, "accel", t, zero, R.T @ accel_at(t), accel_lag_ns)
    bag.messages.sort(key=lambda m: m[0])
    return bag


@pytest.mark.parametrize(("lag_ms", "turn"), [(0, False), (90, False), (-90, True)])
def test_accelerations_are_interpolated_at_the_stamps_of_the_gyroscope(tmp_path: Path, lag_ms: int, turn: bool) -> None:
    source = open_source(str(split_bag(accel_lag_ns=lag_ms * MS, turn=turn).write(tmp_path / "a.mcap")))
    frames, batches = read(source)
    assert len(frames) == 10 and source.imu is not None and source.imu.rate_hz == pytest.approx(400, rel=0.25)
    np.testing.assert_allclose(source.rig.T_b_c, T_B_L, atol=1e-12)
    t = np.concatenate([b.t_ns for b in batches])
    # From the first acceleration to the last one, each rate is a sample.
    last_accel = max(range(START_NS + 4 * MS, START_NS + 9 * STEP_NS, 15_873_000))
    rates = [s for s in range(START_NS + MS, START_NS + 9 * STEP_NS, 2_500_000) if START_NS + 4 * MS <= s <= last_accel]
    assert t.tolist() == rates
    np.testing.assert_allclose(np.concatenate([b.gyro for b in batches]), [rate_at(s) for s in rates], rtol=1e-12)
    np.testing.assert_allclose(np.concatenate([b.accel for b in batches]), [accel_at(s) for s in rates], atol=1e-9)
    items = list(source)
    for before, after in pairwise(items):  # every frame has all samples up to its own time
        if isinstance(before, Frame) and isinstance(after, ImuBatch):
            assert after.t_ns[0] > before.t_ns
    assert any(ACCEL in note and GYRO in note for note in source.report.notes)
    assert not source.report.skipped


def test_a_gap_in_the_accelerations_makes_no_samples(tmp_path: Path) -> None:
    source = open_source(str(split_bag(20, gap=range(20, 25)).write(tmp_path / "a.mcap")))
    _, batches = read(source)
    t = np.concatenate([b.t_ns for b in batches])
    gap_ns = [START_NS + 4 * MS + k * 15_873_000 for k in (19, 25)]
    assert not ((t > gap_ns[0]) & (t < gap_ns[1])).any() and np.diff(t).max() > 90 * MS
    assert np.sort(np.diff(t))[:-1].max() == 2_500_000
    assert source.report.skipped == {"imu sample without acceleration": 38}


def test_an_accelerometer_that_stops_keeps_no_images_waiting() -> None:
    report = SourceReport()
    seen: list[int] = []

    def items() -> list[tuple[int, int, object]]:
        out: list[tuple[int, int, object]] = [(0, 2, (0.0,) * 3 + (9.8,) * 3)]
        for t in range(0, 5000 * MS, 5 * MS):
            out.append((t + 1, 1, (0.1,) * 6))
            out.append((t + 2, 3, "image"))
        return out

    most = 0
    for t, _, _ in join_imu((seen.append(i[0]) or i for i in items()), 1, 2, ImuJoiner(report)):  # type: ignore[func-returns-value]
        most = max(most, seen[-1] - t)
    assert most < 200 * MS and report.skipped["imu sample without acceleration"] > 900


def test_one_topic_with_both_is_preferred(tmp_path: Path) -> None:
    bag = stereo_bag()
    for i in range(100):
        half(bag, GYRO, "imu", START_NS + i * MS, np.full(3, 5.0), np.zeros(3))
        half(bag, ACCEL, "imu", START_NS + i * MS, np.zeros(3), np.full(3, 5.0))
    bag.messages.sort(key=lambda m: m[0])
    check_stereo(open_source(str(bag.write(tmp_path / "a.mcap"))))


def test_an_imu_without_a_transform_gives_way_to_one_that_has_it(tmp_path: Path) -> None:
    bag = stereo_bag()
    for i in range(300):
        half(bag, "/mavros/imu/data", "base_link", START_NS + i * MS, np.full(3, 5.0), np.full(3, 5.0))
    bag.messages.sort(key=lambda m: m[0])
    check_stereo(open_source(str(bag.write(tmp_path / "a.mcap"))))


@pytest.mark.parametrize(
    ("gyro", "accel", "said"),
    [
        (True, False, f"{GYRO} has no accelerations: record"),
        (False, True, f"{ACCEL} has no angular velocities: record"),
    ],
)
def test_half_an_imu_is_left_out_and_it_is_said(tmp_path: Path, gyro: bool, accel: bool, said: str) -> None:
    source = open_source(str(split_bag(gyro=gyro, accel=accel).write(tmp_path / "a.mcap")))
    assert source.imu is None and not read(source)[1]
    assert any(said in note for note in source.report.notes)


def test_an_imu_that_measures_nothing_is_left_out_and_it_is_said(tmp_path: Path) -> None:
    bag = images(3)
    for i in range(20):
        half(bag, "/imu", "gyro", START_NS + i * 5 * MS, np.zeros(3), np.zeros(3))
    source = open_source(str(bag.write(tmp_path / "a.mcap")))
    assert source.imu is None and not read(source)[1]
    assert any("/imu holds zeros only" in note for note in source.report.notes)


def test_a_gyroscope_at_rest_is_no_missing_one(tmp_path: Path) -> None:
    bag = images(10)
    for i in range(100):
        half(bag, "/imu", "gyro", START_NS + i * 5 * MS, np.full(3, 0.5 * (i > 60)), np.full(3, 5.0))
    bag.messages.sort(key=lambda m: m[0])
    assert open_source(str(bag.write(tmp_path / "a.mcap"))).imu is not None
