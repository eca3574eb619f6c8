"""The read-out of a rolling shutter of which nothing is known, by the window of a monocular start.

A window in which every row counts as of the frame's stamp bends poses and landmarks to what the shutter did, and so
tells a part of the read-out at first. It is solved again with what it told, until it tells no change.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kiteline_agent.initialisation.window.rolling_rows import RollingRows
from kiteline_agent.initialisation.window.window_bundle import InertialBundle
from kiteline_agent.initialisation.window.window_state import InParts, WarmStart, WindowSolution

_MOST_S = 0.06  # longer than any camera takes at 20 images a second
_SOLUTIONS = 4  # of one window
_SETTLED_S = 0.001  # change that a window tells once it is solved with the right read-out
_LEAST_FALL = 0.1  # of the step, by the change of the read-out; below it nothing is extrapolated
_SHORT_S = 0.001  # read-out with which derivatives are taken
_LOOKED_AT = 2.0  # deviations of the first step above which a window is solved again
_LEAST_S = 0.005  # read-outs below change little; errors of lens and depth tell 2 ms
_LEAST_CHI2 = 36.0  # by which the errors of the corners are smaller with the read-out, in their own variances
_AGREEMENT = 0.5  # of the longer one, by which the read-outs of two windows may differ
_SHARE = 0.15  # deviation of a read-out over the read-out: windows tell some too short

BundleWith = Callable[[RollingRows], InertialBundle]


@dataclass(frozen=True, slots=True)
class _Told:
    """A read-out in s, and by how much it makes the corners' errors smaller, in their own variances."""

    readout_s: float
    chi2: float


class WindowReadout:
    """Asks each window, and believes two in turn that agree."""

    def __init__(self) -> None:
        self._before: float | None = None  # s, by the last window

    def clear(self) -> None:
        """Begin anew."""
        self._before = None

    def asking(
        self, solved: InertialBundle, found: WindowSolution, bundle_with: BundleWith, rows: RollingRows, sigma_px: float
    ) -> InParts[tuple[float, float] | None]:
        """The read-out and its deviation in s, once two windows agree that it is none of a global shutter.

        solved: with the read-out of rows, 0 at first: it found the solution. bundle_with: of the same window, with
        other rows. sigma_px: of a corner, as `found` takes it.
        """
        told = yield from _told(solved, found, bundle_with, rows, sigma_px)
        before, self._before = self._before, None
        if told is None or abs(told.readout_s) < _LEAST_S or told.chi2 < _LEAST_CHI2:
            return None
        self._before = told.readout_s
        longer = max(abs(told.readout_s), abs(before or 0.0))
        if before is None or abs(told.readout_s - before) > _AGREEMENT * longer:
            return None
        return told.readout_s, _SHARE * abs(told.readout_s)


def _told(
    bundle: InertialBundle, found: WindowSolution, bundle_with: BundleWith, rows: RollingRows, sigma_px: float
) -> InParts[_Told | None]:
    """Solve a window with the read-out that it tells, by the secant method; None if that does not settle."""
    short = rows.with_readout(_SHORT_S)
    step_s, step_sigma_s = bundle.readout_step(found.state, short)
    scale = 0.5 * (found.reprojection_px / sigma_px) ** 2  # of the corners' variances; they are smaller than is told
    if not abs(step_s) > _LOOKED_AT * step_sigma_s * np.sqrt(scale):
        return None
    readout_s, change_s, solution = rows.shutter.readout_s, step_s, found
    for _ in range(_SOLUTIONS):
        last_s, readout_s = readout_s, float(np.clip(readout_s + change_s, -_MOST_S, _MOST_S))
        warm = WarmStart(solution.state, bundle.landmarks_of(solution.state)[0])
        bundle = bundle_with(rows.with_readout(readout_s))
        again = yield from bundle.solving(warm)
        if again is None or not again.fits:
            return None
        solution, last_step_s = again, step_s
        step_s, _ = bundle.readout_step(solution.state, short)
        if abs(step_s) < _SETTLED_S:
            break
        # each solution takes up a part of what the shutter does: the share by which the step fell says how much
        fell = (last_step_s - step_s) / (readout_s - last_s) if readout_s != last_s else 1.0
        change_s = step_s / fell if _LEAST_FALL < fell < 1.0 else step_s
    return _Told(readout_s, 2.0 * (found.cost - solution.cost) / scale)
