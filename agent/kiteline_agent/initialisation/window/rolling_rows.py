"""A rolling shutter in a window: where corners were at the stamps of keyframes whose rows showed them at others."""

from dataclasses import dataclass, replace

import numpy as np

from kiteline_agent.initialisation.window.window_state import WindowState
from kiteline_agent.tracking.shutter.rolling_shutter import RollingShutter, moved_back
from kiteline_core.arrays import F64


@dataclass(frozen=True, slots=True)
class RollingRows:
    """When the rows of K keyframes were exposed, and how the camera moved then.

    stamps_s: (K,). rate: (K,3) rad/s of the body by the gyro, with its bias. shutter: of a camera that does not move.
    """

    stamps_s: F64
    rate: F64
    shutter: RollingShutter

    def with_readout(self, readout_s: float) -> "RollingRows":
        """The same with another read-out."""
        return replace(self, shutter=replace(self.shutter, readout_s=readout_s))

    def row_times_s(self, xy: F64) -> F64:
        """Times (...) of the rows that show x/z, y/z (...,2) after a keyframe's stamp."""
        c = self.shutter.camera
        uv = xy.reshape(-1, 2) * [c.fx, c.fy] + [c.cx, c.cy]
        return self.shutter.row_times_s(uv).reshape(xy.shape[:-1])

    def twists(self, state: WindowState, T_b_c: F64) -> F64:
        """Twists (K,6) of the camera in its own axes; velocities by differences while the state has none."""
        rate = self.rate - state.gyro_bias
        velocity = state.v
        if not velocity.any():
            velocity = np.gradient(state.p, self.stamps_s, axis=0)
        body = np.einsum("kij,ki->kj", state.R, velocity) + np.cross(rate, T_b_c[:3, 3])
        return np.asarray(np.concatenate([body, rate], axis=1) @ np.kron(np.eye(2), T_b_c[:3, :3]))


def shifts(xy: F64, rho: F64, twists: F64, dt_s: F64) -> F64:
    """How far rows at dt_s (K,P) after the stamps show landmarks from their places xy (K,P,2) at the stamps.

    rho: (K,P) 1/m inverse depths. twists: (K,6) of the camera.
    """
    x, y, _ = moved_back(xy[..., 0], xy[..., 1], rho, twists[:, None], -dt_s)
    return np.stack([x, y], axis=-1) - xy
