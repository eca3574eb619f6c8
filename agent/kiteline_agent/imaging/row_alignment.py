"""Finds how far the right image lies off the rows of the left one, and reads it there from then on.

A right camera that was turned by 0.06 degrees, or a lens whose centre moved, shifts rows by one or two pixels. A
row-wise disparity is then off by the shift times the slope of the texture, which depends on the place in the image: it
passes for a curved disparity offset. Offsets of rows need no depth and no motion: one keyframe shows them to a tenth of
a pixel.
"""

import math
from dataclasses import dataclass

import numpy as np

from kiteline_agent.imaging import row_kernels
from kiteline_agent.imaging.raw_grid import grid_for_kernels
from kiteline_core.arrays import F64, U8
from kiteline_core.geometry.cameras import Rectifier

TERMS = 5
_ROUNDS = 4  # of robust weighting
_TURNS = np.array([0, 1, 3])  # terms of pitch, roll and yaw of the right camera
_MOST_DEVIATIONS = 3.0  # of a worn rig's x y
_MIN_POINTS = 40  # points of a keyframe with a measured offset; five numbers are estimated from them
_PRIOR_PX = 1.5  # px; standard deviation of each number before anything was measured: a worn rig's
_MAX_PX = 3.5  # px of the level; offset beyond which the patch is another one
_MIN_NCC = 0.9  # correlation of the two patches; lower at occlusions
_MIN_CHANGE_PX = 0.5  # px; rms over points of a change that is applied: good calibrations are off by 0.3 px
_MIN_SIGNIFICANCE = 4.0  # standard deviations of a change that is applied
_KNOWN_PX = 0.1  # px; standard deviation of each number where an earlier flight measured it
_SHARE_PX = 0.1  # px; rms over points of a change that the base is told: a tenth of what a worn rig has
_SIGMA_SHARE = 0.3  # of the standard deviations by sigma_px: what estimates of known rigs err by at most
_GOOD_PX = 0.1  # px; standard deviation of level, slope along x and x y with a good calibration
_WORN_SLOPE_PX = 0.3  # px where x is 1; of the slope along x: the mount is twisted by 0.04 degrees
_WORN_TURN_PX = 0.6  # px where x y is 1; of x y: it is turned about y by 0.07 degrees
_ITERATIONS = 10  # Gauss-Newton steps; it converges in 4 from 1 px
_LEAST_PX = 1.0  # px; rows that are off by less are measured along them
_BENT = "read there from now on; the mount is bent or the calibration is of another rig: calibrate again"
_SHOWN_SHARE = 0.7  # share of worn rigs whose rows are off; focal lengths do not move them


@dataclass(frozen=True, slots=True)
class RowConfig:
    """Estimation of how far the right image lies off the rows of the left one, from the points of keyframes."""

    on: bool = True  # False: the right image is read where the calibration says
    sigma_px: float = 0.5  # px at octave 0; of a measured offset, with what points of a keyframe have in common
    worn_px: float = 0.9  # px; standard deviation of the level with a worn rig: both centres moved


def terms(xy: F64) -> F64:
    """Terms (n,5) of a row offset at normalised image coordinates (n,2): 1, x, y, x y, y^2.

    They come from pitch, roll, focal length and yaw of the right camera, and from pitch again, to second order.
    """
    x, y = xy[:, 0], xy[:, 1]
    return np.stack([np.ones(len(xy)), x, y, x * y, y * y], 1)


class RowAlignment:
    """Sums of row offsets over keyframes, and the offset that is applied."""

    def __init__(self, rectifier: Rectifier, config: RowConfig) -> None:
        self._rectifier = rectifier
        self._config = config
        self.estimate_px: F64 = np.zeros(TERMS)  # the offset as measured so far, applied or not
        self._forget()
        self._at = np.zeros((1, TERMS))  # terms at the last keyframe's points
        self._taken_px: F64 = np.zeros(TERMS)  # see take_change
        self._taken_read = False
        self._measured = False  # since take_change
        self._rough = False  # the offset that is applied is known to a pixel; see read_lower
        self.worn_evidence = 0.0  # logarithm of the likelihood of the rows with a worn rig over that with a good one
        self.roll_px: float | None = None  # px where x is 1; rms of the slope along x, the roll of the right camera
        self.known = False  # something was measured, in this flight or an earlier one
        self._events: list[str] = []
        self.applied_px: F64 = np.zeros(TERMS)  # the offset, as factors of `terms` at pixels of the right image

    def _forget(self) -> None:
        self._know(np.diag(np.full(TERMS, _PRIOR_PX**-2.0)), np.zeros(TERMS))

    def _know(self, information: F64, vector: F64) -> None:
        """Set the information (5,5) about the offset, and its product (5,) with the estimate."""
        self._information, self._vector = information, vector
        self.estimate_px = np.asarray(np.linalg.solve(information, vector), np.float64)

    def add(
        self, left: tuple[U8, ...], right: tuple[U8, ...], uv: F64,
        octave: U8, disparity: F64,
    ) -> int:  # fmt: skip
        """Measure rows at points (n,) of a keyframe. Returns at how many they are known; 0 if at too few to be used.

        left: rectified pyramid; right: raw. disparity: as measured.
        """
        config = self._config
        if not config.on:
            return 0
        offset, found = np.zeros(len(uv)), np.zeros(len(uv), np.bool_)
        row_kernels.measure_rows(
            left, right, grid_for_kernels(self._rectifier.right_grid), uv, octave, disparity, _ITERATIONS, _MAX_PX,
            _MIN_NCC, offset, found,
        )  # fmt: skip
        count = int(np.count_nonzero(found))
        if count < _MIN_POINTS:
            return 0
        at = terms(self._normalised(uv[found] - np.stack([disparity[found], np.zeros(count)], 1)))
        total = offset[found] + at @ self.applied_px
        sigma = config.sigma_px * (1 << octave[found]).astype(np.float64)
        weight: F64 = np.ones(len(total), np.float64)
        for _ in range(_ROUNDS - 1):
            residual = np.abs(total - at @ np.linalg.solve(*self._with(at, total, weight / sigma**2))) / sigma
            weight = 1.0 / np.maximum(residual, 1.0) ** 2  # a point on an occluding edge counts little
        self._know(*self._with(at, total, weight / sigma**2))
        self._at = at
        self._measured = self.known = True
        self._weigh()
        return count

    def _with(self, at: F64, total: F64, weight: F64) -> tuple[F64, F64]:
        """Information and vector with offsets (n,) px at points whose terms are (n,5), of weights (n,) 1/px^2."""
        scaled = at * weight[:, None]
        return self._information + scaled.T @ at, self._vector + scaled.T @ total

    def at(self, uv: F64) -> F64:
        """By how much (n,) px the right image is read lower, at pixels (n,2) of it."""
        return np.asarray(terms(self._normalised(uv)) @ self.applied_px)

    def read_lower(self, off_px: float) -> bool:
        """Read the right image at rows that were found without a search along them; True if they are others.

        They are known to a pixel; the next points measure what is left. What was measured before is forgotten: the
        camera has been moved since.
        """
        if not self._config.on or abs(off_px) < _LEAST_PX:
            return False
        self._forget()
        self._read_at(self.applied_px + [off_px, 0.0, 0.0, 0.0, 0.0])
        self._rough = True
        return True

    def apply(self) -> float:
        """Read the right image at other rows if the last points are significantly off. Returns their rms px, or 0.

        After `read_lower` any measured change is applied.
        """
        estimate = self.estimate_px
        change = estimate - self.applied_px
        rms = float(np.sqrt(np.mean((self._at @ change) ** 2)))
        if not self._rough and (rms < _MIN_CHANGE_PX or rms < _MIN_SIGNIFICANCE * self._sigma_px()):
            return 0.0
        self._read_at(estimate)
        said = f"rows of the right image are {estimate[0]:+.2f} px off in the middle"
        self._events.append(f"images: {said}: {_BENT}" if self._rough else said)
        self._rough = False
        return rms

    def _sigma_px(self) -> float:
        """Standard deviation of the estimate, rms over the last points."""
        at = self._at
        return float(np.sqrt(np.mean(np.einsum("ni,in->n", at, np.linalg.solve(self._information, at.T)))))

    @property
    def read(self) -> bool:
        """True if the right image is read at other rows than the calibration says."""
        return bool(self.applied_px.any())

    def begin_with(self, rows_px: F64, *, read: bool) -> None:
        """Begin with the offset (5,) that an earlier flight measured. read: it read the right image there.

        Disparities that were calibrated with the rows as they came would not fit others.
        """
        information = np.diag(np.full(TERMS, _KNOWN_PX**-2.0))
        self._know(information, information @ rows_px)
        self._taken_px = rows_px
        self.known = True
        self._weigh()
        self._events.append("the right camera is taken as earlier flights found it")
        self._taken_read = read
        if read:
            self._read_at(rows_px)

    def take_change(self) -> F64 | None:
        """The estimate, if a new one differs from what was taken last, at first from zero, or is read from now on."""
        if not self._measured:
            return None
        self._measured, estimate = False, self.estimate_px
        before, self._taken_read = self._taken_read, self.read
        change = float(np.sqrt(np.mean((self._at @ (estimate - self._taken_px)) ** 2)))
        if before == self.read and change < _SHARE_PX:
            return None
        self._taken_px = estimate
        return estimate

    def take_events(self) -> list[str]:
        """Changes since the last call, for the log."""
        events, self._events = self._events, []
        return events

    def _weigh(self) -> None:
        """Compare a worn rig with a good one by level, slope along x and x y: pitch, roll and yaw of the right camera.

        No depth moves them. An x y beyond any wear is what a rectification has left, and tells nothing.
        """
        c = self._config
        at, worn_px = _TURNS, np.array([c.worn_px, _WORN_SLOPE_PX, _WORN_TURN_PX])
        if abs(self.estimate_px[at[2]]) > _MOST_DEVIATIONS * _WORN_TURN_PX:
            at, worn_px = at[:2], worn_px[:2]
        found = self.estimate_px[at]
        cov = _SIGMA_SHARE**2 * np.linalg.inv(self._information)[np.ix_(at, at)]
        self.roll_px = math.sqrt(float(found[1] ** 2 + cov[1, 1]))
        good, worn = (_log_normal(found, cov + np.diag(np.square(s))) for s in (np.full(len(at), _GOOD_PX), worn_px))
        self.worn_evidence = float(np.logaddexp(math.log1p(-_SHOWN_SHARE), math.log(_SHOWN_SHARE) + worn - good))

    def _read_at(self, rows_px: F64) -> None:
        self.applied_px = rows_px
        self._rectifier.set_right_rows(self.at)

    def _normalised(self, uv: F64) -> F64:
        camera = self._rectifier.camera
        return np.asarray((uv - [camera.cx, camera.cy]) / [camera.fx, camera.fy])


def _log_normal(x: F64, cov: F64) -> float:
    """Logarithm of a normal density about zero at x (n,), but for a constant of n."""
    return -0.5 * (float(x @ np.linalg.solve(cov, x)) + float(np.linalg.slogdet(cov)[1]))
