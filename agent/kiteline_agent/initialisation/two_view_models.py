"""Homography and fundamental matrix of matched pixels, by seeded RANSAC on normalised points.

All draws are fitted and scored at once, as stacks of small matrices. Scores are those of ORB-SLAM (2015, section IV):
each inlier adds its distance to the outlier bound, so that scores of both models compare.
"""

from collections.abc import Callable

import numpy as np

from kiteline_core.arrays import F64, Bool

_CHI2_POINT = 5.991  # 95 % of a chi-square with 2 degrees of freedom: point to point
_CHI2_LINE = 3.841  # 95 % with 1 degree of freedom: point to line


def homography(a: F64, b: F64, draws: int, sigma_px: float, seed: int) -> tuple[F64, float, Bool]:
    """H (3,3) with b = H a for pixels a, b (n,2), n >= 8; its score, and its inliers (n,)."""
    return _ransac(a, b, 4, draws, sigma_px, seed, _fit_homographies, _score_homographies)


def fundamental(a: F64, b: F64, draws: int, sigma_px: float, seed: int) -> tuple[F64, float, Bool]:
    """F (3,3) with b' F a = 0 for pixels a, b (n,2), n >= 8; its score, and its inliers (n,)."""
    return _ransac(a, b, 8, draws, sigma_px, seed, _fit_fundamentals, _score_fundamentals)


def _ransac(
    a: F64, b: F64, size: int, draws: int, sigma_px: float, seed: int,
    fit: Callable[[F64, F64], F64], score_models: Callable[[F64, F64, F64, float], tuple[F64, Bool]],
) -> tuple[F64, float, Bool]:  # fmt: skip
    scale_a, scale_b = _normalisation(a), _normalisation(b)
    na, nb = _apply(scale_a, a), _apply(scale_b, b)
    turn = scale_b.T if fit is _fit_fundamentals else np.linalg.inv(scale_b)
    chosen = np.argpartition(np.random.default_rng(seed).random((draws, len(a))), size, axis=1)[:, :size]
    models = turn @ fit(na[chosen], nb[chosen]) @ scale_a
    scores, inside = score_models(models, a, b, sigma_px)
    best = int(np.argmax(scores))
    model, score, inlier = models[best], float(scores[best]), inside[best]
    for _ in range(2):  # least squares over the inliers, while the score grows
        if np.count_nonzero(inlier) < 8:
            break
        wider = turn @ fit(na[None, inlier], nb[None, inlier]) @ scale_a
        scores, inside = score_models(wider, a, b, sigma_px)
        if scores[0] <= score:
            break
        model, score, inlier = wider[0], float(scores[0]), inside[0]
    return model, score, inlier


def _normalisation(uv: F64) -> F64:
    """The similarity (3,3) that brings pixels to mean 0 and mean distance sqrt 2 (R. Hartley, 1997)."""
    mean = uv.mean(axis=0)
    s = np.sqrt(2.0) / max(float(np.linalg.norm(uv - mean, axis=1).mean()), 1e-9)
    return np.array([[s, 0.0, -s * mean[0]], [0.0, s, -s * mean[1]], [0.0, 0.0, 1.0]])


def _apply(scale: F64, uv: F64) -> F64:
    return np.asarray(uv * scale[0, 0] + scale[:2, 2])


def _null_vectors(rows: F64) -> F64:
    """Unit vectors (s,9) that stacks of rows (s,k,9) send nearest to zero."""
    return np.asarray(np.linalg.eigh(np.swapaxes(rows, 1, 2) @ rows)[1][:, :, 0])


def _fit_homographies(a: F64, b: F64) -> F64:
    """H (s,3,3) of normalised matches (s,k,2), k >= 4, by direct linear transformation."""
    x, y, u, v = a[..., 0], a[..., 1], b[..., 0], b[..., 1]
    zero, one = np.zeros_like(x), np.ones_like(x)
    rows = np.concatenate(
        [
            np.stack([zero, zero, zero, -x, -y, -one, v * x, v * y, v], -1),
            np.stack([x, y, one, zero, zero, zero, -u * x, -u * y, -u], -1),
        ],
        axis=1,
    )
    return _null_vectors(rows).reshape(-1, 3, 3)


def _fit_fundamentals(a: F64, b: F64) -> F64:
    """F (s,3,3) of rank 2 of normalised matches (s,k,2), k >= 8, by the eight-point algorithm."""
    x, y, u, v = a[..., 0], a[..., 1], b[..., 0], b[..., 1]
    f = _null_vectors(np.stack([u * x, u * y, u, v * x, v * y, v, x, y, np.ones_like(x)], -1)).reshape(-1, 3, 3)
    left, s, right = np.linalg.svd(f)
    s[:, 2] = 0.0
    return np.asarray((left * s[:, None, :]) @ right)


def _score_homographies(models: F64, a: F64, b: F64, sigma_px: float) -> tuple[F64, Bool]:
    """Scores (s,) of H (s,3,3), and which matches each explains (s,n)."""
    regular = np.abs(np.linalg.det(models)) > 1e-15
    models = np.where(regular[:, None, None], models, np.eye(3))
    inverses: F64 = np.asarray(np.linalg.inv(models), np.float64)
    forth, back = _squared_transfer(models, a, b), _squared_transfer(inverses, b, a)
    scores, inside = _score_errors(forth / sigma_px**2, back / sigma_px**2, _CHI2_POINT)
    return np.where(regular, scores, 0.0), inside


def _squared_transfer(models: F64, a: F64, b: F64) -> F64:
    """Squared px (s,n) between H a and b."""
    mapped = np.einsum("sij,nj->sni", models, np.column_stack([a, np.ones(len(a))]))
    w = np.where(np.abs(mapped[..., 2]) > 1e-12, mapped[..., 2], 1e-12)
    return np.asarray(((mapped[..., :2] / w[..., None] - b) ** 2).sum(axis=-1))


def _score_fundamentals(models: F64, a: F64, b: F64, sigma_px: float) -> tuple[F64, Bool]:
    """Scores (s,) of F (s,3,3), and which matches each explains (s,n)."""
    forth, back = _squared_line(models, a, b), _squared_line(np.swapaxes(models, 1, 2), b, a)
    return _score_errors(forth / sigma_px**2, back / sigma_px**2, _CHI2_LINE)


def _squared_line(models: F64, a: F64, b: F64) -> F64:
    """Squared px (s,n) between b and the line F a."""
    line = np.einsum("sij,nj->sni", models, np.column_stack([a, np.ones(len(a))]))
    off = line[..., 0] * b[:, 0] + line[..., 1] * b[:, 1] + line[..., 2]
    return np.asarray(off**2 / np.maximum(line[..., 0] ** 2 + line[..., 1] ** 2, 1e-15))


def _score_errors(forth: F64, back: F64, bound: float) -> tuple[F64, Bool]:
    inside = (forth < bound) & (back < bound)
    gain = np.where(forth < bound, _CHI2_POINT - forth, 0.0) + np.where(back < bound, _CHI2_POINT - back, 0.0)
    return gain.sum(axis=1), inside
