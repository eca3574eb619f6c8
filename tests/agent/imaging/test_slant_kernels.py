"""Slants from sheared templates: against a plain least-squares fit, and on planes that are known."""

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from kiteline_agent.imaging import alignment_kernels, slant_kernels
from kiteline_agent.imaging.alignment_kernels import PATCH, PATCH_RADIUS, TEMPLATE, TEMPLATE_LEVELS
from kiteline_agent.imaging.features import build_pyramid
from kiteline_agent.imaging.raw_grid import NO_GRID
from kiteline_agent.local_map import projection_kernels
from kiteline_core.arrays import F64, U8
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, CameraRig, Lens, Rectifier

F = 300.0
CAMERA = np.array([F, F, 160.0, 120.0, 30.0])
SHAPE = (240, 320)
UV = np.array([[float(x), float(y)] for y in range(50, 200, 18) for x in range(50, 280, 18)])
LEVELS = 4
NORMAL = np.array([0.12, -0.25, 0.2])  # of the plane NORMAL X = 1 in the first camera
T_C_K = se3.from_rt(se3.so3_exp(np.array([0.01, -0.02, 0.015])), np.array([0.12, -0.1, -1.0]))


def plane_image(T_c_k: F64, normal: F64, seed: int = 3) -> U8:
    """What a camera at T_c_k sees of a textured plane of the first camera, with a little noise."""
    rng = np.random.default_rng(seed)
    texture = cv2.GaussianBlur(np.random.default_rng(1).standard_normal((1200, 1600)), (0, 0), 2.0)
    texture = (120 + 40 * texture / texture.std()).astype(np.float32)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float64)
    rays = np.stack([(x - CAMERA[2]) / F, (y - CAMERA[3]) / F, np.ones_like(x)], axis=-1)
    turned, centre = rays @ T_c_k[:3, :3], -T_c_k[:3, :3].T @ T_c_k[:3, 3]
    on_plane = centre + turned * ((1.0 - normal @ centre) / (turned @ normal))[..., None]
    # Pixels of the first camera, so that the texture is as fine as its image.
    at = (on_plane[..., :2] / on_plane[..., 2:] * F + [800.0, 600.0]).astype(np.float32)
    seen = cv2.remap(texture, at[..., 0], at[..., 1], cv2.INTER_CUBIC)
    return np.clip(seen + rng.normal(0, 1.0, SHAPE) + 0.5, 0, 255).astype(np.uint8)


class Views:
    """Landmarks of one keyframe on a plane, and where a second camera sees them."""

    def __init__(self, octave: int = 0, T_c_k: F64 = T_C_K) -> None:
        self.n = len(UV)
        self.bearing = ((UV - CAMERA[2:4]) / F)[None]
        homogeneous = np.column_stack([self.bearing[0], np.ones(self.n)])
        self.rho = (homogeneous @ NORMAL)[None]
        self.slant = NORMAL[:2] / self.rho[0][:, None]  # true ones
        self.octave = np.full(self.n, octave, np.uint8)
        self.first = build_pyramid(plane_image(np.eye(4), NORMAL), LEVELS)
        self.T_c_k, self.second = T_c_k, build_pyramid(plane_image(T_c_k, NORMAL, seed=4), LEVELS)
        self.templates = np.empty((self.n, TEMPLATE_LEVELS, TEMPLATE, TEMPLATE), np.uint8)
        alignment_kernels.cut_templates(self.first, UV, self.octave, self.templates)
        seen = se3.transform(T_c_k, homogeneous / self.rho[0][:, None])
        self.true_uv = seen[:, :2] / seen[:, 2:] * F + CAMERA[2:4]

    def seen_with(self, slant: F64) -> tuple[F64, F64]:
        """Warps (n,2,2) and parallaxes (n,2) with slants (n,2)."""
        warp, parallax = np.empty((self.n, 2, 2)), np.empty((self.n, 2))
        projection_kernels.views(
            self.T_c_k, CAMERA, np.arange(self.n), np.eye(4)[None], self.bearing, self.rho, slant[None], warp, parallax
        )  # fmt: skip
        return warp, parallax

    def aligned(self, slant: F64) -> tuple[F64, F64]:
        """Where the templates are found with slants (n,2), and which are."""
        warp, _ = self.seen_with(slant)
        uv, found, ncc = self.true_uv.copy(), np.zeros(self.n, np.bool_), np.zeros(self.n)
        alignment_kernels.align(
            self.second, NO_GRID, self.templates, np.arange(self.n), self.octave, warp, uv, 0, 0, 8, 3.0, 0.6,
            found, ncc,
        )  # fmt: skip
        return uv, found

    def equations(self, slant: F64, uv: F64) -> F64:
        warp, parallax = self.seen_with(slant)
        out = np.empty((self.n, 5))
        slant_kernels.measure_slants(
            self.second, NO_GRID, self.templates, np.arange(self.n), self.octave, warp, parallax, uv, F, F, 1.0,
            out,
        )  # fmt: skip
        return out


def solved(equations: F64) -> F64:
    matrices = equations[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    return np.asarray(np.linalg.solve(matrices, equations[:, 3:, None])[..., 0])


def interpolated(image: U8, uv: F64) -> F64:
    """Bilinear values (n,) of an image at pixels (n,2), in floating point: OpenCV 4 has weights of 1/32."""
    return np.asarray(map_coordinates(image.astype(np.float64), uv[:, ::-1].T, order=1))


def reference(views: Views, slant: F64, uv: F64, i: int) -> F64:
    """The equations of landmark i at octave 0, written plainly: sampled in floating point, solved by projection."""
    warp, parallax = views.seen_with(slant)
    inverse = np.linalg.inv(warp[i])
    level = int(np.floor(0.5 * np.log2(np.linalg.det(warp[i])) + 0.5))
    s = 2.0**level
    offsets = np.array([[c, r] for r in range(-PATCH_RADIUS, PATCH_RADIUS + 1) for c in range(-4, 5)], np.float64)

    def template(at: F64) -> F64:
        return interpolated(views.templates[i, 0], at * s @ inverse.T + TEMPLATE // 2)

    seen = interpolated(views.second[level], offsets + uv[i] / s)
    gx = 0.5 * (template(offsets + [1, 0]) - template(offsets - [1, 0]))
    gy = 0.5 * (template(offsets + [0, 1]) - template(offsets - [0, 1]))
    nuisances = np.column_stack([np.ones(len(offsets)), template(offsets), gx, gy])
    away = np.eye(len(offsets)) - nuisances @ np.linalg.pinv(nuisances)
    gain = np.polyfit(template(offsets), seen, 1)[0]  # by constant and template, which are eliminated first
    along = np.column_stack([gx, gy]) @ parallax[i] / s
    shears = -gain * along[:, None] * (offsets * s @ inverse.T) / F
    shears, left = away @ shears, away @ seen
    information, product = shears.T @ shears, shears.T @ left
    residual = left - shears @ np.linalg.solve(information, product)
    variance = max(residual @ residual / (PATCH * PATCH - 6), 1.0)
    return np.array([information[0, 0], information[0, 1], information[1, 1], *product]) / variance


@pytest.mark.parametrize(("ahead_m", "level"), [(1.0, 0), (2.4, 1)])
def test_equations_are_those_of_a_plain_fit(ahead_m: float, level: int) -> None:
    T_c_k = T_C_K.copy()
    T_c_k[2, 3] = -ahead_m
    views = Views(T_c_k=T_c_k)
    flat = np.zeros_like(views.slant)
    uv, found = views.aligned(flat)
    measured = views.equations(flat, uv)
    scales = np.floor(0.5 * np.log2(np.linalg.det(views.seen_with(flat)[0])) + 0.5)
    compared = np.flatnonzero(found & (measured[:, 0] > 0.0) & (scales == level))[::3]
    assert len(compared) > 10
    for i in compared:
        plain = reference(views, flat, uv, int(i))
        scale = np.array([plain[0], np.sqrt(plain[0] * plain[2]), plain[2], plain[0] ** 0.5, plain[2] ** 0.5])
        np.testing.assert_allclose(measured[i] / scale, plain / scale, rtol=0.08, atol=0.12)


def test_slants_of_a_plane_are_found_and_aligned_templates_with_them() -> None:
    for octave in (0, 1):
        views = Views(octave)
        slant = np.zeros_like(views.slant)
        flat_uv, flat_found = views.aligned(slant)
        for _ in range(4):
            uv, found = views.aligned(slant)
            equations = views.equations(slant, uv)
            known = found & (equations[:, 0] + equations[:, 2] > 1.0)
            equations[:, [0, 2]] += 1.0
            slant[known] += solved(equations)[known]
        wrong = np.abs(slant - views.slant)[known]
        assert known.mean() > 0.8
        assert np.median(wrong) < 0.25 * np.median(np.abs(views.slant[known]))
        before = np.linalg.norm(flat_uv - views.true_uv, axis=1)[flat_found]
        after = np.linalg.norm(views.aligned(slant)[0] - views.true_uv, axis=1)[known]
        assert np.median(after) < 0.5 * np.median(before) and np.percentile(after, 90) < 0.2 * 2**octave


def test_nothing_is_measured_without_parallax_or_texture_or_at_the_border() -> None:
    views = Views()
    warp, parallax = views.seen_with(views.slant)
    uv = views.true_uv.copy()
    uv[0] = 2.0, 2.0
    parallax[1] = 0.0
    views.templates[2] = 90
    out = np.empty((views.n, 5))
    slant_kernels.measure_slants(
        views.second, NO_GRID, views.templates, np.arange(views.n), views.octave, warp, parallax, uv, F, F, 1.0,
        out,
    )  # fmt: skip
    assert (out[:3] == 0.0).all() and (out[3:, 0] > 0.0).mean() > 0.9


def test_a_raw_image_says_what_the_rectified_one_says() -> None:
    model = CameraModel(320, 240, F, F, 160.0, 120.0, Lens.RADTAN, (-0.2, 0.05, 1e-4, 2e-5))
    rectifier = Rectifier(CameraRig(model, None, np.eye(4), None))
    assert rectifier.left_grid is not None
    views = Views()
    # A raw image whose rectified one is the second view.
    grid = np.stack(np.meshgrid(np.arange(320.0), np.arange(240.0)), axis=-1).reshape(-1, 2)
    flat = cv2.undistortPoints(grid[:, None], model.matrix(), np.array(model.distortion), P=model.matrix())
    at = flat.reshape(240, 320, 2).astype(np.float32)
    raw = build_pyramid(cv2.remap(views.second[0], at[..., 0], at[..., 1], cv2.INTER_CUBIC), LEVELS)
    assert (rectifier.camera.fx, rectifier.camera.cx) == (F, 160.0)
    zero = np.zeros_like(views.slant)
    warp, parallax = views.seen_with(zero)
    uv, found = views.aligned(zero)
    rectified = views.equations(zero, uv)
    out = np.empty((views.n, 5))
    slant_kernels.measure_slants(
        raw, rectifier.left_grid, views.templates, np.arange(views.n), views.octave, warp, parallax, uv, F, F, 1.0,
        out,
    )  # fmt: skip
    both = found & (rectified[:, 0] > 4.0) & (out[:, 0] > 4.0)
    assert both.mean() > 0.7
    difference = np.abs(solved(out[both]) - solved(rectified[both]))
    assert np.median(difference) < 0.1 * np.median(np.abs(views.slant))


def test_contrast_and_focal_lengths_change_equations_as_they_change_shears() -> None:
    views = Views()
    flat = np.zeros_like(views.slant)
    uv, found = views.aligned(flat)
    before = views.equations(flat, uv)
    sure = found & (before[:, 0] > 8.0) & (before[:, 2] > 8.0)
    # A dimmer image tells the same slants.
    views.second = tuple((0.5 * level.astype(np.float64) + 40.5).astype(np.uint8) for level in views.second)
    dim = views.equations(flat, uv)
    difference = np.abs(solved(dim[sure]) - solved(before[sure]))
    assert np.median(difference) < 0.1 * np.median(np.abs(views.slant)) and sure.mean() > 0.5
    # A slant along an axis with twice the focal length shears half as much.
    warp, parallax = views.seen_with(flat)
    longer = np.empty((views.n, 5))
    slant_kernels.measure_slants(
        views.second, NO_GRID, views.templates, np.arange(views.n), views.octave, warp, parallax, uv, F, 2.0 * F,
        1.0, longer,
    )  # fmt: skip
    np.testing.assert_allclose(longer, dim * [1.0, 0.5, 0.25, 1.0, 0.5], rtol=1e-9)


@pytest.mark.parametrize("most_forgotten", [0.0, 0.3])
def test_measurements_are_fused_as_written_plainly(most_forgotten: float) -> None:
    rng = np.random.default_rng(5)
    rows, octave = rng.permutation(40)[:25], rng.integers(0, 3, 25).astype(np.uint8)
    root, error = rng.normal(0.0, 1.0, (25, 2, 2)), rng.normal(0.0, 0.5, (25, 2))
    information = root @ root.transpose(0, 2, 1)
    product = np.einsum("nij,nj->ni", information, error)
    equations = np.column_stack([information[:, 0, 0], information[:, 0, 1], information[:, 1, 1], product])
    equations[0] = 0.0  # nothing was measured
    known, slant, prior = np.abs(rng.normal(1.0, 0.3, (40, 5))), rng.normal(0.0, 0.3, (40, 2)), 0.25
    known[:, 1] *= 0.1
    expected_known, expected = known.copy(), slant.copy()
    for row, cut, (xx, xy, yy, *side) in zip(rows, octave, equations, strict=True):
        matrix, before = np.array([[xx, xy], [xy, yy]]), expected_known[row]
        told = np.array([xx, xy, yy, *(side + matrix @ expected[row])])
        forgotten = min(most_forgotten, (xx + yy) / max(before[0] + before[2], xx + yy + 1e-12))
        expected_known[row] = total = (1.0 - forgotten) * before + told
        solution = np.linalg.solve(total[[0, 1, 1, 2]].reshape(2, 2) + prior * np.eye(2), total[3:])
        steepest = 0.5 * F / (PATCH_RADIUS * 2.0**cut)
        expected[row] = np.clip(solution, -steepest, steepest)
    slant_kernels.fuse_slants(rows, octave, equations, most_forgotten, prior, F, 0.5, known, slant)
    np.testing.assert_allclose(known, expected_known, rtol=1e-12)
    np.testing.assert_allclose(slant, expected, rtol=1e-9)
