"""Rolling shutter: pixels moved from the time of their row to that of the frame, by the camera's predicted motion."""

from dataclasses import dataclass, replace

import numpy as np

from kiteline_core.arrays import F32, F64
from kiteline_core.geometry.cameras import GRID_STEP, RectifiedCamera

_STEP_RHO = 1e-3  # 1/m, of differences by inverse depth


@dataclass(frozen=True, slots=True)
class RollingShutter:
    """Motion of a camera while the rows of one image were exposed; a frame's stamp is that of its middle row.

    readout_s: from the first row to the last. height: rows of the raw image. grid: (gh,gw,2) raw pixels of every
    GRID_STEP-th rectified one, None if the image needs no rectification. twist: (6,) [m/s, rad/s] of the camera, in
    its own axes. right_grid: as grid, of a right camera whose rows are exposed together with those of the left one.
    """

    camera: RectifiedCamera
    readout_s: float
    height: int
    grid: F32 | None
    twist: F64
    right_grid: F32 | None = None

    def scaled(self, factor: float) -> "RollingShutter":
        """The same where all lengths are `factor` times as long."""
        return replace(self, twist=self.twist * [factor, factor, factor, 1.0, 1.0, 1.0])

    def to_frame(self, uv: F64, rho: F64) -> F64:
        """Where pixels (n,2), of landmarks at inverse depths (n,) 1/m, would be at the frame's stamp.

        Returns (n,3): u, v, and the factor by which the inverse depth changes.
        """
        return self._moved(uv, rho, self.row_times_s(uv))

    def to_rows(self, uv: F64, rho: F64) -> F64:
        """The inverse of `to_frame`, to first order of the readout time."""
        return self._moved(uv, rho, -self.row_times_s(uv))

    def largest_px(self) -> float:
        """Largest shift of a pixel at the image's border, of a landmark 2 m away."""
        w, h = self.camera.width - 1.0, self.camera.height - 1.0
        border = np.array([[0.0, 0.0], [w, 0.0], [0.0, h], [w, h], [0.5 * w, 0.0], [0.5 * w, h]])
        return float(np.abs(self.to_frame(border, np.full(len(border), 0.5))[:, :2] - border).max())

    def to_frame_with_parallax(self, uv: F64, rho: F64) -> tuple[F64, F64]:
        """`to_frame`, and by how much x/z and y/z there (n,2) change with the inverse depth, in m."""
        row_times_s = self.row_times_s(uv)
        moved, near = (self._moved(uv, rho + step, row_times_s) for step in (0.0, _STEP_RHO))
        change = (near[:, :2] - moved[:, :2]) / (_STEP_RHO * np.array([self.camera.fx, self.camera.fy]))
        return moved, np.asarray(change)

    def at_once(self, uv: F64, disparity: F64) -> F64:
        """Disparities (n,) of pixels (n,2) as if the right image had been exposed when the left one was; < 0: unknown.

        Rectification brings rows together that two cameras expose at different times.
        """
        if self.right_grid is None:
            return disparity
        c, v, w = self.camera, self.twist[:3], self.twist[3:]
        right_uv = np.column_stack([uv[:, 0] - disparity, uv[:, 1]])
        dt_s = self._times_s(right_uv, self.right_grid) - self.row_times_s(uv)
        x, y, rho = (right_uv[:, 0] - c.cx) / c.fx, (uv[:, 1] - c.cy) / c.fy, disparity / c.bf
        right_twist = np.concatenate([v + np.array([0.0, w[2], -w[1]]) * c.baseline_m, w])
        moved_x, _, _ = moved_back(x, y, rho, right_twist, dt_s)
        return np.where(disparity >= 0.0, disparity - c.fx * (moved_x - x), disparity)

    def row_times_s(self, uv: F64) -> F64:
        """Times (n,) of the rows of pixels (n,2) after the frame's stamp."""
        return self._times_s(uv, self.grid)

    def _times_s(self, uv: F64, grid: F32 | None) -> F64:
        v = uv[:, 1]
        if grid is not None:
            gh, gw = grid.shape[:2]
            column = np.clip(np.rint(uv[:, 0] / GRID_STEP).astype(np.int64), 0, gw - 1)
            line = np.clip(np.rint(v / GRID_STEP).astype(np.int64), 0, gh - 1)
            v = grid[line, column, 1] + (v - GRID_STEP * line)
        share = np.clip((v + 0.5) / self.height, 0.0, 1.0)
        return np.asarray(self.readout_s * (share - 0.5))

    def _moved(self, uv: F64, rho: F64, dt_s: F64) -> F64:
        """Pixels of landmarks seen at uv, after the camera has moved back by dt_s (n,)."""
        c = self.camera
        x, y, z = moved_back((uv[:, 0] - c.cx) / c.fx, (uv[:, 1] - c.cy) / c.fy, rho, self.twist, dt_s)
        return np.column_stack([x * c.fx + c.cx, y * c.fy + c.cy, 1.0 / z])


def moved_back(x: F64, y: F64, rho: F64, twist: F64, dt_s: F64) -> tuple[F64, F64, F64]:
    """Landmarks at x/z, y/z (...), at inverse depths rho 1/m, after the camera has moved back by dt_s: x/z, y/z, and z.

    twist: (...,6) [m/s, rad/s] of the camera, in its own axes. z: in units of the depth before.
    """
    v, w = twist[..., :3], twist[..., 3:]
    # the point (x, y, 1) / rho moves by w x p + v, in units of its depth
    px = x + dt_s * (w[..., 1] - w[..., 2] * y + v[..., 0] * rho)
    py = y + dt_s * (w[..., 2] * x - w[..., 0] + v[..., 1] * rho)
    pz = np.maximum(1.0 + dt_s * (w[..., 0] * y - w[..., 1] * x + v[..., 2] * rho), 0.1)
    return px / pz, py / pz, pz
