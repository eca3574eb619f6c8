"""Rectification against the raw lens models: a point seen through the lens must land where the ideal camera puts it."""

import numpy as np
import pytest

from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CalibrationError, CameraModel, CameraRig, Lens, RectifiedCamera, Rectifier

W, H = 752, 480
EUROC = (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)
LENSES = [
    (Lens.NONE, ()),
    (Lens.RADTAN, EUROC),
    (Lens.RADTAN, (*EUROC, 0.01)),
    (Lens.RADTAN, (0.2, -0.1, 1e-4, -2e-4, 0.05, 0.5, 0.02, 0.01)),
    (Lens.EQUIDISTANT, (-0.0131, 0.0205, -0.0127, 0.0026)),
]


def camera(lens: Lens, d: tuple[float, ...], fx: float = 458.0) -> CameraModel:
    return CameraModel(W, H, fx, fx - 1.5, 367.2, 248.4, lens, d)


def through_lens(c: CameraModel, points: np.ndarray) -> np.ndarray:
    """Pixels of points (n,3) in the raw camera, written out from the models' own formulas."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r2 = x * x + y * y
    if c.lens is Lens.RADTAN:
        k1, k2, p1, p2, k3, k4, k5, k6 = (*c.distortion, *[0.0] * 8)[:8]
        scale = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        x, y = (x * scale + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * scale + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)
    elif c.lens is Lens.EQUIDISTANT:
        r = np.sqrt(r2)
        a = np.arctan(r)
        k1, k2, k3, k4 = c.distortion
        bent = a * (1 + k1 * a**2 + k2 * a**4 + k3 * a**6 + k4 * a**8) / np.maximum(r, 1e-12)
        x, y = x * bent, y * bent
    return np.stack([c.fx * x + c.cx, c.fy * y + c.cy], axis=1)


def project(c: RectifiedCamera, points: np.ndarray) -> np.ndarray:
    return np.stack([c.fx * points[:, 0] / points[:, 2] + c.cx, c.fy * points[:, 1] / points[:, 2] + c.cy], axis=1)


def ramp(axis: int) -> np.ndarray:
    """An image whose grey value tells the pixel along an axis: what remap makes of it is the raw coordinate."""
    line = np.arange(W if axis == 0 else H) % 256
    return np.broadcast_to(line if axis == 0 else line[:, None], (H, W)).astype(np.uint8).copy()


def raw_pixels(eye, at: np.ndarray) -> np.ndarray:
    """Where in the raw image the rectified pixels `at` (n,2) come from, read off remapped ramps (modulo 256)."""
    maps = [eye(ramp(axis)).astype(np.float64) for axis in (0, 1)]
    u, v = np.rint(at).astype(int).T
    return np.stack([m[v, u] for m in maps], axis=1)


def scene(rng: np.random.Generator, n: int = 400) -> np.ndarray:
    z = rng.uniform(1.0, 20.0, n)
    return np.stack([rng.uniform(-0.6, 0.6, n) * z, rng.uniform(-0.4, 0.4, n) * z, z], axis=1)


def stereo_rig(lens: Lens, d: tuple[float, ...]) -> CameraRig:
    t_b_c = se3.exp(np.array([0.1, -0.2, 0.3, 0.4, -0.5, 1.4]))
    t_c_r = se3.exp(np.array([0.11, -0.0016, 0.0009, 0.014, 0.001, 0.0023]))
    return CameraRig(camera(lens, d), camera(lens, d, 457.0), t_b_c, t_c_r)


def inside(c: RectifiedCamera, pixels: np.ndarray, margin: int = 3) -> np.ndarray:
    return ((pixels > margin) & (pixels < np.array([c.width, c.height]) - 1 - margin)).all(axis=1)


def check_eye(eye, model: CameraModel, c: RectifiedCamera, points_c: np.ndarray, ideal: np.ndarray) -> int:
    """Points that fall near the middle of a rectified pixel must come from where the lens shows them."""
    near = (np.abs(ideal - np.rint(ideal)).max(axis=1) < 0.25) & inside(c, ideal)
    raw = through_lens(model, points_c[near])
    # The ramp is read at whole pixels; a quarter pixel off the middle and rounding of grey values remain.
    error = (raw_pixels(eye, ideal[near]) - raw + 128) % 256 - 128
    wraps = (raw % 256 > 250).any(axis=1) | (raw % 256 < 5).any(axis=1)  # the ramp jumps there
    within = (raw > 2).all(axis=1) & (raw < np.array([W - 3, H - 3])).all(axis=1) & ~wraps
    assert np.abs(error[within]).max() < 1.0
    return int(within.sum())


@pytest.mark.parametrize(("lens", "d"), LENSES)
def test_mono_image_lands_on_the_ideal_pinhole(lens: Lens, d: tuple[float, ...]) -> None:
    rig = CameraRig(camera(lens, d), None, np.eye(4), None)
    rectifier = Rectifier(rig)
    points = scene(np.random.default_rng(1), 4000)
    assert not rectifier.camera.stereo
    assert check_eye(rectifier.left, rig.left, rectifier.camera, points, project(rectifier.camera, points)) > 100


@pytest.mark.parametrize(("lens", "d"), LENSES)
def test_both_eyes_agree_with_the_rectified_camera_in_the_body(lens: Lens, d: tuple[float, ...]) -> None:
    rig = stereo_rig(lens, d)
    assert rig.right is not None and rig.T_c_r is not None
    rectifier = Rectifier(rig)
    c = rectifier.camera
    body = se3.transform(rig.T_b_c, scene(np.random.default_rng(2), 4000))
    left = se3.transform(se3.inverse(rig.T_b_c), body)
    right = se3.transform(se3.inverse(rig.T_b_c @ rig.T_c_r), body)
    rectified = se3.transform(se3.inverse(c.T_b_c), body)
    beside = rectified - np.array([c.baseline_m, 0.0, 0.0])
    assert check_eye(rectifier.left, rig.left, c, left, project(c, rectified)) > 100
    assert check_eye(rectifier.right, rig.right, c, right, project(c, beside)) > 100
    # Same row in both eyes, and disparity = bf / depth, exactly.
    np.testing.assert_allclose(project(c, rectified)[:, 1], project(c, beside)[:, 1], atol=1e-9)
    np.testing.assert_allclose(
        project(c, rectified)[:, 0] - project(c, beside)[:, 0], c.bf / rectified[:, 2], rtol=1e-9
    )
    # Both centres of projection are kept: rectification turns the cameras, it does not move them.
    np.testing.assert_allclose(c.T_b_c[:3, 3], rig.T_b_c[:3, 3], atol=1e-12)
    centre = c.T_b_c @ np.array([c.baseline_m, 0.0, 0.0, 1.0])
    np.testing.assert_allclose(centre[:3], (rig.T_b_c @ rig.T_c_r)[:3, 3], atol=1e-12)
    assert c.baseline_m == pytest.approx(np.linalg.norm(rig.T_c_r[:3, 3]))


def test_no_black_border_in_the_middle_rows() -> None:
    rectifier = Rectifier(stereo_rig(Lens.RADTAN, EUROC))
    white = np.full((H, W), 255, np.uint8)
    for image in (rectifier.left(white), rectifier.right(white)):
        assert (image[H // 2, 2:-2] == 255).all()
        assert (image[2:-2, W // 2] == 255).all()


def test_a_rectified_pair_costs_nothing() -> None:
    t_c_r = np.eye(4)
    t_c_r[0, 3] = 0.5
    rectifier = Rectifier(CameraRig(camera(Lens.NONE, ()), camera(Lens.NONE, ()), np.eye(4), t_c_r))
    image = ramp(0)
    assert rectifier.left(image) is image
    assert rectifier.right(image) is image
    assert rectifier.camera.baseline_m == 0.5


def test_depth_moves_with_the_image_it_belongs_to() -> None:
    rig = CameraRig(camera(Lens.RADTAN, EUROC), None, np.eye(4), None, has_depth=True)
    rectifier = Rectifier(rig)
    smooth = (np.arange(W)[None, :] * 0.1 + np.arange(H)[:, None] * 0.2).astype(np.float32)
    moved = rectifier.depth(smooth)
    v, u = np.mgrid[20:460:7, 20:730:7]
    rays = np.stack([(u.ravel() - rig.left.cx) / rig.left.fx, (v.ravel() - rig.left.cy) / rig.left.fy], axis=1)
    source = through_lens(rig.left, np.column_stack([rays, np.ones(len(rays))]))
    error = moved[v.ravel(), u.ravel()] - (source @ np.array([0.1, 0.2]))
    assert np.abs(error).max() <= 0.5 * 0.3 + 0.02  # half a pixel either way, and no more
    assert abs(error.mean()) < 0.02  # nearest, not rounded down


def test_a_lens_beyond_a_half_sphere_still_gives_a_useful_camera() -> None:
    fisheye = CameraModel(848, 800, 285.0, 285.0, 420.0, 400.0, Lens.EQUIDISTANT, (-0.008, 0.04, -0.04, 0.007))
    t_c_r = np.eye(4)
    t_c_r[0, 3] = 0.064
    t_c_r[1, 3] = 1e-4
    c = Rectifier(CameraRig(fisheye, fisheye, np.eye(4), t_c_r)).camera
    assert 200.0 < c.fx < 300.0


def test_unusable_calibrations_say_why() -> None:
    eye = camera(Lens.NONE, ())
    with pytest.raises(CalibrationError, match="baseline is 0"):
        Rectifier(CameraRig(eye, eye, np.eye(4), np.eye(4)))
    swapped = np.eye(4)
    swapped[0, 3] = -0.1
    with pytest.raises(CalibrationError, match=r"lies -0.1 m to the right of the left one.*exchange left and right"):
        Rectifier(CameraRig(eye, eye, np.eye(4), swapped))
    other = CameraModel(640, 480, 458.0, 458.0, 320.0, 240.0)
    with pytest.raises(CalibrationError, match="640x480"):
        Rectifier(CameraRig(eye, other, np.eye(4), se3.inverse(swapped)))
    apart = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 1.6, 0.0]))
    apart[:3, 3] = [0.1, 0.0, 0.0]
    with pytest.raises(CalibrationError, match="hardly look the same way"):
        Rectifier(CameraRig(eye, eye, np.eye(4), apart))
    with pytest.raises(CalibrationError, match="image is 100x50"):
        Rectifier(CameraRig(eye, None, np.eye(4), None)).left(np.zeros((50, 100), np.uint8))


@pytest.mark.parametrize("level", [1, 3])
def test_a_coarse_level_is_rectified_as_the_whole_image(level: int) -> None:
    rectifier = Rectifier(CameraRig(camera(Lens.RADTAN, EUROC), None, np.eye(4), None))
    v, u = np.mgrid[0:H, 0:W]
    raw = np.round(120.0 + 60.0 * np.sin(u / 40.0) + 50.0 * np.cos(v / 30.0)).astype(np.uint8)
    step = 1 << level
    small = rectifier.left_level(np.ascontiguousarray(raw[::step, ::step]), level)
    whole = rectifier.left(raw)[::step, ::step]
    inner = (slice(3, -3), slice(3, -3))
    assert small.shape == whole.shape and np.abs(small[inner].astype(int) - whole[inner]).max() <= 4
    plain = Rectifier(CameraRig(camera(Lens.NONE, ()), None, np.eye(4), None))
    assert plain.left_level(small, level) is small
