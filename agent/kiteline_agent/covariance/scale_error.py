"""Error of positions by the scale of a monocular map, which images do not measure.

All lengths of a map err by the same share, so that the error grows with the distance from where the map began, along
the line to there. Maps that follow each other add theirs up as one error: a later scale rests on the earlier one.
"""

import numpy as np

from kiteline_core.arrays import F64


class ScaleError:
    """Standard deviation of positions, as a vector. sigma: relative deviation of lengths in the map, 0 if certain."""

    def __init__(self) -> None:
        self.sigma = 0.0
        self._before_o: F64 = np.zeros(3)  # m, of the maps before this one
        self._begin_m: F64 = np.zeros(3)  # where the map began, in m and o
        self._begin_o: F64 | None = None

    def begin_map(self, p_m_b: F64, p_o_b: F64) -> None:
        """Begin a map at p_m_b (3,) in it, which is p_o_b (3,) in the odometry frame."""
        self._before_o = self.in_o(p_o_b)
        self._begin_m, self._begin_o = p_m_b.copy(), p_o_b.copy()

    def in_m(self, p_m_b: F64) -> F64:
        """(3,) m at p_m_b (3,), relative to where the map began."""
        return self.sigma * (p_m_b - self._begin_m)

    def in_o(self, p_o_b: F64) -> F64:
        """(3,) m at p_o_b (3,), relative to where the flight began."""
        return self._before_o if self._begin_o is None else self._before_o + self.sigma * (p_o_b - self._begin_o)
