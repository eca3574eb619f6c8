"""Scale of a monocular map of unknown unit, from displacements by the odometer and by the images."""

import numpy as np

from kiteline_core.arrays import F64

WINDOW_S = 0.4  # s; window of a comparison
ALIGNED = 0.9  # least cosine between both displacements of a window for their lengths to be compared
_WINDOWS = 20  # newest windows that are kept: the unit of a young map drifts
_LEAST_WINDOWS = 5  # least number of agreeing windows for a scale
_LEAST_SHARE = 0.7  # least share of the windows that must agree
_NEWEST = 2  # windows of which one must lie near the median: else the unit changes, or the odometer slips now
_LEAST_MOVED_M = 0.05  # m; least motion by the odometer in a window that counts
_LEAST_SPREAD = 1e-9  # relative spread of windows, at least: some that agree to the last digit are no outliers
_OUTLYING = 3.0  # deviations of a window from the median scale: slip, a moment of bad images


class UnitScale:
    """Windows in which odometer and images moved, and the metres per unit of the map that they give."""

    def __init__(self, windows: int = _WINDOWS) -> None:
        """windows: newest ones, kept."""
        self._most = windows
        # Displacement by the odometer times that by the images, m times units; the latter's square; agrees.
        self._windows: list[tuple[float, float, bool]] = []

    def clear(self) -> None:
        """Drop all windows: the unit of the map is another one."""
        self._windows = []

    def add(self, by_odometer: F64, by_images: F64) -> None:
        """Add a window: displacement (3,) in m by the odometer and in map units by the images."""
        a, b = float(np.sqrt(by_odometer @ by_odometer)), float(np.sqrt(by_images @ by_images))
        if a < _LEAST_MOVED_M or b <= 0.0:
            return
        along = float(by_odometer @ by_images)
        self._windows.append((along, b * b, along > ALIGNED * a * b))
        del self._windows[: -self._most]

    def metres_per_unit(self, newest: int | None = None) -> tuple[float, float] | None:
        """Metres per unit of the map and its standard deviation; None while unknown.

        newest: of so many windows alone; None: of all that are kept.
        """
        windows = self._windows if newest is None else self._windows[-newest:]
        agreed = np.array([window[:2] for window in windows if window[2]])
        if len(windows) < (newest or 0) or len(agreed) < max(_LEAST_WINDOWS, _LEAST_SHARE * len(windows)):
            return None
        along, square = agreed.T
        each = along / square
        middle = float(np.median(each))
        spread = 1.4826 * float(np.median(np.abs(each - middle)))
        near = np.abs(each - middle) <= _OUTLYING * max(spread, _LEAST_SPREAD * middle)
        if not near[-_NEWEST:].any():
            return None
        metres = float(along[near].sum() / square[near].sum())
        left = along[near] - metres * square[near]
        count = np.count_nonzero(near)
        return metres, float(np.sqrt(left @ left * count / (count - 1)) / square[near].sum())
