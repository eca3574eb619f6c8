"""Keyframes, landmarks and inertial state of a monocular window, in metres, by maximum a posteriori.

Three steps, each of which starts the next: structure from one depth and the gyro's rotations, up to scale; scale and
gravity by linear least squares; all of it together. The scale's deviation comes from the last one's Hessian. The first
two follow T. Qin et al., "VINS-Mono", 2018, section V; the last one is that of C. Campos et al., "Inertial-only
optimization for visual-inertial initialization", 2020, with the landmarks among the unknowns.
"""

from dataclasses import dataclass, replace

import numpy as np

from kiteline_agent.inertial import initial_alignment
from kiteline_agent.inertial.preintegration import BiasPrior, Samples
from kiteline_agent.inertial_start_config import InertialBundleConfig
from kiteline_agent.initialisation import lens_correction
from kiteline_agent.initialisation.corner_tracks import CornerObservations
from kiteline_agent.initialisation.inertial_terms import SHARED, STATE, InertialTerms
from kiteline_agent.initialisation.inertial_window import (
    InParts,
    WarmStart,
    WindowSolution,
    WindowState,
    finished,
    tangent,
)
from kiteline_agent.initialisation.lens_correction import TERMS
from kiteline_agent.initialisation.window_kernels import add_observations
from kiteline_agent.initialisation.window_noise import WindowNoise
from kiteline_core.arrays import F64, I64
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry import se3

_MAX_DAMPING = 1e4
_PLACE_ITERATIONS = 4  # of landmarks alone
_MOST_TANGENT, _MOST_RHO = 1e3, 1e6  # of a landmark that diverges, as people's do: it is left out, not computed with
_MOST_GROWTH = 0.5  # of all lengths in one step
_ROUNDS = 2  # in which corners are left out, each followed by another solution
_FIRST_DEPTH_M = 3.0  # m at which all landmarks start; only the sign matters
_STRUCTURE_ITERATIONS, _ITERATIONS = 25, 20  # steps of the first stage, of which nothing is known, and of the last
_STRUCTURE_SETTLED, _SETTLED = 1e-3, 0.1  # fall of the cost, relative and not: a deviation of the scale is worth 0.5
_MAX_RMS = 3.0  # deviations, and times the median, beyond which a corner moves and is left out; most have 0.6


@dataclass(slots=True)
class _System:
    """Normal equations. h, b: of the unknowns without landmarks. inv, iw, bp: to find those again."""

    cost: float
    h: F64
    b: F64
    inv: F64
    iw: F64
    bp: F64


class InertialBundle:
    """One window. Call `solve`, or `solving`, which pauses after each iteration."""

    def __init__(
        self,
        observations: CornerObservations,
        intervals: list[Samples],
        calibration: ImuCalibration,
        T_b_c: F64,
        focal_px: float,
        gravity_m_s2: float,
        prior: BiasPrior,
        config: InertialBundleConfig,
        noise: WindowNoise | None = None,
        lens_info: F64 | None = None,
    ) -> None:
        """intervals: K - 1, between the keyframes. noise: factors on the inertial error model.

        lens_info: (8,8) inverse covariance of the lens before this window; None: by the options.
        """
        self._obs = observations
        self._terms = InertialTerms(intervals, calibration, gravity_m_s2, prior, config, noise or WindowNoise())
        self._r_bc, self._t_bc = T_b_c[:3, :3].copy(), T_b_c[:3, 3].copy()
        self._sigma = config.sigma_px / focal_px
        self._length = gravity_m_s2
        self._prior = prior
        self._config = config
        self._lens_info = lens_prior(config, focal_px) if lens_info is None else lens_info
        self._converged = False
        self._keyframes, self._landmarks = observations.seen.shape
        self._axes = np.zeros((self._landmarks, 3, 3))  # of the landmarks, see WindowState
        self._error = np.zeros((0, 0))  # (K,P) of observations in deviations
        self._used = np.ones(self._landmarks, np.bool_)  # the other landmarks move, or their corners slide along edges
        self._projected: tuple[WindowState, tuple[F64, F64, F64, F64]] | None = None  # the last state's projections
        self.structure_px = 0.0  # median error of corners in the structure that a solution from nothing starts with

    def solve(self, warm: WarmStart | None = None) -> WindowSolution | None:
        """The window's states; None if it is degenerate. warm: states to start from."""
        with np.errstate(all="ignore"):
            return finished(self.solving(warm))

    def solving(self, warm: WarmStart | None) -> InParts[WindowSolution | None]:
        """`solve` in parts. Where images and IMU contradict each other it diverges, which numpy must not warn of."""
        try:
            state = (yield from self._first_state()) if warm is None else self._warm_state(warm)
            if state is None:
                return None
            self._terms.integrate(state)
            every = np.arange(6, STATE * self._keyframes + SHARED + TERMS)
            if warm is None:  # what moves is left out before the lens may bend to it
                state, _ = yield from self._consistent(state, every[:-TERMS], _ITERATIONS, inertial=True)
            state, system = yield from self._consistent(state, every, _ITERATIONS, inertial=True)
            return self._solution(state, system, every)
        except np.linalg.LinAlgError:
            return None

    def placing_landmarks(self, state: WindowState) -> InParts[WindowSolution | None]:
        """The solution with these poses (rho of any length is replaced) and every landmark of the observations."""
        rho = np.full(self._landmarks, float(np.median(state.rho)))
        state = self._anchored(replace(state, rho=rho, m=np.zeros((self._landmarks, 2))))
        self._terms.integrate(state)
        system = self._linearise(state, inertial=True)
        still = np.zeros(len(system.b))
        for _ in range(_PLACE_ITERATIONS):
            moved = self._moved(state, still, system)
            state = replace(state, m=moved.m, rho=moved.rho)
            yield
            system = self._linearise(state, inertial=True)
        if self._leave_out(state):
            system = self._linearise(state, inertial=True)
        return self._solution(state, system, np.arange(6, len(still)))

    def landmarks_of(self, state: WindowState) -> tuple[F64, I64]:
        """Landmarks (P,3) in w, and the keyframe (P,) that saw each one first."""
        return state.origin + self._rays(state) / state.rho[:, None], np.argmax(self._obs.seen, axis=0)

    def _rays(self, state: WindowState) -> F64:
        """(P,3) from the landmarks' origins to the landmarks, in w, times rho."""
        m = np.append(state.m, np.ones((self._landmarks, 1)), axis=1)
        return np.asarray((self._axes @ m[..., None])[..., 0])

    # stages

    def _first_state(self) -> InParts[WindowState | None]:
        """The state in metres from nothing; None if it is degenerate."""
        state = yield from self._structure()
        error = np.linalg.norm(self._project(state)[3][self._obs.seen], axis=-1)
        self.structure_px = float(np.median(error)) * self._config.sigma_px
        return self._align(state)

    def _structure(self) -> InParts[WindowState]:
        """Poses and landmarks up to scale: from one depth for all, no translation, and the gyro's rotations."""
        n = self._keyframes
        state = WindowState(
            np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), np.zeros((n, 3)), np.tile(self._prior.bias[3:], (n, 1)),
            self._prior.bias[:3].copy(), np.zeros(3), np.zeros((self._landmarks, 2)), np.zeros(self._landmarks),
            np.zeros((self._landmarks, 3)),
        )  # fmt: skip
        self._terms.integrate(state)
        rotation = [np.eye(3)]
        for motion in self._terms.motions:
            rotation.append(rotation[-1] @ motion.turn)
        R = np.array(rotation)
        rho = np.full(self._landmarks, 1.0 / _FIRST_DEPTH_M)
        state = self._anchored(replace(state, R=R, p=self._t_bc - R @ self._t_bc, rho=rho))
        unknown = (STATE * np.arange(1, n)[:, None] + np.arange(6)).ravel()
        unknown = np.concatenate([unknown, STATE * n + np.arange(3)])
        found, _ = yield from self._consistent(state, unknown, _STRUCTURE_ITERATIONS, inertial=False)
        return found

    def _warm_state(self, warm: WarmStart) -> WindowState:
        """The state of an earlier solution, carried to the newest keyframes by the IMU. NaN: unknown landmarks."""
        old = warm.state
        R, p, v, bias = (list(x) for x in (old.R, old.p, old.v, old.accel_bias))
        for samples in self._terms.intervals[len(R) - 1 :]:
            both = np.concatenate([old.gyro_bias, bias[-1]])
            motion = self._terms.preintegrate(samples, both)
            T, velocity = motion.propagate(se3.from_rt(R[-1], p[-1]), v[-1], both, old.gravity)
            R, p, v, bias = [*R, T[:3, :3]], [*p, T[:3, 3]], [*v, velocity], [*bias, bias[-1]]
        state = replace(old, R=np.array(R), p=np.array(p), v=np.array(v), accel_bias=np.array(bias))
        state = self._anchored(state)
        depth = np.einsum("pi,pi->p", warm.xyz - state.origin, self._axes[:, :, 2])
        known = np.isfinite(depth) & (depth > 0.1)
        usual = float(np.median(depth[known])) if known.any() else _FIRST_DEPTH_M
        return replace(state, rho=1.0 / np.where(known, depth, usual))

    def _align(self, state: WindowState) -> WindowState | None:
        """The state in metres, with velocities and gravity."""
        T_w_b = np.tile(np.eye(4), (self._keyframes, 1, 1))
        T_w_b[:, :3, :3], T_w_b[:, :3, 3] = state.R, state.p
        bias = np.concatenate([state.gyro_bias, self._prior.bias[3:]])
        self._terms.integrate(state)
        found = initial_alignment.align(T_w_b, self._t_bc, self._terms.motions, bias, self._length, with_scale=True)
        if found is None:
            return None
        camera = state.p + state.R @ self._t_bc
        p = found.scale * (camera - camera[0]) + camera[0] - state.R @ self._t_bc
        origin = found.scale * (state.origin - camera[0]) + camera[0]
        rho = state.rho / found.scale
        return replace(state, p=p, v=found.velocities, gravity=found.gravity, rho=rho, origin=origin)

    def _anchored(self, state: WindowState) -> WindowState:
        """The state with each landmark on the ray of the keyframe that saw it first, at its depth there."""
        first = np.argmax(self._obs.seen, axis=0)
        camera = state.p + state.R @ self._t_bc
        self._axes = (state.R @ self._r_bc)[first]
        shown = self._obs.xy[first, np.arange(self._landmarks)]
        return replace(state, m=lens_correction.true_place(shown, state.lens), origin=camera[first])

    def _consistent(
        self, state: WindowState, unknown: I64, iterations: int, *, inertial: bool
    ) -> InParts[tuple[WindowState, _System]]:
        """`_iterate`, and again without the corners that do not fit: a robust weight does not end their pull."""
        state, system = yield from self._iterate(state, unknown, iterations, inertial=inertial)
        for _ in range(_ROUNDS):
            if not self._leave_out(state):
                break
            state, system = yield from self._iterate(state, unknown, iterations, inertial=inertial)
        return state, system

    def _leave_out(self, state: WindowState) -> bool:
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

    def _iterate(
        self, state: WindowState, unknown: I64, iterations: int, *, inertial: bool
    ) -> InParts[tuple[WindowState, _System]]:
        """Levenberg-Marquardt over the unknowns with these columns."""
        self._converged, damping = False, 1e-4 if inertial else 1e-3
        system = self._linearise(state, inertial=inertial)
        for _ in range(iterations):
            yield
            h = system.h[np.ix_(unknown, unknown)]
            step = np.zeros(len(system.b))
            step[unknown] = -np.linalg.solve(h + np.diag(damping * np.diag(h) + 1e-9), system.b[unknown])
            moved = self._moved(state, step, system)
            cost = self._cost(moved, inertial=inertial)
            if not cost < system.cost:
                damping *= 10.0
                if damping > _MAX_DAMPING:
                    break
                continue
            enough = _SETTLED if inertial else _STRUCTURE_SETTLED * system.cost
            settled = system.cost - cost < enough
            state, damping = moved, max(0.1 * damping, 1e-9)
            if self._terms.biases_moved(state):
                self._terms.integrate(state)
            system = self._linearise(state, inertial=inertial)
            if settled:
                self._converged = True
                break
        return state, system

    def _solution(self, state: WindowState, system: _System, unknown: I64) -> WindowSolution | None:
        n = self._keyframes
        cov = np.zeros_like(system.h)
        try:
            cov[np.ix_(unknown, unknown)] = np.linalg.inv(system.h[np.ix_(unknown, unknown)])
        except np.linalg.LinAlgError:
            return None
        spread = state.p - state.p.mean(axis=0)
        along = np.zeros(len(cov))
        rows = (STATE * np.arange(n)[:, None] + np.arange(3, 6)).ravel()
        along[rows] = (spread / max(float((spread**2).sum()), 1e-12)).ravel()
        variance = float(along @ cov @ along)
        if not (np.isfinite(cov).all() and variance > 0.0 and np.isfinite(state.p).all()):
            return None
        last = STATE * (n - 1)
        order = np.concatenate(
            [last + np.arange(9), STATE * n + np.arange(3), last + np.arange(9, 12), STATE * n + 3 + np.arange(2)]
        )
        camera = state.p[-1] + state.R[-1] @ self._t_bc
        scaled = (self._rays(state) + state.rho[:, None] * (state.origin - camera)) @ (state.R[-1] @ self._r_bc)
        fits = self._error[self._obs.seen & self._used]
        fits = fits[fits < 3.0]
        reprojection_px = float(np.sqrt(np.mean(fits**2))) * self._config.sigma_px if len(fits) else np.inf
        return WindowSolution(
            state, se3.from_rt(state.R[-1], state.p[-1]), state.v[-1],
            np.concatenate([state.gyro_bias, state.accel_bias[-1]]), state.gravity, cov[np.ix_(order, order)],
            cov[-TERMS:, -TERMS:].copy(), float(np.sqrt(variance)), system.cost, self._converged,
            reprojection_px, self._terms.mean_chi2(state), self._terms.evidence(state, cov),
            scaled[:, 2] / state.rho, np.sqrt(np.maximum(system.inv[:, 2, 2], 0.0)) / state.rho,
        )  # fmt: skip

    # errors

    def _project(self, state: WindowState) -> tuple[F64, F64, F64, F64]:
        """Landmarks in the body (K,P,3) times rho, depth times rho (K,P), pixels over focal (K,P,2), error there."""
        if self._projected is not None and self._projected[0] is state:
            return self._projected[1]
        to = state.origin[None] - state.p[:, None]
        y = (self._rays(state)[None] + state.rho[None, :, None] * to) @ state.R
        q = (y - state.rho[None, :, None] * self._t_bc) @ self._r_bc
        z = np.maximum(q[..., 2], 1e-3)
        xy = q[..., :2] / z[..., None]
        error = (lens_correction.moved(xy, state.lens) - self._obs.xy) / self._sigma
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

    def _cost(self, state: WindowState, *, inertial: bool) -> float:
        lens = 0.5 * float(state.lens @ self._lens_info @ state.lens)
        return self._visual_cost(self._project(state)[3])[0] + self._terms.cost(state, inertial=inertial) + lens

    # normal equations

    def _linearise(self, state: WindowState, *, inertial: bool) -> _System:
        n, size, lens = self._keyframes, STATE * self._keyframes + SHARED + TERMS, 6 * self._keyframes
        y, z, xy, error = self._project(state)
        cost, weight = self._visual_cost(error)
        h, b = np.zeros((size, size)), np.zeros(size)
        hpp, bp = np.zeros((self._landmarks, 3, 3)), np.zeros((self._landmarks, 3))
        seen = lens + TERMS  # unknowns that the observations depend on
        hpk, reduced, rest = np.zeros((self._landmarks, 3, seen)), np.zeros((seen, seen)), np.zeros(seen)
        add_observations(
            xy, error, weight, self._sigma, y, z, self._r_bc, state.R, state.p, self._t_bc, state.rho, state.origin,
            self._axes, hpp, bp, hpk, reduced, rest,
        )  # fmt: skip
        reduced[:lens, lens:] = reduced[lens:, :lens].T
        reduced[lens:, lens:] += self._lens_info
        rest[lens:] += self._lens_info @ state.lens
        cost += 0.5 * float(state.lens @ self._lens_info @ state.lens)
        # landmarks are eliminated (Schur complement)
        hpp[:, [0, 1, 2], [0, 1, 2]] += np.array([1e-6, 1e-6, 1e-4]) + 1e-12 * np.einsum("pii->p", hpp)[:, None]
        inv = np.asarray(np.linalg.inv(hpp), np.float64)
        iw = inv @ hpk
        reduced -= hpk.reshape(-1, seen).T @ iw.reshape(-1, seen)
        rest -= bp.ravel() @ iw.reshape(-1, seen)
        rows = np.append((STATE * np.arange(n)[:, None] + np.arange(6)).ravel(), np.arange(size - TERMS, size))
        h[np.ix_(rows, rows)] += reduced
        b[rows] += rest
        cost += self._terms.add(state, h, b, inertial=inertial)
        return _System(cost, h, b, inv, iw, bp)

    def _moved(self, state: WindowState, step: F64, system: _System) -> WindowState:
        n = self._keyframes
        x, shared = step[: STATE * n].reshape(n, STATE), step[STATE * n : STATE * n + SHARED]
        R = np.array([r @ se3.so3_exp(phi) for r, phi in zip(state.R, x[:, :3], strict=True)])
        gravity = state.gravity
        if gravity.any():
            gravity = gravity + self._length * tangent(gravity) @ shared[3:]
            gravity = self._length * gravity / np.linalg.norm(gravity)
        lens = step[STATE * n + SHARED :]
        landmark = -(system.inv @ system.bp[..., None])[..., 0] - system.iw @ np.append(x[:, :6].ravel(), lens)
        # A map that grows is the same to the camera, but a linear step of inverse depths is not: the growth in the step
        # is applied exactly, and the rest of the step to the longer map.
        dp, dv = x[:, 3:6], x[:, 6:9]
        share = self._lengthened_by(state, dp) if gravity.any() else 0.0
        along, origin = self._with_longer_lengths(state, share)
        landmark -= along
        away = state.p - state.p[0] + (state.R - state.R[0]) @ self._t_bc  # cameras from the first one
        p = state.p + dp + share * (dp - share * away)
        v = state.v + dv + share * (dv - share * state.v)
        return WindowState(
            R, p, v, state.accel_bias + x[:, 9:],
            state.gyro_bias + shared[:3], gravity,
            np.clip(state.m + landmark[:, :2], -_MOST_TANGENT, _MOST_TANGENT),
            np.clip((state.rho + landmark[:, 2]) / (1.0 + share), 1e-4, _MOST_RHO), origin,
            state.lens + lens,
        )  # fmt: skip

    def _lengthened_by(self, state: WindowState, step: F64) -> float:
        """Share by which a step (K,3) of the positions lengthens all lengths."""
        spread = state.p - state.p.mean(axis=0)
        square = float((spread**2).sum())
        found = float((spread * step).sum()) / square if square > 0.0 else 0.0
        return float(np.clip(found, -_MOST_GROWTH, _MOST_GROWTH))

    def _with_longer_lengths(self, state: WindowState, share: float) -> tuple[F64, F64]:
        """Change (P,3) of (m, rho) at the old origins, to first order, and new origins (P,3), if lengths grow so."""
        first = state.p[0] + state.R[0] @ self._t_bc  # the first camera, which stays
        away = share * (state.origin - first + self._rays(state) / state.rho[:, None])
        moved = np.einsum("pij,pi->pj", self._axes, away) * state.rho[:, None]
        change = np.column_stack([moved[:, :2] - state.m * moved[:, 2:], -state.rho * moved[:, 2]])
        return change, state.origin + share * (state.origin - first)


def lens_prior(config: InertialBundleConfig, focal_px: float) -> F64:
    """(8,8) inverse covariance of the errors of a calibrated camera."""
    centre = config.lens_centre_px / focal_px
    radial, turn = config.lens_radial, config.camera_turn_rad
    sigma = np.array([config.lens_focal, centre, centre, radial, radial, turn, turn, turn])
    return np.diag(sigma**-2.0)
