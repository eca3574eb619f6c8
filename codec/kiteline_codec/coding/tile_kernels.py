"""Cells of a grid tile as adaptive binary decisions of a range coder. The layout is described in SPEC.md, "cells".

Method: contexts from the neighbours, as in JBIG.
"""

from kiteline_codec.coding.range_coder_kernels import HALF, begin_reading, begin_writing, finish, get, put
from kiteline_core.arrays import I8, I64, U8
from kiteline_core.jit import helper, njit

SIDE = 64  # cells along a side of a tile
MAX_MASK = 7  # of the height bands that are occupied
CONTEXTS = 81 * 2 + 8 * 8  # known and occupied by four neighbours; masks by a neighbour's and by the bits so far
MAX_CODE = 5 * SIDE * SIDE  # bytes; five decisions a cell, each of which takes less than eight bits

_FIRST_RATE = 1


@helper
def _class_of(cells: I8, row: int, column: int) -> int:
    """0 unknown or outside, 1 free, 2 occupied."""
    if row < 0 or column < 0 or column >= SIDE:
        return 0
    value = int(cells[row, column])
    return 0 if value < 0 else 1 if value == 0 else 2


@helper
def _context(cells: I8, row: int, column: int) -> int:
    """Classes of the cells west, south-west, south and south-east (rows go north), as digits to base 3."""
    return (
        27 * _class_of(cells, row, column - 1)
        + 9 * _class_of(cells, row - 1, column)
        + 3 * _class_of(cells, row - 1, column - 1)
        + _class_of(cells, row - 1, column + 1)
    )


@helper
def _near_mask(cells: I8, row: int, column: int) -> int:
    """Mask of the first occupied cell of west, south, south-west, south-east; 0 if none is."""
    if column > 0 and cells[row, column - 1] > 0:
        return int(cells[row, column - 1])
    if row > 0:
        if cells[row - 1, column] > 0:
            return int(cells[row - 1, column])
        if column > 0 and cells[row - 1, column - 1] > 0:
            return int(cells[row - 1, column - 1])
        if column + 1 < SIDE and cells[row - 1, column + 1] > 0:
            return int(cells[row - 1, column + 1])
    return 0


@helper
def _reset(model: I64) -> None:
    for i in range(CONTEXTS):
        model[0, i] = HALF
        model[1, i] = _FIRST_RATE


@njit
def pack_cells(cells: I8, model: I64, out: U8) -> int:
    """Code cells (64,64), -1..7, into out (MAX_CODE,). model: (2, CONTEXTS), scratch. Returns the number of bytes.

    The code ends before its last zero bytes: the decoder goes on with zeros.
    """
    _reset(model)
    state = begin_writing()
    for row in range(SIDE):
        for column in range(SIDE):
            value = int(cells[row, column])
            context = _context(cells, row, column)
            put(out, state, model, context, 1 if value >= 0 else 0)
            if value < 0:
                continue
            put(out, state, model, 81 + context, 1 if value > 0 else 0)
            if value == 0:
                continue
            base = 162 + 8 * _near_mask(cells, row, column)
            node = 1
            for k in range(2, -1, -1):
                bit = (value >> k) & 1
                put(out, state, model, base + node, bit)
                node = 2 * node + bit
    return finish(out, state)


@njit
def unpack_cells(data: U8, model: I64, cells: I8) -> bool:
    """Fill cells (64,64) from a code. model: (2, CONTEXTS), scratch. Returns False where a mask is empty.

    Takes any bytes; whether they are the code of the cells, only `pack_cells` tells.
    """
    _reset(model)
    state = begin_reading(data)
    for row in range(SIDE):
        for column in range(SIDE):
            context = _context(cells, row, column)
            if get(data, state, model, context) == 0:
                cells[row, column] = -1
                continue
            if get(data, state, model, 81 + context) == 0:
                cells[row, column] = 0
                continue
            base = 162 + 8 * _near_mask(cells, row, column)
            node = 1
            for _ in range(3):
                node = 2 * node + get(data, state, model, base + node)
            if node == 8:
                return False
            cells[row, column] = node - 8
    return True
