"""Images of which a part jumped: told from all motions of a camera, and left out of the window of a start."""

import cv2
import numpy as np
import pytest

from kiteline_agent.config import AgentConfig
from kiteline_agent.imaging.features import build_pyramid
from kiteline_agent.initialisation.corner_tracks import CornerTracks, is_torn
from kiteline_core.arrays import F64
from kiteline_core.geometry.cameras import RectifiedCamera

CAMERA = RectifiedCamera(752, 480, 420.0, 420.0, 376.0, 240.0, 0.0, False, np.eye(4))
RNG = np.random.default_rng(0)
UV = RNG.uniform((0.0, 0.0), (752.0, 480.0), (150, 2))
CENTRED = UV - (376.0, 240.0)
NOISE = RNG.normal(0.0, 1.0, (150, 2))
PARALLAX = 1.0 / RNG.uniform(1.0, 6.0, (150, 1)) * np.array([8.0, 2.0])
ROLL = 0.1 * np.column_stack([-CENTRED[:, 1], CENTRED[:, 0]])


def jump(row: float, shift_px: float) -> F64:
    return np.column_stack([shift_px * (UV[:, 1] > 480.0 * row), np.zeros(150)])


@pytest.mark.parametrize(
    "change",
    [0.0 * UV, 0.0 * UV + (40.0, -25.0), ROLL, 3.0 * ROLL, 0.15 * CENTRED, PARALLAX],
    ids=["none", "turn", "roll", "faster roll", "step ahead", "parallax"],
)  # fmt: skip
def test_what_a_vehicle_does_is_no_jump(change: F64) -> None:
    assert not is_torn(UV, NOISE + change)


@pytest.mark.parametrize("shift_px", [25.0, -40.0, 60.0])
@pytest.mark.parametrize("row", [0.2, 0.4, 0.6])
def test_a_part_that_jumps_is_noticed(row: float, shift_px: float) -> None:
    assert is_torn(UV, NOISE + jump(row, shift_px))
    assert is_torn(UV, NOISE + jump(row, shift_px) + ROLL)
    assert not is_torn(UV, np.full((150, 2), np.nan))  # nothing is known of the motion before


def test_a_torn_image_is_left_out() -> None:
    config = AgentConfig()
    scene = cv2.GaussianBlur(RNG.normal(128.0, 80.0, (480, 852)), (0, 0), 4.0)
    scene = cv2.normalize(scene, None, 0.0, 255.0, cv2.NORM_MINMAX).astype(np.uint8)  # type: ignore[call-overload]
    tracks = CornerTracks(CAMERA, config.detector, config.inertial_start.corner_tracks)
    left_out = []
    for k in range(12):
        image = np.ascontiguousarray(scene[:, 4 * k : 752 + 4 * k])
        if k in (4, 8):
            image[240:] = np.roll(image[240:], 25, axis=1)
        pyramid, t_ns = build_pyramid(image, 4), k * 50_000_000
        if not tracks.follow(pyramid):
            left_out.append(k)
        elif tracks.is_due(t_ns):
            tracks.add(t_ns, pyramid)
    assert left_out == [4, 8]
    first, last = tracks.keyframes[0], tracks.keyframes[-1]
    _, a, b = np.intersect1d(first.ids, last.ids, return_indices=True)
    moved = last.uv[b] - first.uv[a]
    assert len(a) > 80 and np.abs(moved - np.median(moved, axis=0)).max() < 1.0
