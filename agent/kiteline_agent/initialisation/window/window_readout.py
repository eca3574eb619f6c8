"""The read-out of a rolling shutter of which nothing is known, by the window of a monocular start.

A window in which every row counts as of the frame's stamp bends poses and landmarks to what the shutter did. So one
step of least squares gives the read-out's sign, but only a part of its length: the window is solved with longer and
longer ones, until the corners' errors grow again.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kiteline_agent.initialisation.window.rolling_rows import RollingRows
from kiteline_agent.initialisation.window.window_bundle import InertialBundle
from kiteline_agent.initialisation.window.window_state import InParts, WarmStart, WindowSolution

_FIRST_S, _MOST_S = 0.01, 0.06  # s; first and longest read-out that is tried, each twice the one before
_SHORT_S = 0.001  # s; read-out with which derivatives are taken
_LOOKED_AT = 2.0  # deviations of the first step above which a window is solved again
_LEAST_S = 0.005  # s; shorter read-outs change little, and errors of lens and depth look like 2 ms
_LEAST_CHI2 = 64.0  # by which it lowers corners' squared errors, in their own variances; a worn rig had 91 once
_LEAST_SIGMAS = 3.5  # deviations of the estimate
_AGREEMENT = 0.3  # of the longer one, by which the read-outs of two windows may differ
_SHARE = 0.15  # deviation of a read-out over the read-out: some windows give too short ones

BundleWith = Callable[[RollingRows], InertialBundle]


@dataclass(frozen=True, slots=True)
class _Estimate:
    """Read-out by one window, and its deviation, in s.

    chi2: by how much it lowers the squared errors of corners, in units of their variance.
    """

    readout_s: float
    sigma_s: float
    chi2: float

    @property
    def is_rolling(self) -> bool:
        """True if windows of a global shutter hardly come to this estimate."""
        least_s = max(_LEAST_SIGMAS * self.sigma_s, _LEAST_S)
        return abs(self.readout_s) > least_s and self.chi2 > _LEAST_CHI2


class WindowReadout:
    """Estimates the read-out in each window, until two in turn agree."""

    def __init__(self) -> None:
        self._before: float | None = None  # s, by the last window

    def clear(self) -> None:
        """Begin anew."""
        self._before = None

    def measuring(
        self, solved: InertialBundle, found: WindowSolution, bundle_with: BundleWith, rows: RollingRows, sigma_px: float
    ) -> InParts[tuple[float, float] | None]:
        """The read-out and its deviation in s, once this window and the one before agree that the shutter rolls.

        solved: the window as solved with a read-out of 0. found: its solution. bundle_with: the same window with other
        rows. rows: of any read-out. sigma_px: deviation of a corner in `solved`.
        """
        now = yield from _estimate(solved, found, bundle_with, rows, sigma_px)
        before, self._before = self._before, None
        if now is None or not now.is_rolling:
            return None
        self._before = now.readout_s
        longer = max(abs(now.readout_s), abs(before or 0.0))
        if before is None or abs(now.readout_s - before) > _AGREEMENT * longer:
            return None
        return now.readout_s, _SHARE * abs(now.readout_s)

    @property
    def waits(self) -> bool:
        """True if the last window gave a read-out that the next one has to confirm."""
        return self._before is not None


def _estimate(
    bundle: InertialBundle, found: WindowSolution, bundle_with: BundleWith, rows: RollingRows, sigma_px: float
) -> InParts[_Estimate | None]:
    """Solve a window with other read-outs; None if none is significant, or another solution does not fit."""
    short = rows.with_readout(_SHORT_S)
    step_s, step_sigma_s = bundle.readout_step(found.state, short)
    # Corners err by less than sigma_px; each error has two components.
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
    return _Estimate(readout_s + rest_s, sigma_s, 2.0 * (found.cost - min(again[0].cost, best.cost)) / variance)


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
