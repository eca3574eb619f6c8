"""Keyframes, landmarks and inertial state of a monocular window, in metres, by maximum a posteriori.

Three steps, each of which starts the next: structure from one depth and the gyro's rotations, up to scale; scale and
gravity by linear least squares; all of it together. The scale's deviation comes from the last one's Hessian. The first
two follow T. Qin et al., "VINS-Mono", 2018, section V; the last one is that of C. Campos et al., "Inertial-only
optimization for visual-inertial initialization", 2020, with the landmarks among the unknowns.
"""

from dataclasses import dataclass, replace

import numpy as np

from kiteline_agent.inertial import initial_alignment
from kiteline_agent.inertial.fixed_lag import tilt_by_direction
from kiteline_agent.inertial.preintegration import BiasPrior, TimeOffset
from kiteline_agent.inertial_start_config import InertialBundleConfig
from kiteline_agent.initialisation.corner_tracks import CornerObservations
from kiteline_agent.initialisation.window.corner_terms import CornerTerms, ReducedCorners
from kiteline_agent.initialisation.window.inertial_terms import (
    NO_OFFSET,
    OFFSET,
    SHARED,
    STATE,
    CutSamples,
    InertialTerms,
)
from kiteline_agent.initialisation.window.known_length import KnownLength
from kiteline_agent.initialisation.window.lens_correction import TERMS
from kiteline_agent.initialisation.window.rolling_rows import RollingRows
from kiteline_agent.initialisation.window.window_noise import WindowNoise
from kiteline_agent.initialisation.window.window_state import (
    InParts,
    WarmStart,
    WindowSolution,
    WindowState,
    finished,
    tangent,
)
from kiteline_core.arrays import F64, I64
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry import se3

_MAX_DAMPING = 1e4
_PLACE_ITERATIONS = 4  # of landmarks alone
_MOST_TANGENT, _MOST_RHO = 1e3, 1e6  # of a landmark that diverges, as people's do: it is left out, not computed with
_REPEAT_S = 0.01  # s; change of the time offset by which the first stage is repeated
_MOST_GROWTH = 0.5  # of all lengths in one step
_ROUNDS = 2  # in which corners are left out, each followed by another solution
_FIRST_DEPTH_M = 3.0  # m at which all landmarks start; only the sign matters
_STRUCTURE_ITERATIONS, _ITERATIONS = 25, 20  # steps of the first stage, of which nothing is known, and of the last
_STRUCTURE_SETTLED, _SETTLED = 1e-3, 0.1  # fall of the cost, relative and not: a deviation of the scale is worth 0.5


@dataclass(slots=True)
class _System:
    """Normal equations. h, b: of the unknowns without landmarks."""

    cost: float
    h: F64
    b: F64
    corners: ReducedCorners


class InertialBundle:
    """One window. Call `solve`, or `solving`, which pauses after each iteration."""

    def __init__(
        self,
        observations: CornerObservations,
        cut: CutSamples,
        calibration: ImuCalibration,
        T_b_c: F64,
        focal_px: float,
        gravity_m_s2: float,
        prior: BiasPrior,
        config: InertialBundleConfig,
        noise: WindowNoise | None = None,
        lens_info: F64 | None = None,
        offset: TimeOffset = NO_OFFSET,
        length: KnownLength | None = None,
        rows: RollingRows | None = None,
    ) -> None:
        """cut: gives the samples between the keyframes. noise: factors on the inertial error model.

        lens_info: (8,8) inverse covariance of the lens before this window; None: by the options. offset: known before.
        length: of the path, if a sensor other than the IMU tells it. rows: of a rolling shutter; None: a global one.
        """
        self._offset_s = offset.offset_s
        self._terms = InertialTerms(cut, offset, calibration, gravity_m_s2, prior, config, noise or WindowNoise())
        lens_info = lens_prior(config, focal_px) if lens_info is None else lens_info
        self._corners = CornerTerms(observations, T_b_c, focal_px, config, lens_info, rows)
        self._t_bc = T_b_c[:3, 3].copy()
        self._gravity_m_s2 = gravity_m_s2
        self._known_length = length
        self._prior = prior
        self._converged = False
        self._keyframes, self._landmarks = observations.seen.shape
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
        state = self._corners.anchored(replace(state, rho=rho, m=np.zeros((self._landmarks, 2))))
        self._terms.integrate(state)
        system = self._linearise(state, inertial=True)
        still = np.zeros(len(system.b))
        for _ in range(_PLACE_ITERATIONS):
            moved = self._moved(state, still, system)
            state = replace(state, m=moved.m, rho=moved.rho)
            yield
            system = self._linearise(state, inertial=True)
        if self._corners.leave_out(state):
            system = self._linearise(state, inertial=True)
        return self._solution(state, system, np.arange(6, len(still)))

    def readout_step(self, state: WindowState, rows: RollingRows) -> tuple[float, float]:
        """By how much longer the read-out should be at a solution, in s, and its deviation.

        rows: of a short read-out, for derivatives.
        """
        system = self._linearise(state, inertial=True)
        second, first, by_unknowns = self._corners.by_readout(state, rows)
        column = np.zeros(len(system.b))
        column[self._rows_of_corners] = by_unknowns
        h = system.h[6:, 6:]
        along = np.linalg.solve(h + np.diag(1e-9 * np.diag(h) + 1e-12), column[6:])
        information, gradient = second - float(column[6:] @ along), first - float(system.b[6:] @ along)
        return -gradient / information, float(np.sqrt(1.0 / information)) if information > 0.0 else np.inf

    @property
    def _rows_of_corners(self) -> I64:
        """The unknowns (6K+8,) that corners depend on: poses and lens."""
        n, size = self._keyframes, STATE * self._keyframes + SHARED + TERMS
        return np.append((STATE * np.arange(n)[:, None] + np.arange(6)).ravel(), np.arange(size - TERMS, size))

    def landmarks_of(self, state: WindowState) -> tuple[F64, I64]:
        """Landmarks (P,3) in w, and the keyframe (P,) that saw each one first."""
        return state.origin + self._corners.rays(state) / state.rho[:, None], self._corners.first

    # stages

    def _first_state(self) -> InParts[WindowState | None]:
        """The state in metres from nothing; None if it is degenerate."""
        state = yield from self._structure(self._offset_s)
        if abs(state.offset_s - self._offset_s) > _REPEAT_S:  # rotations were off, by which corners were left out
            self._corners.use_all()
            state = yield from self._structure(state.offset_s)
        self.structure_px = self._corners.median_px(state)
        return self._align(state)

    def _structure(self, offset_s: float) -> InParts[WindowState]:
        """Poses and landmarks up to scale, and the time offset, from the gyro's rotations alone and one depth for all.

        offset_s: to begin with.
        """
        n = self._keyframes
        state = WindowState(
            np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), np.zeros((n, 3)), np.tile(self._prior.bias[3:], (n, 1)),
            self._prior.bias[:3].copy(), np.zeros(3), offset_s, np.zeros((self._landmarks, 2)),
            np.zeros(self._landmarks), np.zeros((self._landmarks, 3)),
        )  # fmt: skip
        self._terms.integrate(state)
        rotation = [np.eye(3)]
        for motion in self._terms.motions:
            rotation.append(rotation[-1] @ motion.turn)
        R = np.array(rotation)
        rho = np.full(self._landmarks, 1.0 / _FIRST_DEPTH_M)
        state = self._corners.anchored(replace(state, R=R, p=self._t_bc - R @ self._t_bc, rho=rho))
        unknown = (STATE * np.arange(1, n)[:, None] + np.arange(6)).ravel()
        unknown = np.concatenate([unknown, STATE * n + np.arange(3), [STATE * n + OFFSET]])
        found, _ = yield from self._consistent(state, unknown, _STRUCTURE_ITERATIONS, inertial=False)
        return found

    def _warm_state(self, warm: WarmStart) -> WindowState:
        """The state of an earlier solution, carried to the newest keyframes by the IMU. NaN: unknown landmarks."""
        old = warm.state
        R, p, v, bias = (list(x) for x in (old.R, old.p, old.v, old.accel_bias))
        for samples in self._terms.samples_at(old.offset_s)[len(R) - 1 :]:
            both = np.concatenate([old.gyro_bias, bias[-1]])
            motion = self._terms.preintegrate(samples, both)
            T, velocity = motion.propagate(se3.from_rt(R[-1], p[-1]), v[-1], both, old.gravity)
            R, p, v, bias = [*R, T[:3, :3]], [*p, T[:3, 3]], [*v, velocity], [*bias, bias[-1]]
        state = replace(old, R=np.array(R), p=np.array(p), v=np.array(v), accel_bias=np.array(bias))
        return self._corners.at_places(state, warm.xyz, _FIRST_DEPTH_M)

    def _align(self, state: WindowState) -> WindowState | None:
        """The state in metres, with velocities and gravity."""
        T_w_b = np.tile(np.eye(4), (self._keyframes, 1, 1))
        T_w_b[:, :3, :3], T_w_b[:, :3, 3] = state.R, state.p
        bias = np.concatenate([state.gyro_bias, self._prior.bias[3:]])
        self._terms.integrate(state)
        found = initial_alignment.align(
            T_w_b, self._t_bc, self._terms.motions, bias, self._gravity_m_s2, with_scale=True
        )
        if found is None:
            return None
        camera = state.p + state.R @ self._t_bc
        p = found.scale * (camera - camera[0]) + camera[0] - state.R @ self._t_bc
        origin = found.scale * (state.origin - camera[0]) + camera[0]
        rho = state.rho / found.scale
        return replace(state, p=p, v=found.velocities, gravity=found.gravity, rho=rho, origin=origin)

    def _consistent(
        self, state: WindowState, unknown: I64, iterations: int, *, inertial: bool
    ) -> InParts[tuple[WindowState, _System]]:
        """`_iterate`, and again without the corners that do not fit: a robust weight does not end their pull."""
        state, system = yield from self._iterate(state, unknown, iterations, inertial=inertial)
        for _ in range(_ROUNDS):
            if not self._corners.leave_out(state):
                break
            state, system = yield from self._iterate(state, unknown, iterations, inertial=inertial)
        return state, system

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
            if self._terms.moved_far(state):
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
        along[_positions(n)] = (spread / max(float((spread**2).sum()), 1e-12)).ravel()
        variance = float(along @ cov @ along)
        if not (np.isfinite(cov).all() and variance > 0.0 and np.isfinite(state.p).all()):
            return None
        if not self._terms.has_samples_at(state.offset_s):
            return None
        last = STATE * (n - 1)
        order = np.concatenate(
            [last + np.arange(9), STATE * n + np.arange(3), last + np.arange(9, 12), STATE * n + 3 + np.arange(2)]
        )
        to_tilt = np.eye(len(order))
        to_tilt[-2:, -2:] = tilt_by_direction(state.gravity, tangent(state.gravity))
        offset = TimeOffset(state.offset_s, float(np.sqrt(cov[STATE * n + OFFSET, STATE * n + OFFSET])))
        return WindowSolution(
            state, se3.from_rt(state.R[-1], state.p[-1]), state.v[-1],
            np.concatenate([state.gyro_bias, state.accel_bias[-1]]), state.gravity, offset,
            to_tilt @ cov[np.ix_(order, order)] @ to_tilt.T, cov[-TERMS:, -TERMS:].copy(),
            float(np.sqrt(variance)), system.cost, self._converged, self._corners.reprojection_px,
            self._terms.mean_chi2(state), self._terms.evidence(state, cov), self._corners.newest_depth_m(state),
            np.sqrt(np.maximum(system.corners.inv[:, 2, 2], 0.0)) / state.rho,
        )  # fmt: skip

    # errors and normal equations

    def _cost(self, state: WindowState, *, inertial: bool) -> float:
        known = self._known_length.cost(state.p) if self._known_length is not None and inertial else 0.0
        return self._corners.cost(state) + self._terms.cost(state, inertial=inertial) + known

    def _linearise(self, state: WindowState, *, inertial: bool) -> _System:
        n, size = self._keyframes, STATE * self._keyframes + SHARED + TERMS
        h, b = np.zeros((size, size)), np.zeros(size)
        self._corners.follow_shutter(state)
        corners = self._corners.reduced(state)
        rows = self._rows_of_corners
        h[np.ix_(rows, rows)] += corners.h
        b[rows] += corners.b
        cost = corners.cost + self._terms.add(state, h, b, inertial=inertial)
        if self._known_length is not None and inertial:
            cost += self._known_length.add(state.p, _positions(n), h, b)
        return _System(cost, h, b, corners)

    def _moved(self, state: WindowState, step: F64, system: _System) -> WindowState:
        n = self._keyframes
        x, shared = step[: STATE * n].reshape(n, STATE), step[STATE * n : STATE * n + SHARED]
        R = np.array([r @ se3.so3_exp(phi) for r, phi in zip(state.R, x[:, :3], strict=True)])
        gravity = state.gravity
        if gravity.any():
            gravity = gravity + self._gravity_m_s2 * tangent(gravity) @ shared[3:5]
            gravity = self._gravity_m_s2 * gravity / np.linalg.norm(gravity)
        lens = step[STATE * n + SHARED :]
        landmark = system.corners.landmark_steps(np.append(x[:, :6].ravel(), lens))
        # A map that grows is the same to the camera, but a linear step of inverse depths is not: the growth in the step
        # is applied exactly, and the rest of the step to the longer map.
        dp, dv = x[:, 3:6], x[:, 6:9]
        share = self._lengthened_by(state, dp) if gravity.any() else 0.0
        along, origin = self._corners.with_longer_lengths(state, share)
        landmark -= along
        away = state.p - state.p[0] + (state.R - state.R[0]) @ self._t_bc  # cameras from the first one
        p = state.p + dp + share * (dp - share * away)
        v = state.v + dv + share * (dv - share * state.v)
        return WindowState(
            R, p, v, state.accel_bias + x[:, 9:],
            state.gyro_bias + shared[:3], gravity, state.offset_s + float(shared[OFFSET]),
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


def _positions(keyframes: int) -> I64:
    """Rows of the positions of so many keyframes among the unknowns."""
    return np.asarray((STATE * np.arange(keyframes)[:, None] + np.arange(3, 6)).ravel())


def lens_prior(config: InertialBundleConfig, focal_px: float) -> F64:
    """(8,8) inverse covariance of the errors of a calibrated camera."""
    centre = config.lens_centre_px / focal_px
    radial, turn = config.lens_radial, config.camera_turn_rad
    sigma = np.array([config.lens_focal, centre, centre, radial, radial, turn, turn, turn])
    return np.diag(sigma**-2.0)
