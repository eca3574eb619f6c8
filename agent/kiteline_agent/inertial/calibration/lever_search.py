"""Where the camera is beside the IMU, from accelerations in turns: for a lever arm that is off by centimetres."""

import numpy as np

from kiteline_core.arrays import F64

_LEVER, _GRAVITY, _BIAS = slice(0, 3), slice(3, 6), slice(6, 9)
_LEAST_FREE = 3.0  # equations more than unknowns
_PULL = 1e-6  # of the bias towards zero, which is not told from gravity where nothing turns
_MEMORY_S = 12.0  # s; time constant of the accelerations: flights turn now and then
_LEAST_M = 0.04  # m; smaller errors cost less than the search may err by
_LEVER_SIGMA_M = 0.2  # m; of a lever arm as told: along an axis about which alone it turns it stays so
_ERROR_M_S = 0.005  # m/s; of a change of velocity, by images and IMU
_MOST_M = 1.0  # m; larger ones are no lever arm of a drone
_EXPLAINED = 0.5  # share of the squared errors that a found lever arm must explain
_SIGNIFICANCE = 60.0  # squared errors that it explains, over the mean square of what it leaves


class LeverSearch:
    """Least squares over [change of the lever arm (3) m, gravity (3) in the map, bias (3)]; older ones count less."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Begin again: in a new map, with other axes or another time offset."""
        self._h, self._g, self._square, self._count = np.zeros((9, 9)), np.zeros(9), 0.0, 0.0

    def rotate_map(self, R_new_old: F64) -> None:
        """Rotate gravity with the map by R_new_old (3,3)."""
        self._h[_GRAVITY, :] = R_new_old @ self._h[_GRAVITY, :]
        self._h[:, _GRAVITY] = self._h[:, _GRAVITY] @ R_new_old.T
        self._g[_GRAVITY] = R_new_old @ self._g[_GRAVITY]

    def add(self, by_lever: F64, by_gravity_s: float, by_bias: F64, error: F64, dt_s: float) -> None:
        """Add an error (3,) m/s of a change of velocity, without gravity, with the present lever arm.

        It is by_lever (3,3) @ change of the lever arm + by_gravity_s * gravity + by_bias (3,3) @ bias. dt_s: since the
        one before.
        """
        j = np.concatenate([by_lever, by_gravity_s * np.eye(3), by_bias], axis=1)
        kept = float(np.exp(-dt_s / _MEMORY_S))
        self._h, self._g = kept * self._h + j.T @ j, kept * self._g + j.T @ error
        self._square = kept * self._square + float(error @ error)
        self._count = kept * self._count + 3.0

    def find(self) -> F64 | None:
        """Change (3,) of the lever arm, camera in the body, m, if it explains far more than none does."""
        free = self._count - 9.0
        if free < _LEAST_FREE:
            return None
        pull = np.full(9, _PULL)
        pull[_LEVER] = (_ERROR_M_S / _LEVER_SIGMA_M) ** 2
        h, others = self._h + np.diag(pull), slice(3, 9)
        x = np.linalg.solve(h, self._g)
        left = max(self._square - float(x @ self._g), 0.0)
        given = self._square - float(self._g[others] @ np.linalg.solve(h[others, others], self._g[others]))
        size, explained = float(np.linalg.norm(x[_LEVER])), given - left
        if not _LEAST_M < size < _MOST_M or explained < _EXPLAINED * given:
            return None
        is_clear = explained > _SIGNIFICANCE * max(left / free, _ERROR_M_S**2)
        return np.asarray(x[_LEVER], np.float64) if is_clear else None
