"""IMU samples integrated over a window between two frames."""

from dataclasses import dataclass

import numpy as np

from kiteline_agent.inertial.calibration.window_kernels import integrate_window
from kiteline_agent.inertial.preintegration import Samples
from kiteline_core.arrays import F64


@dataclass(frozen=True, slots=True)
class Window:
    """Integrals of raw samples, see window_kernels.integrate_window.

    first_rate, last_rate: (3,) rad/s at its ends.
    """

    duration_s: float
    turn: F64
    by_rate: F64
    by_force: F64
    time: F64
    first_rate: F64
    last_rate: F64

    @staticmethod
    def of(samples: Samples, matrix: F64, bias: F64, first_rate: F64, last_rate: F64) -> "Window":
        """Integrate samples. matrix (3,3), bias (3,): rate = matrix @ gyro - bias."""
        turn, by_rate, by_force, time = np.empty((3, 3)), np.empty((3, 9)), np.empty((2, 3, 9)), np.empty((2, 3, 3))
        integrate_window(samples.t_s, samples.gyro, samples.accel, matrix, bias, turn, by_rate, by_force, time)
        return Window(samples.duration_s, turn, by_rate, by_force, time, first_rate, last_rate)
