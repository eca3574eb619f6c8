"""Flights before a cloud of landmarks whose disparities are off by a known amount."""

from collections.abc import Iterator

import numpy as np

from kiteline_agent.config import DisparityAlignmentConfig, LocalMapConfig
from kiteline_agent.local_map.disparity_alignment import DisparityAlignment
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_codec.schema import KeyframeHeader
from kiteline_core.arrays import F64, I64
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.geometry.disparity_offset import terms
from kiteline_core.ids import NO_KEYFRAME, KeyframeId
from tests.agent.plain_landmarks import plain_landmarks

CAMERA = RectifiedCamera(752, 480, 430.0, 430.0, 376.0, 240.0, 0.11, True, np.eye(4))


WORN = np.array([-0.6, 0.1, -0.3, -0.5, 0.3])


NOTHING = np.zeros(5)


def normalised(uv: F64) -> F64:
    return np.asarray((uv - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy])


class Flight:
    """A camera that moves before a cloud; its disparities are off."""

    def __init__(self, offset: F64, seed: int, step: F64) -> None:
        self.rng, self.offset, self.step = np.random.default_rng(seed), offset, step
        self.period_ns = 50_000_000
        self.map = LocalMap(CAMERA, LocalMapConfig(keyframes=8))
        self.alignment = DisparityAlignment(self.map, DisparityAlignmentConfig())
        uv = self.rng.uniform([40, 40], [710, 440], (160, 2))
        self.depth = self.rng.uniform(2.0, 12.0, len(uv))
        self.xyz = np.column_stack([normalised(uv), np.ones(len(uv))]) * self.depth[:, None]
        disparity = CAMERA.bf / self.depth + terms(normalised(uv)) @ offset + self.rng.normal(0, 0.2, len(uv))
        header = KeyframeHeader(KeyframeId(0), 0, NO_KEYFRAME, np.eye(4), len(uv))
        self.map.add(header, np.eye(4), plain_landmarks(uv, np.maximum(disparity, 0.1) / CAMERA.bf, 0.01), 0)

    def frames(self, count: int) -> Iterator[tuple[int, F64, I64, F64]]:
        """Times, poses, rows and observations of frames."""
        for k in range(count):
            T = se3.inverse(se3.exp(np.concatenate([k * self.step, [0.0, 0.002 * k, 0.0]])))
            q = se3.transform(T, self.xyz)
            uv = q[:, :2] / q[:, 2:] * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]
            inside = (q[:, 2] > 0.3) & (uv > 10).all(1) & (uv < [740, 470]).all(1)
            disparity = CAMERA.bf / q[:, 2] + terms(normalised(uv)) @ self.offset - self.map.offset_px(uv)
            seen = np.column_stack([uv, disparity]) + self.rng.normal(0, 0.2, (len(uv), 3))
            yield k * self.period_ns, T, np.flatnonzero(inside), seen[inside]

    def fly(self, frames: int) -> list[F64]:
        """Changes of the map's offset."""
        changes = (self.alignment.add(*frame) for frame in self.frames(frames))
        return [change for change in changes if change is not None]


SIDEWAYS, AHEAD = np.array([0.03, 0.01, 0.02]), np.array([0.0, 0.0, 0.04])
