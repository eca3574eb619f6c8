"""Corners followed from keyframe to keyframe before there is a map, and which keyframes a window holds."""

from typing import Any

import cv2
import numpy as np
import pytest

from kiteline_agent.config import AgentConfig
from kiteline_agent.imaging.features import DetectorConfig, build_pyramid
from kiteline_agent.inertial_start_config import CornerTracksConfig
from kiteline_agent.initialisation.corner_tracks import CornerTracks, TrackedKeyframe
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from tests.agent.initialisation.test_inertial_start import CAMERA, SECOND
from tests.agent.initialisation.window.test_window_bundle import FOCAL


def kept_s(seconds: float, config: CornerTracksConfig, oldest_s: float = 0.0) -> np.ndarray[Any, Any]:
    """Stamps of the keyframes that are left of one every 0.25 s."""
    camera: Any = None
    tracks = CornerTracks(camera, DetectorConfig(), config)
    for k in range(round(4 * seconds) + 1):
        tracks.keyframes.append(TrackedKeyframe(k * SECOND // 4, (), np.zeros(0, np.int64), np.zeros((0, 2))))
        tracks.drop_before(round(oldest_s * SECOND))
    return np.array([k.t_ns for k in tracks.keyframes]) / SECOND


def test_a_long_window_keeps_every_second_of_its_old_keyframes() -> None:
    config = CornerTracksConfig(keyframes=20)
    np.testing.assert_array_equal(kept_s(4.0, config), np.arange(0.0, 4.01, 0.25))
    long = kept_s(7.0, config)
    assert len(long) == 20 and long[0] == 0.0 and long[-1] == 7.0
    assert np.diff(long).max() == 0.5 and (np.diff(long)[-8:] == 0.25).all()


def test_a_window_that_is_thinned_out_ends_before_its_oldest_keyframes() -> None:
    config = CornerTracksConfig(keyframes=20)
    longest = kept_s(30.0, config)
    assert len(longest) == 20 and longest[-1] == 30.0 and 8.5 < np.ptp(longest) <= 9.5
    assert np.diff(longest).max() == 0.5
    assert kept_s(7.0, config, oldest_s=3.0)[0] == 3.0


def test_corners_are_followed_over_a_turn_that_the_gyro_tells() -> None:
    rng = np.random.default_rng(3)
    image = cv2.GaussianBlur(rng.integers(0, 256, (480, 752)).astype(np.uint8), (0, 0), 2.0)
    image = cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)  # type: ignore[call-overload]
    turn = se3.so3_exp(np.array([0.0, 0.2, 0.0]))  # of the camera, in a quarter of a second
    matrix = np.array([[FOCAL, 0.0, CAMERA.cx], [0.0, FOCAL, CAMERA.cy], [0.0, 0.0, 1.0]])
    turned = cv2.warpPerspective(image, matrix @ turn.T @ np.linalg.inv(matrix), (752, 480))
    config = AgentConfig()

    def followed(told: F64 | None) -> int:
        tracks = CornerTracks(CAMERA, config.detector, config.inertial_start.corner_tracks)
        tracks.add(0, build_pyramid(image, 4))
        if not tracks.add(SECOND // 4, build_pyramid(np.asarray(turned, np.uint8), 4), lambda _since_ns: told):
            return 0  # it shows too few
        return len(np.intersect1d(tracks.keyframes[0].ids, tracks.keyframes[1].ids))

    assert followed(turn) > 80 and followed(None) < 40


def test_frames_between_keyframes_tell_where_corners_went() -> None:
    config, rng = AgentConfig(), np.random.default_rng(4)
    scene = cv2.GaussianBlur(rng.normal(128.0, 80.0, (480, 1152)), (0, 0), 2.0).clip(0.0, 255.0).astype(np.uint8)
    frames = [build_pyramid(np.ascontiguousarray(scene[:, 20 * k : 752 + 20 * k]), 4) for k in range(13)]

    def followed(frame_by_frame: bool) -> int:
        tracks = CornerTracks(CAMERA, config.detector, config.inertial_start.corner_tracks)
        for k, frame in enumerate(frames):
            if frame_by_frame:
                tracks.follow(frame)
            if k in (0, len(frames) - 1) and not tracks.add(k * SECOND // 20, frame):
                return 0  # it shows too few
        return len(np.intersect1d(tracks.keyframes[0].ids, tracks.keyframes[1].ids))

    assert followed(frame_by_frame=True) > 80 and followed(frame_by_frame=False) < 40


@pytest.mark.parametrize("frame_by_frame", [True, False])
def test_tracks_go_on_over_images_that_show_nothing(frame_by_frame: bool) -> None:
    """One between two keyframes, and one that was to be a keyframe; if that lasts, what is there is taken."""
    config, rng = AgentConfig(), np.random.default_rng(4)
    scene = cv2.GaussianBlur(rng.normal(128.0, 80.0, (480, 852)), (0, 0), 2.0).clip(0.0, 255.0).astype(np.uint8)
    blank = rng.normal(120.0, 1.3, (480, 752)).clip(0.0, 255.0).astype(np.uint8)
    tracks = CornerTracks(CAMERA, config.detector, config.inertial_start.corner_tracks)

    def show(k: int, *, nothing: bool) -> bool:
        image = build_pyramid(blank if nothing else np.ascontiguousarray(scene[:, 4 * k : 752 + 4 * k]), 4)
        shows = not frame_by_frame or tracks.follow(image)
        return shows and tracks.is_due(k * SECOND // 20) and tracks.add(k * SECOND // 20, image)

    assert [k for k in range(8) if show(k, nothing=k in (3, 5))] == [0, 6]
    assert len(np.intersect1d(tracks.keyframes[0].ids, tracks.keyframes[1].ids)) > 80
    due = 12  # four images are left out; without the frames between one, at 0.24 s after frame 6
    assert next(k for k in range(8, 25) if show(k, nothing=True)) == due
