"""Floors that are not flat, or have no texture: a ramp, waves, bare ground."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kiteline_hw.sim.world.world import World

F64 = NDArray[np.float64]

FLOORS = ("flat", "ramp", "wave", "bare")
_CELL_M = 0.1  # m; cell of the ground's field
_RAMP_SLOPE = 0.12  # a ramp for wheelchairs or trolleys
_WAVE_M, _WAVE_LENGTH_M = 0.12, 2.5  # from crest to trough, from crest to crest
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
    columns, rows = (int(v) for v in np.ceil((2.0 * shell[3:5] + 2.0) / _CELL_M) + 1)
    axis = int(np.argmax(shell[3:5]))
    along = (lower[axis] + _CELL_M * np.arange((columns, rows)[axis])) - shell[axis]
    fall = _ramp(along, float(shell[3 + axis])) if floor == "ramp" else _waves(along)
    height = world.floor_m - np.broadcast_to(fall if axis == 0 else fall[:, None], (rows, columns))
    field = np.stack([height, np.zeros_like(height)]).astype(np.float32)
    slope = float(np.abs(np.diff(fall)).max()) / _CELL_M * 1.1 + 0.02
    frame = np.array([*lower, _CELL_M, slope, 0.0, np.inf, np.inf])
    ground = np.tile(world.faces[6 * world.shell + _FLOOR_FACE], (4, 1))
    tilted = replace(world, field=field, field_frame=frame, ground=ground)
    return replace(tilted, boxes=_lowered(tilted, float(fall.max())))


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
