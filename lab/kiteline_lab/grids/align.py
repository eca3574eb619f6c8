"""Fit one occupancy grid to another by rotation and translation."""

import cv2
import numpy as np

from kiteline_core.arrays import F64
from kiteline_lab.grids.files import OCCUPIED, GridFile, GridFileError, planar

_FAR_M = 0.4  # m; an obstacle farther from those of the truth counts no more: it may be one that was never seen
_POINTS = 3000  # obstacle cells that are compared
_ROUNDS = ((0.8, 8.0, 9), (0.2, 2.0, 9), (0.05, 0.5, 9), (0.0125, 0.125, 9))  # half-widths in m and degrees, steps


def aligned(est: GridFile, true: GridFile, T_true_est: F64) -> F64:
    """(3,3) motion that maps est onto true with the least mean distance of its obstacles to true ones.

    T_true_est: (3,3) first guess; 0.8 m and 8 degrees around it are searched, coarse to fine. Raises GridFileError if
    one of the grids has no obstacle.
    """
    row, column = np.nonzero(est.state == OCCUPIED)
    solid = true.state == OCCUPIED
    if not len(row) or not solid.any():
        raise GridFileError("grids without obstacles cannot be aligned: leave out --align, or fly longer")
    chosen = np.random.default_rng(0).permutation(len(row))[:_POINTS]
    points = est.points(np.column_stack([column[chosen] + 0.5, row[chosen] + 0.5]).astype(np.float64))
    middle = points.mean(0)
    border = int(np.ceil(_FAR_M / true.cell_m)) + 1
    padded = np.pad(~solid, border, constant_values=True).astype(np.uint8)
    distance = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * true.cell_m
    distance = np.minimum(np.asarray(distance, np.float64), _FAR_M)

    def cost(x: float, y: float, yaw_deg: float) -> float:
        turn = planar(0.0, 0.0, yaw_deg)[:2, :2] @ T_true_est[:2, :2]
        moved = (points - middle) @ turn.T + T_true_est[:2, :2] @ middle + T_true_est[:2, 2] + [x, y]
        c, r = np.floor(true.cells(moved)).astype(np.int64).T + border
        inside = (c >= 0) & (r >= 0) & (c < distance.shape[1]) & (r < distance.shape[0])
        return float(np.where(inside, distance[np.where(inside, r, 0), np.where(inside, c, 0)], _FAR_M).mean())

    best = (0.0, 0.0, 0.0)
    for shift_m, turn_deg, steps in _ROUNDS:
        shifts, turns = np.linspace(-shift_m, shift_m, steps), np.linspace(-turn_deg, turn_deg, steps)
        tried = [(best[0] + x, best[1] + y, best[2] + yaw) for yaw in turns for x in shifts for y in shifts]
        best = min([best, *tried], key=lambda at: cost(*at))
    x, y, yaw = best
    turn = planar(0.0, 0.0, yaw)[:2, :2] @ T_true_est[:2, :2]
    T = np.eye(3)
    T[:2, :2] = turn
    T[:2, 2] = T_true_est[:2, :2] @ middle + T_true_est[:2, 2] + [x, y] - turn @ middle
    return T


def share_near(est: GridFile, true: GridFile, T_true_est: F64, near_m: float) -> float:
    """Share of the obstacle cells of est that lie within near_m of one of true; 1 without any."""
    row, column = np.nonzero(est.state == OCCUPIED)
    if not len(row):
        return 1.0
    points = est.points(np.column_stack([column + 0.5, row + 0.5])) @ T_true_est[:2, :2].T + T_true_est[:2, 2]
    border = int(np.ceil(near_m / true.cell_m)) + 1
    free = np.pad(true.state != OCCUPIED, border, constant_values=True).astype(np.uint8)
    distance = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * true.cell_m
    c, r = np.floor(true.cells(points)).astype(np.int64).T + border
    inside = (c >= 0) & (r >= 0) & (c < distance.shape[1]) & (r < distance.shape[0])
    return float((distance[r[inside], c[inside]] <= near_m).sum() / len(row))
