"""Kernel of the A* search on a grid. Arrays in, caller's arrays out."""

import numpy as np

from kiteline_core.arrays import F64, I64, Bool
from kiteline_core.jit import helper, njit

DIAGONAL = float(np.sqrt(2.0))


@njit
def search(
    clear: Bool, start: int, goal: int, cost: F64, before: I64, closed: Bool, heap_key: F64, heap_cell: I64
) -> bool:
    """Find the shortest way over clear cells to any of their eight neighbours (A*, P. Hart et al., 1968).

    clear: (rows, columns). start, goal: row * columns + column. A diagonal step needs both cells beside it clear.
    cost: (cells,) inf; receives lengths in cells from the start. before: (cells,) receives the cell before each.
    closed: (cells,) False. heap_key, heap_cell: (8 cells + 8,) scratch. Returns whether the goal was reached.
    """
    rows, columns = clear.shape
    goal_r, goal_c = goal // columns, goal % columns
    cost[start] = 0.0
    before[start] = -1
    size = _push(heap_key, heap_cell, 0, 0.0, start)
    while size > 0:
        cell = heap_cell[0]
        size = _pop(heap_key, heap_cell, size)
        if closed[cell]:
            continue
        closed[cell] = True
        if cell == goal:
            return True
        r, c = cell // columns, cell % columns
        for dr in range(-1, 2):
            for dc in range(-1, 2):
                nr, nc = r + dr, c + dc
                if (dr == 0 and dc == 0) or nr < 0 or nc < 0 or nr >= rows or nc >= columns or not clear[nr, nc]:
                    continue
                if dr != 0 and dc != 0 and not (clear[r, nc] and clear[nr, c]):
                    continue
                there = nr * columns + nc
                length = cost[cell] + (DIAGONAL if dr != 0 and dc != 0 else 1.0)
                if closed[there] or length >= cost[there]:
                    continue
                cost[there] = length
                before[there] = cell
                far, near = max(abs(goal_r - nr), abs(goal_c - nc)), min(abs(goal_r - nr), abs(goal_c - nc))
                size = _push(heap_key, heap_cell, size, length + far + (DIAGONAL - 1.0) * near, there)
    return False


@helper
def _push(key: F64, cell: I64, size: int, new_key: float, new_cell: int) -> int:
    """Add an entry to a binary heap of a size; returns the new size."""
    i = size
    while i > 0:
        parent = (i - 1) >> 1
        if key[parent] <= new_key:
            break
        key[i], cell[i] = key[parent], cell[parent]
        i = parent
    key[i], cell[i] = new_key, new_cell
    return size + 1


@helper
def _pop(key: F64, cell: I64, size: int) -> int:
    """Remove the first entry of a binary heap of a size; returns the new size."""
    size -= 1
    last_key, last_cell = key[size], cell[size]
    i = 0
    while 2 * i + 1 < size:
        child = 2 * i + 1
        if child + 1 < size and key[child + 1] < key[child]:
            child += 1
        if key[child] >= last_key:
            break
        key[i], cell[i] = key[child], cell[child]
        i = child
    key[i], cell[i] = last_key, last_cell
    return size
