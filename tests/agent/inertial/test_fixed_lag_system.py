"""The fixed-lag smoother's step and its marginalisation against dense algebra."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from kiteline_agent.inertial import fixed_lag_kernels as kernels
from kiteline_agent.inertial import inertial_kernels
from kiteline_agent.inertial.preintegration import preintegrate
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from tests.agent.lag_flights import CALIBRATION, make_flight
from tests.core.helpers_from_python import from_python

SEEDS = st.integers(0, 2**31)
STATES = 3
GRAVITY_M_S2 = 9.81


def definite(rng: np.random.Generator, n: int) -> F64:
    half = rng.normal(size=(n, n))
    return np.asarray(half @ half.T + np.eye(n))


def turned(rng: np.random.Generator, r: F64) -> F64:
    return np.asarray(r @ se3.so3_exp(0.05 * rng.normal(size=3)))


class Window:
    """Some states, and terms of all kinds at them, as the kernels take them. Velocity is measured in some frames."""

    def __init__(self, seed: int) -> None:
        rng, n = np.random.default_rng(seed), STATES
        flight = make_flight(seed, n)
        self.motions = [preintegrate(flight.samples(k), 0.02 * rng.normal(size=6), CALIBRATION) for k in range(n)]
        self.rot = np.empty((n, 3, 3))
        self.rot[0] = se3.so3_exp(rng.normal(size=3))
        for k in range(1, n):
            self.rot[k] = turned(rng, self.rot[k - 1] @ self.motions[k - 1].turn)
        self.state, self.tilt = 0.1 * rng.normal(size=(n, 12)), 0.2 * rng.normal(size=2)
        self.info = np.array([definite(rng, 9) for _ in range(n)])
        self.walk = rng.uniform(1.0, 5.0, (n, 2))
        self.prior_h, self.prior_b = definite(rng, 17), rng.normal(size=17)
        self.prior_r, self.prior_s = turned(rng, self.rot[0]), self.state[0] + 0.1 * rng.normal(size=12)
        self.prior_tilt = self.tilt + 0.05 * rng.normal(size=2)
        self.vis_h, self.vis_b = np.array([definite(rng, 6) for _ in range(n)]), rng.normal(size=(n, 6))
        self.vis_r = np.array([turned(rng, r) for r in self.rot])
        self.vis_p = self.state[:, :3] + 0.1 * rng.normal(size=(n, 3))
        self.vel, self.vel_info = rng.normal(size=(n, 3)), np.array([definite(rng, 3) for _ in range(n)])
        self.vel_info[1] = 0.0

    def system(self, states: int, observed: int) -> tuple[F64, F64]:
        """Matrix and right-hand side of so many states and the tilt, with what the first `observed` ones observe."""
        size = 15 * states + 2
        h, b = np.zeros((size, size)), np.zeros(size)
        tilt = [size - 2, size - 1]

        def add(at: list[int], j: F64, info: F64, residual: F64) -> None:
            h[np.ix_(at, at)] += j.T @ info @ j
            b[at] -= j.T @ info @ residual

        def add_linearised(at: list[int], info: F64, side: F64, moved: F64) -> None:
            add(at, np.eye(len(at)), info, moved)
            b[at] += side

        off = [se3.so3_log(self.prior_r.T @ self.rot[0]), self.state[0] - self.prior_s, self.tilt - self.prior_tilt]
        add_linearised([*range(15), *tilt], self.prior_h, self.prior_b, np.concatenate(off))
        for k in range(observed):
            at, r = 15 * k, self.rot[k]
            moved = np.concatenate([se3.so3_log(self.vis_r[k].T @ r), self.state[k, :3] - self.vis_p[k]])
            add_linearised([*range(at, at + 6)], self.vis_h[k], self.vis_b[k], moved)
            u = r.T @ self.state[k, 3:6]
            j = np.column_stack([se3.skew(u), r.T])
            add([*range(at, at + 3), *range(at + 6, at + 9)], j, self.vel_info[k], u - self.vel[k])
        for k, motion in enumerate(self.motions[: states - 1]):
            residual, j = np.empty(9), np.empty((9, 32))
            from_python(inertial_kernels.imu_terms)(
                self.rot[k], self.state[k], self.rot[k + 1], self.state[k + 1], self.tilt, GRAVITY_M_S2, motion.dt_s,
                motion.turn, motion.vp, motion.jac, motion.bias, residual, j,
            )  # fmt: skip
            both = [*range(15 * k, 15 * k + 30)]
            add([*both, *tilt], j, self.info[k], residual)
            biases = np.column_stack([-np.eye(6), np.eye(6)])
            change = self.state[k + 1, 6:] - self.state[k, 6:]
            add([*both[9:15], *both[24:]], biases, np.diag(np.repeat(self.walk[k], 3)), change)
        return h, b

    def stacked(self, name: str) -> F64:
        return np.array([getattr(motion, name) for motion in self.motions])


@settings(max_examples=10)
@given(SEEDS)
def test_a_step_is_that_of_the_dense_system(seed: int) -> None:
    w = Window(seed)
    h, b = w.system(STATES, STATES)
    x, cov, none = np.linalg.solve(h, b), np.empty((17, 17)), np.zeros((STATES, 1, 3))
    rot, state, tilt = w.rot.copy(), w.state.copy(), w.tilt.copy()
    cost = kernels.smooth(
        STATES, 1, 0, rot, state, tilt, GRAVITY_M_S2, w.stacked("dt_s"), w.stacked("turn"), w.stacked("vp"),
        w.stacked("jac"), w.stacked("bias"), w.info, w.walk, w.prior_h, w.prior_b, w.prior_r, w.prior_s, w.prior_tilt,
        np.eye(3), np.zeros(3), np.ones(5), np.zeros(STATES, np.int64), none, none, none, none[:, :, 0].copy(),
        np.zeros((STATES, 1), np.bool_), 1.0, np.ones(STATES), w.vis_h, w.vis_b, w.vis_r, w.vis_p, w.vel, w.vel_info,
        cov,
    )  # fmt: skip
    assert cost >= 0.0
    for k in range(STATES):
        step = x[15 * k : 15 * k + 15]
        np.testing.assert_allclose(rot[k], w.rot[k] @ se3.so3_exp(step[:3]), atol=1e-8)
        np.testing.assert_allclose(state[k], w.state[k] + step[3:], atol=1e-8)
    np.testing.assert_allclose(tilt, w.tilt + x[-2:], atol=1e-8)
    np.testing.assert_allclose(cov, np.linalg.inv(h)[-17:, -17:], rtol=1e-6, atol=1e-9)


def without(h: F64, b: F64, gone: list[int]) -> tuple[F64, F64]:
    """The system after some unknowns are eliminated."""
    left = [k for k in range(len(b)) if k not in gone]
    gain = np.linalg.solve(h[np.ix_(gone, gone)], h[np.ix_(gone, left)]).T
    return h[np.ix_(left, left)] - gain @ h[np.ix_(gone, left)], b[left] - gain @ b[gone]


@settings(max_examples=10)
@given(SEEDS, st.sampled_from([0.0, 0.01, 0.5]))
def test_the_prior_after_marginalisation_is_the_dense_one(seed: int, tilt_walk: float) -> None:
    w = Window(seed)
    h, b = without(*w.system(2, 1), gone=[*range(15)])
    if tilt_walk > 0.0:  # the old tilt gives way to a new one, which differs by a random walk
        wide, side, step = np.zeros((19, 19)), np.append(b, np.zeros(2)), np.column_stack([-np.eye(2), np.eye(2)])
        wide[:17, :17] = h
        wide[15:, 15:] += step.T @ step / tilt_walk
        h, b = without(wide, side, gone=[15, 16])
    motion = w.motions[0]
    assert kernels.marginalise(
        w.rot[:2], w.state[:2], w.tilt, GRAVITY_M_S2, motion.dt_s, motion.turn, motion.vp, motion.jac, motion.bias,
        w.info[0], w.walk[0], w.vis_h[0], w.vis_b[0], w.vis_r[0], w.vis_p[0], w.vel[0], w.vel_info[0], tilt_walk,
        w.prior_h, w.prior_b, w.prior_r, w.prior_s, w.prior_tilt,
    )  # fmt: skip
    np.testing.assert_allclose(w.prior_h, h, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(w.prior_b, b, rtol=1e-7, atol=1e-7)
    np.testing.assert_array_equal(w.prior_r, w.rot[1])
    np.testing.assert_array_equal(w.prior_s, w.state[1])
    np.testing.assert_array_equal(w.prior_tilt, w.tilt)
