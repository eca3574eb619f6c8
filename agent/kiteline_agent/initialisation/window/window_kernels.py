"""Normal equations of a monocular window's observations, before landmarks are eliminated."""

import numpy as np

from kiteline_agent.initialisation.window.lens_correction import FARTHEST, TERMS
from kiteline_core.arrays import F64
from kiteline_core.jit import njit


@njit
def add_observations(
    xy: F64, error: F64, weight: F64, sigma: float, y: F64, z: F64, R_bc: F64, R: F64, p: F64, t_bc: F64, rho: F64,
    origin: F64, axes: F64, hpp: F64, bp: F64, hpk: F64, hkk: F64, bk: F64,
) -> None:  # fmt: skip
    """Add the observations of P landmarks by K keyframes; those without weight are left out.

    xy (K,P,2): predicted pixels over focal. error (K,P,2): in deviations. weight (K,P). sigma: of a pixel over focal.
    y (K,P,3), z (K,P): landmarks in the body, and their depths, times rho (P,). R (K,3,3), p (K,3): bodies in w; R_bc
    (3,3), t_bc (3,): the camera in the body. origin (P,3), axes (P,3,3): of the landmarks' (m, rho).
    Added to: hpp (P,3,3), bp (P,3) of landmarks; hkk (6K+8,6K+8), bk (6K+8,) of rotations and positions, and of the
    lens, of which the rows alone are filled, not the columns beside the poses; hpk (P,3,6K+8).
    """
    to_point = np.empty((3, 3))
    of_pose = np.empty((2, 6))
    of_point = np.empty((2, 3))
    of_lens = np.zeros((2, TERMS))
    lens = 6 * xy.shape[0]
    s = np.empty(3)
    for k in range(xy.shape[0]):
        for i in range(xy.shape[1]):
            if weight[k, i] <= 0.0:
                continue
            root = np.sqrt(weight[k, i])
            for a in range(3):
                for b in range(2):
                    to_point[a, b] = (
                        R[k, 0, a] * axes[i, 0, b] + R[k, 1, a] * axes[i, 1, b] + R[k, 2, a] * axes[i, 2, b]
                    )
                to_point[a, 2] = (
                    R[k, 0, a] * (origin[i, 0] - p[k, 0]) + R[k, 1, a] * (origin[i, 1] - p[k, 1])
                    + R[k, 2, a] * (origin[i, 2] - p[k, 2]) - t_bc[a]
                )  # fmt: skip
            y0, y1, y2 = y[k, i, 0], y[k, i, 1], y[k, i, 2]
            for r in range(2):
                for a in range(3):
                    s[a] = (R_bc[a, r] - xy[k, i, r] * R_bc[a, 2]) / z[k, i] * root / sigma
                of_pose[r, 0] = s[1] * y2 - s[2] * y1
                of_pose[r, 1] = s[2] * y0 - s[0] * y2
                of_pose[r, 2] = s[0] * y1 - s[1] * y0
                for a in range(3):
                    of_pose[r, 3 + a] = -rho[i] * (R[k, a, 0] * s[0] + R[k, a, 1] * s[1] + R[k, a, 2] * s[2])
                    of_point[r, a] = s[0] * to_point[0, a] + s[1] * to_point[1, a] + s[2] * to_point[2, a]
            x0, x1, whitened = xy[k, i, 0], xy[k, i, 1], root / sigma
            square = min(x0 * x0 + x1 * x1, FARTHEST)
            of_lens[0, 0], of_lens[1, 0] = x0 * whitened, x1 * whitened
            of_lens[0, 1], of_lens[1, 2] = whitened, whitened
            of_lens[0, 3], of_lens[1, 3] = x0 * square * whitened, x1 * square * whitened
            of_lens[0, 4], of_lens[1, 4] = x0 * square * square * whitened, x1 * square * square * whitened
            of_lens[0, 5], of_lens[1, 5] = x0 * x1 * whitened, (1.0 + x1 * x1) * whitened
            of_lens[0, 6], of_lens[1, 6] = -(1.0 + x0 * x0) * whitened, -x0 * x1 * whitened
            of_lens[0, 7], of_lens[1, 7] = x1 * whitened, -x0 * whitened
            e0, e1 = error[k, i, 0] * root, error[k, i, 1] * root
            at = 6 * k
            for a in range(3):
                bp[i, a] += of_point[0, a] * e0 + of_point[1, a] * e1
                for b in range(3):
                    hpp[i, a, b] += of_point[0, a] * of_point[0, b] + of_point[1, a] * of_point[1, b]
                for b in range(6):
                    hpk[i, a, at + b] += of_point[0, a] * of_pose[0, b] + of_point[1, a] * of_pose[1, b]
            for a in range(6):
                bk[at + a] += of_pose[0, a] * e0 + of_pose[1, a] * e1
                for b in range(6):
                    hkk[at + a, at + b] += of_pose[0, a] * of_pose[0, b] + of_pose[1, a] * of_pose[1, b]
            for a in range(TERMS):
                l0, l1, row = of_lens[0, a], of_lens[1, a], lens + a
                bk[row] += l0 * e0 + l1 * e1
                for b in range(3):
                    hpk[i, b, row] += of_point[0, b] * l0 + of_point[1, b] * l1
                for b in range(6):
                    hkk[row, at + b] += l0 * of_pose[0, b] + l1 * of_pose[1, b]
                for b in range(TERMS):
                    hkk[row, lens + b] += l0 * of_lens[0, b] + l1 * of_lens[1, b]
