"""Cells of a grid tile as adaptive binary decisions of a range coder. The layout is described in SPEC.md, "Cells".

Method: the range coder of G. N. N. Martin, 1979, in the binary form of LZMA; contexts from the neighbours, as in JBIG.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kiteline_core.jit import helper, njit

I8 = NDArray[np.int8]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

SIDE = 64  # cells along a side of a tile
MAX_MASK = 7  # of the height bands that are occupied
CONTEXTS = 81 * 2 + 8 * 8  # known and occupied by four neighbours; masks by a neighbour's and by the bits so far
MAX_CODE = 5 * SIDE * SIDE  # bytes; five decisions a cell, each of which takes less than eight bits

_TOP = 1 << 24
_RANGE = 0xFFFFFFFF
_ONE = 1 << 12  # probabilities are in 1/4096
_FIRST_RATE, _LAST_RATE = 1, 5  # probabilities move by 1/2^rate of what they lack


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
def _adapt(model: I64, context: int, bit: int) -> None:
    """Move the probability of 0 towards what was found, by ever smaller shares."""
    rate = model[1, context]
    if bit == 0:
        model[0, context] += (_ONE - model[0, context]) >> rate
    else:
        model[0, context] -= model[0, context] >> rate
    if rate < _LAST_RATE:
        model[1, context] += 1
    model[0, context] = min(max(model[0, context], 32), _ONE - 32)


@helper
def _reset(model: I64) -> None:
    for i in range(CONTEXTS):
        model[0, i] = _ONE // 2
        model[1, i] = _FIRST_RATE


@helper
def _carry(out: U8, at: int) -> None:
    """Add one to the number before a position."""
    k = at - 1
    while out[k] == 255:
        out[k] = 0
        k -= 1
    out[k] += np.uint8(1)


@helper
def _put(out: U8, state: I64, model: I64, context: int, bit: int) -> None:
    """Code a decision. state: low (below 2^32), range, bytes written."""
    bound = (state[1] >> 12) * model[0, context]
    if bit == 0:
        state[1] = bound
    else:
        state[0] += bound
        state[1] -= bound
        if state[0] > _RANGE:
            state[0] &= _RANGE
            _carry(out, state[2])
    _adapt(model, context, bit)
    while state[1] < _TOP:
        out[state[2]] = np.uint8(state[0] >> 24)
        state[2] += 1
        state[0] = (state[0] << 8) & _RANGE
        state[1] <<= 8


@njit
def pack_cells(cells: I8, model: I64, out: U8) -> int:
    """Code cells (64,64), -1..7, into out (MAX_CODE,). model: (2, CONTEXTS), scratch. Returns the number of bytes.

    The code ends before its last zero bytes: the decoder goes on with zeros.
    """
    _reset(model)
    state = np.zeros(3, np.int64)
    state[1] = _RANGE
    for row in range(SIDE):
        for column in range(SIDE):
            value = int(cells[row, column])
            context = _context(cells, row, column)
            _put(out, state, model, context, 1 if value >= 0 else 0)
            if value < 0:
                continue
            _put(out, state, model, 81 + context, 1 if value > 0 else 0)
            if value == 0:
                continue
            base = 162 + 8 * _near_mask(cells, row, column)
            node = 1
            for k in range(2, -1, -1):
                bit = (value >> k) & 1
                _put(out, state, model, base + node, bit)
                node = 2 * node + bit
    # The number within the last range that has most zero bits at its end.
    low, high = state[0], state[0] + state[1] - 1
    shift = 32
    while shift > 0 and ((high >> shift) << shift) < low:
        shift -= 1
    end = (high >> shift) << shift
    at = int(state[2])
    if end > _RANGE:
        end &= _RANGE
        _carry(out, at)
    for k in range(4):
        out[at + k] = np.uint8((end >> (24 - 8 * k)) & 255)
    at += 4
    while at > 0 and out[at - 1] == 0:
        at -= 1
    return at


@helper
def _next_byte(data: U8, state: I64) -> int:
    k = state[2]
    state[2] += 1
    return int(data[k]) if k < data.size else 0


@helper
def _get(data: U8, state: I64, model: I64, context: int) -> int:
    """Read a decision. state: number less low, range, bytes read."""
    bound = (state[1] >> 12) * model[0, context]
    if state[0] < bound:
        bit = 0
        state[1] = bound
    else:
        bit = 1
        state[0] -= bound
        state[1] -= bound
    _adapt(model, context, bit)
    while state[1] < _TOP:
        state[0] = (state[0] << 8) | _next_byte(data, state)
        state[1] <<= 8
    return bit


@njit
def unpack_cells(data: U8, model: I64, cells: I8) -> bool:
    """Fill cells (64,64) from a code. model: (2, CONTEXTS), scratch. Returns False where a mask is empty.

    Takes any bytes; whether they are the code of the cells, only `pack_cells` tells.
    """
    _reset(model)
    state = np.zeros(3, np.int64)
    state[1] = _RANGE
    for _ in range(4):
        state[0] = (state[0] << 8) | _next_byte(data, state)
    for row in range(SIDE):
        for column in range(SIDE):
            context = _context(cells, row, column)
            if _get(data, state, model, context) == 0:
                cells[row, column] = -1
                continue
            if _get(data, state, model, 81 + context) == 0:
                cells[row, column] = 0
                continue
            base = 162 + 8 * _near_mask(cells, row, column)
            node = 1
            for _ in range(3):
                node = 2 * node + _get(data, state, model, base + node)
            if node == 8:
                return False
            cells[row, column] = node - 8
    return True
