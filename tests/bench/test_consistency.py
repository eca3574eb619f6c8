"""Errors of poses against the truth, faults in mid-flight, and random flights."""

from pathlib import Path

import numpy as np

from kiteline_bench.harness.faults import FAULTS_IN_MID_FLIGHT, changed, wall
from kiteline_bench.harness.recording import Item, Recording
from kiteline_bench.harness.result import pose_error
from kiteline_bench.harness.simulated import random_flight
from kiteline_core.frame import Frame, ImuBatch
from kiteline_core.geometry import se3
from kiteline_hw.sim.sensors.rig import make_rig


def item(k: int) -> Item:
    image = np.full((8, 8), 60 + k, np.uint8)
    stamps = np.array([k * 50 - 25, k * 50], np.int64) * 1_000_000
    imu = ImuBatch(stamps, np.zeros((2, 3)), np.zeros((2, 3)))
    return Item(Frame(k * 50_000_000, image, image.copy()), imu, T_w_b=np.eye(4))


def test_an_error_has_the_axes_of_the_covariance() -> None:
    start, truth0 = (
        se3.exp(np.array([1.0, 2.0, 3.0, 0.3, -0.2, 1.0])),
        se3.exp(np.array([0.0, 5.0, 1.0, 0.0, 0.1, 2.0])),
    )
    motion = se3.exp(np.array([0.5, 0.1, -0.2, 0.4, 0.1, 0.3]))
    np.testing.assert_allclose(pose_error((start, truth0), start @ motion, truth0 @ motion), 0.0, atol=1e-12)
    found = start @ motion
    moved = found.copy()
    moved[:3, 3] += [0.1, 0.2, -0.3]
    np.testing.assert_allclose(
        pose_error((start, truth0), moved, truth0 @ motion), [0.1, 0.2, -0.3, 0, 0, 0], atol=1e-12
    )
    rotated = found @ se3.exp(np.array([0.0, 0.0, 0.0, 0.01, 0.02, 0.03]))
    error = pose_error((start, truth0), rotated, truth0 @ motion)
    np.testing.assert_allclose(error, [0, 0, 0, 0.01, 0.02, 0.03], atol=1e-9)


def test_faults_keep_stamps_in_order_and_lose_no_samples() -> None:
    items = tuple(item(k) for k in range(160))
    recording = Recording(make_rig(), None, items)
    samples = sum(len(i.imu.t_ns) for i in items if i.imu is not None)
    for name, fault in FAULTS_IN_MID_FLIGHT.items():
        out = fault(recording).items
        stamps = [i.frame.t_ns for i in out]
        assert stamps == sorted(set(stamps)), name
        assert sum(len(i.imu.t_ns) for i in out if i.imu is not None) == samples, name
        same = len(out) == len(items) and all(np.array_equal(a.frame.left, b.frame.left) for a, b in zip(items, out))
        assert same == (name in ("none", "left image only, 1 s")), name
    assert FAULTS_IN_MID_FLIGHT["left image only, 1 s"](recording).items[85].frame.right is None
    blank = changed(recording, 20, 50, wall).items
    assert blank[19].frame is items[19].frame and blank[50].frame is items[50].frame
    assert abs(float(blank[20].frame.left.mean()) - 120.0) < 2.0


def test_a_random_flight_is_the_same_each_time(data_dir: Path, tmp_path: Path) -> None:
    coarse = {"texture_bits": 6}  # drawing the walls takes 5 s otherwise
    a, b = (random_flight(1, data_dir / "trajectories", tmp_path, 0.1, 0.5, **coarse).recording for _ in range(2))
    assert len(a.items) == 10 and a.items[9].frame.left.tobytes() == b.items[9].frame.left.tobytes()
    assert a.items[3].imu is not None and a.imu is not None and a.imu.rate_hz == 200.0
