"""Odometry on its way in: samples until a frame claims them, the simulated odometer, logs that keep every bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from kiteline_core import odometry
from kiteline_core.frame import UNMEASURED, Frame, ImuBatch, OdometryBatch
from kiteline_hw.logs.mcap_log import ODOMETER, LogReader, LogWriter
from kiteline_hw.ports import SourceError, SourceReport
from kiteline_hw.sensors.odometry_buffer import OdometerStream, insert_before_frames, reported_covariance
from kiteline_hw.sim.source import SimSource, open_sim
from kiteline_hw.sources.open import open_source

RNG = np.random.default_rng(3)


def batch(*t_ns: int) -> OdometryBatch:
    n = len(t_ns)
    cov = np.tile(0.01 * np.eye(3), (n, 1, 1))
    return OdometryBatch(np.array(t_ns, np.int64), RNG.normal(size=(n, 3)), RNG.normal(size=(n, 3)), cov, 2.0 * cov)


def same(a: OdometryBatch, b: OdometryBatch) -> bool:
    names = ("t_ns", "velocity", "rate", "velocity_cov", "rate_cov")
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in names)


def test_a_frame_claims_what_came_before_it() -> None:
    stream = OdometerStream()
    stream.add(batch(10, 20))
    stream.add(batch(30))
    first, second = stream.take_until(20), stream.take_until(40)
    assert first is not None
    assert second is not None
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
    assert taken is not None
    assert taken.t_ns.tolist() == [10, 20, 30]
    assert report.skipped == {"odometer sample not finite": 1, "odometer stamp not increasing": 2}


def test_odometry_comes_right_before_its_frame() -> None:
    stream = OdometerStream()
    stream.add(batch(5, 15))
    image = np.zeros((2, 2), np.uint8)
    items = [ImuBatch(np.array([4]), np.zeros((1, 3)), np.zeros((1, 3))), Frame(10, image), Frame(20, image)]
    kinds = [type(item).__name__ for item in insert_before_frames(items, stream)]
    assert kinds == ["ImuBatch", "OdometryBatch", "Frame", "OdometryBatch", "Frame"]


def test_variances_as_drivers_state_them() -> None:
    cov = reported_covariance(np.array([0.04, 0.0, 99999.0]), 0.1)
    np.testing.assert_allclose(cov.diagonal(), [0.04, 0.01, UNMEASURED])
    np.testing.assert_allclose(reported_covariance(np.full(3, np.nan), 0.1), 0.01 * np.eye(3))


def test_a_log_keeps_every_bit(tmp_path: Path) -> None:
    told = batch(100, 200, 300)
    with LogWriter(tmp_path / "log.mcap", {}) as log:
        log.odometer(ODOMETER, 300, told)
        log.blob("/other", 300, b"x")
    with LogReader(tmp_path / "log.mcap") as log:
        message, other = log.messages()
        assert same(message.odometry(), told)
        with pytest.raises(SourceError, match=r"not kiteline\.Odometry"):
            other.odometry()


# the simulator


def simulated(**options: object) -> SimSource:
    return open_sim("room", seconds=6.0, seed=2, texture_bits=6, scale=0.1, odometry=50.0, **options)


def true_velocity(source: SimSource, t_ns: np.ndarray) -> np.ndarray:
    """Of the body in its own axes, by differences of its true places."""
    t_s = (t_ns - 1_000_000_000) * 1e-9
    before, at, after = (source.path.motion(t_s + d).T_w_b for d in (-1e-4, 0.0, 1e-4))
    return np.einsum("nji,nj->ni", at[:, :3, :3], (after[:, :3, 3] - before[:, :3, 3]) / 2e-4)


def test_the_simulated_odometer_tells_the_truth_but_for_its_noise() -> None:
    source = simulated(odometry_noise=0.03, odometry_scale=1.05)
    told = source.odometry()
    assert told is not None
    assert np.diff(told.t_ns).tolist() == [20_000_000] * (len(told.t_ns) - 1)
    rest = told.velocity - 1.05 * true_velocity(source, told.t_ns)
    assert rest.std() == pytest.approx(0.03, rel=0.15)
    np.testing.assert_allclose(told.velocity_cov[0], 0.03**2 * np.eye(3))


def test_slips_are_rare_and_fast() -> None:
    source = simulated(odometry_noise=0.0, odometry_slip=0.25)
    told = source.odometry()
    assert told is not None
    truth = true_velocity(source, told.t_ns)
    moving = np.linalg.norm(truth, axis=1) > 0.1
    factor = np.linalg.norm(told.velocity, axis=1)[moving] / np.linalg.norm(truth, axis=1)[moving]
    slipping = factor > 1.05
    assert 0.0 < slipping.mean() < 0.6
    assert factor[slipping].min() > 1.25
    np.testing.assert_allclose(factor[~slipping], 1.0, atol=1e-3)


def test_wheels_measure_along_the_view_alone() -> None:
    source = simulated(odometry_noise=0.0, odometry_wheels=True)
    told = source.odometry()
    assert told is not None
    ahead = source.rig.T_b_c[:3, 2]
    np.testing.assert_allclose(told.velocity @ ahead, true_velocity(source, told.t_ns) @ ahead, atol=1e-4)
    assert np.linalg.norm(told.velocity - np.outer(told.velocity @ ahead, ahead)) < 1e-9
    variance = ahead @ told.velocity_cov[0] @ ahead
    assert variance < 0.1
    assert np.trace(told.velocity_cov[0]) - variance == pytest.approx(2 * UNMEASURED)


def test_a_simulated_flight_without_an_odometer_has_none_and_looks_the_same() -> None:
    plain, driven = open_sim("room", seconds=0.2, scale=0.1, texture_bits=6), simulated()
    assert not any(isinstance(item, OdometryBatch) for item in plain)
    assert any(isinstance(item, OdometryBatch) for item in driven)


def test_odd_odometry_is_refused() -> None:
    with pytest.raises(SourceError, match="0 to 1000 Hz"):
        open_sim("room?odometry=-1")


def test_a_recorded_flight_gives_its_odometry_again(tmp_path: Path) -> None:
    source = simulated()
    path = tmp_path / "flight.mcap"
    with LogWriter(path, {"role": "recording"}) as log:
        log.rig(1_000_000_000, source.rig, source.imu)
        for item in source:
            if isinstance(item, OdometryBatch):
                log.odometer(ODOMETER, int(item.t_ns[-1]), item)
            elif isinstance(item, Frame):
                log.frame(item)
    read = [item for item in open_source(str(path), imu=False) if isinstance(item, OdometryBatch)]
    told, whole = odometry.joined(read), source.odometry()
    assert told is not None
    assert whole is not None
    assert same(told, whole)
