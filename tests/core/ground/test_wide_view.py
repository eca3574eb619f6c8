"""The wider view of scans: it goes on where the rectified images end, and holds nothing that a lens did not see."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from kiteline_core.arrays import F64, U8, Bool
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, CameraRig, Lens, RawSide, Rectifier
from kiteline_core.ground.config import GroundConfig
from kiteline_core.ground.disparity import DisparityCamera
from kiteline_core.ground.wide_view import WideView

WIDE = replace(GroundConfig(), wider=0.085, lower=0.067)
WIDTH, HEIGHT = 640, 400
SIDE, LOWER = 56, 24  # px of the full image, by the shares of the configuration
K1_K2 = (-0.28, 0.07)
T_C_R = se3.from_rt(se3.so3_exp(np.array([0.01, -0.02, 0.015])), np.array([0.11, 0.001, -0.002]))


def camera(distortion: tuple[float, float] = K1_K2, focal: float = 390.0) -> CameraModel:
    return CameraModel(WIDTH, HEIGHT, focal, focal, 315.0, 205.0, Lens.RADTAN, (*distortion, 0.0, 0.0))


def rig(lens: CameraModel) -> CameraRig:
    return CameraRig(lens, lens, np.eye(4), T_C_R)


def texture(seed: int) -> U8:
    noise = np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH)).astype(np.uint8)
    return np.asarray(cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 4.0), None, 0, 255, cv2.NORM_MINMAX), np.uint8)


def raw_pixels(side: RawSide, uv: F64) -> tuple[F64, F64]:
    """Raw pixels (n,2) of rectified ones (n,2), and the tangent (n,) of the angle to the raw optical axis."""
    xy = (uv - side.matrix[:2, 2]) / side.matrix[[0, 1], [0, 1]]
    rays = np.column_stack([xy, np.ones(len(xy))]) @ side.rotation  # by the transpose: from rectified to raw
    xy = rays[:, :2] / rays[:, 2:]
    r2 = (xy**2).sum(1)
    k1, k2 = side.lens.distortion[:2]
    raw = xy * (1.0 + k1 * r2 + k2 * r2**2)[:, None] * side.lens.fx + [side.lens.cx, side.lens.cy]
    return raw, np.sqrt(r2)


def kept(view: WideView, disparity_px: float) -> tuple[F64, F64, Bool]:
    """Where pixels of a disparity image lie in the rectified left and right image (n,2), and which are not masked."""
    small = DisparityCamera.of(view.camera)
    disparity = np.full((small.height, small.width), disparity_px, np.float32)
    u, v = np.meshgrid(np.arange(small.width), np.arange(small.height))
    left = np.column_stack([2.0 * u.ravel() - SIDE, 4.0 * v.ravel() + 1.0 + LOWER])
    return left, left - [2.0 * disparity_px, 0.0], view.mask(disparity).ravel() > 0.0


def test_the_view_goes_on_where_the_rectified_images_end() -> None:
    rectifier = Rectifier(rig(camera()))
    view = WideView(rectifier, WIDE)
    told = rectifier.camera
    assert (view.camera.width, view.camera.height) == (WIDTH + 2 * SIDE, HEIGHT)
    assert (view.camera.cx, view.camera.cy) == (told.cx + SIDE, told.cy - LOWER)
    assert (view.camera.fx, view.camera.bf) == (told.fx, told.bf)
    halves = cv2.pyrDown(texture(1)), cv2.pyrDown(texture(2))
    found = view.pair(*halves)
    inner = np.s_[: (HEIGHT - LOWER) // 2, SIDE // 2 : (SIDE + WIDTH) // 2]
    for side, (half, image) in enumerate(zip(halves, found, strict=True)):
        assert image.shape == (HEIGHT // 2, WIDTH // 2 + SIDE)
        same = image[inner].astype(int) - rectifier.halved(side, half)[LOWER // 2 :]
        assert np.abs(same[4:-4, 4:-4]).max() <= 3  # maps are rounded to 1/32 px


def test_pixels_of_the_full_image_keep_their_rays() -> None:
    view = WideView(Rectifier(rig(camera())), WIDE)
    uv = np.array([[0.0, 0.0], [100.0, 300.0], [639.0, 399.0]])
    assert np.array_equal(view.at(uv), uv + [SIDE, -LOWER])


def test_the_right_image_is_read_at_its_rows() -> None:
    rectifier = Rectifier(rig(camera()))
    view = WideView(rectifier, WIDE)
    halves = cv2.pyrDown(texture(1)), cv2.pyrDown(texture(2))
    before = view.pair(*halves)
    rectifier.set_right_rows(lambda uv: 4.0 + 0.005 * uv[:, 0])
    after = view.pair(*halves)
    assert np.array_equal(after[0], before[0])
    at = np.s_[:-10, SIDE // 2 : (SIDE + WIDTH) // 2]
    told = rectifier.halved(1, halves[1])[LOWER // 2 :].astype(int)
    error = np.abs(after[1][: len(told), at[1]].astype(int) - told)[8:-8, 8:-8]
    assert error.mean() < 1.0
    assert np.abs(before[1][: len(told), at[1]].astype(int) - told).mean() > 10.0
    moved = WideView(rectifier, WIDE)  # a view that begins with the rows sees the same
    assert np.array_equal(moved.pair(*halves)[1], after[1])


@pytest.mark.parametrize("disparity_px", [1.0, 12.0, 40.0])
def test_what_either_eye_did_not_see_is_masked_with_its_border(disparity_px: float) -> None:
    rectifier = Rectifier(rig(camera()))
    view = WideView(rectifier, WIDE)
    left, right, some = kept(view, disparity_px)
    inside = np.ones(len(left), np.bool_)
    for side, uv in zip(rectifier.raw_sides, (left, right), strict=True):
        # What a matched block reaches to the sides must be seen, three pixels of two px, and half a row of four above
        # and below. Nothing is read beyond the view.
        for corner in ([-6.0, -2.0], [6.0, -2.0], [-6.0, 2.0], [6.0, 2.0]):
            first, last = [-SIDE, LOWER], [WIDTH + SIDE - 1.0, HEIGHT + LOWER - 1.0]
            raw, _ = raw_pixels(side, np.clip(uv + corner, first, last))
            inside &= ((raw >= 0.0) & (raw <= [WIDTH - 1.0, HEIGHT - 1.0])).all(1)
    assert inside[some].all()
    assert some.sum() > 0.85 * inside.sum()  # and not much more is masked
    assert (~inside).sum() > 500
    rectified = (left[:, 0] >= 0.0) & (left[:, 0] < WIDTH) & (left[:, 1] < HEIGHT)
    assert (some & ~rectified).sum() > 800  # the view shows more


def test_a_lens_model_that_folds_back_shows_nothing_beyond() -> None:
    """A polynomial of the third degree bends rays beyond its summit back into the raw image."""
    lens = camera((-0.3, 0.0), focal=480.0)
    rectifier = Rectifier(rig(lens))
    view = WideView(rectifier, replace(WIDE, wider=0.25))
    summit = np.sqrt(1.0 / 0.9)
    small = DisparityCamera.of(view.camera)
    u, v = np.meshgrid(np.arange(small.width), np.arange(small.height))
    uv = np.column_stack([2.0 * u.ravel(), 4.0 * v.ravel() + 1.0]) - view.at(np.zeros((1, 2)))
    raw, tangent = raw_pixels(rectifier.raw_sides[0], uv)
    beyond = tangent > summit
    folded = beyond & ((raw >= 0.0) & (raw <= [WIDTH - 1.0, HEIGHT - 1.0])).all(1)
    assert folded.sum() > 500  # they pass for seen by their raw pixels alone
    disparity = view.mask(np.full((small.height, small.width), 1.0, np.float32)).ravel()
    assert not disparity[beyond].any()
    assert (disparity > 0.0).mean() > 0.3


@pytest.mark.parametrize("right", [True, False])
def test_images_that_are_rectified_or_have_depth_are_taken_as_they_are(right: bool) -> None:
    plain = replace(camera(), lens=Lens.NONE, distortion=())
    beside = se3.from_rt(np.eye(3), np.array([0.1, 0.0, 0.0]))
    one = CameraRig(plain, plain, np.eye(4), beside) if right else CameraRig(camera(), None, np.eye(4), None, True)
    rectifier = Rectifier(one)
    view = WideView(rectifier, WIDE if right else GroundConfig())
    assert view.camera is rectifier.camera
    uv = np.array([[3.0, 5.0]])
    assert np.array_equal(view.at(uv), uv)
    disparity = np.full((100, 320), 2.0, np.float32)
    assert (view.mask(disparity) == 2.0).all()
    halves = cv2.pyrDown(texture(1)), cv2.pyrDown(texture(2))
    told = (rectifier.halved(side, half) for side, half in enumerate(halves))
    assert all(np.array_equal(a, b) for a, b in zip(view.pair(*halves), told, strict=True))
