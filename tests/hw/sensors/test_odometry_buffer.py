"""The odometry buffer, and batches in a log."""

from pathlib import Path

import numpy as np
import pytest

from kiteline_core.frame import UNMEASURED, Frame, ImuBatch, OdometryBatch
from kiteline_hw.logs.mcap_log import ODOMETER, LogReader, LogWriter
from kiteline_hw.ports import SourceError, SourceReport
from kiteline_hw.sensors.odometry_buffer import OdometerStream, insert_before_frames, reported_covariance

RNG = np.random.default_rng(3)


def batch(*t_ns: int) -> OdometryBatch:
    n = len(t_ns)
    cov = np.tile(0.01 * np.eye(3), (n, 1, 1))
    return OdometryBatch(np.array(t_ns, np.int64), RNG.normal(size=(n, 3)), RNG.normal(size=(n, 3)), cov, 2.0 * cov)


def same(a: OdometryBatch, b: OdometryBatch) -> bool:
    names = ("t_ns", "velocity", "rate", "velocity_cov", "rate_cov")
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in names)


def test_samples_up_to_a_frame_are_taken() -> None:
    stream = OdometerStream()
    stream.add(batch(10, 20))
    stream.add(batch(30))
    first, second = stream.take_until(20), stream.take_until(40)
    assert (first.t_ns.tolist(), second.t_ns.tolist()) == ([10, 20], [30])
    assert stream.take_until(100) is None


def test_late_repeated_and_broken_samples_are_counted() -> None:
    report = SourceReport()
    stream = OdometerStream(report)
    broken = batch(25)
    broken.velocity[0, 1] = np.nan
    for part in (batch(10, 20), batch(20, 15), broken, batch(30)):
        stream.add(part)
    taken = stream.take_until(100)
    assert taken.t_ns.tolist() == [10, 20, 30]
    assert report.skipped == {"odometer sample not plausible": 1, "odometer stamp not increasing": 2}


def test_odometry_is_inserted_before_its_frame() -> None:
    stream = OdometerStream()
    stream.add(batch(5, 15))
    image = np.zeros((2, 2), np.uint8)
    items = [ImuBatch(np.array([4]), np.zeros((1, 3)), np.zeros((1, 3))), Frame(10, image), Frame(20, image)]
    kinds = [type(item).__name__ for item in insert_before_frames(items, stream)]
    assert kinds == ["ImuBatch", "OdometryBatch", "Frame", "OdometryBatch", "Frame"]


def test_variances_reported_by_drivers() -> None:
    cov = reported_covariance(np.array([0.04, 0.0, 99999.0]), 0.1)
    np.testing.assert_allclose(cov.diagonal(), [0.04, 0.01, UNMEASURED])
    np.testing.assert_allclose(reported_covariance(np.full(3, np.nan), 0.1), 0.01 * np.eye(3))


def test_a_logged_batch_is_exact(tmp_path: Path) -> None:
    told = batch(100, 200, 300)
    with LogWriter(tmp_path / "log.mcap", {}) as log:
        log.odometer(ODOMETER, 300, told)
        log.blob("/other", 300, b"x")
    with LogReader(tmp_path / "log.mcap") as log:
        message, other = log.messages()
        assert same(message.odometry(), told)
        with pytest.raises(SourceError, match=r"not kiteline\.Odometry"):
            other.odometry()
