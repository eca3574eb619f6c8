"""How surfaces around landmarks are seen: warps, parallaxes and slopes of disparities, against differences."""

import numpy as np
import pytest

from kiteline_agent.local_map import projection_kernels as kernels
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3

CAMERA = np.array([410.0, 430.0, 320.0, 240.0, 45.0])  # fx, fy, cx, cy, bf
STEP_PX = 1e-3


class Scene:
    """Landmarks of one keyframe on slanted planes, and a camera that moved."""

    def __init__(self, seed: int, landmarks: int = 12) -> None:
        rng = np.random.default_rng(seed)
        self.T_m_k = se3.from_rt(se3.so3_exp(rng.normal(0, 0.5, 3)), rng.normal(0, 2.0, 3))[None]
        T_c_k = se3.from_rt(se3.so3_exp(rng.normal(0, 0.05, 3)), rng.normal(0, 0.3, 3))
        self.T_c_m = T_c_k @ se3.inverse(self.T_m_k[0])
        self.T_c_k = T_c_k
        self.bearing = rng.uniform(-0.4, 0.4, (1, landmarks, 2))
        self.rho = rng.uniform(0.1, 0.5, (1, landmarks))
        self.slant = rng.normal(0, 0.8, (1, landmarks, 2))

    def inverse_depth(self, i: int, bearing: F64) -> float:
        """Of landmark i's plane at another bearing."""
        return float(self.rho[0, i] * (1.0 + self.slant[0, i] @ (bearing - self.bearing[0, i])))

    def seen(self, i: int, bearing: F64, factor: float = 1.0) -> tuple[F64, float]:
        """Pixel and disparity of what the keyframe sees at a bearing on landmark i's plane."""
        point = np.array([*bearing, 1.0]) / (factor * self.inverse_depth(i, bearing))
        x, y, z = se3.transform(self.T_c_k, point[None])[0]
        return CAMERA[:2] * [x / z, y / z] + CAMERA[2:4], float(CAMERA[4] / z)

    def warp(self, i: int) -> F64:
        """By differences."""
        columns = []
        for axis in range(2):
            move = np.zeros(2)
            move[axis] = STEP_PX / CAMERA[axis]
            ahead, behind = (self.seen(i, self.bearing[0, i] + sign * move)[0] for sign in (1.0, -1.0))
            columns.append((ahead - behind) / (2.0 * STEP_PX))
        return np.column_stack(columns)


def test_views_are_the_differences_of_projections() -> None:
    for seed in range(5):
        scene = Scene(seed)
        rows = np.arange(12)
        warp, parallax = np.empty((12, 2, 2)), np.empty((12, 2))
        kernels.views(
            scene.T_c_m, CAMERA, rows, scene.T_m_k, scene.bearing, scene.rho, scene.slant, warp, parallax
        )  # fmt: skip
        for i in range(12):
            np.testing.assert_allclose(warp[i], scene.warp(i), rtol=1e-4, atol=1e-5)
            more, less = (scene.seen(i, scene.bearing[0, i], f)[0] for f in (1.0 + 1e-6, 1.0 - 1e-6))
            np.testing.assert_allclose(parallax[i], (more - less) / 2e-6, rtol=1e-3, atol=1e-3)


def test_landmarks_are_projected_with_the_warp_of_their_surface() -> None:
    scene, k, b = Scene(7), 1, 12
    row, uv, warp = np.zeros(b, np.int64), np.zeros((b, 2)), np.zeros((b, 2, 2))
    xyz, ray, depth = np.zeros((b, 3)), np.zeros((b, 3)), np.zeros(b)
    n = kernels.project(
        scene.T_c_m, CAMERA, np.array([640.0, 480.0]), 0.0, 10.0, np.zeros(k, np.int64), scene.T_m_k,
        np.arange(b)[None], np.full(k, b), np.ones((k, b), np.bool_), scene.bearing, scene.rho, scene.slant,
        np.full((k, b), 0.01), row, uv, warp, xyz, ray, depth,
    )  # fmt: skip
    assert n > 6
    for i in range(n):
        np.testing.assert_allclose(uv[i], scene.seen(int(row[i]), scene.bearing[0, row[i]])[0], atol=1e-9)
        np.testing.assert_allclose(warp[i], scene.warp(int(row[i])), rtol=0.05, atol=0.02)  # over four pixels


def test_slopes_of_disparities_are_their_differences() -> None:
    scene = Scene(3)
    slopes = np.empty((12, 2))
    kernels.disparity_slopes(
        scene.T_c_m, CAMERA, np.arange(12), scene.T_m_k, scene.bearing, scene.rho, scene.slant, 9.0, slopes
    )  # fmt: skip
    for i in range(12):
        warp = scene.warp(i)
        for axis in range(2):
            move = np.zeros(2)
            move[axis] = STEP_PX / CAMERA[axis]
            ahead, behind = (scene.seen(i, scene.bearing[0, i] + sign * move)[1] for sign in (1.0, -1.0))
            along = (ahead - behind) / (2.0 * STEP_PX)  # by a pixel of the keyframe
            assert abs(along - slopes[i] @ warp[:, axis]) < 1e-4
    kernels.disparity_slopes(
        scene.T_c_m, CAMERA, np.arange(12), scene.T_m_k, scene.bearing, scene.rho, scene.slant, 0.001, slopes
    )  # fmt: skip
    assert np.abs(slopes).max() <= 0.001


@pytest.mark.parametrize("limit", [5, 60])
def test_candidates_are_spread_over_cells_those_of_the_last_frame_first(limit: int) -> None:
    rng = np.random.default_rng(4)
    order, first, uv = rng.permutation(60), rng.random(60) < 0.4, rng.uniform(-10.0, 110.0, (60, 2))
    cells, chosen = np.zeros((3, 3), np.int32), np.empty(limit, np.int64)
    n = kernels.select(order, first, uv, 35.0, limit, 2, cells, chosen)
    expected: list[int] = []
    held = dict.fromkeys(np.ndindex(3, 3), 0)
    for i in [*order[first[order]], *order[~first[order]]]:
        at = int(uv[i, 1] / 35.0), int(uv[i, 0] / 35.0)
        if held.get(at, 2) < 2 and len(expected) < limit:
            held[at] += 1
            expected.append(int(i))
    assert chosen[:n].tolist() == expected
    assert cells.tolist() == [[held[r, c] for c in range(3)] for r in range(3)]
