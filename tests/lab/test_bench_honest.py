"""The judge of honest poses: what it calls an error, what faults do, and that a small flight keeps the bars."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from kiteline_bench.harness.honest_flights import FAULTS, Shown, _error, no_texture
from kiteline_core.frame import Frame, ImuBatch
from kiteline_core.geometry import se3


def shown(k: int) -> Shown:
    image = np.full((8, 8), 60 + k, np.uint8)
    stamps = np.array([k * 50 - 25, k * 50], np.int64) * 1_000_000
    return Shown(Frame(k * 50_000_000, image, image.copy()), ImuBatch(stamps, np.zeros((2, 3)), np.zeros((2, 3))),
                 np.eye(4))  # fmt: skip


def test_an_error_is_told_as_the_covariance_tells_it() -> None:
    start, truth0 = (
        se3.exp(np.array([1.0, 2.0, 3.0, 0.3, -0.2, 1.0])),
        se3.exp(np.array([0.0, 5.0, 1.0, 0.0, 0.1, 2.0])),
    )
    motion = se3.exp(np.array([0.5, 0.1, -0.2, 0.4, 0.1, 0.3]))
    np.testing.assert_allclose(_error((start, truth0), start @ motion, truth0 @ motion), 0.0, atol=1e-12)
    found = start @ motion
    moved = found.copy()
    moved[:3, 3] += [0.1, 0.2, -0.3]
    np.testing.assert_allclose(_error((start, truth0), moved, truth0 @ motion), [0.1, 0.2, -0.3, 0, 0, 0], atol=1e-12)
    turned = found @ se3.exp(np.array([0.0, 0.0, 0.0, 0.01, 0.02, 0.03]))
    error = _error((start, truth0), turned, truth0 @ motion)
    np.testing.assert_allclose(error, [0, 0, 0, 0.01, 0.02, 0.03], atol=1e-9)


def test_faults_keep_stamps_in_order_and_lose_no_samples() -> None:
    items = [shown(k) for k in range(160)]
    samples = sum(len(s.imu.t_ns) for s in items if s.imu is not None)
    for name, fault in FAULTS.items():
        out = fault(list(items))
        stamps = [s.frame.t_ns for s in out]
        assert stamps == sorted(set(stamps)), name
        assert sum(len(s.imu.t_ns) for s in out if s.imu is not None) == samples, name
        same = all(np.array_equal(a.frame.left, b.frame.left) for a, b in zip(items, out)) and len(out) == len(items)
        assert same == (name in ("none", "one eye only, 1 s")), name
    assert FAULTS["one eye only, 1 s"](list(items))[85].frame.right is None
    blank = no_texture(list(items), 20, 30)
    assert blank[19].frame is items[19].frame and blank[50].frame is items[50].frame
    assert abs(float(blank[20].frame.left.mean()) - 128.0) < 2.0


def test_a_flight_is_the_same_each_time(data_dir: Path, tmp_path: Path) -> None:
    from kiteline_bench.harness.honest_flights import flight

    a, b = (flight(1, data_dir / "trajectories", tmp_path, 0.1, 0.5) for _ in "ab")
    assert len(a.items) == 10 and a.items[9].frame.left.tobytes() == b.items[9].frame.left.tobytes()
    assert a.items[3].imu is not None and a.imu.rate_hz == 200.0
