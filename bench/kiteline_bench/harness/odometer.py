"""An odometer for a recording that has none: velocities along its true path, with an error of scale and noise."""

import numpy as np

from kiteline_bench.harness.faults import Spans, within
from kiteline_bench.harness.recording import Recording
from kiteline_core import odometry
from kiteline_core.frame import OdometryBatch, Trajectory
from kiteline_hw.sim.config import SimConfig
from kiteline_hw.sim.sensors import odometer
from kiteline_hw.sim.world.path import Path
from kiteline_hw.sim.world.path_fit import fit

SCALE = 1.01  # a good one, whose wheels or height over ground are known to a per cent
NOISE_M_S = 0.02  # of a sample, in each axis
_HZ, _SEED = 50.0, 3
_KNOT_S, _SMOOTHING = 0.08, 0.02  # of the path, as for the trajectories that simulated flights follow


def measured_along(truth: Trajectory) -> OdometryBatch:
    """Velocities and rates of the body, from the first true pose to the last."""
    config = SimConfig(odometry=_HZ, odometry_scale=SCALE, odometry_noise=NOISE_M_S, seed=_SEED)
    first_ns, last_ns = int(truth.t_ns[0]), int(truth.t_ns[-1])
    t_s = np.asarray((truth.t_ns - first_ns) * 1e-9, np.float64)
    spline = fit(t_s, truth.T_w_b, max(_KNOT_S, 1.5 * float(np.median(np.diff(t_s)))), _SMOOTHING)
    path = Path(spline.coefficients, spline.knot_s, spline.length_s, rest_s=0.0)
    return odometer.measure(path, np.arange(first_ns, last_ns, round(1e9 / _HZ)), first_ns, config, np.eye(4))


def with_odometer_between(recording: Recording, spans: Spans) -> Recording:
    """The recording with an odometer that measures in these spans alone. Its true path must be known."""
    truth = recording.truth
    assert truth is not None
    measured = measured_along(truth)
    keep = within((measured.t_ns - recording.items[0].frame.t_ns) * 1e-9, spans)
    return recording.with_odometry(odometry.chosen(measured, keep) if keep.any() else None)
