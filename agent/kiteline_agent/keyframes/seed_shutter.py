"""Seeds in the image of a rolling shutter: where its rows show them, and where they were at the frame's stamp."""

from dataclasses import dataclass

import numpy as np

from kiteline_agent.tracking.shutter.rolling_shutter import RollingShutter
from kiteline_core.arrays import F64, Bool


@dataclass(frozen=True, slots=True)
class SeedShutter:
    """Of seeds at (direction + centre rho) / rho (n,3) in the camera, for inverse depths rho in their keyframes.

    rolled: (n,) those whose keyframes show them as rows did: they are compared as rows show them now.
    """

    shutter: RollingShutter
    direction: F64
    centre: F64
    rolled: Bool

    def segments(self, start: F64, end: F64, rho: F64) -> tuple[F64, F64]:
        """Segments from start to end (n,2) px at the stamp, as rows show them. rho: (n,) 1/m, likely ones."""
        middle = 0.5 * (start + end)
        shift = self.shutter.to_rows(middle, self._inverse_depth(rho))[:, :2] - middle
        shift[self.rolled] = 0.0
        return start + shift, end + shift

    def at_frame(self, uv: F64, rho: F64) -> F64:
        """Pixels (n,2) that rows show, at the stamp. rho: (n,) 1/m."""
        moved = self.shutter.to_frame(uv, self._inverse_depth(rho))[:, :2]
        return np.where(self.rolled[:, None], uv, moved)

    def _inverse_depth(self, rho: F64) -> F64:
        """(n,) in the camera."""
        return np.asarray(rho / np.maximum(self.direction[:, 2] + self.centre[:, 2] * rho, 1e-3))
