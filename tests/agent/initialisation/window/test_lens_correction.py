"""Errors of a calibrated lens as a map of pixels, and images that are read through it."""

import cv2
import numpy as np
import pytest

from kiteline_agent.initialisation.window.lens_correction import TERMS, moved, rms_px, true_place
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, CameraRig, Lens, Rectifier

LENS = np.array([0.004, 0.002, -0.002, -0.015, 0.02, -0.004, 0.003, 0.002])
RADTAN = (-0.28, 0.07, 2e-4, 2e-5)


def places() -> F64:
    x, y = np.meshgrid(np.linspace(-0.8, 0.8, 9), np.linspace(-0.5, 0.5, 7))
    return np.stack([x, y], axis=-1)


def test_the_inverse_undoes_the_error() -> None:
    np.testing.assert_allclose(true_place(moved(places(), LENS), LENS), places(), atol=1e-7)
    np.testing.assert_array_equal(moved(places(), np.zeros(TERMS)), places())


def test_the_last_factors_are_a_rotation_of_the_camera() -> None:
    turn = np.array([0.001, -0.002, 0.0015])
    rays = np.append(places(), np.ones((*places().shape[:2], 1)), axis=-1) @ se3.so3_exp(turn)
    np.testing.assert_allclose(moved(places(), np.append(np.zeros(5), turn)), rays[..., :2] / rays[..., 2:], atol=2e-5)


@pytest.mark.parametrize(
    ("kind", "distortion"), [(Lens.RADTAN, RADTAN), (Lens.EQUIDISTANT, (-0.01, 0.02, -0.01, 0.0)), (Lens.NONE, ())]
)
def test_a_corrected_image_shows_true_places(kind: Lens, distortion: tuple[float, ...]) -> None:
    """A blob where the true lens shows a place is, after two corrections in turn, at that place; level 1 follows."""
    model = CameraModel(320, 240, 200.0, 198.0, 158.0, 121.0, kind, distortion)
    rectifier = Rectifier(CameraRig(model, None, np.eye(4), None))
    assert rms_px(np.append(np.zeros(3), LENS[3:5].tolist() + [0.01] * 3), rectifier.camera) == pytest.approx(
        0.5, abs=0.4
    )
    focal, centre = np.array([200.0, 198.0]), np.array([158.0, 121.0])
    for lens in (0.5 * LENS, -1.5 * LENS):

        def corrected(uv: F64, lens: F64 = lens) -> F64:
            return moved((uv - centre) / focal, lens) * focal + centre

        rectifier.correct_left(corrected)
    at = np.array([[0.4, -0.3]])
    told = moved(moved(at, -1.5 * LENS), 0.5 * LENS)  # pixels over focal by the calibration
    rays = np.append(told, np.ones((1, 1)), axis=1)
    d, zero = np.array(distortion), np.zeros(3)
    if kind is Lens.EQUIDISTANT:
        raw = cv2.fisheye.projectPoints(rays[None], zero, zero, model.matrix(), d)[0]
    else:
        raw = cv2.projectPoints(rays, zero, zero, model.matrix(), d if len(d) else None)[0]
    u, v = raw.ravel()
    x, y = np.meshgrid(np.arange(320.0), np.arange(240.0))
    image = np.round(200.0 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / 18.0)).astype(np.uint8)
    found = rectifier.left(image).astype(np.float64)
    at_px = [(found * g).sum() / found.sum() for g in (x, y)]
    np.testing.assert_allclose(at_px, (at * focal + centre)[0], atol=0.15)
    small = rectifier.halved(0, image[::2, ::2]).astype(np.float64)
    half = [(small * g[::2, ::2]).sum() / small.sum() for g in (x, y)]
    np.testing.assert_allclose(half, at_px, atol=0.3)
