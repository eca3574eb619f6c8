"""The rotation between two images that lie far apart, from their shift and their roll."""

import cv2
import numpy as np
import pytest

from kiteline_agent.imaging.features import Pyramid
from kiteline_agent.tracking.image_shift import ImageShift
from kiteline_core.arrays import F64, U8
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, CameraRig, Rectifier

CAMERA = CameraModel(752, 480, 450.0, 450.0, 375.5, 239.5)
FOCAL = CAMERA.matrix()


def wall(seed: int = 0) -> U8:
    """A far wall with patches of all sizes, as a camera sees it that looks straight at it; four times as wide."""
    rng = np.random.default_rng(seed)
    out = np.zeros((1920, 3008), np.float32)
    for size in (8, 24, 64, 160):
        noise = rng.uniform(-1.0, 1.0, (1920 // size + 1, 3008 // size + 1)).astype(np.float32)
        out += cv2.resize(noise, (3008, 1920), interpolation=cv2.INTER_CUBIC)
    return np.clip(128.0 + 40.0 * out, 0.0, 255.0).astype(np.uint8)


def seen(scene: U8, R_c_w: F64) -> Pyramid:
    """The pyramid of what the camera sees after a rotation."""
    on_wall = np.array([[450.0, 0.0, 1503.5], [0.0, 450.0, 959.5], [0.0, 0.0, 1.0]])
    image = cv2.warpPerspective(scene, FOCAL @ R_c_w @ np.linalg.inv(on_wall), (CAMERA.width, CAMERA.height))
    levels = [np.asarray(image, np.uint8)]
    for _ in range(3):
        levels.append(np.asarray(cv2.pyrDown(levels[-1]), np.uint8))
    return tuple(levels)


def guesses(turn_deg: tuple[float, float, float], T_c_m: F64) -> list[F64]:
    """Poses of the second of two images, the first one at T_c_m (4,4)."""
    scene, shift = wall(), ImageShift(Rectifier(CameraRig(CAMERA, None, np.eye(4), None)))
    shift.remember(seen(scene, np.eye(3)), T_c_m)
    return shift.rotated_poses(seen(scene, se3.so3_exp(np.radians(turn_deg))))


@pytest.mark.parametrize("turn_deg", [(0.0, 9.0, 0.0), (6.0, -4.0, 0.0), (0.0, 3.0, 15.0), (-5.0, 6.0, -22.0)])
def test_a_rotation_is_found_to_a_few_degrees(turn_deg: tuple[float, float, float]) -> None:
    T_c_m = se3.exp(np.array([0.3, -1.0, 2.0, 0.1, 0.4, -0.2]))
    true = se3.from_rt(se3.so3_exp(np.radians(turn_deg)), np.zeros(3)) @ T_c_m
    found = guesses(turn_deg, T_c_m)
    off_deg = [np.degrees(np.linalg.norm(se3.so3_log(T[:3, :3] @ true[:3, :3].T))) for T in found]
    assert min(off_deg) < 4.5  # half a step of the roll
    centre = -found[0][:3, :3].T @ found[0][:3, 3]
    np.testing.assert_allclose(centre, -T_c_m[:3, :3].T @ T_c_m[:3, 3], atol=1e-9)  # the camera has turned about itself


def test_one_guess_where_the_image_did_not_roll_and_none_for_another_place() -> None:
    assert len(guesses((0.0, 5.0, 0.0), np.eye(4))) == 1
    shift = ImageShift(Rectifier(CameraRig(CAMERA, None, np.eye(4), None)))
    assert shift.rotated_poses(seen(wall(), np.eye(3))) == []
    shift.remember(tuple(np.full_like(level, 90) for level in seen(wall(), np.eye(3))), np.eye(4))
    assert shift.rotated_poses(seen(wall(1), np.eye(3))) == []
