import numpy as np

from kiteline_agent.initialisation.lens_correction import TERMS, moved
from kiteline_agent.initialisation.window_kernels import add_observations
from kiteline_core.geometry import se3


def test_normal_equations_of_observations_are_those_of_their_jacobians() -> None:
    """Beside sums of outer products of each observation's Jacobian, taken by matrices of numpy."""
    rng = np.random.default_rng(3)
    n, m, sigma = 4, 7, 0.002
    xy, error, y = rng.normal(size=(n, m, 2)), rng.normal(size=(n, m, 2)), rng.normal(size=(n, m, 3))
    z, rho = rng.uniform(0.5, 2.0, (n, m)), rng.uniform(0.1, 1.0, m)
    weight = rng.uniform(0.2, 1.0, (n, m)) * (rng.uniform(size=(n, m)) < 0.7)
    R = np.array([se3.so3_exp(v) for v in rng.normal(size=(n, 3))])
    axes = np.array([se3.so3_exp(v) for v in rng.normal(size=(m, 3))])
    R_bc, t_bc, p, origin = (
        se3.so3_exp(rng.normal(size=3)),
        rng.normal(size=3),
        rng.normal(size=(n, 3)),
        np.ones((m, 3)),
    )
    seen = 6 * n + TERMS
    start = rng.normal(size=(seen, seen))  # what was summed before is kept
    hpp, bp, hpk = np.zeros((m, 3, 3)), np.zeros((m, 3)), np.zeros((m, 3, seen))
    hkk, bk, lens = start.copy(), np.zeros(seen), slice(6 * n, seen)
    add_observations(xy, error, weight, sigma, y, z, R_bc, R, p, t_bc, rho, origin, axes, hpp, bp, hpk, hkk, bk)
    point_h, point_b, mixed = np.zeros_like(hpp), np.zeros_like(bp), np.zeros_like(hpk)
    pose_h, pose_b = start.copy(), np.zeros_like(bk)
    for k in range(n):
        for i in range(m):
            slope = (R_bc[:, :2].T - xy[k, i][:, None] * R_bc[:, 2]) / z[k, i] / sigma
            place = np.column_stack([R[k].T @ axes[i][:, :2], R[k].T @ (origin[i] - p[k]) - t_bc])
            of_point = slope @ place
            of_pose = np.column_stack([slope @ se3.skew(y[k, i]), -rho[i] * slope @ R[k].T])
            w, at = weight[k, i], slice(6 * k, 6 * k + 6)
            unit = np.eye(TERMS)
            of_lens = np.stack([moved(xy[k, i], a) - xy[k, i] for a in unit], axis=1) / sigma  # linear in the factors
            point_h[i] += w * of_point.T @ of_point
            point_b[i] += w * of_point.T @ error[k, i]
            mixed[i][:, at] += w * of_point.T @ of_pose
            pose_h[at, at] += w * of_pose.T @ of_pose
            pose_b[at] += w * of_pose.T @ error[k, i]
            mixed[i][:, lens] += w * of_point.T @ of_lens
            pose_h[lens, at] += w * of_lens.T @ of_pose
            pose_h[lens, lens] += w * of_lens.T @ of_lens
            pose_b[lens] += w * of_lens.T @ error[k, i]
    for found, wanted in ((hpp, point_h), (bp, point_b), (hpk, mixed), (hkk, pose_h), (bk, pose_b)):
        assert np.allclose(found, wanted, rtol=1e-9, atol=1e-9 * np.abs(wanted).max())
        assert np.abs(found).max() > 0.0
