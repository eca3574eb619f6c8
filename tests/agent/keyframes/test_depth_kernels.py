"""Kernels that find depths along epipolar lines, against plain numpy."""

import cv2
import numpy as np

from kiteline_agent.imaging import alignment_kernels
from kiteline_agent.imaging.epipolar_kernels import search_segments
from kiteline_agent.imaging.features import Pyramid, build_pyramid
from kiteline_agent.imaging.raw_grid import NO_GRID
from kiteline_agent.keyframes.seed_kernels import intersect, seed_segments
from kiteline_core.arrays import F64, I8, U8
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, CameraRig, Lens, Rectifier


def picture(seed: int = 0, blur_px: float = 2.0) -> U8:
    noise = np.random.default_rng(seed).integers(0, 256, (240, 320), np.uint8)
    return np.asarray(cv2.normalize(cv2.GaussianBlur(noise, (0, 0), blur_px), None, 10, 245, cv2.NORM_MINMAX), np.uint8)


def search(
    pyramid: Pyramid, other: Pyramid, uv: F64, start: F64, end: F64, warp: F64 | None = None, octave: int = 0
) -> tuple[F64, I8]:
    n = len(uv)
    octaves = np.full(n, octave, np.uint8)
    templates = np.empty((n, 3, alignment_kernels.TEMPLATE, alignment_kernels.TEMPLATE), np.uint8)
    alignment_kernels.cut_templates(pyramid, uv, octaves, templates)
    out, found = np.zeros((n, 2)), np.zeros(n, np.int8)
    warps = np.tile(np.eye(2) if warp is None else warp, (n, 1, 1))
    search_segments(
        other, NO_GRID, templates, np.arange(n), octaves, warps, start, end, 0.7, 40, 0.8, 0.9, out, found
    )  # fmt: skip
    return out, found


def grid() -> F64:
    return np.stack(np.meshgrid(np.arange(80.0, 250.0, 24.0), np.arange(60.0, 190.0, 24.0)), -1).reshape(-1, 2)


def test_a_shift_is_found_on_short_and_long_segments() -> None:
    image = picture()
    shift = np.array([9.0, -4.0])
    moved = cv2.warpAffine(image, np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]]]), (320, 240))
    a, b = build_pyramid(image, 4), build_pyramid(np.asarray(moved, np.uint8), 4)
    uv = grid()
    for reach, tolerance in ((1.0, 0.8), (4.0, 2.5)):
        out, found = search(a, b, uv, uv - 0.4 * reach * shift, uv + (1.0 + 0.3 * reach) * shift)
        assert (found == 1).mean() > 0.9
        assert np.linalg.norm(out - uv - shift, axis=1)[found == 1].max() < tolerance


def test_a_warped_template_is_found() -> None:
    image = picture(1)
    turn = np.array([[1.25, -0.35], [0.35, 1.25]])
    centre = np.array([160.0, 120.0])
    moved = cv2.warpAffine(image, np.column_stack([turn, centre - turn @ centre]), (320, 240))
    uv = centre + np.array([[-30.0, 10.0], [20.0, 25.0], [5.0, -30.0]])
    true = centre + (uv - centre) @ turn.T
    along = np.array([12.0, 5.0])
    a, b = build_pyramid(image, 4), build_pyramid(np.asarray(moved, np.uint8), 4)
    out, found = search(a, b, uv, true - along, true + 0.5 * along, turn)
    assert (found == 1).all()
    assert np.linalg.norm(out - true, axis=1).max() < 1.0
    _, unwarped = search(a, b, uv, true - along, true + 0.5 * along)
    assert not (unwarped == 1).all()


def test_what_is_not_there_is_told_from_what_is_there_twice() -> None:
    image = picture(2, 1.0)
    uv = np.array([[100.0, 100.0], [200.0, 120.0]])
    pyramid = build_pyramid(image, 4)
    _, found = search(pyramid, build_pyramid(picture(3, 1.0), 4), uv, uv - [8.0, 0.0], uv + [8.0, 0.0])
    assert (found == 0).all()
    twice = np.tile(image[:, :20], (1, 16))
    again = build_pyramid(twice, 4)
    _, found = search(again, again, uv, uv - [24.0, 0.0], uv + [24.0, 0.0])
    assert (found == -1).all()
    _, found = search(pyramid, pyramid, uv, uv + [400.0, 0.0], uv + [410.0, 0.0])
    assert (found == -1).all()


def test_scores_are_those_of_plain_numpy() -> None:
    a, b = picture(4), picture(5)
    b[90:150, 70:190] = a[90:150, 70:190]
    uv = np.array([[100.0, 110.0], [150.0, 130.0]])
    start, end = uv - [7.0, 0.0], uv + [7.0, 0.0]
    out, found = search(build_pyramid(a, 4), build_pyramid(b, 4), uv, start, end)
    assert (found == 1).all()
    for i in range(len(uv)):
        x0, y0 = uv[i].astype(int)
        patch = a[y0 - 4 : y0 + 5, x0 - 4 : x0 + 5].astype(np.float64)
        best, where = -1.0, 0.0
        for x in np.linspace(start[i, 0], end[i, 0], 21):
            left, part = int(x), x - int(x)
            rows = b[y0 - 4 : y0 + 5].astype(np.float64)
            there = (1.0 - part) * rows[:, left - 4 : left + 5] + part * rows[:, left - 3 : left + 6]
            score = np.corrcoef(patch.ravel(), there.ravel())[0, 1]
            if score > best:
                best, where = score, x
        np.testing.assert_allclose(out[i], [where, y0])


def test_a_raw_image_is_searched_as_the_rectified_one() -> None:
    model = CameraModel(320, 240, 220.0, 221.0, 158.0, 121.0, Lens.RADTAN, (-0.28, 0.07, 1e-4, 2e-5))
    rectifier = Rectifier(CameraRig(model, None, np.eye(4), None))
    assert rectifier.left_grid is not None
    raw = picture(3)
    whole, uv = build_pyramid(rectifier.left(raw), 4), grid()
    n = len(uv)
    octaves, warps = np.zeros(n, np.uint8), np.tile(np.eye(2), (n, 1, 1))
    templates = np.empty((n, 3, alignment_kernels.TEMPLATE, alignment_kernels.TEMPLATE), np.uint8)
    alignment_kernels.cut_templates(whole, uv, octaves, templates)
    for pyramid, raw_grid in ((whole, NO_GRID), (build_pyramid(raw, len(whole)), rectifier.left_grid)):
        out, found = np.zeros((n, 2)), np.zeros(n, np.int8)
        search_segments(
            pyramid, raw_grid, templates, np.arange(n), octaves, warps, uv - 9.0, uv + 11.0, 0.7, 40, 0.8, 0.9, out,
            found,
        )  # fmt: skip
        assert (found == 1).mean() > 0.9
        assert abs(out - uv)[found == 1].max() < 0.8


CAMERA = np.array([420.0, 430.0, 320.0, 200.0, 40.0])
KEYFRAMES, SLOT, N = 3, 12, 20


def poses(rng: np.random.Generator, n: int) -> F64:
    return np.stack([se3.exp(rng.normal(0.0, 0.2, 6)) for _ in range(n)])


def pixels(direction: F64, centre: F64, rho: F64) -> F64:
    p = direction + centre * rho[:, None]
    return np.asarray(p[:, :2] / np.maximum(p[:, 2], 0.05)[:, None] * CAMERA[:2] + CAMERA[2:4])


def test_segments_of_seeds() -> None:
    rng = np.random.default_rng(1)
    T_c_m, T_m_k = poses(rng, 1)[0], poses(rng, KEYFRAMES)
    bearing = rng.normal(0.0, 0.4, (KEYFRAMES, SLOT, 2))
    rows = rng.integers(0, KEYFRAMES * SLOT, N)
    rho, sigma = rng.uniform(0.05, 0.5, N), rng.uniform(0.01, 0.4, N)
    direction, centre = np.empty((2, N, 3))
    start, end = np.empty((2, N, 2))
    seed_segments(T_c_m, CAMERA, rows, T_m_k, bearing, rho, sigma, 2.0, 0.6, direction, centre, start, end)
    T_c_k = T_c_m @ T_m_k[rows // SLOT]
    ray = np.column_stack([bearing.reshape(-1, 2)[rows], np.ones(N)])
    assert np.allclose(direction, np.einsum("nij,nj->ni", T_c_k[:, :3, :3], ray))
    assert np.allclose(centre, T_c_k[:, :3, 3])
    assert np.allclose(start, pixels(direction, centre, np.maximum(rho - 2.0 * sigma, 1e-6)))
    assert np.allclose(end, pixels(direction, centre, np.minimum(rho + 2.0 * sigma, 0.6)))


def test_depths_where_rays_meet() -> None:
    rng = np.random.default_rng(2)
    direction, centre = rng.normal(0.0, 0.3, (N, 3)) + [0.0, 0.0, 1.0], rng.normal(0.0, 0.3, (N, 3))
    true = rng.uniform(0.1, 0.8, N)
    uv = pixels(direction, centre, true)
    octave = rng.integers(0, 3, N).astype(np.uint8)
    rho, variance, off = np.empty((3, N))
    intersect(direction, centre, uv, octave, CAMERA, 0.5, rho, variance, off)
    assert np.allclose(rho, true) and off.max() < 1e-6
    step = 1e-6  # px of a change of the inverse depth, by differences
    slope = np.linalg.norm(pixels(direction, centre, true + step) - pixels(direction, centre, true - step), axis=1)
    expected = (0.5 * (1 << octave.astype(np.int64)) / (slope / (2.0 * step))) ** 2
    in_front = direction[:, 2] + centre[:, 2] * true > 0.05
    assert in_front.sum() > N // 2 and np.allclose(variance[in_front], expected[in_front], rtol=1e-4)
    along = pixels(direction, centre, true + 0.1) - uv
    across = np.column_stack([-along[:, 1], along[:, 0]])
    across *= 3.0 / np.linalg.norm(across, axis=1)[:, None]
    intersect(direction, centre, uv + across, octave, CAMERA, 0.5, rho, variance, off)
    assert np.allclose(off, 3.0, rtol=0.01)
    intersect(-direction, 0.0 * centre, uv, octave, CAMERA, 0.5, rho, variance, off)
    assert np.isinf(variance).all()
