"""Velocity of an agent between two plans of what it is sent."""

from dataclasses import dataclass, field

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.ids import SubmapId

_LONGEST = 4.0  # periods between two plans, beyond which the velocity between them is out of date


@dataclass(slots=True)
class AgentVelocity:
    """Call `update` at each plan. period_s: time between two plans, if none is left out."""

    period_s: float
    _last: tuple[int, SubmapId, F64] | None = field(default=None, init=False)  # time stamp, submap, position in w

    def update(self, t_ns: int, submap: SubmapId, position: F64) -> F64:
        """Velocity (3,) m/s in w since the last plan; zero if that was long ago or in another submap.

        position: (3,) m in w.
        """
        last, self._last = self._last, (t_ns, submap, position.copy())
        if last is None or last[1] != submap:
            return np.zeros(3)
        dt_s = (t_ns - last[0]) * 1e-9
        if not 0.0 < dt_s <= _LONGEST * self.period_s:
            return np.zeros(3)
        return (position - last[2]) / dt_s
