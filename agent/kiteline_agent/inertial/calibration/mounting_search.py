"""How an IMU is mounted, and its clock's offset, from turns alone: for a calibration that is off by degrees.

The filters begin near the calibration that they are given, and follow slowly. This search needs no start: rotations
by images and by the gyro over short windows are two sets of vectors that one rotation maps onto each other (R. Tsai,
R. Lenz, "Hand/eye calibration", 1989, in the closed form of W. Kabsch, 1976), for each time offset of a grid.
"""

from dataclasses import dataclass

import numpy as np

from kiteline_agent.inertial.samples.sample_buffer import SampleBuffer
from kiteline_core.arrays import F64, I64
from kiteline_core.geometry import se3

_LONGEST = 2.5  # times the window: a longer one lacks frames
_FITS = 3  # each with the weights that the one before gave
_UNKNOWNS = 8.0  # rotation, scale, bias and time offset
_TAIL = 2.0  # times the median residual, from which a window weighs less
SUSPICION = 1e-3  # squared errors over squared turns from which it is searched; sound rigs reach 5e-4
_WINDOW_S = 0.09  # s over which turns are compared: short beside changes of the rate
_MEMORY_S = 3.0  # s of turns; samples are kept for as long
_LEAST_S = 0.5  # s of turns that are compared, at least
_EVERY_S = 0.24  # s between the first two searches
_BACKOFF = 1.4  # by which the time to the next search grows with each that finds nothing
_SELDOM_S = 5.0  # s; longest time between two searches: a rig that is worn badly stays in doubt
_MOST_OFFSET_S = 0.15  # s, either way: drivers that stamp at arrival are late by less
_ROTATION_SIGMA_RAD = 0.1  # rad; of a mounting about an axis: one about which nothing turned stays as told
_SCALE_SIGMA = 0.02  # of the gyro's scale: what little turns leave open is the time offset first
_TURN_SIGMA_RAD = 2e-4  # rad; least error of a turn by images over a window
_EXPLAINED = 0.5  # share of the squared errors that a found calibration must explain
LEAST_ROTATION_RAD = 0.025  # rad; smaller rotations are left to the filters
_LEAST_SCALE = 0.02  # of the gyro; smaller changes of its scale are left to the filters
LEAST_CHANGE_S = 0.015  # s; smaller changes of the time offset are left to the filters
RESTART_S = 0.04  # s; change of the time offset from which velocity and vertical are found anew
_MOST_ROTATION_RAD = 0.4  # rad; beyond it axes were confused, and nothing else of a mounting is right
_MOST_SCALE = 0.08  # of the gyro's scale, either way: beyond it the unit is another one, or the clock
_STEP_S = 0.01  # s of the grid of offsets: turns change slower
_SIGNIFICANCE = 60.0  # squared errors that it explains, over the mean square of what it leaves


@dataclass(frozen=True, slots=True)
class Mounting:
    """axes: (3,3), IMU to body, scaled as the gyro has to be. offset_s: camera stamp + offset = IMU time, sigma_s its
    deviation. bias: (3,) of the gyro, rad/s: rate = axes @ gyro - bias.
    """

    axes: F64
    offset_s: float
    sigma_s: float
    bias: F64

    @property
    def rotation(self) -> F64:
        """(3,3) IMU to body."""
        return _rotation(self.axes)

    def __str__(self) -> str:
        turned, measured = np.degrees(_angle_rad(self.axes)), 100.0 / _scale(self.axes)
        return (
            f"the camera is turned by {turned:.1f} degrees against it, camera stamps + {1e3 * self.offset_s:.0f} ms "
            f"are its time, its gyro measures {measured:.0f} % of a rate"
        )


class MountingSearch:
    """Call `add` with each rotation by images, then `find`."""

    def __init__(self) -> None:
        self._frames = list[tuple[int, F64]]()  # stamps and R_m_b (3,3)
        self._next_ns, self._wait_s = 0, _EVERY_S  # time of the next search, and from it to the one after
        self.has_searched = False  # in turns that last long enough

    def clear(self) -> None:
        """Begin again after an image loss or in a new map."""
        self._frames = []

    def rotate_map(self, R_new_old: F64) -> None:
        """Rotate the map by R_new_old (3,3)."""
        self._frames = [(t, R_new_old @ R) for t, R in self._frames]

    def add(self, t_ns: int, R_m_b: F64) -> None:
        """Append the rotation R_m_b (3,3) of a frame by images."""
        self._frames.append((t_ns, R_m_b))
        while self._frames[0][0] < t_ns - _MEMORY_S * 1e9:
            del self._frames[0]

    def find(self, buffer: SampleBuffer, matrix: F64, offset_s: float) -> Mounting | None:
        """The mounting, if it explains the turns far better than the gyro's present matrix (3,3) and offset do."""
        t_ns = self._frames[-1][0]
        if t_ns < self._next_ns:
            return None
        windows, last = list[tuple[int, int, F64]](), self._frames[0]
        for t_ns, R_m_b in self._frames:
            duration_s = (t_ns - last[0]) * 1e-9
            if duration_s >= _WINDOW_S:
                if duration_s < _LONGEST * _WINDOW_S:
                    windows.append((last[0], t_ns, se3.so3_log(last[1].T @ R_m_b)))
                last = t_ns, R_m_b
        if not windows:
            return None
        begin, end, turns = (np.array(column) for column in zip(*windows, strict=True))
        compared = _Turns(begin, end, turns, *buffer.samples())
        compared.keep_inside(_MOST_OFFSET_S)
        if float(compared.dt_s.sum()) < _LEAST_S:
            return None
        found, self.has_searched = _found(compared, matrix, offset_s), True
        self._next_ns = self._frames[-1][0] + round(1e9 * self._wait_s)
        self._wait_s = _EVERY_S if found is not None else min(_BACKOFF * self._wait_s, _SELDOM_S)
        return found


class _Turns:
    """Rotations by images over n windows, and the gyro's samples, integrated axis by axis: the turns are small."""

    def __init__(self, begin_ns: I64, end_ns: I64, turns: F64, stamps: I64, samples: F64) -> None:
        """begin_ns, end_ns: (n,) camera stamps. turns: (n,3) rad. stamps (m,), samples (m,6): of the IMU."""
        first, last = begin_ns - stamps[0], end_ns - stamps[0]
        self._begin_s, self._end_s, self._t_s = 1e-9 * first, 1e-9 * last, 1e-9 * (stamps - stamps[0])
        self.by_images, self.dt_s = turns, self._end_s - self._begin_s
        rates = samples[:, :3]
        steps = 0.5 * (rates[1:] + rates[:-1]) * np.diff(self._t_s)[:, None]
        self._sum = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])

    def keep_inside(self, margin_s: float) -> None:
        """Keep the windows that have samples for any offset up to margin_s."""
        inside = (self._begin_s >= margin_s) & (self._end_s + margin_s <= self._t_s[-1])
        self._begin_s, self._end_s = self._begin_s[inside], self._end_s[inside]
        self.by_images, self.dt_s = self.by_images[inside], self.dt_s[inside]

    def by_gyro(self, offsets_s: F64) -> F64:
        """Integrals (k,n,3) of the windows, at k time offsets."""
        begin_s, end_s = self._begin_s + offsets_s[:, None], self._end_s + offsets_s[:, None]
        columns = [np.interp(end_s, self._t_s, sums) - np.interp(begin_s, self._t_s, sums) for sums in self._sum.T]
        return np.stack(columns, axis=-1)


def _found(turns: _Turns, matrix: F64, offset_s: float) -> Mounting | None:
    steps = round(_MOST_OFFSET_S / _STEP_S)
    offsets = np.asarray(_STEP_S * np.arange(-steps, steps + 1), np.float64)
    by_gyro, weight, cost = turns.by_gyro(offsets), np.ones(len(turns.dt_s)), np.empty(0)
    for _ in range(_FITS):
        _, cost, left = _fit(turns, by_gyro, weight)
        size = np.maximum(np.linalg.norm(left[np.argmin(cost)], axis=1), _TURN_SIGMA_RAD)
        weight = np.minimum(1.0, _TAIL * np.median(size) / size) ** 2
    both_s, only_s = _least(offsets, cost), _least(offsets, _cost(turns, by_gyro, matrix, weight))
    if both_s is None or only_s is None:
        return None
    by_gyro = turns.by_gyro(np.array([both_s[0], only_s[0], offset_s]))
    fitted, cost, _ = _fit(turns, by_gyro, weight)
    by_offset, given = _cost(turns, by_gyro[1:], matrix, weight)
    noise = max(float(cost[0]) / max(3.0 * float(weight.sum()) - _UNKNOWNS, 1.0), _TURN_SIGMA_RAD**2)
    clear = _SIGNIFICANCE * noise
    # The fewest changes that explain the turns: where little turned, a rotation could pass for an offset.
    k, axes, (found_s, sigma) = 0, fitted[0], both_s
    if by_offset < cost[0] + clear:
        k, axes, (found_s, sigma) = 1, matrix, only_s
    elif cost[2] < cost[0] + clear:
        k, axes, found_s = 2, fitted[2], offset_s
    explained = given - (by_offset if k == 1 else float(cost[k]))
    if explained < max(_EXPLAINED * given, clear) or not _differs(axes, matrix, found_s - offset_s):
        return None
    rest, share = turns.by_images - by_gyro[k] @ axes.T, weight * turns.dt_s
    bias = -share @ rest / float(share @ turns.dt_s)
    return Mounting(axes, found_s, sigma * float(np.sqrt(noise)), bias)


def _differs(axes: F64, matrix: F64, later_s: float) -> bool:
    """True if axes (3,3) and a time offset are those of a rig, but not of the given one."""
    change = np.asarray(np.linalg.solve(matrix, axes), np.float64)
    turn, scale = (_angle_rad(change), _angle_rad(axes)), (_scale(change), _scale(axes))
    if turn[1] > _MOST_ROTATION_RAD or abs(scale[1] - 1.0) > _MOST_SCALE:
        return False
    changed = turn[0] > LEAST_ROTATION_RAD or abs(scale[0] - 1.0) > _LEAST_SCALE
    return changed or abs(later_s) > LEAST_CHANGE_S


def _scale(axes: F64) -> float:
    return float(np.cbrt(np.linalg.det(axes)))


def _angle_rad(axes: F64) -> float:
    return float(np.linalg.norm(se3.so3_log(_rotation(axes))))


def _least(offsets_s: F64, cost: F64) -> tuple[float, float] | None:
    """The offset of the least of costs, by a parabola, and its deviation for errors of one; None at an end."""
    k = int(np.argmin(cost))
    if k in (0, len(cost) - 1):
        return None
    curve = float(cost[k - 1] - 2.0 * cost[k] + cost[k + 1])
    if not curve > 0.0:
        return None
    step_s = float(offsets_s[1] - offsets_s[0])
    return float(offsets_s[k] + 0.5 * step_s * (cost[k - 1] - cost[k + 1]) / curve), step_s * float(
        np.sqrt(2.0 / curve)
    )


def _cost(turns: _Turns, by_gyro: F64, axes: F64, weight: F64) -> F64:
    """Squared errors (k,) of by_gyro (k,n,3) by given axes (3,3), apart from a bias."""
    left = _without_bias(turns.by_images - by_gyro @ axes.T, turns.dt_s, weight)
    return np.asarray(np.sum(left**2, axis=2) @ weight)


def _fit(turns: _Turns, by_gyro: F64, weight: F64) -> tuple[F64, F64, F64]:
    """Scaled rotations (k,3,3) of by_gyro (k,n,3) onto the turns by images, apart from a bias. weight: (n,).

    Also their squared errors (k,), with those of the prior, which is no scale and no rotation; and the errors (k,n,3).
    """
    pull = 0.5 * (_TURN_SIGMA_RAD / _ROTATION_SIGMA_RAD) ** 2
    stiff = (_TURN_SIGMA_RAD / _SCALE_SIGMA) ** 2
    seen, by_gyro = (_without_bias(vectors, turns.dt_s, weight) for vectors in (turns.by_images, by_gyro))
    moment = (weight * seen.T) @ by_gyro + pull * np.eye(3)
    rotation = _rotation(moment)
    matched, square = np.sum(rotation * moment, axis=(1, 2)), np.sum(by_gyro**2, axis=2) @ weight + 3.0 * pull
    scale = (matched + stiff) / (square + stiff)
    axes = scale[:, None, None] * rotation
    left = seen - by_gyro @ axes.transpose(0, 2, 1)
    prior = pull * np.sum((axes - np.eye(3)) ** 2, axis=(1, 2)) + stiff * (scale - 1.0) ** 2
    return axes, np.asarray(np.sum(left**2, axis=2) @ weight + prior), left


def _rotation(moment: F64) -> F64:
    """Rotations (...,3,3) that are next to matrices (...,3,3)."""
    u, _, vt = np.linalg.svd(moment)
    u[..., 2] *= np.linalg.det(u @ vt)[..., None]
    return np.asarray(u @ vt)


def _without_bias(vectors: F64, dt_s: F64, weight: F64) -> F64:
    """Vectors (...,n,3) less what a constant rate explains of them."""
    share = weight * dt_s
    return np.asarray(vectors - dt_s[:, None] * (share @ vectors / float(share @ dt_s))[..., None, :])
