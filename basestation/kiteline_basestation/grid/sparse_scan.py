"""A column scan from sparse landmarks, where an agent sends none: with one camera, or with the grid turned off.

Method: "Segfloor", section 5.6, points above the ground and rays to points of the ground, with the heights of the rays:
a ray over a box clears neither the box nor the floor below. A column is free where one of its rays is low, not between
two rays, and not around what stands, whichever keyframe saw it: a low ray passes below a table, too.
"""

from typing import NamedTuple

import numpy as np

from kiteline_basestation.config import GridConfig
from kiteline_basestation.grid import sparse_kernels as kernels
from kiteline_basestation.grid.ground_height import ground_heights
from kiteline_basestation.grid.landmark_ground import GroundView, view_of
from kiteline_core.arrays import F64, I64, U8, Bool
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ground.column_scan import ColumnScan, level_rotation

UNLABELLED, GROUND, OBSTACLE = 0, 1, 2  # labels of landmarks
_COLUMNS = 36  # of a scan from landmarks: more would leave gaps between rays
_FLOOR_POINTS = 20  # nearest landmarks on the ground, whose median is the camera's height
_DEPTH_M = 0.3  # m; landmarks so far behind the nearest obstacle of a column belong to it
_FREE_BELOW_M = 0.6  # m; a ray to a landmark frees cells only where it is lower: it passes over boxes and chairs
_BESIDE_M = 0.125  # m; so far beside a low ray cells are free: columns near the camera are narrower than three cells
_AROUND_M = 0.1  # m; so far around a landmark that stands none are
_SURE_VIEWS = 3  # keyframes that observe a landmark that stands: of those with two a sixth are matched wrongly ...
_NEIGHBOUR_M = 0.4  # m; ... which are alone: those of a table top have another one so near
_BIN_M = 0.05  # m; ranges of a column are looked at in these steps, those of cells
_NOISE_PER_M = 0.01  # m/m; height noise of landmarks per distance


class LandmarksAround(NamedTuple):
    """Landmarks around a keyframe.

    points_k: (n,3) in its camera, in m. seen: (n,) those that it sees. close: (n,) those of the keyframes next to it,
    which tell where its ground lies; the others tell where nothing is free. views: (n,) keyframes that observe them.
    """

    points_k: F64
    seen: Bool
    close: Bool
    views: I64


def label(config: GridConfig, height_m: F64, distance_m: F64) -> U8:
    """Labels (n,) uint8 of points by height above the ground (n,) and distance (n,), both m; NaN: unlabelled."""
    low = _low_m(config, distance_m)
    out = np.zeros(len(height_m), np.uint8)
    out[np.abs(height_m) <= low] = GROUND  # comparisons with NaN are false
    out[(height_m > low) & (height_m <= config.bands_m[-1])] = OBSTACLE
    return out


def sparse_ground(config: GridConfig, S_w_k: F64, points_k: F64, unit_m: float) -> GroundView | None:
    """What the landmarks around a keyframe show of the ground; None without landmarks. As in `sparse_scan`."""
    local, distance, near = _levelled(config, S_w_k, points_k)
    if not near.any():
        return None
    local, distance = local[near], distance[near]
    height = local[:, 2] - ground_heights(local, np.zeros(len(local)))
    ground = label(config, height, distance) == GROUND
    return view_of(local, ground, _low_m(config, distance), level_rotation(_up(S_w_k)), unit_m)


def sparse_scan(
    config: GridConfig, camera: RectifiedCamera, S_w_k: F64, around: LandmarksAround, plane: F64
) -> tuple[ColumnScan, U8] | None:
    """A scan of the landmarks that a keyframe sees, and the labels of all. None if they show no ground.

    S_w_k: (4,4), z of w up. plane: (3,) the ground about there, see `GroundView`.
    """
    up_c, seen = _up(S_w_k), around.seen
    local, distance, near = _levelled(config, S_w_k, around.points_k)
    if not near.any():
        return None
    ground = np.full(len(local), np.nan)
    ground[near] = ground_heights(local[near], np.zeros(int(near.sum())), plane)
    above = local[:, 2] - ground
    labels = np.zeros(len(local), np.uint8)
    labels[near] = label(config, above[near], distance[near])
    floor = labels == GROUND
    below = floor & around.close
    if not below.any():
        return None
    nearest = np.argsort(distance + np.where(below, 0.0, np.inf))[:_FLOOR_POINTS]
    height = -float(np.median(ground[nearest[below[nearest]]]))
    if not height > 0.0:
        return None
    solid = (labels == OBSTACLE) & _certain(config, local, above, distance, around.views)
    n = _COLUMNS
    half = float(np.arctan2(0.5 * camera.width, camera.fx))
    step = 2.0 * half / n
    azimuth = np.arctan2(local[:, 1], local[:, 0])
    column = np.floor((azimuth + half) / step).astype(np.int64)
    used = seen & (floor | solid) & (column >= 0) & (column < n)
    hit, at = used & solid, column[used & solid]
    obstacle = np.full(n, np.inf)
    np.minimum.at(obstacle, at, distance[hit])
    band = np.searchsorted(config.bands_m[1:-1], above[hit], side="right").astype(np.uint8)
    front = distance[hit] <= obstacle[at] + _DEPTH_M
    bands = np.zeros(n, np.uint8)
    np.bitwise_or.at(bands, at[front], np.uint8(1) << band[front])
    low = used & (floor | (above < _FREE_BELOW_M))
    drop = np.maximum(height - np.where(floor, 0.0, above)[low], 1e-6)
    start = distance[low] * np.clip((height - _FREE_BELOW_M) / drop, 0.0, 1.0)
    free = np.zeros((n, int(config.max_range_m / _BIN_M)), np.uint8)
    kernels.mark_rays(azimuth[low], start, distance[low], obstacle, -half, step, _BESIDE_M, _BIN_M, free)
    kernels.clear_around(azimuth[solid], distance[solid], -half, step, _AROUND_M, _BIN_M, free)
    runs = np.empty((n, 2), np.int64)
    kernels.longest_runs(free, runs)
    free_from, free_to = _BIN_M * runs.T
    azimuth0 = -half + 0.5 * step
    return ColumnScan(up_c, azimuth0, step, free_from, free_to, obstacle, bands, np.zeros(n), height), labels


def _certain(config: GridConfig, local: F64, above: F64, distance: F64, views: I64) -> Bool:
    """Landmarks (n,) that are no errors if they stand: observed often, or beside another one above the ground."""
    with np.errstate(invalid="ignore"):  # comparisons with NaN are false
        standing = np.flatnonzero(above > _low_m(config, distance))
    accompanied = np.zeros(len(local), np.uint8)
    found = np.empty(len(standing), np.uint8)
    kernels.mark_accompanied(local[standing], _NEIGHBOUR_M, found)
    accompanied[standing] = found
    return np.asarray((views >= _SURE_VIEWS) | (accompanied > 0))


def _low_m(config: GridConfig, distance_m: F64) -> F64:
    """Height (n,) up to which landmarks at these distances (n,) may lie on the ground."""
    return config.bands_m[0] + _NOISE_PER_M * distance_m


def _up(S_w_k: F64) -> F64:
    """The vertical (3,) in the camera."""
    return np.asarray(S_w_k[2, :3] / np.linalg.norm(S_w_k[2, :3]))


def _levelled(config: GridConfig, S_w_k: F64, points_k: F64) -> tuple[F64, F64, Bool]:
    """Landmarks (n,3) in the levelled camera, their distances (n,), and which are near enough (n,)."""
    local = points_k @ level_rotation(_up(S_w_k))
    distance = np.hypot(local[:, 0], local[:, 1])
    return local, distance, np.isfinite(local).all(axis=1) & (distance <= config.max_range_m)
