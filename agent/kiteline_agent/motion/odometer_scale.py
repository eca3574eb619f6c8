"""Lengths by images over those by the odometer: its own scale, or by how much a monocular map has grown."""

import numpy as np

from kiteline_agent.inertial.scale_filter import MAP_WALK, correction_due
from kiteline_agent.motion.unit_scale import ALIGNED, UnitScale
from kiteline_core.arrays import F64

LEAST_MOVED_M = 0.02  # m; motion in a window below which axes and scale are not observable
_START = 0.1  # relative deviation at the start
_MOST = 0.25  # relative; a larger difference is a fault, not a scale
_FLOOR = 0.01  # least relative deviation
_SIGMA_M_S = 0.05  # m/s; expected noise of a window
_LEAST_M_S = 0.015  # m/s; least noise of one, where windows show less than expected
_WALK = 0.003  # relative change per sqrt(s): load and temperature
_YOUNG_WALK, _YOUNG_S = 0.05, 4.0  # relative per sqrt(s), and s in which it calms down, of one camera's map
_CLEAR_S, _CLEAR, _CLEAR_DEVIATIONS = 1.5, 0.06, 4.0  # s, relative: by more than that a map is corrected sooner
_LASTING = 30  # windows, 6 s of motion, most of which must agree on another length than a map in metres has
_YOUNG_LASTING = 15  # the same of a young map of one camera: rather that one is wrong than the odometer
_NOW = 5  # windows, the last second, that tell by how much lengths are off now
_WRONG = 0.1  # relative; by which a map of one camera is wrong, and no longer drifts
_WRONG_SIGMA = 0.04  # relative deviation of that
_GATE = 3.0  # deviations beyond which a window is left out: slip


class OdometerScale:
    """Kalman filter over windows of displacements. value: true displacements over measured ones, in the map's unit."""

    def __init__(self, *, of_map: bool) -> None:
        """of_map: the map of one camera, whose lengths the odometer tells: the map is off by it, not the odometer."""
        self._of_map = of_map
        self._lasting = UnitScale(_LASTING)
        self.value, self.var = 1.0, _START**2
        self._age_s = 0.0  # of compared windows since the map began, or was corrected
        self._grown_s = 0.0  # of those since it was in a unit of its own

    def add(self, by_odometer: F64, by_images: F64, dt_s: float, noise_m_s: float) -> None:
        """Add a window of so many s: displacements (3,) in m. noise_m_s: of the windows before, an axis."""
        distance, square = float(np.sqrt(by_images @ by_images)), float(by_odometer @ by_odometer)
        self.var += self._walk_square() * dt_s
        self._age_s += dt_s
        self._grown_s += dt_s
        if self._of_map:
            self._lasting.add(by_odometer, by_images)
        if square <= LEAST_MOVED_M**2:
            return
        along = float(by_odometer @ by_images)
        # Over the part along the images' motion: the odometer's own noise in its square would shorten it.
        measured = distance**2 / along if along > 0.0 else 0.0
        # A map of one camera drifts within seconds: its windows count as what they are.
        noise_m_s = min(max(noise_m_s, _LEAST_M_S), _SIGMA_M_S) if self._of_map else _SIGMA_M_S
        var = (noise_m_s * dt_s / distance) ** 2 if distance > 0.0 else np.inf
        off = measured - self.value
        aligned = along > ALIGNED * distance * float(np.sqrt(square))
        if aligned and off * off < _GATE**2 * (self.var + var):
            gain = self.var / (self.var + var)
            self.value = float(np.clip(self.value + gain * off, 1.0 - _MOST, 1.0 + _MOST))
            self.var = max((1.0 - gain) * self.var, _FLOOR**2)

    def _walk_square(self) -> float:
        """Relative change per sqrt(s), squared. A young map of one camera drifts by percents: few views made it."""
        if not self._of_map:
            return _WALK**2
        return MAP_WALK**2 + float(_YOUNG_WALK * np.exp(-self._grown_s / _YOUNG_S)) ** 2

    def begin(self, factor: float) -> None:
        """A map in metres begins, whose lengths are `factor` times those before: the next correction waits."""
        self.scale_map(factor)
        self._age_s = 0.0
        self._lasting.clear()
        if abs(self.value - 1.0) > _MOST:  # the map was off by more than is followed
            self.value, self.var = 1.0, _START**2

    def scale_map(self, factor: float) -> None:
        """Lengths in the map were multiplied by `factor`."""
        if self._of_map:
            self.value *= factor
            self.var *= factor**2

    def correction(self, *, believed: bool) -> tuple[float, float] | None:
        """Factor by which the map is to be scaled, and its deviation; None if it is right as far as is known.

        believed: odometer and images agree.
        """
        if not self._of_map:
            return None
        if not believed:
            return self._lasting_correction()
        scale, sigma = self._metres_per_unit
        clear = self._age_s >= _CLEAR_S and abs(np.log(scale)) > max(_CLEAR_DEVIATIONS * sigma / scale, _CLEAR)
        return (scale, sigma) if clear else correction_due(scale, sigma, self._age_s)

    @property
    def of_map(self) -> tuple[float, float] | None:
        """Metres per unit of a map of one camera, and the deviation; None of a map whose lengths images measure."""
        return self._metres_per_unit if self._of_map else None

    @property
    def _metres_per_unit(self) -> tuple[float, float]:
        return 1.0 / self.value, float(np.sqrt(self.var)) / self.value**2

    @property
    def deviation(self) -> float:
        """Relative deviation of lengths in a map of one camera: how well they are known, and how far off they seem."""
        return float(np.hypot(np.sqrt(self.var), self.value - 1.0))

    @property
    def apart(self) -> float:
        """Share by which the newest windows see lengths too long or too short; 0 if they do not agree on one."""
        found = self._lasting.metres_per_unit(_NOW)
        return 0.0 if found is None else abs(1.0 / found[0] - 1.0)

    def _lasting_correction(self) -> tuple[float, float] | None:
        """The same where images and odometer agree on directions and, for seconds, on another length: the map is wrong.

        A map of two views may collapse while its first landmarks are measured.
        """
        young = self._grown_s < 2.0 * _YOUNG_S
        found = self._lasting.metres_per_unit(_YOUNG_LASTING if young else _LASTING)
        if found is None or abs(np.log(found[0])) < _WRONG or found[1] > _WRONG_SIGMA * found[0]:
            return None
        return self._lasting.metres_per_unit(_NOW) or found  # it may not have come to rest yet
