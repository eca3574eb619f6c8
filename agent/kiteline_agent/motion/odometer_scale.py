"""Lengths by images over those by the odometer: its own scale, or by how much a monocular map has grown."""

import numpy as np

from kiteline_agent.inertial.scale_filter import MAP_WALK, correction_due
from kiteline_core.arrays import F64

LEAST_MOVED_M = 0.02  # m; motion in a window below which axes and scale are not observable
_ALIGNED = 0.9  # least cosine between both displacements for their lengths to be compared
_START = 0.1  # relative deviation at the start
_MOST = 0.25  # relative; a larger difference is a fault, not a scale
_FLOOR = 0.01  # least relative deviation
_SIGMA_M_S = 0.05  # m/s; expected noise of a window
_WALK = 0.003  # relative change per sqrt(s): load and temperature
_GATE = 3.0  # deviations beyond which a window is left out: slip


class OdometerScale:
    """Kalman filter over windows of displacements. value: true displacements over measured ones, in the map's unit."""

    def __init__(self, *, of_map: bool) -> None:
        """of_map: the map of one camera, whose lengths the odometer tells: the map is off by it, not the odometer."""
        self._of_map = of_map
        self.value, self.var = 1.0, _START**2
        self._age_s = 0.0  # of compared windows since the map began

    def add(self, by_odometer: F64, by_images: F64, dt_s: float) -> None:
        """Add a window of so many s: displacements (3,) in m."""
        distance, square = float(np.sqrt(by_images @ by_images)), float(by_odometer @ by_odometer)
        self.var += (MAP_WALK if self._of_map else _WALK) ** 2 * dt_s
        self._age_s += dt_s
        if square <= LEAST_MOVED_M**2:
            return
        along = float(by_odometer @ by_images)
        # Over the part along the images' motion: the odometer's own noise in its square would shorten it.
        measured = distance**2 / along if along > 0.0 else 0.0
        var = (_SIGMA_M_S * dt_s / distance) ** 2 if distance > 0.0 else np.inf
        off = measured - self.value
        aligned = along > _ALIGNED * distance * float(np.sqrt(square))
        if aligned and off * off < _GATE**2 * (self.var + var):
            gain = self.var / (self.var + var)
            self.value = float(np.clip(self.value + gain * off, 1.0 - _MOST, 1.0 + _MOST))
            self.var = max((1.0 - gain) * self.var, _FLOOR**2)

    def begin(self, factor: float) -> None:
        """A map in metres begins, whose lengths are `factor` times those before: the next correction waits."""
        self.scale_map(factor)
        self._age_s = 0.0

    def scale_map(self, factor: float) -> None:
        """Lengths in the map were multiplied by `factor`."""
        if self._of_map:
            self.value *= factor
            self.var *= factor**2

    def correction(self) -> tuple[float, float] | None:
        """Factor by which the map is to be scaled, and its deviation; None if it is right as far as is known."""
        if not self._of_map:
            return None
        return correction_due(1.0 / self.value, float(np.sqrt(self.var)) / self.value**2, self._age_s)
