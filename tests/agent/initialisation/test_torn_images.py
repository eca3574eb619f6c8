"""Images of which a part jumped: told from all motions of a camera, and left out of the window of a start."""

import cv2
import numpy as np
import pytest

from kiteline_agent.config import AgentConfig
from kiteline_agent.imaging.features import build_pyramid
from kiteline_agent.imaging.optical_flow import Flow
from kiteline_agent.initialisation.corner_tracks import CornerTracks
from kiteline_agent.initialisation.frame_flow import FrameFlow, is_torn
from kiteline_core.arrays import F64, U8
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
    assert is_torn(UV, NOISE + change) is False


@pytest.mark.parametrize("shift_px", [25.0, -40.0, 60.0])
@pytest.mark.parametrize("row", [0.2, 0.4, 0.6])
def test_a_part_that_jumps_is_noticed(row: float, shift_px: float) -> None:
    assert is_torn(UV, NOISE + jump(row, shift_px))
    assert is_torn(UV, NOISE + jump(row, shift_px) + ROLL)
    assert is_torn(UV, np.full((150, 2), np.nan)) is None  # nothing is known of the motion before


def shaken(torn: tuple[int, ...]) -> list[U8]:
    """Images of a plane that passes by 4 px an image; of some the lower half is shifted."""
    scene = cv2.GaussianBlur(np.random.default_rng(1).normal(128.0, 80.0, (480, 852)), (0, 0), 4.0)
    scene = cv2.normalize(scene, None, 0.0, 255.0, cv2.NORM_MINMAX).astype(np.uint8)  # type: ignore[call-overload]
    images = [np.ascontiguousarray(scene[:, 4 * k : 752 + 4 * k]) for k in range(12)]
    for k in torn:
        images[k][240:] = np.roll(images[k][240:], 25, axis=1)
    return images


def test_a_torn_image_is_left_out() -> None:
    config = AgentConfig()
    tracks = CornerTracks(CAMERA, config.detector, config.inertial_start.corner_tracks)
    left_out = []
    for k, image in enumerate(shaken((4, 8, 9))):
        pyramid, t_ns = build_pyramid(image, 4), k * 50_000_000
        if not tracks.follow(pyramid):
            left_out.append(k)
        elif tracks.is_due(t_ns):
            tracks.add(t_ns, pyramid)
    assert left_out == [4, 8, 9]
    first, last = tracks.keyframes[0], tracks.keyframes[-1]
    _, a, b = np.intersect1d(first.ids, last.ids, return_indices=True)
    moved = last.uv[b] - first.uv[a]
    assert len(a) > 80 and np.abs(moved - np.median(moved, axis=0)).max() < 1.0


@pytest.mark.parametrize(("torn", "smooth"), [((), [2, 3, 4, 5]), ((0,), [3, 4, 5]), ((1,), [4, 5]), ((4,), [2, 3, 5])])
def test_motion_is_smooth_once_two_steps_agree(torn: tuple[int, ...], smooth: list[int]) -> None:
    images = shaken(torn)[:6]
    corners = cv2.goodFeaturesToTrack(images[0], 150, 0.01, 20.0)
    flow = FrameFlow(Flow(window_px=15, return_px=1.0))
    flow.begin(images[0], corners.reshape(-1, 2).astype(np.float64))
    taken = [k for k in range(1, 6) if flow.follow(images[k]) is not None and flow.smooth]
    assert taken == smooth
