"""The images' part of a window: where its landmarks are, errors of their corners, and which of these do not fit."""

from dataclasses import dataclass, replace

import numpy as np

from kiteline_agent.inertial_start_config import InertialBundleConfig
from kiteline_agent.initialisation.corner_tracks import CornerObservations
from kiteline_agent.initialisation.window import lens_correction
from kiteline_agent.initialisation.window.lens_correction import TERMS
from kiteline_agent.initialisation.window.rolling_rows import RollingRows, shifts
from kiteline_agent.initialisation.window.window_kernels import add_observations
from kiteline_agent.initialisation.window.window_state import WindowState
from kiteline_core.arrays import F64, I64

_MAX_RMS = 3.0  # deviations, and times the median, beyond which a corner moves and is left out; most have 0.6
_INLIER = 3.0  # deviations of a single corner, for the error that a solution reports


@dataclass(slots=True)
class ReducedCorners:
    """Normal equations of poses and lens. cost: half the squared errors. h (6K+8,6K+8), b (6K+8,).

    inv (P,3,3), iw (P,3,6K+8), bp (P,3): to find the landmarks' steps again.
    """

    cost: float
    h: F64
    b: F64
    inv: F64
    iw: F64
    bp: F64

    def landmark_steps(self, step: F64) -> F64:
        """(P,3) of (m, rho), for a step (6K+8,) of poses and lens."""
        return np.asarray(-(self.inv @ self.bp[..., None])[..., 0] - self.iw @ step)


class CornerTerms:
    """Corners of P landmarks in K keyframes, whose places depend on poses, landmarks and lens."""

    def __init__(
        self, observations: CornerObservations, T_b_c: F64, focal_px: float, config: InertialBundleConfig,
        lens_info: F64, rows: RollingRows | None = None,
    ) -> None:  # fmt: skip
        """lens_info: (8,8) inverse covariance of the lens. rows: of a rolling shutter; None: a global one."""
        self._obs = observations
        self._rows, self._T_b_c = rows, T_b_c
        self._row_times_s = None if rows is None else rows.row_times_s(observations.xy)
        self._shown = observations.xy  # (K,P,2) where a global shutter would show the corners, see follow_shutter
        self._r_bc, self._t_bc = T_b_c[:3, :3].copy(), T_b_c[:3, 3].copy()
        self._sigma = config.sigma_px / focal_px
        self._config = config
        self._lens_info = lens_info
        self.keyframes, self.landmarks = observations.seen.shape
        self._axes = np.zeros((self.landmarks, 3, 3))  # of the landmarks, see WindowState
        self._error = np.zeros((0, 0))  # (K,P) of observations in deviations
        self._used = np.ones(self.landmarks, np.bool_)  # the other landmarks move, or their corners slide along edges
        self._projected: tuple[WindowState, tuple[F64, F64, F64, F64]] | None = None  # the last state's projections

    # landmarks

    @property
    def first(self) -> I64:
        """(P,) the keyframe that saw each landmark first."""
        return np.asarray(np.argmax(self._obs.seen, axis=0))

    def anchored(self, state: WindowState) -> WindowState:
        """The state with each landmark on the ray of the keyframe that saw it first, at its depth there."""
        first = self.first
        camera = state.p + state.R @ self._t_bc
        self._axes = (state.R @ self._r_bc)[first]
        shown = self._shown[first, np.arange(self.landmarks)]
        return replace(state, m=lens_correction.true_place(shown, state.lens), origin=camera[first])

    def at_places(self, state: WindowState, xyz: F64, usual_m: float) -> WindowState:
        """The state with landmarks at the depths of xyz (P,3) m; at the median of these, or usual_m, where NaN."""
        state = self.anchored(state)
        depth = np.einsum("pi,pi->p", xyz - state.origin, self._axes[:, :, 2])
        known = np.isfinite(depth) & (depth > 0.1)
        usual_m = float(np.median(depth[known])) if known.any() else usual_m
        return replace(state, rho=1.0 / np.where(known, depth, usual_m))

    def rays(self, state: WindowState) -> F64:
        """(P,3) from the landmarks' origins to the landmarks, in w, times rho."""
        m = np.append(state.m, np.ones((self.landmarks, 1)), axis=1)
        return np.asarray((self._axes @ m[..., None])[..., 0])

    def newest_depth_m(self, state: WindowState) -> F64:
        """(P,) of the landmarks in the newest camera."""
        camera = state.p[-1] + state.R[-1] @ self._t_bc
        scaled = (self.rays(state) + state.rho[:, None] * (state.origin - camera)) @ (state.R[-1] @ self._r_bc)
        return np.asarray(scaled[:, 2] / state.rho)

    def with_longer_lengths(self, state: WindowState, share: float) -> tuple[F64, F64]:
        """Change (P,3) of (m, rho) at the old origins, to first order, and new origins (P,3), if lengths grow so."""
        first = state.p[0] + state.R[0] @ self._t_bc  # the first camera, which stays
        away = share * (state.origin - first + self.rays(state) / state.rho[:, None])
        moved = np.einsum("pij,pi->pj", self._axes, away) * state.rho[:, None]
        change = np.column_stack([moved[:, :2] - state.m * moved[:, 2:], -state.rho * moved[:, 2]])
        return change, state.origin + share * (state.origin - first)

    # which corners count

    def use_all(self) -> None:
        """Take back all that was left out."""
        self._used[:] = True

    def leave_out(self, state: WindowState) -> bool:
        """Leave out the corners that do not fit. Returns whether there are any.

        Errors count beside their median as well: before the solver has converged, those of still corners are large.
        """
        square = np.where(self._obs.seen, np.sum(self._project(state)[3] ** 2, axis=2), 0.0)
        rms = np.sqrt(square.sum(axis=0) / np.maximum(self._obs.seen.sum(axis=0), 1))
        if not self._used.any():
            return False
        fits = rms < _MAX_RMS * max(1.0, float(np.median(rms[self._used])))
        changed = bool((self._used & ~fits).any())
        self._used &= fits
        return changed

    def median_px(self, state: WindowState) -> float:
        """Median error of all corners."""
        error = np.linalg.norm(self._project(state)[3][self._obs.seen], axis=-1)
        return float(np.median(error)) * self._config.sigma_px

    @property
    def reprojection_px(self) -> float:
        """Root mean square of the inliers, of the last state whose cost was asked for."""
        fits = self._error[self._obs.seen & self._used]
        fits = fits[fits < _INLIER]
        return float(np.sqrt(np.mean(fits**2))) * self._config.sigma_px if len(fits) else np.inf

    # errors

    def follow_shutter(self, state: WindowState) -> None:
        """Take the corners of a rolling shutter to the keyframes' stamps, by how the camera moves in this state."""
        if self._rows is None or self._row_times_s is None:
            return
        _, z, xy, _ = self._project(state)
        twists = self._rows.twists(state, self._T_b_c)
        self._shown = self._obs.xy - shifts(xy, state.rho / z, twists, self._row_times_s)
        self._projected = None

    def cost(self, state: WindowState) -> float:
        """Half the squared errors of corners, made robust, and of the lens."""
        return self._visual_cost(self._project(state)[3])[0] + self._lens_cost(state)

    def by_readout(self, state: WindowState, rows: RollingRows) -> tuple[float, float, F64]:
        """Second and first derivative of the cost by the read-out, and that of `b` (6K+8,) in `reduced`; by s.

        rows: of the same keyframes, with a short read-out. Landmarks are eliminated.
        """
        system = self.reduced(state)
        _, z, xy, error = self._project(state)
        _, weight = self._visual_cost(error)
        shift = shifts(xy, state.rho / z, rows.twists(state, self._T_b_c), rows.row_times_s(self._obs.xy))
        column = shift / self._sigma
        shown = self._shown
        self._shown, self._projected = shown - shift, None
        longer = self.reduced(state)
        self._shown, self._projected = shown, None
        of_landmarks = longer.bp - system.bp
        eliminated = (system.inv @ of_landmarks[..., None])[..., 0]
        second = float((weight[..., None] * column * column).sum() - (of_landmarks * eliminated).sum())
        first = float((weight[..., None] * column * error).sum() - (system.bp * eliminated).sum())
        unit_s = rows.shutter.readout_s
        return second / unit_s**2, first / unit_s, (longer.b - system.b) / unit_s

    def _lens_cost(self, state: WindowState) -> float:
        return 0.5 * float(state.lens @ self._lens_info @ state.lens)

    def _project(self, state: WindowState) -> tuple[F64, F64, F64, F64]:
        """Landmarks in the body (K,P,3) times rho, depth times rho (K,P), pixels over focal (K,P,2), error there."""
        if self._projected is not None and self._projected[0] is state:
            return self._projected[1]
        to = state.origin[None] - state.p[:, None]
        y = (self.rays(state)[None] + state.rho[None, :, None] * to) @ state.R
        q = (y - state.rho[None, :, None] * self._t_bc) @ self._r_bc
        z = np.maximum(q[..., 2], 1e-3)
        xy = q[..., :2] / z[..., None]
        error = (lens_correction.moved(xy, state.lens) - self._shown) / self._sigma
        found = y, z, xy, np.where(q[..., 2:] > 1e-2, error, 1e3)
        self._projected = state, found
        return found

    def _visual_cost(self, error: F64) -> tuple[float, F64]:
        """Robust cost, and weights (K,P) of the observations."""
        k = self._config.huber
        used = self._obs.seen & self._used
        norm = np.where(used, np.linalg.norm(error, axis=2), 0.0)
        self._error = norm
        weight = np.where(norm < k, 1.0, k / np.maximum(norm, 1e-9)) * used
        # so that costs with different corners can be compared, those left out cost what they would just before
        left_out = k * (_MAX_RMS - 0.5 * k) * float(np.count_nonzero(self._obs.seen & ~self._used))
        return float(np.where(norm < k, 0.5 * norm**2, k * (norm - 0.5 * k)).sum()) + left_out, weight

    def reduced(self, state: WindowState) -> ReducedCorners:
        """Normal equations of poses and lens; landmarks are eliminated (Schur complement)."""
        lens = 6 * self.keyframes
        seen = lens + TERMS  # unknowns that the observations depend on
        y, z, xy, error = self._project(state)
        cost, weight = self._visual_cost(error)
        hpp, bp = np.zeros((self.landmarks, 3, 3)), np.zeros((self.landmarks, 3))
        hpk, h, b = np.zeros((self.landmarks, 3, seen)), np.zeros((seen, seen)), np.zeros(seen)
        add_observations(
            xy, error, weight, self._sigma, y, z, self._r_bc, state.R, state.p, self._t_bc, state.rho, state.origin,
            self._axes, hpp, bp, hpk, h, b,
        )  # fmt: skip
        h[:lens, lens:] = h[lens:, :lens].T
        h[lens:, lens:] += self._lens_info
        b[lens:] += self._lens_info @ state.lens
        hpp[:, [0, 1, 2], [0, 1, 2]] += np.array([1e-6, 1e-6, 1e-4]) + 1e-12 * np.einsum("pii->p", hpp)[:, None]
        inv = np.asarray(np.linalg.inv(hpp), np.float64)
        iw = inv @ hpk
        h -= hpk.reshape(-1, seen).T @ iw.reshape(-1, seen)
        b -= bp.ravel() @ iw.reshape(-1, seen)
        return ReducedCorners(cost + self._lens_cost(state), h, b, inv, iw, bp)
