"""A column scan from sparse landmarks, where an agent sends none: with one camera, or with the grid turned off.

Method: "Segfloor", section 5.6, points above the ground and rays to points of the ground, with the heights of the rays:
a ray over a box clears neither the box nor the floor below.
"""

import numpy as np

from kiteline_basestation.config import GridConfig
from kiteline_basestation.grid.ground_height import ground_heights
from kiteline_basestation.grid.landmark_ground import GroundView, view_of
from kiteline_core.arrays import F64, U8, Bool
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ground.column_scan import ColumnScan, level_rotation

UNLABELLED, GROUND, OBSTACLE = 0, 1, 2  # labels of landmarks
_COLUMNS = 36  # of a scan from landmarks: more would leave gaps between rays
_FLOOR_POINTS = 20  # nearest landmarks on the ground, whose median is the camera's height
_DEPTH_M = 0.3  # m; landmarks so far behind the nearest obstacle of a column belong to it
_FREE_BELOW_M = 0.7  # m; a ray to a landmark frees cells only where it is lower: it passes over boxes and chairs
_NOISE_PER_M = 0.01  # m/m; height noise of landmarks per distance


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
    config: GridConfig, camera: RectifiedCamera, S_w_k: F64, points_k: F64, seen: Bool, plane: F64
) -> tuple[ColumnScan, U8] | None:
    """A scan of the landmarks that a keyframe sees, and the labels of all. None if they show no ground.

    S_w_k: (4,4), z of w up. points_k: (n,3) landmarks around it in its camera, in m. seen: (n,) those
    that the keyframe sees; the others only tell the ground. plane: (3,) the ground about there, see `GroundView`.
    """
    up_c = _up(S_w_k)
    local, distance, near = _levelled(config, S_w_k, points_k)
    if not near.any():
        return None
    ground = np.full(len(local), np.nan)
    ground[near] = ground_heights(local[near], np.zeros(int(near.sum())), plane)
    labels = np.zeros(len(local), np.uint8)
    labels[near] = label(config, (local[:, 2] - ground)[near], distance[near])
    floor = labels == GROUND
    if not floor.any():
        return None
    nearest = np.argsort(distance + np.where(floor, 0.0, np.inf))[:_FLOOR_POINTS]
    height = -float(np.median(ground[nearest[floor[nearest]]]))
    if not height > 0.0:
        return None
    n = _COLUMNS
    half = float(np.arctan2(0.5 * camera.width, camera.fx))
    step = 2.0 * half / n
    column = np.floor((np.arctan2(local[:, 1], local[:, 0]) + half) / step).astype(np.int64)
    used = near & seen & (column >= 0) & (column < n) & (labels != UNLABELLED)
    column, distance, label_of = column[used], distance[used], labels[used]
    above = (local[:, 2] - ground)[used]
    solid = label_of == OBSTACLE
    obstacle = np.full(n, np.inf)
    np.minimum.at(obstacle, column[solid], distance[solid])
    bands = np.zeros(n, np.uint8)
    band = np.searchsorted(config.bands_m[1:-1], above, side="right").astype(np.uint8)
    front = solid & (distance <= obstacle[column] + _DEPTH_M)
    np.bitwise_or.at(bands, column[front], np.uint8(1) << band[front])
    # A ray frees the cells over which it is lower than _FREE_BELOW_M.
    drop = np.maximum(height - np.where(solid, above, 0.0), 1e-6)
    start = np.where(
        solid & (above >= _FREE_BELOW_M),
        distance,
        distance * np.clip((height - _FREE_BELOW_M) / drop, 0.0, 1.0),
    )
    free, free_from = np.zeros(n), np.full(n, np.inf)
    np.maximum.at(free, column, np.where(start < distance, distance, 0.0))
    np.minimum.at(free_from, column, start)
    free_from = np.where(free > 0.0, np.minimum(free_from, free), 0.0)
    azimuth0 = -half + 0.5 * step
    return ColumnScan(up_c, azimuth0, step, free_from, free, obstacle, bands, np.zeros(n), height), labels


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
