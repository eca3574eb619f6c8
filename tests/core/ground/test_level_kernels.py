"""Kernels of ground segmentation against plain numpy."""

import numpy as np

from kiteline_core.ground import label_kernels, level_kernels, profile_kernels
from kiteline_core.ground.column_scan import level_rotation
from kiteline_core.ground.level_kernels import BIN_PX

H, W = 40, 90
CAMERA = np.array([60.0, 30.0, 44.0, 19.0])
BF = 7.0
SLOPES = np.tan(np.linspace(-0.6, 0.6, 13))


def a_disparity(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    d = rng.uniform(0.1, 20.0, (H, W))
    return np.where(rng.random((H, W)) < 0.2, 0.0, d).astype(np.float32)


def levelled(seed: int, disparity: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """x, z, column and known pixels by the kernel, of a tilted camera."""
    rotation = np.ascontiguousarray(level_rotation(np.array([0.1, -0.95, -0.2])).T)
    x, z = np.zeros((H, W), np.float32), np.zeros((H, W), np.float32)
    column = np.zeros((H, W), np.int16)
    offset = np.array([0.1, -0.2, 0.05, 0.3, 0.1])
    known = np.zeros((len(SLOPES) - 1, 2), np.int32)
    disparity = a_disparity(seed) if disparity is None else disparity
    level_kernels.level_points(disparity, rotation, CAMERA, BF, offset, 0.25, SLOPES, x, z, column, known)
    return x, z, column, known


def test_known_pixels_below_the_horizon_are_counted_where_both_eyes_saw_them() -> None:
    disparity = a_disparity(3)
    disparity[:, :7] = 0.0  # not seen by the right eye
    disparity[::5, 3] = 4.0  # but for errors
    disparity[10:, 50:60] = 0.0
    known = levelled(3, disparity)[3]
    u, v = np.meshgrid((np.arange(W) - CAMERA[2]) / CAMERA[0], (np.arange(H) - CAMERA[3]) / CAMERA[1])
    ray = np.stack([u, v, np.ones_like(u)], -1) @ level_rotation(np.array([0.1, -0.95, -0.2]))
    slope = ray[..., 1] / ray[..., 0]
    use = (ray[..., 2] < 0.0) & (np.arange(W) >= 7) & (ray[..., 0] > 0.2) & (slope >= SLOPES[0]) & (slope < SLOPES[-1])
    of = np.clip(np.searchsorted(SLOPES, slope, side="right") - 1, 0, len(SLOPES) - 2)
    n = len(SLOPES) - 1
    wanted = np.stack([np.bincount(of[use & (disparity > 0)], minlength=n), np.bincount(of[use], minlength=n)], 1)
    assert known.sum(0).tolist() == wanted.sum(0).tolist()
    assert np.abs(known - wanted).max() <= 3  # pixels at the border of two columns: the table has 1024 steps
    share = known[:, 0] / known[:, 1]
    assert share.min() < 0.5 < share.max()


def test_level_points() -> None:
    x, z, column, _ = levelled(1)
    disparity = a_disparity(1).astype(np.float64)
    u, v = np.meshgrid((np.arange(W) - CAMERA[2]) / CAMERA[0], (np.arange(H) - CAMERA[3]) / CAMERA[1])
    offset = 0.1 - 0.2 * u + 0.05 * v + 0.3 * u * u + 0.1 * u * v
    depth = BF / np.maximum(disparity - offset, 0.25)
    p = np.stack([u, v, np.ones_like(u)], -1) * depth[..., None] @ level_rotation(np.array([0.1, -0.95, -0.2]))
    slope = p[..., 1] / p[..., 0]
    inside = (disparity > 0.0) & (p[..., 0] > 0.2 * depth) & (slope >= SLOPES[0]) & (slope < SLOPES[-1])
    assert np.array_equal(column >= 0, inside)
    assert np.allclose(x[inside], p[..., 0][inside], rtol=1e-5)
    assert np.allclose(z[inside], p[..., 2][inside], rtol=1e-4, atol=1e-5)
    expected = np.searchsorted(SLOPES, slope[inside], side="right") - 1
    at_border = np.abs(slope[inside][:, None] - SLOPES).min(1) < 2e-3  # the table has 1024 steps
    assert np.array_equal(column[inside][~at_border], expected[~at_border])
    assert np.abs(column[inside] - expected).max() <= 1


def test_counts_by_column_and_height() -> None:
    x, z, column, _ = levelled(2)
    n, bins, heights, step_m = 12, 80, 60, 0.05
    counts, sums = np.zeros((n, bins), np.int32), np.zeros((n, bins))
    level_kernels.count_columns(x, z, column, BF, counts, sums)
    valid = column >= 0
    j = np.where(valid, BF / (np.where(valid, x, 1.0) * np.float32(BIN_PX)), bins).astype(int)
    expected, expected_sums = np.zeros((n, bins)), np.zeros((n, bins))
    use = valid & (j < bins)
    np.add.at(expected, (column[use], j[use]), 1)
    np.add.at(expected_sums, (column[use], j[use]), z[use])
    assert np.array_equal(counts, expected)
    assert np.allclose(sums, expected_sums, atol=1e-4)

    widths, upright = np.full(n, 4.0), np.zeros((n, bins), np.bool_)
    level_kernels.find_upright(counts, sums, widths, 0.3, 0.5, upright)
    mean = np.abs(sums / np.maximum(counts, 1))
    assert np.array_equal(upright, (counts > 0) & (counts / 4.0 > 0.3 + 1.5 * mean * 0.5 * BIN_PX))
    assert upright.any() and not upright.all()

    got, disparities, slopes = np.zeros((bins, heights), np.int32), np.zeros((bins, heights)), np.zeros((bins, heights))
    below = (2, 5)
    level_kernels.count_heights(x, z, column, upright, BF, below, 0.6, step_m, got, disparities, slopes)
    want = np.zeros((bins, heights))
    for v in range(H - 5):
        for u in range(W - 2):
            if column[v, u] < 0 or column[v + 5, u + 2] < 0 or z[v, u] >= 0.0:
                continue
            here, other = float(-z[v, u]), float(-z[v + 5, u + 2])
            wall = x[v, u] * other / x[v + 5, u + 2] - here
            if wall <= 0.0 or abs(other - here) > 0.6 * wall or j[v, u] >= bins or upright[column[v, u], j[v, u]]:
                continue
            if int(here / step_m) < heights:
                want[j[v, u], int(here / step_m)] += 1
    assert np.array_equal(got, want)
    assert want.sum() > 20
    used = got > 0
    centre = (np.nonzero(used)[0] + 0.5) * BIN_PX
    assert np.abs(disparities[used] / got[used] - centre).max() <= 0.5 * BIN_PX + 1e-4
    assert np.allclose(slopes[used] * BF / disparities[used], -(-np.nonzero(used)[1] - 0.5) * step_m, atol=0.05)


def test_texture() -> None:
    rng = np.random.default_rng(4)
    image = rng.integers(99, 102, (6, 50)).astype(np.uint8)
    image[1:, 20:23] = rng.integers(0, 255, (5, 3))
    image[2, 40] = 110
    out = np.ones((6, 50), np.bool_)
    label_kernels.mark_texture(image, 3, 4, out)
    step = np.zeros((6, 50), bool)
    step[:, 1:-1] = np.abs(image[:, 2:].astype(int) - image[:, :-2].astype(int)) >= 3
    expected = np.zeros((6, 50), bool)
    for v, u in zip(*np.nonzero(step), strict=True):
        expected[v, max(u - 4, 0) : u + 5] = True
    assert np.array_equal(out, expected)
    assert not out[0].any() and out[2, 37:44].all() and not out[3, 30:].any()


def test_a_spline_through_level_ground_is_level_and_outliers_do_not_matter() -> None:
    rng = np.random.default_rng(5)
    d = rng.uniform(2.0, 10.0, 400)
    slope = d * (1.5 / BF) + rng.normal(0.0, 0.01, 400)
    slope[::8] -= 0.4  # things that stand on it
    c = np.zeros(profile_kernels.COEFFICIENTS)
    assert profile_kernels.fit_spline(d, slope, np.ones(400), 2.0, 10.0, np.full(400, 0.03), 1e-3, 6, c)
    at = np.array([1.0, 2.0, 4.0, 7.0, 10.0, 14.0])
    out = np.zeros(6)
    profile_kernels.sample_spline(c, 2.0, 10.0, at, out)
    assert np.abs(out * BF / at - 1.5).max() < 0.04


def test_a_spline_equals_weighted_least_squares() -> None:
    """One round without robust weights, against numpy's solution of the same equations."""
    rng = np.random.default_rng(6)
    d, slope, weight = rng.uniform(2.0, 10.0, 200), rng.uniform(0.0, 1.0, 200), rng.uniform(0.5, 2.0, 200)
    sigma = rng.uniform(0.05, 0.2, 200)
    c = np.zeros(profile_kernels.COEFFICIENTS)
    assert profile_kernels.fit_spline(d, slope, weight, 2.0, 10.0, sigma, 1e-2, 1, c)
    basis = np.zeros((200, profile_kernels.COEFFICIENTS))
    for k in range(profile_kernels.COEFFICIENTS):
        unit = np.eye(profile_kernels.COEFFICIENTS)[k]
        profile_kernels.sample_spline(unit, 2.0, 10.0, d, basis[:, k])
    assert np.allclose(basis.sum(1), 1.0)  # a partition of unity
    w = weight / sigma**2
    bend = np.diff(np.eye(profile_kernels.COEFFICIENTS), 2, axis=0)
    A = (basis * w[:, None]).T @ basis + 1e-2 * w.sum() * bend.T @ bend + 1e-9 * w.sum() * np.eye(len(c))
    assert np.allclose(c, np.linalg.solve(A, (basis * w[:, None]).T @ slope), atol=1e-6)


def test_the_path_follows_a_ramp_and_not_a_table_above_it() -> None:
    bins, heights, bf = 48, 80, 24.0
    counts = np.zeros((bins, heights), np.int32)
    truth = np.zeros(bins)
    for j in range(10, 40):
        ahead = bf / ((j + 0.5) * BIN_PX)
        truth[j] = (1.5 - 0.15 * max(ahead - 3.5, 0.0)) / 0.05  # a ramp from 3.5 m on
        counts[j, int(truth[j])] = 60
        if 25 <= j < 35:
            counts[j, 15] = 90  # a table top
    path = np.zeros(bins, np.int64)
    profile_kernels.ground_path(counts, 3, -1, 8, bf, 0.05, 0.35, 0.25, 30.0, path)
    assert np.abs(path[10:40] - truth[10:40]).max() <= 3.0


def test_pixels_near_a_height_and_a_path() -> None:
    rng = np.random.default_rng(5)
    bins, heights, step_m, sigma_px = 40, 60, 0.05, 0.25
    counts = rng.integers(0, 4, (bins, heights)).astype(np.int32)
    sums = rng.random((2, bins, heights)) * counts
    centres, columns = (np.arange(bins) + 0.5) * BIN_PX, np.arange(heights)
    height_m = rng.uniform(0.1, 2.5, bins)
    rows = height_m / step_m - 0.5
    near = np.abs(columns - rows[:, None]) <= (1.5 + 2.0 * rows * sigma_px / centres)[:, None]
    found, total = np.empty((2, bins), np.int64)
    profile_kernels.count_near(counts, height_m, step_m, sigma_px, found)
    assert np.array_equal(found, (counts * near).sum(1)) and near.any() and not near.all()
    path = rng.integers(0, heights, bins)
    near = np.abs(columns - path[:, None]) <= (2.0 + 3.0 * (path + 0.5) * sigma_px / centres)[:, None]
    profile_kernels.count_path(counts, path, sigma_px, found, total)
    assert np.array_equal(found, (counts * near).sum(1)) and np.array_equal(total, counts.sum(1))
    used = near & (counts > 0)
    used[:3] = used[31:] = False
    out = np.empty((3, counts.size))
    m = profile_kernels.cells_near(counts, sums[0], sums[1], path, 3, 30, sigma_px, out)
    assert np.array_equal(
        out[:, :m], np.stack([counts[used], sums[0][used] / counts[used], sums[1][used] / counts[used]])
    )


def test_unlock() -> None:
    rng = np.random.default_rng(6)
    raw = rng.integers(-16, 700, (9, 30)).astype(np.int16)
    table = rng.random(16).astype(np.float32)
    out = np.empty((9, 26), np.float32)
    level_kernels.unlock(raw, 4, table, out)
    raw = raw[:, 4:]
    assert np.array_equal(out, np.where(raw > 0, ((raw + 8) >> 4) + table[(raw + 8) & 15], np.float32(0.0)))
