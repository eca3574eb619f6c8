"""What the map knows of slants: they converge, last while nothing is told, are bounded, and go with their keyframe."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kiteline_agent.config import AgentConfig, LocalMapConfig, SlantConfig
from kiteline_agent.governor.cost_model import Work
from kiteline_agent.imaging.alignment_kernels import TEMPLATE, TEMPLATE_LEVELS
from kiteline_agent.keyframes import slant_from_motion
from kiteline_agent.keyframes.slant_from_motion import SlantFromMotion
from kiteline_agent.local_map.keyframe_landmarks import KeyframeLandmarks
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_codec.schema import KeyframeHeader
from kiteline_core.arrays import F64
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import NO_KEYFRAME, keyframe_id, submap_id

CAMERA = RectifiedCamera(752, 480, 420.0, 420.0, 376.0, 240.0, 0.11, True, np.eye(4))
LANDMARKS, ROWS = 6, np.arange(6)
TRUE = np.array([1.5, -0.5])


def add_keyframe(local_map: LocalMap, sequence: int) -> None:
    octave = np.array([0, 0, 0, 1, 1, 2], np.uint8)
    keyframe = keyframe_id(submap_id(0, 1, 0), sequence)
    landmarks = KeyframeLandmarks(
        np.full((LANDMARKS, 2), 200.0), np.full(LANDMARKS, 0.2), np.full(LANDMARKS, 0.01), octave,
        np.zeros(LANDMARKS, np.uint8), np.zeros((LANDMARKS, 32), np.uint8),
        np.zeros((LANDMARKS, TEMPLATE_LEVELS, TEMPLATE, TEMPLATE), np.uint8),
    )  # fmt: skip
    local_map.add(KeyframeHeader(keyframe, sequence, NO_KEYFRAME, np.eye(4), 0), np.eye(4), landmarks, sequence)


class Told:
    """A map with one keyframe, and frames that tell equations of its slants' errors."""

    def __init__(self, config: SlantConfig) -> None:
        self.map = LocalMap(CAMERA, replace(LocalMapConfig(), keyframes=1, landmarks=LANDMARKS))
        add_keyframe(self.map, 0)
        self._slants, self._config = SlantFromMotion(self.map, Work()), config

    def frames(self, count: int, information: float, true: F64 = TRUE) -> F64:
        """Slants (6,2) after so many frames, each with this information along both axes."""
        for _ in range(count):
            error = true - self.map.slant[0]
            level = np.full(LANDMARKS, information)
            self._slants._fuse(ROWS, np.column_stack([level, 0.0 * level, level, information * error]), self._config)
        return self.map.slant[0].copy()


def test_slants_converge_to_what_frames_tell() -> None:
    told = Told(SlantConfig())
    first = told.frames(1, 4.0)
    np.testing.assert_allclose(first, np.tile(0.8 * TRUE, (LANDMARKS, 1)))  # 4 of 5 parts, with a prior of 1
    np.testing.assert_allclose(told.frames(40, 4.0), np.tile(TRUE, (LANDMARKS, 1)), rtol=0.03)


def test_a_slant_is_the_most_probable_one_after_what_both_axes_tell_together() -> None:
    told, information = Told(SlantConfig(memory=1.0)), np.array([[5.0, 2.0], [2.0, 3.0]])
    slants, config = SlantFromMotion(told.map, Work()), SlantConfig(memory=1.0)
    for frames in (1, 2, 3):
        product = (TRUE - told.map.slant[0]) @ information
        rows = np.column_stack([np.tile([5.0, 2.0, 3.0], (LANDMARKS, 1)), product])
        slants._fuse(ROWS, rows, config)
        expected = np.linalg.solve(frames * information + np.eye(2) / config.sigma**2, frames * information @ TRUE)
        np.testing.assert_allclose(told.map.slant[0], np.tile(expected, (LANDMARKS, 1)), rtol=1e-6)


def test_frames_count_as_many_as_memory_says() -> None:
    told = Told(SlantConfig(memory=0.9))
    told.frames(200, 4.0)
    np.testing.assert_allclose(told.map.slant_equations[0, :, 0], 40.0, rtol=1e-3)
    other = -TRUE
    after = told.frames(7, 4.0, other)  # 0.9 to the seventh is a half
    assert (np.abs(after) < 0.2 * np.abs(TRUE)).all()


def test_nothing_is_forgotten_where_nothing_is_told() -> None:
    told = Told(SlantConfig())
    before = told.frames(30, 4.0)
    np.testing.assert_array_equal(told.frames(500, 0.0), before)
    np.testing.assert_allclose(told.frames(500, 0.01), before, rtol=0.02)


def test_a_memory_beyond_one_keeps_everything_and_no_more() -> None:
    told = Told(SlantConfig(memory=1.2))
    assert np.isfinite(told.frames(3000, 4.0)).all()
    np.testing.assert_allclose(told.map.slant_equations[0, :, 0], 12000.0)


def test_slants_are_no_steeper_than_edges() -> None:
    steep = Told(SlantConfig(sigma=1e3)).frames(5, 1e3, np.array([1e3, -1e3]))
    patch = 4.0 * 2.0 ** np.array([0, 0, 0, 1, 1, 2]) / CAMERA.fx
    np.testing.assert_allclose(steep[:, 0] * patch, 0.5)
    np.testing.assert_allclose(steep[:, 1] * patch, -0.5)


def test_a_keyframe_in_an_old_slot_begins_without_slants() -> None:
    told = Told(SlantConfig())
    told.frames(3, 4.0)
    add_keyframe(told.map, 1)
    assert not told.map.slant.any() and not told.map.slant_equations.any()


@pytest.mark.parametrize(
    ("dt_s", "first", "points", "measured"),
    [
        (0.05, 0, 240, [0, 1, 2, 4, 5]),  # all inliers
        (0.05, 1, 240, [4, 5]),  # a frame of halved images: those of finer levels were aligned elsewhere
        (0.05, 0, 2, [0, 1]),
        (0.05, 0, 0, []),  # below full effort
        (0.2, 0, 240, []),  # a slow camera
    ],
)
def test_what_a_frame_measures(
    monkeypatch: pytest.MonkeyPatch, dt_s: float, first: int, points: int, measured: list[int]
) -> None:
    def measure(*arguments: Any) -> None:
        arguments[-1][:] = (1.0, 0.0, 1.0, 0.5, 0.0)

    monkeypatch.setattr(slant_from_motion, "measure_slants", measure)
    told, work = Told(SlantConfig()), Work()
    images: Any = SimpleNamespace(first=first, sampled=(), grid=None)
    config = replace(AgentConfig(), slant=SlantConfig(points=points))
    ctx: Any = SimpleNamespace(dt_s=dt_s, images=images, config=config, shutter=None)
    track: Any = SimpleNamespace(
        T_c_m=np.eye(4), rows=ROWS, observed=np.full((LANDMARKS, 3), 200.0), inlier=np.arange(LANDMARKS) != 3
    )
    SlantFromMotion(told.map, work).update(ctx, track)
    assert np.flatnonzero(told.map.slant_equations[0, :, 0]).tolist() == measured
    assert not len(measured) or told.map.slant_equations[0, measured, 0] == pytest.approx(1.0 / 16.0)  # inflated
    assert np.flatnonzero(told.map.slant[0, :, 0] > 0.0).tolist() == measured
    assert work.slants == len(measured)


def test_only_candidates_that_face_their_keyframes_are_warped_without_slants() -> None:
    flat, told = Told(SlantConfig()).map, Told(SlantConfig()).map
    told.slant[0] = TRUE
    flat.active = told.active = submap_id(0, 1, 0)
    T_c_m = np.eye(4)
    T_c_m[2, 3] = -1.0
    expected = flat.candidates(T_c_m, 0.0).warp.copy()
    assert len(expected) == LANDMARKS
    np.testing.assert_array_equal(told.candidates(T_c_m, 0.0, facing=True).warp, expected)
    assert (np.abs(told.candidates(T_c_m, 0.0).warp - expected).max((1, 2)) > 0.01).all()
