"""Floors that are not flat, or have no texture: a ramp, waves, pits, steps, bare ground."""

from dataclasses import replace

import numpy as np

from kiteline_core.arrays import F64
from kiteline_hw.sim.world.world import World

FLOORS = ("flat", "ramp", "wave", "pits", "steps", "bare")
_CELL_M = 0.1  # m; cell of the ground's field
_EDGE_M = 0.05  # m; the same where the ground falls at once
_RAMP_SLOPE = 0.12  # a ramp for wheelchairs or trolleys
_WAVE_M, _WAVE_LENGTH_M = 0.12, 2.5  # from crest to trough, from crest to crest
_PIT_M, _PIT_SIDE_M, _PIT_APART_M = 0.25, 0.8, 2.4  # depth, side, from pit to pit
_STEP_M, _STEP_EVERY_M = 0.2, 2.0  # height of a step, from one down to the next one up
_HIDDEN_M = 0.05  # m that solids reach below the lowest ground
_STANDS_M = 0.02  # m above the floor up to which the bottom of a solid stands on it
_TALL_M = 2.2  # m: a solid that reaches higher keeps its top, which may meet the ceiling
_FLOOR_FACE = 4  # of a shell


def with_floor(world: World, floor: str) -> World:
    """The world of an indoor scene with one of FLOORS. The ground is nowhere higher than the flat floor was."""
    if floor == "flat":
        return world
    assert world.shell is not None
    if floor == "bare":
        faces = world.faces.copy()
        faces[6 * world.shell + _FLOOR_FACE, 5] = 0.0
        return replace(world, faces=faces)
    shell = world.boxes[world.shell]
    lower = shell[:2] - shell[3:5] - 1.0
    cell_m = _EDGE_M if floor in ("pits", "steps") else _CELL_M
    columns, rows = (int(v) for v in np.ceil((2.0 * shell[3:5] + 2.0) / cell_m) + 1)
    x, y = (lower[k] + cell_m * np.arange((columns, rows)[k]) - shell[k] for k in range(2))
    axis = int(np.argmax(shell[3:5]))
    fall = _fall(floor, x[None, :], y[:, None], axis, float(shell[3 + axis]))
    height = world.floor_m - np.broadcast_to(fall, (rows, columns))
    field = np.stack([height, np.zeros_like(height)]).astype(np.float32)
    steepest = max(float(np.abs(np.diff(height, axis=k)).max()) for k in range(2))
    slope = steepest / cell_m * 1.1 + 0.02
    frame = np.array([*lower, cell_m, slope, 0.0, np.inf, np.inf])
    ground = np.tile(world.faces[6 * world.shell + _FLOOR_FACE], (4, 1))
    tilted = replace(world, field=field, field_frame=frame, ground=ground)
    return replace(tilted, boxes=_lowered(tilted, float(fall.max())))


def _fall(floor: str, x: F64, y: F64, axis: int, half_m: float) -> F64:
    """How far the ground of a floor falls, at x (1,columns) and y (rows,1) from the middle of the shell.

    axis: the longer one of the shell, along which the ground changes; half_m: half its length.
    """
    along = x if axis == 0 else y
    if floor == "ramp":
        return _ramp(along, half_m)
    if floor == "wave":
        return _waves(along)
    if floor == "steps":
        return np.asarray(np.where(np.mod(along, 2.0 * _STEP_EVERY_M) > _STEP_EVERY_M, _STEP_M, 0.0))
    inside = (np.mod(x, _PIT_APART_M) < _PIT_SIDE_M) & (np.mod(y, _PIT_APART_M) < _PIT_SIDE_M)
    return np.asarray(np.where(inside, _PIT_M, 0.0))


def _ramp(along: F64, half_m: float) -> F64:
    """How far the ground falls at places along an axis: level, a ramp over the middle half, level."""
    return _RAMP_SLOPE * np.clip(along + 0.5 * half_m, 0.0, half_m)


def _waves(along: F64) -> F64:
    return np.asarray(0.5 * _WAVE_M * (1.0 - np.cos(2 * np.pi * along / _WAVE_LENGTH_M)))


def _lowered(world: World, fall_m: float) -> F64:
    """The boxes, the shell and all that stands on its floor extended below the lowest ground."""
    boxes = world.boxes.copy()
    top, bottom = boxes[:, 2] + boxes[:, 5], boxes[:, 2] - boxes[:, 5]
    stands = bottom <= world.floor_m + _STANDS_M
    sinks = stands & (top < world.floor_m + _TALL_M)
    sinks[world.shell] = False
    top[sinks] -= world.floor_m - world.height(boxes[sinks, :2])
    bottom[stands] = world.floor_m - fall_m - _HIDDEN_M
    boxes[:, 2], boxes[:, 5] = 0.5 * (top + bottom), 0.5 * (top - bottom)
    return boxes
