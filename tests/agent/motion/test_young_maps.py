"""The map of one camera is young where the odometer tells its metre: its unit may still change by tens of percent."""

import numpy as np
import pytest

from kiteline_agent.config import OdometerConfig
from kiteline_agent.motion.odometer import Odometer
from kiteline_agent.motion.odometer_scale import OdometerScale
from kiteline_agent.motion.unit_scale import UnitScale
from kiteline_core.arrays import F64
from tests.agent.motion.test_odometer_scale import DT_S, NOISE_M_S, driven


def moved(k: int, metres: float = 0.2) -> F64:
    return metres * np.array([np.cos(0.3 * k), np.sin(0.3 * k), 0.1])


def test_a_unit_that_has_just_changed_is_not_known() -> None:
    """Of seven windows two differ, the newest ones: left out as outliers they would make it certain, and wrong."""
    unit, units = UnitScale(), [0.50, 0.51, 0.50, 0.505, 0.50, 0.62, 0.63]
    for k, metres in enumerate(units[:5]):
        unit.add(moved(k), moved(k) / metres)
    found = unit.metres_per_unit()
    assert found is not None and found[0] == pytest.approx(0.503, abs=0.005)
    for k, metres in enumerate(units[5:], 5):
        unit.add(moved(k), moved(k) / metres)
    assert unit.metres_per_unit() is None
    for k in range(7, 9):  # two outliers that have passed: a slip
        unit.add(moved(k), moved(k) / 0.5)
    assert unit.metres_per_unit() is not None


def test_a_young_map_that_shrinks_at_once_is_corrected_within_seconds() -> None:
    scale = OdometerScale(of_map=True)
    scale.begin(1.0)
    driven(scale, 1.4, 0.8)
    assert scale.correction(believed=True) is None
    driven(scale, 0.8, 0.8)
    found = scale.correction(believed=True)
    assert found is not None and found[0] == pytest.approx(1.25, rel=0.1)
    old = OdometerScale(of_map=True)
    driven(old, 20.0)
    driven(old, 1.0, 0.94)  # a map that has been right for long does not move as fast
    assert old.correction(believed=True) is None


def compared(odometer: Odometer, seconds: float, length: float) -> None:
    """Windows whose images see so many times the odometer's lengths."""
    for k in range(round(seconds / DT_S)):
        odometer._compare_displacements(moved(k), length * moved(k), 3.0, DT_S)


def test_a_map_that_collapsed_is_scaled_although_the_odometer_is_no_longer_believed() -> None:
    odometer = Odometer(np.eye(4), OdometerConfig(), metric=False)
    odometer.set_metric(metric=True)
    compared(odometer, 10.0, 1.0)
    assert odometer.trusted and odometer.deviation < 0.05
    compared(odometer, 2.4, 2.1)
    assert not odometer.trusted and odometer.deviation > 0.8  # poses say so
    assert odometer.scale_correction() is None  # wheels that slip do so for some seconds
    compared(odometer, 4.0, 2.1)
    found = odometer.scale_correction()
    assert found is not None and found[0] == pytest.approx(1.0 / 2.1, rel=0.02)
    odometer.set_metric(metric=True, factor=found[0])
    assert odometer.scale == 1.0 and odometer.scale_correction() is None
    compared(odometer, 6.0, 1.0)
    assert odometer.trusted and odometer.deviation < 0.05


def test_a_map_that_collapses_while_it_is_young_is_scaled_sooner_by_what_it_is_now() -> None:
    odometer = Odometer(np.eye(4), OdometerConfig(), metric=False)
    odometer.set_metric(metric=True)
    compared(odometer, 1.0, 1.0)
    compared(odometer, 1.4, 1.8)
    assert odometer.scale_correction() is None
    compared(odometer, 1.2, 2.0)
    found = odometer.scale_correction()
    assert found is not None and found[0] == pytest.approx(0.5, rel=0.01)


def test_poses_say_how_well_lengths_are_known() -> None:
    """The unit was told to two per cent, by windows that lie back, and a young map changes it by five in a second."""
    odometer = Odometer(np.eye(4), OdometerConfig(), metric=False)
    odometer.set_metric(metric=True)
    assert odometer.deviation > 0.05
    compared(odometer, 30.0, 1.0)
    assert odometer.deviation < 0.015


def test_windows_count_as_what_they_are() -> None:
    """The noise that is expected of any odometer held up corrections for as long as the map went on drifting."""
    good, usual = OdometerScale(of_map=True), OdometerScale(of_map=True)
    for k in range(100):
        growth = 1.0 + 0.0006 * k
        good.add(moved(k), growth * moved(k), DT_S, 0.015)
        usual.add(moved(k), growth * moved(k), DT_S, NOISE_M_S)
    assert abs(good.value - growth) < 0.7 * abs(usual.value - growth)
