"""Template alignment: it finds known displacements to a fraction of a pixel, whatever brightness does."""

import cv2
import numpy as np
import pytest

from kiteline_agent.imaging import alignment_kernels as kernels
from kiteline_agent.imaging.features import build_pyramid
from kiteline_agent.imaging.raw_grid import NO_GRID
from kiteline_core.arrays import F64, U8, Bool
from kiteline_core.geometry.cameras import CameraModel, CameraRig, Lens, Rectifier
from tests.core.helpers_from_python import from_python


def texture(seed: int, shape: tuple[int, int] = (240, 320)) -> F64:
    """A smooth random image with detail at many scales, 40..215."""
    rng = np.random.default_rng(seed)
    out = np.zeros(shape)
    for sigma, weight in ((1.2, 1.0), (3.0, 2.0), (8.0, 3.0)):
        layer = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), sigma)
        out += weight * layer / layer.std()
    return 127.0 + 30.0 * out / out.std()


def warped(image: F64, matrix: F64) -> U8:
    """The image as seen when its pixel p moves to matrix @ (p, 1)."""
    h, w = image.shape
    moved = cv2.warpAffine(image, matrix, (w, h), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return np.clip(np.round(moved), 0, 255).astype(np.uint8)


def run(
    first: U8,
    second: U8,
    uv: F64,
    warp: F64,
    guess: F64,
) -> tuple[F64, Bool]:
    n = len(uv)
    octave = np.zeros(n, np.uint8)
    templates = np.empty((n, kernels.TEMPLATE_LEVELS, kernels.TEMPLATE, kernels.TEMPLATE), np.uint8)
    kernels.cut_templates(build_pyramid(first, 4), uv, octave, templates)
    out, found, ncc = guess.copy(), np.zeros(n, np.bool_), np.zeros(n)
    warps = np.tile(warp, (n, 1, 1))
    pyramid = build_pyramid(second, 4)
    kernels.align(pyramid, NO_GRID, templates, np.arange(n), octave, warps, out, 2, 1, 8, 7.0, 0.8, found, ncc)
    kernels.align(pyramid, NO_GRID, templates, np.arange(n), octave, warps, out, 1, 0, 8, 3.0, 0.8, found, ncc)
    return out, found


POINTS = np.array([[x, y] for y in range(60, 190, 26) for x in range(60, 270, 30)], np.float64)


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (0.7, 20.0), (1.15, -12.0)])
@pytest.mark.parametrize("shift", [(0.4, -0.3), (6.3, 4.8), (-7.2, 5.6)])
def test_finds_shifts_to_a_tenth_of_a_pixel(shift: tuple[float, float], gain: float, offset: float) -> None:
    image = texture(1)
    matrix = np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]]])
    second = np.clip(warped(image, matrix) * gain + offset, 0, 255).astype(np.uint8)
    out, found = run(warped(image, np.eye(2, 3)), second, POINTS, np.eye(2), POINTS)
    assert found.mean() > 0.8
    error = np.linalg.norm(out[found] - POINTS[found] - shift, axis=1)
    assert np.median(error) < 0.1
    assert np.percentile(error, 90) < 0.25


@pytest.mark.parametrize(("angle_deg", "scale"), [(20.0, 1.0), (-35.0, 1.0), (10.0, 1.3), (0.0, 0.75), (5.0, 1.9)])
def test_warps_make_turns_and_zooms_alignable(angle_deg: float, scale: float) -> None:
    image = texture(2)
    matrix = cv2.getRotationMatrix2D((160.0, 120.0), angle_deg, scale)
    truth = POINTS @ matrix[:, :2].T + matrix[:, 2]
    inside = (truth > 25).all(axis=1) & (truth[:, 0] < 295) & (truth[:, 1] < 215)
    guess = truth + np.array([1.4, -1.1])
    out, found = run(warped(image, np.eye(2, 3)), warped(image, matrix), POINTS, matrix[:, :2].copy(), guess)
    good = found & inside
    assert good.sum() > 0.7 * inside.sum()
    assert np.median(np.linalg.norm(out[good] - truth[good], axis=1)) < 0.12


def test_rejects_what_is_not_there() -> None:
    _, found = run(warped(texture(3), np.eye(2, 3)), warped(texture(4), np.eye(2, 3)), POINTS, np.eye(2), POINTS)
    assert found.mean() < 0.1


def test_flat_images_give_nothing() -> None:
    flat = np.full((240, 320), 90, np.uint8)
    assert not run(flat, flat, POINTS, np.eye(2), POINTS)[1].any()


def test_sample_is_bilinear() -> None:
    image = np.arange(12, dtype=np.uint8).reshape(3, 4)
    assert from_python(kernels.sample)(image, 1.25, 0.5) == pytest.approx(1.25 + 2.0)


def test_templates_are_cut_as_one_would_by_hand() -> None:
    pyramid = build_pyramid(warped(texture(4), np.eye(2, 3)), 4)
    uv = np.array([[100.0, 80.0], [57.3, 121.8], [20.0, 21.5], [299.0, 219.0], [2.2, 238.9]])
    octave = np.array([0, 1, 2, 0, 1], np.uint8)
    templates = np.empty((len(uv), kernels.TEMPLATE_LEVELS, kernels.TEMPLATE, kernels.TEMPLATE), np.uint8)
    kernels.cut_templates(pyramid, uv, octave, templates)
    reach = np.arange(kernels.TEMPLATE) - kernels.TEMPLATE_RADIUS
    for i in range(len(uv)):
        for j in range(kernels.TEMPLATE_LEVELS):
            image = pyramid[min(octave[i] + j, 3)].astype(np.float64)
            h, w = image.shape
            x, y = (uv[i] / (1 << min(octave[i] + j, 3)))[:, None] + reach
            x, y = np.clip(x, 0.0, w - 1.001), np.clip(y, 0.0, h - 1.001)
            left, top = x.astype(int), y.astype(int)
            fx, fy = x - left, (y - top)[:, None]
            above = image[np.ix_(top, left)] * (1 - fx) + image[np.ix_(top, left + 1)] * fx
            below = image[np.ix_(top + 1, left)] * (1 - fx) + image[np.ix_(top + 1, left + 1)] * fx
            np.testing.assert_allclose(templates[i, j], above * (1 - fy) + below * fy, atol=0.501)


def bilinear(image: U8, x: F64, y: F64) -> F64:
    grey = image.astype(np.float64)
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = x - left, y - top
    above = grey[top, left] * (1 - fx) + grey[top, left + 1] * fx
    below = grey[top + 1, left] * (1 - fx) + grey[top + 1, left + 1] * fx
    return np.asarray(above * (1 - fy) + below * fy)


def test_patches_and_their_sums_are_those_of_plain_numpy() -> None:
    image = warped(texture(5), np.eye(2, 3))
    template = np.ascontiguousarray(image[100:121, 130:151])
    w = np.array([[1.1, -0.2], [0.15, 0.9]])
    reference = np.zeros((kernels.PATCH + 2, kernels.STRIDE), np.int16)
    around = np.zeros((4, kernels.WARPED), np.uint16)
    assert from_python(kernels.warp_template)(template, *w.ravel(), around, reference)
    dx, dy = np.meshgrid(np.arange(-5.0, 6.0), np.arange(-5.0, 6.0))
    plain = bilinear(template, 10 + w[0, 0] * dx + w[0, 1] * dy, 10 + w[1, 0] * dx + w[1, 1] * dy)
    steepest = np.abs(np.diff(plain)).max()
    np.testing.assert_allclose(reference[:, : kernels.PATCH + 2] / kernels.GREY, plain, atol=0.04 + steepest / 128)
    assert not from_python(kernels.warp_template)(template, 1.5, 0.6, -0.6, 1.5, around, reference)
    assert not from_python(kernels.warp_template)(
        template, 2.1, 0.0, 0.0, 1.0, around, reference
    )  # along one axis alone
    assert not from_python(kernels.warp_template)(template, 1.0, 0.0, 0.0, 2.1, around, reference)

    patches = np.zeros((5, kernels.LANES), np.int16)
    inside = np.zeros((kernels.PATCH, kernels.STRIDE), np.bool_)
    inside[:, : kernels.PATCH] = True
    patches[4] = inside.ravel()
    from_python(kernels.template_gradients)(reference, patches)
    grey = reference[:, : kernels.PATCH + 2].astype(np.int64)
    for row, wanted in (
        (1, grey[1:-1, 1:-1]),
        (2, grey[1:-1, 2:] - grey[1:-1, :-2]),
        (3, grey[2:, 1:-1] - grey[:-2, 1:-1]),
    ):
        np.testing.assert_array_equal(patches[row].reshape(inside.shape)[:, : kernels.PATCH], wanted)
        assert not patches[row].reshape(inside.shape)[~inside].any()
    assert (
        from_python(kernels.dot)(patches[2], patches[1])
        == (grey[1:-1, 1:-1] * (grey[1:-1, 2:] - grey[1:-1, :-2])).sum()
    )

    raw, across = np.zeros(2 * (kernels.PATCH + 1), np.uint64), np.zeros(kernels.LANES + kernels.STRIDE, np.int16)
    for x, y in ((100.0, 90.0), (47.31, 60.78), (4.0, 4.99), (314.9, 234.9)):
        from_python(kernels.sample_patch)(image, x, y, raw, across, patches[0])
        dx, dy = np.meshgrid(np.arange(-4.0, 5.0), np.arange(-4.0, 5.0))
        seen = patches[0].reshape(inside.shape)[:, : kernels.PATCH] / kernels.GREY
        np.testing.assert_allclose(seen, bilinear(image, x + dx, y + dy), atol=0.04 + 40.0 / 256)


def test_the_greatest_contrast_does_not_overflow() -> None:
    image = np.zeros((64, 64), np.uint8)
    image[:, 32:] = 255
    image[32:] = 255 - image[32:]
    pyramid = build_pyramid(image, 4)
    uv, octave = np.array([[32.0, 32.0]]), np.zeros(1, np.uint8)
    templates = np.empty((1, kernels.TEMPLATE_LEVELS, kernels.TEMPLATE, kernels.TEMPLATE), np.uint8)
    kernels.cut_templates(pyramid, uv, octave, templates)
    out, found, ncc = uv + 0.7, np.zeros(1, np.bool_), np.zeros(1)
    kernels.align(
        pyramid, NO_GRID, templates, np.zeros(1, np.int64), octave, np.eye(2)[None], out, 0, 0, 8, 3.0, 0.8, found, ncc
    )
    assert found[0] and abs(out - uv).max() < 0.05 and ncc[0] > 0.99


def through_lens(scene: F64, camera: CameraModel, shift: tuple[float, float]) -> U8:
    """A raw image of a scene (h + 120, w + 120), moved by `shift` in the rectified image."""
    rectified = Rectifier(CameraRig(camera, None, np.eye(4), None)).camera
    x, y = np.meshgrid(np.arange(float(camera.width)), np.arange(float(camera.height)))
    pixels = np.stack([x.ravel(), y.ravel()], 1)[:, None]
    rays = cv2.undistortPoints(pixels, camera.matrix(), np.array(camera.distortion)).reshape(-1, 2)
    u = rays[:, 0] * rectified.fx + rectified.cx - shift[0] + 60.0
    v = rays[:, 1] * rectified.fy + rectified.cy - shift[1] + 60.0
    maps = [part.reshape(x.shape).astype(np.float32) for part in (u, v)]
    seen = cv2.remap(scene.astype(np.float32), *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return np.clip(np.round(seen), 0, 255).astype(np.uint8)


def test_a_raw_image_is_aligned_as_well_as_the_rectified_one() -> None:
    model = CameraModel(320, 240, 220.0, 221.0, 158.0, 121.0, Lens.RADTAN, (-0.28, 0.07, 1e-4, 2e-5))
    rectifier = Rectifier(CameraRig(model, None, np.eye(4), None))
    assert rectifier.left_grid is not None
    n, off = len(POINTS), dict[str, list[F64]](whole=[], raw=[])
    for seed, shift in enumerate([(2.6, -2.2), (1.25, 0.4), (0.5, 0.5), (-3.3, 1.8)]):
        scene = texture(seed, (360, 440))
        before = rectifier.left(through_lens(scene, model, (0.0, 0.0)))
        raw = through_lens(scene, model, shift)
        whole = build_pyramid(rectifier.left(raw), 4)
        templates = np.empty((n, kernels.TEMPLATE_LEVELS, kernels.TEMPLATE, kernels.TEMPLATE), np.uint8)
        kernels.cut_templates(build_pyramid(before, 4), POINTS, np.zeros(n, np.uint8), templates)
        for name, pyramid, grid in (("whole", whole, NO_GRID), ("raw", build_pyramid(raw, 4), rectifier.left_grid)):
            out, found, ncc = POINTS.copy(), np.zeros(n, np.bool_), np.zeros(n)
            warps, octave = np.tile(np.eye(2), (n, 1, 1)), np.zeros(n, np.uint8)
            kernels.align(
                pyramid, grid, templates, np.arange(n), octave, warps, out, 2, 0, 8, 7.0, 0.8, found, ncc
            )  # fmt: skip
            assert found.mean() > 0.9
            off[name].append((out - POINTS - shift)[found])
    whole_px, raw_px = (float(np.sqrt(np.mean(np.concatenate(off[name]) ** 2))) for name in ("whole", "raw"))
    assert whole_px < 0.06
    assert raw_px < 1.03 * whole_px
    assert np.abs(np.concatenate(off["raw"])).max() < 0.25
