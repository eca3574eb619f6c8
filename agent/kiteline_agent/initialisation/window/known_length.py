"""What is known of a window's lengths beside its images and samples of the IMU."""

from dataclasses import dataclass

import numpy as np

from kiteline_core.arrays import F64, I64


@dataclass(frozen=True, slots=True)
class KnownLength:
    """A path's extent: root of the summed squares of its positions about their mean. sigma: relative deviation."""

    metres: float
    sigma: float

    def cost(self, p: F64) -> float:
        """Half the squared error of positions (K,3)."""
        return 0.5 * self._error(p) ** 2

    def add(self, p: F64, rows: I64, h: F64, b: F64) -> float:
        """Add the normal equations of the error; returns its cost. rows: (3 K,) of the positions in h (N,N), b (N,)."""
        spread = (p - p.mean(axis=0)).ravel()
        j, error = spread / (self.sigma * float(spread @ spread)), self._error(p)
        h[np.ix_(rows, rows)] += np.outer(j, j)
        b[rows] += error * j
        return 0.5 * error**2

    def _error(self, p: F64) -> float:
        return float(np.log(extent(p) / self.metres)) / self.sigma


def joint_sigma(sigma: float, known: KnownLength | None) -> float:
    """Relative deviation of lengths that a window knows to `sigma`, together with what else is known of them."""
    return sigma if known is None else float((sigma**-2.0 + known.sigma**-2.0) ** -0.5)


def extent(p: F64) -> float:
    """Of positions (K,3), as in `KnownLength`."""
    return float(np.linalg.norm(p - p.mean(axis=0)))
