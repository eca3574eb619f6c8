"""The read-out of a rolling shutter of which nothing is known, by the window of a monocular start.

A window in which every row counts as of the frame's stamp bends poses and landmarks to what the shutter did. So one
step of least squares tells the read-out's sign, but a part of its length: the window is solved with longer and longer
ones, until the corners' errors grow again.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kiteline_agent.initialisation.window.rolling_rows import RollingRows
from kiteline_agent.initialisation.window.window_bundle import InertialBundle
from kiteline_agent.initialisation.window.window_state import InParts, WarmStart, WindowSolution

_FIRST_S, _MOST_S = 0.01, 0.06  # first and longest read-out that is tried; longer ones double
_SHORT_S = 0.001  # read-out with which derivatives are taken
_LOOKED_AT = 2.0  # deviations of the first step above which a window is solved again
_LEAST_S = 0.005  # read-outs below change little; errors of lens and depth tell 2 ms
_LEAST_CHI2 = 64.0  # by which corners' errors are smaller with it, in their own variances; a worn rig had 91 once
_LEAST_SIGMAS = 3.5  # of its own deviation
_AGREEMENT = 0.3  # of the longer one, by which the read-outs of two windows may differ
_SHARE = 0.15  # deviation of a read-out over the read-out: windows tell some too short

BundleWith = Callable[[RollingRows], InertialBundle]


@dataclass(frozen=True, slots=True)
class _Told:
    """A read-out and its deviation in s, and by how much it makes the corners' errors smaller, in their variances."""

    readout_s: float
    sigma_s: float
    chi2: float

    @property
    def is_rolling(self) -> bool:
        """True if a global shutter would hardly tell this."""
        least_s = max(_LEAST_SIGMAS * self.sigma_s, _LEAST_S)
        return abs(self.readout_s) > least_s and self.chi2 > _LEAST_CHI2


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
        if told is None or not told.is_rolling:
            return None
        self._before = told.readout_s
        longer = max(abs(told.readout_s), abs(before or 0.0))
        if before is None or abs(told.readout_s - before) > _AGREEMENT * longer:
            return None
        return told.readout_s, _SHARE * abs(told.readout_s)

    @property
    def waits(self) -> bool:
        """True if the last window told a read-out that another one has to confirm."""
        return self._before is not None


def _told(
    bundle: InertialBundle, found: WindowSolution, bundle_with: BundleWith, rows: RollingRows, sigma_px: float
) -> InParts[_Told | None]:
    """Solve a window with other read-outs; None if it tells none."""
    short = rows.with_readout(_SHORT_S)
    step_s, step_sigma_s = bundle.readout_step(found.state, short)
    # Errors of corners are smaller than is told; two numbers each.
    variance = 0.5 * (found.reprojection_px / sigma_px) ** 2
    if not abs(step_s) > _LOOKED_AT * step_sigma_s * np.sqrt(variance):
        return None
    # 1. Longer and longer ones, until the errors grow.
    tried = [(0.0, found.cost)]
    best, best_bundle = found, bundle
    longer_s = float(np.copysign(_FIRST_S, step_s))
    while abs(longer_s) <= _MOST_S:
        again = yield from _again(best, best_bundle, bundle_with(rows.with_readout(longer_s)))
        if again is None:
            break
        tried.append((longer_s, again[0].cost))
        if again[0].cost > best.cost:
            break
        (best, best_bundle), longer_s = again, 2.0 * longer_s
    # 2. The lowest point of the parabola through the last three; there a step tells what is left.
    readout_s = _lowest(tried[-3:])
    again = yield from _again(best, best_bundle, bundle_with(rows.with_readout(readout_s)))
    if again is None:
        return None
    rest_s, sigma_s = again[1].readout_step(again[0].state, short)
    return _Told(readout_s + rest_s, sigma_s, 2.0 * (found.cost - min(again[0].cost, best.cost)) / variance)


def _again(
    before: WindowSolution, solver: InertialBundle, bundle: InertialBundle
) -> InParts[tuple[WindowSolution, InertialBundle] | None]:
    """The window solved from a solution by `solver`, with what found it; None if it does not fit."""
    solution = yield from bundle.solving(WarmStart(before.state, solver.landmarks_of(before.state)[0]))
    return None if solution is None or not solution.fits else (solution, bundle)


def _lowest(tried: list[tuple[float, float]]) -> float:
    """Where a parabola through the costs of three read-outs is lowest; the lowest one of fewer, or of a line."""
    lowest = min(tried, key=lambda point: point[1])[0]
    if len(tried) < 3:
        return lowest
    s, cost = np.array(tried).T
    curvature, slope, _ = np.polyfit(s, cost, 2)
    if not curvature > 0.0:
        return lowest
    return float(np.clip(-0.5 * slope / curvature, s.min(), s.max()))
