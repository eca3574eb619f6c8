"""Corners that something hides before there is a map: they are found again, and what nothing connects is left out."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from kiteline_agent.config import AgentConfig
from kiteline_agent.imaging.features import Pyramid, build_pyramid
from kiteline_agent.imaging.optical_flow import Flow
from kiteline_agent.initialisation.corner_tracks import CornerTracks, TrackedKeyframe
from kiteline_agent.initialisation.hidden_corners import HiddenView, turned
from kiteline_core.arrays import F64, U8
from kiteline_core.geometry import se3
from tests.agent.initialisation.test_torn_images import CAMERA

FLOW = Flow(window_px=15, return_px=0.5)
PX_A_FRAME, FRAME_NS = 3, 50_000_000
COVERED = range(8, 17)  # 0.45 s


def scene(seed: int = 2) -> U8:
    grey = cv2.GaussianBlur(np.random.default_rng(seed).normal(128.0, 80.0, (480, 1152)), (0, 0), 3.0)
    return cv2.normalize(grey, None, 0.0, 255.0, cv2.NORM_MINMAX).astype(np.uint8)  # type: ignore[call-overload]


def view(k: int, hidden: float = 0.0) -> Pyramid:
    """A plane that passes by; a plain surface hides a share of it from the left."""
    image = np.ascontiguousarray(scene()[:, PX_A_FRAME * k : PX_A_FRAME * k + 752])
    image[:, : round(hidden * 752)] = 70
    return build_pyramid(image, 4)


def no_tracks() -> CornerTracks:
    config = AgentConfig()
    return CornerTracks(CAMERA, config.detector, config.inertial_start.corner_tracks)


def flown(turn: F64 | None, hidden: float, every: int = 1) -> CornerTracks:
    """Tracks over 30 frames, of which COVERED show a part. every: frames between which corners are not followed."""
    tracks = no_tracks()
    for k in range(30):
        image, t_ns = view(k, hidden if k in COVERED else 0.0), k * FRAME_NS
        if (every > 1 or tracks.follow(image)) and tracks.is_due(t_ns):
            tracks.add(t_ns, image, lambda _since_ns: turn)
    return tracks


def seen_before_and_after(tracks: CornerTracks) -> int:
    before = max((k for k in tracks.keyframes if k.t_ns < COVERED[0] * FRAME_NS), key=lambda k: k.t_ns)
    return len(np.intersect1d(before.ids, tracks.keyframes[-1].ids))


@pytest.mark.parametrize("every", [1, 5])
@pytest.mark.parametrize("hidden", [0.9, 1.0])
def test_corners_are_found_again_where_the_gyro_tells_the_turn(hidden: float, every: int) -> None:
    tracks = flown(np.eye(3), hidden, every)
    assert seen_before_and_after(tracks) > 60
    assert seen_before_and_after(flown(None, hidden, every)) < 20
    last = tracks.keyframes[-1].uv
    apart = np.linalg.norm(last[:, None] - last[None], axis=2)[np.triu_indices(len(last), 1)]
    assert apart.min() > 3.0  # no corner is there twice
    moved = []
    for keyframe in tracks.keyframes:
        _, a, b = np.intersect1d(tracks.keyframes[0].ids, keyframe.ids, return_indices=True)
        moved.append(keyframe.uv[b] - tracks.keyframes[0].uv[a] + [PX_A_FRAME * keyframe.t_ns / FRAME_NS, 0.0])
    assert np.quantile(np.abs(np.concatenate(moved)), 0.98) < 1.0
    assert all((np.diff(keyframe.ids) > 0).all() for keyframe in tracks.keyframes)


def test_a_turn_shifts_corners_as_it_shifts_the_image() -> None:
    turn, ray = se3.so3_exp(np.array([0.02, 0.1, -0.05])), np.array([0.3, -0.2, 1.0])
    before = CAMERA.fx * ray[:2] + (CAMERA.cx, CAMERA.cy)
    after = turn.T @ ray
    expected = CAMERA.fx * after[:2] / after[2] + (CAMERA.cx, CAMERA.cy)
    np.testing.assert_allclose(turned(before[None], turn, CAMERA)[0], expected)


def test_another_view_shows_none_of_the_corners() -> None:
    image = view(0)
    corners = cv2.goodFeaturesToTrack(image[0], 150, 0.01, 15.0).reshape(-1, 2).astype(np.float64)
    ids, nothing = np.arange(10, 10 + len(corners)), np.zeros(0, np.int64)
    hidden = HiddenView(0, image, ids, corners, CAMERA)
    found, uv = hidden.find(view(4), nothing, np.eye(3), FLOW)
    assert len(found) > 100
    np.testing.assert_allclose(uv, corners[found - 10] - (4 * PX_A_FRAME, 0.0), atol=0.3)
    known = ids[:40]
    assert len(np.intersect1d(hidden.find(view(4), known, np.eye(3), FLOW)[0], known)) == 0
    other = build_pyramid(np.ascontiguousarray(scene(seed=3)[:, :752]), 4)
    assert len(hidden.find(other, nothing, np.eye(3), FLOW)[0]) < 20


def window(*parts: tuple[int, ...]) -> CornerTracks:
    """Keyframes every 0.25 s, of which those at these places have the same corners; others share none."""
    tracks = no_tracks()
    for k in range(1 + max(k for part in parts for k in part)):
        part = next((n for n, part in enumerate(parts) if k in part), 100 + k)
        tracks.keyframes.append(TrackedKeyframe(k * 250_000_000, (), 20 * part + np.arange(20), np.zeros((20, 2))))
    return tracks


def kept(tracks: CornerTracks) -> tuple[bool, list[int]]:
    solvable = tracks.keep_connected(2.4)
    return solvable, [k.t_ns // 250_000_000 for k in tracks.keyframes]


def test_a_long_newest_part_of_a_window_is_solved_alone() -> None:
    old, new = tuple(range(8)), tuple(range(9, 20))
    assert kept(window(old, new)) == (True, list(new))
    assert kept(window(tuple(range(12)))) == (True, list(range(12)))
    assert kept(window((*range(4), *range(8, 12)), (5, 6, 7))) == (True, [*range(4), *range(8, 12)])  # found again


def test_shorter_parts_are_solved_together_without_single_keyframes() -> None:
    assert kept(window(tuple(range(8)), (9, 10, 11))) == (True, [*range(8), 9, 10, 11])
    assert kept(window(tuple(range(8)), (9, 10))) == (False, [*range(8), 9, 10])
    assert kept(window(tuple(range(8)), (9,))) == (False, [*range(8), 9])


def test_a_window_waits_while_something_hides_its_corners() -> None:
    tracks = flown(np.eye(3), 1.0)
    assert tracks.keep_connected(0.4)
    tracks = no_tracks()
    for k in range(COVERED[-1]):
        image = view(k, 1.0 if k in COVERED else 0.0)
        if tracks.follow(image) and tracks.is_due(k * FRAME_NS):
            tracks.add(k * FRAME_NS, image, lambda _since_ns: np.eye(3))
    held = len(tracks.keyframes)
    assert not tracks.keep_connected(0.4) and len(tracks.keyframes) == held


def test_a_window_does_not_wait_for_corners_that_a_turn_left_behind() -> None:
    """Each keyframe shares corners with the next one, so that all are connected."""
    tracks = window(tuple(range(12)))
    tracks.keyframes = [replace(k, ids=k.ids + 10 * n) for n, k in enumerate(tracks.keyframes)]
    hidden = tracks.keyframes[8]
    tracks._hidden = HiddenView(hidden.t_ns, view(0), hidden.ids, hidden.uv, CAMERA)
    assert kept(tracks) == (True, list(range(12)))
    tracks.keyframes[9:] = [replace(k, ids=k.ids + 1000) for k in tracks.keyframes[9:]]
    assert kept(tracks) == (False, list(range(12)))
