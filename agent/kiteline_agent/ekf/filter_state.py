"""State of the filter: camera pose, odometry scale, past views, landmarks, and their joint covariance.

Errors are right-invariant: with R, p of the estimate, the true rotation is exp(xi_R) R, the true position
exp(xi_R) p + xi_p, that of a landmark exp(xi_R) l + xi_l. Then an update never claims to know the heading and place
of the whole map, which nothing measures; errors that add up make a filter claim just that.
Source: A. Barrau, S. Bonnabel, "An EKF-SLAM algorithm with consistency properties", 2015.
"""

from dataclasses import dataclass

import numpy as np

from kiteline_agent.ekf import covariance_kernels as kernels
from kiteline_agent.ekf_config import EkfConfig
from kiteline_core.arrays import F64, I64, Bool
from kiteline_core.geometry import se3

SCALE = 6  # row of the odometry's scale, after position (3) and rotation (3) of the camera
_VIEWS = 7  # first row of the past views, six each


@dataclass(frozen=True, slots=True)
class OdometryMotion:
    """Motion of the camera between two frames by odometry.

    T_c0_c1: (4,4). scaled: (3,) m in c0, the part of the translation that the odometry's scale multiplies. cov: (6,6)
    of its white error: translation along the axes of c0, rotation about those of c1.
    """

    T_c0_c1: F64
    scaled: F64
    cov: F64


class FilterState:
    """The estimate and its covariance P, of which the lower triangle counts. Rows of free slots are zero."""

    def __init__(self, T_o_c: F64, config: EkfConfig) -> None:
        """T_o_c: (4,4) the first camera pose, known exactly: it defines o."""
        self.T_o_c = T_o_c.copy()
        self.scale = 1.0  # true way over that by odometry
        self.view_T_o_c = np.tile(np.eye(4), (config.views, 1, 1))
        self.view_used: Bool = np.zeros(config.views, np.bool_)
        self.points = np.zeros((config.landmarks, 3))  # (n,3) landmarks in o
        self.used: Bool = np.zeros(config.landmarks, np.bool_)
        self._walk = np.zeros(config.landmarks)  # rad: what their pixels drift by, see `add_landmark`
        self._first = _VIEWS + 6 * config.views
        rows = self._first + 3 * config.landmarks
        self.P = np.zeros((rows + -rows % 4,) * 2)  # the kernel that adds products takes four rows at a time
        self.P[SCALE, SCALE] = config.scale_sigma**2
        self._size = self._first

    @property
    def size(self) -> int:
        """Rows up to the last landmark."""
        return self._size

    def view_row(self, view: int) -> int:
        """First row of a past view: position, then rotation."""
        return _VIEWS + 6 * view

    def view_columns(self, views: I64) -> I64:
        """Columns (6 + 6 v,) of the camera and of past views (v,)."""
        return np.concatenate([np.arange(6), *(self.view_row(int(v)) + np.arange(6) for v in views)])

    def landmark_row(self, slot: int | I64) -> int | I64:
        """First row of a landmark."""
        return self._first + 3 * slot

    def rows(self, index: I64) -> F64:
        """Whole rows (m, size) of the covariance."""
        out = np.empty((len(index), self._size))
        kernels.symmetric_rows(self.P, self._size, index, out)
        return out

    def covariance(self, columns: I64) -> F64:
        """Covariance (k,k) of columns (k,) of the state."""
        others = columns[:, None]
        return np.asarray(self.P[np.maximum(columns, others), np.minimum(columns, others)])

    # changes

    def propagate(self, motion: OdometryMotion) -> None:
        """Move the camera by odometry."""
        n, R0 = self._size, self.T_o_c[:3, :3]
        moved = motion.T_c0_c1.copy()
        moved[:3, 3] += (self.scale - 1.0) * motion.scaled
        self.T_o_c = se3.orthonormalise(self.T_o_c @ moved)
        R1, p1 = self.T_o_c[:3, :3], self.T_o_c[:3, 3]
        # An error of the scale moves the position.
        along = self.scale * (R0 @ motion.scaled)
        scale_row = self.rows(np.array([SCALE]))[0]
        for i in range(3):
            self.P[i, : i + 1] += along[i] * scale_row[: i + 1] + scale_row[i] * along[: i + 1]
            self.P[i, : i + 1] += along[i] * scale_row[SCALE] * along[: i + 1]
            self.P[3:n, i] += along[i] * scale_row[3:n]
        # White errors: one of the rotation also moves landmarks relative to the camera's heading. Of six independent
        # ones three do not turn: they move the camera alone.
        factor = _root(motion.cov)
        factor = factor @ np.linalg.qr(factor[3:].T, mode="complete")[0]
        shifted = R0 @ factor[:3]
        turned = R1 @ factor[3:, :3]
        self.P[:3, :3] += shifted[:, 3:] @ shifted[:, 3:].T
        count = (n - self._first) // 3
        noise = np.zeros((3, n))
        for k in range(3):
            across = se3.skew(turned[:, k])
            noise[k, :3] = shifted[:, k] + p1 @ across
            noise[k, 3:6] = turned[:, k]
            noise[k, self._first :] = (self.points[:count] @ across).ravel()
        self._add(noise, 1.0)
        # Errors of a landmark's template change with the view: as if it moved by pixels.
        distance = np.linalg.norm(self.points[:count] - p1, axis=1)
        diagonal = np.arange(self._first, n)
        way = float(np.linalg.norm(motion.T_c0_c1[:3, 3]))
        self.P[diagonal, diagonal] += np.repeat(self._walk[:count] * way * distance, 3)

    def correct(self, change: F64) -> None:
        """Apply a correction (size,) in the coordinates of the error."""
        turn = se3.so3_exp(change[3:6])
        self.T_o_c, self.view_T_o_c = self.corrected_views(np.arange(self._first), change[: self._first])
        self.scale *= float(np.exp(change[SCALE]))
        count = (self._size - self._first) // 3
        used = self.used[:count]
        moved = change[self._first : self._size].reshape(-1, 3) @ _jacobian(change[3:6]).T
        self.points[:count][used] = (self.points[:count] @ turn.T + moved)[used]

    @property
    def used_views(self) -> I64:
        """Past views (n,), increasing."""
        return np.flatnonzero(self.view_used)

    def corrected_views(self, columns: I64, change: F64) -> tuple[F64, F64]:
        """Camera (4,4) and past views (views,4,4) after a change (k,) of columns (k,) of the state."""
        whole = np.zeros(self._first)
        whole[columns] = change
        views = self.view_T_o_c.copy()
        for view in self.used_views.tolist():
            row = self.view_row(view)
            views[view] = se3.exp(whole[row : row + 6]) @ views[view]
        return se3.exp(whole[:6]) @ self.T_o_c, views

    def update(self, rows: F64, L: F64, white: F64) -> None:
        """Kalman update. rows: (m,size) H P. L: (m,m), L L^T = H P H^T + R. white: (m,) L^-1 residual."""
        rows = np.linalg.inv(L) @ rows
        self._add(rows, -1.0)
        self.correct(white @ rows)

    def _add(self, rows: F64, sign: float) -> None:
        """Add sign * rows^T rows to the covariance. rows: (m,size)."""
        m, n = rows.shape
        padded = np.zeros((m + -m % 4, n + -n % 4))
        padded[:m, :n] = rows
        kernels.add_products(self.P, padded, sign)

    def add_view(self, view: int) -> None:
        """Keep the camera's pose as a past view."""
        rows = self.rows(np.arange(6))
        first = self.view_row(view)
        for k in range(6):
            row = rows[k].copy()
            row[first : first + 6] = rows[k, :6]
            kernels.set_row(self.P, self._size, first + k, row)
        self.view_T_o_c[view] = self.T_o_c
        self.view_used[view] = True

    def drop_view(self, view: int) -> None:
        """Forget a past view."""
        self._clear(self.view_row(view), 6)
        self.view_used[view] = False

    def add_landmark(self, slot: int, point: F64, across: F64, cov: F64, walk: float) -> None:
        """Add a landmark in a free slot. across: (3,size) covariance with the state; cov: (3,3). walk: rad^2 by which
        the variance of its direction grows for each rad of parallax.
        """
        first = self._first + 3 * slot
        before = self._size
        self._size = max(self._size, first + 3)
        for k in range(3):
            row = np.zeros(self._size)
            row[:before] = across[k]
            row[first : first + 3] = cov[k]
            kernels.set_row(self.P, self._size, first + k, row)
        self.points[slot] = point
        self.used[slot], self._walk[slot] = True, walk

    def drop_landmark(self, slot: int) -> None:
        """Forget a landmark."""
        self._clear(self._first + 3 * slot, 3)
        self.used[slot], self._walk[slot] = False, 0.0
        self.points[slot] = 0.0

    def _clear(self, first: int, count: int) -> None:
        none = np.zeros(self._size)
        for k in range(count):
            kernels.set_row(self.P, self._size, first + k, none)

    # what is known

    def pose_covariance(self, T_c_b: F64) -> F64:
        """Covariance (6,6) of the body's pose: translation in o, rotation about the body's axes. T_c_b: (4,4)."""
        R, p_b = self.T_o_c[:3, :3] @ T_c_b[:3, :3], (self.T_o_c @ T_c_b)[:3, 3]
        to_error = np.zeros((6, 6))
        to_error[:3, :3], to_error[:3, 3:], to_error[3:, 3:] = np.eye(3), -se3.skew(p_b), R.T
        return np.asarray(to_error @ self.covariance(np.arange(6)) @ to_error.T)


def _root(cov: F64) -> F64:
    """A factor (6,6) of a covariance, factor factor^T; negative variances, as some odometers send them, become 0."""
    try:
        return np.asarray(np.linalg.cholesky(cov + 1e-18 * np.eye(6)))
    except np.linalg.LinAlgError:
        variance, axes = np.linalg.eigh(0.5 * (cov + cov.T))
        return np.asarray(axes * np.sqrt(np.maximum(variance, 0.0)))


def _jacobian(turn: F64) -> F64:
    """Left Jacobian (3,3) of a small rotation, to second order."""
    k = se3.skew(turn)
    return np.asarray(np.eye(3) + 0.5 * k + k @ k / 6.0)
