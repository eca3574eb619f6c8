"""How far rotations by images scatter from frame to frame against the gyro: things that move drag the poses along.

Within a window the gyro's bias and the time offset are fitted to the rotations between frames; what is left is neither.
"""

import numpy as np

from kiteline_agent.inertial.calibration.pose_chain import SampledMotion, rate_at
from kiteline_agent.inertial.calibration.window import Window
from kiteline_agent.inertial.samples.sample_buffer import SampleBuffer
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3

_FITTED = 4  # bias and time offset
_CHANCE = 4.0  # times the expected mean square: chance makes up to 3 of it, and worn lenses seldom more


def added_variance(
    link: SampledMotion, buffer: SampleBuffer, matrix: F64, bias: F64, image_rad: float, density: float
) -> float:
    """Variance, rad^2 about an axis, that a window's rotation by images has beyond the expected one.

    matrix (3,3), bias (3,): of the gyro. image_rad: expected error of a rotation by images. density: of the gyro's
    noise, rad/s/sqrt(Hz). Errors of single frames stay as small as they are in the window; those of a map that is
    dragged along add up, and are taken for such.
    """
    steps = len(link.frames) - 1
    if 3 * steps <= _FITTED:
        return 0.0
    off, j, dt_s = np.empty(3 * steps), np.empty((3 * steps, _FITTED)), 0.0
    raw = [rate_at(buffer, t_ns) for t_ns, _ in link.frames]
    rates = [(np.zeros(3) if rate is None else rate) @ matrix.T - bias for rate in raw]
    for k, ((t0_ns, T0), (t1_ns, T1)) in enumerate(zip(link.frames, link.frames[1:])):
        samples = buffer.between(t0_ns, t1_ns)
        if samples is None:
            return 0.0
        window = Window.of(samples, matrix, bias, rates[k], rates[k + 1])
        rows, back = slice(3 * k, 3 * k + 3), window.turn.T
        off[rows] = se3.so3_log(back @ T0[:3, :3].T @ T1[:3, :3])
        j[rows, :3], j[rows, 3] = -back @ window.time[0], window.last_rate - back @ window.first_rate
        dt_s += samples.duration_s / steps
    left = off - j @ np.linalg.lstsq(j, off, rcond=None)[0]
    mean_square = float(left @ left) / (3 * steps - _FITTED)
    return steps * max(0.0, mean_square - _CHANCE * (image_rad**2 + density**2 * dt_s))
