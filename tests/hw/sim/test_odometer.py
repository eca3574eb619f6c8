"""The simulated odometer."""

from pathlib import Path

import numpy as np
import pytest

from kiteline_core import odometry
from kiteline_core.frame import UNMEASURED, Frame, OdometryBatch
from kiteline_hw.logs.mcap_log import ODOMETER, LogWriter
from kiteline_hw.ports import SourceError
from kiteline_hw.sim.source import SimSource, open_sim
from kiteline_hw.sources.open import open_source


def same(a: OdometryBatch, b: OdometryBatch) -> bool:
    names = ("t_ns", "velocity", "rate", "velocity_cov", "rate_cov")
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in names)


def simulated(**options: object) -> SimSource:
    return open_sim("room", seconds=6.0, seed=2, texture_bits=6, scale=0.1, odometry=50.0, **options)


def true_velocity(source: SimSource, t_ns: np.ndarray) -> np.ndarray:
    """Of the body in its own axes, by differences of its true places."""
    t_s = (t_ns - 1_000_000_000) * 1e-9
    before, at, after = (source.path.motion(t_s + d).T_w_b for d in (-1e-4, 0.0, 1e-4))
    return np.einsum("nji,nj->ni", at[:, :3, :3], (after[:, :3, 3] - before[:, :3, 3]) / 2e-4)


def test_the_odometer_measures_the_true_motion_with_noise() -> None:
    source = simulated(odometry_noise=0.03, odometry_scale=1.05)
    told = source.odometry()
    assert np.diff(told.t_ns).tolist() == [20_000_000] * (len(told.t_ns) - 1)
    rest = told.velocity - 1.05 * true_velocity(source, told.t_ns)
    assert rest.std() == pytest.approx(0.03, rel=0.15)
    np.testing.assert_allclose(told.velocity_cov[0], 0.03**2 * np.eye(3))


def test_slips_are_rare_and_fast() -> None:
    source = simulated(odometry_noise=0.0, odometry_slip=0.25)
    told = source.odometry()
    truth = true_velocity(source, told.t_ns)
    moving = np.linalg.norm(truth, axis=1) > 0.1
    factor = np.linalg.norm(told.velocity, axis=1)[moving] / np.linalg.norm(truth, axis=1)[moving]
    slipping = factor > 1.05
    assert 0.0 < slipping.mean() < 0.6
    assert factor[slipping].min() > 1.25
    np.testing.assert_allclose(factor[~slipping], 1.0, atol=1e-3)


def test_wheels_measure_along_the_optical_axis_only() -> None:
    source = simulated(odometry_noise=0.0, odometry_wheels=True)
    told = source.odometry()
    ahead = source.rig.T_b_c[:3, 2]
    np.testing.assert_allclose(told.velocity @ ahead, true_velocity(source, told.t_ns) @ ahead, atol=1e-4)
    assert np.linalg.norm(told.velocity - np.outer(told.velocity @ ahead, ahead)) < 1e-9
    variance = ahead @ told.velocity_cov[0] @ ahead
    assert variance < 0.1
    assert np.trace(told.velocity_cov[0]) - variance == pytest.approx(2 * UNMEASURED)


def test_the_odometer_changes_no_image() -> None:
    options = {"seconds": 0.2, "seed": 2, "scale": 0.1, "texture_bits": 6}
    plain, measured = list(open_sim("room", **options)), list(open_sim("room", odometry=50.0, **options))
    assert not any(isinstance(item, OdometryBatch) for item in plain)
    assert any(isinstance(item, OdometryBatch) for item in measured)
    images = [[item.left.tobytes() for item in items if isinstance(item, Frame)] for items in (plain, measured)]
    assert len(images[0]) == 4 and images[0] == images[1]


def test_invalid_odometry_options() -> None:
    with pytest.raises(SourceError, match="0 to 1000 Hz"):
        open_sim("room?odometry=-1")


def test_odometry_of_a_recorded_flight_is_read_back(tmp_path: Path) -> None:
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
