"""Columns of a scan and labels as adaptive binary decisions. The layout is described in SPEC.md, "scan".

Walls and floors go on from column to column, and most of what is seen ends at an obstacle: each range is coded by its
difference from the column before, unless it is that of the obstacle.
"""

import numpy as np

from kiteline_codec.coding.range_coder_kernels import begin_reading, begin_writing, code, code_even, finish
from kiteline_core.arrays import I64, U8
from kiteline_core.jit import helper, njit

OBSTACLE, FREE, FREE_FROM, CLEAR, BANDS = range(5)  # rows of columns
MAX_CODE = 1 << 14  # bytes; of 128 columns and 2048 labels: up to 90 decisions of less than 8 bits in a column

# Contexts, and the probabilities of 0 with which they begin, in 1/64: means over scans of rooms, corridors and streets.
_CHANGED, _HIGH, _LOW, _UNCLEAR, _CLEAR_ELSE, _NOT_FREE, _FREE_ELSE, _RANGE, _FROM, _LABEL, _WHICH = (
    0, 2, 7, 15, 17, 19, 21, 23, 39, 47, 56,
)  # fmt: skip
_FIRST = np.array([
    57, 40, 63, 63, 63, 63, 63, 32, 36, 33, 8, 25, 15, 49, 14, 61, 27, 58, 10, 62, 5, 60, 15,
    14, 25, 31, 24, 18, 18, 18, 35, 4, 8, 12, 18, 22, 25, 30, 44, 18, 28, 24, 19, 19, 23, 31, 56,
    37, 33, 18, 40, 48, 41, 55, 48, 57, 13, 46, 40,
], np.int64)  # fmt: skip
_FIRST_RATE = 3
_MOST_BITS = 10  # of a difference
_LONG = 7  # bits from which on contexts are shared
_STEADY = 4  # differences below it are followed by small ones
_LABELS = 3


@helper
def _difference(data: U8, state: I64, model: I64, context: int, value: int) -> int:
    """Code a number of at most 10 bits: how many it has, its sign, and those below the highest."""
    size, bits = abs(value), 0
    while size >> bits:
        bits += 1
    k = 0
    while k < _MOST_BITS and code(data, state, model, context + min(k, _LONG), 1 if k < bits else 0):
        k += 1
    if k == 0:
        return 0
    negative, out = code_even(data, state, 1 if value < 0 else 0), 1
    for i in range(k - 2, -1, -1):
        out = 2 * out + code_even(data, state, size >> i & 1)
    return -out if negative else out


@helper
def _range(data: U8, state: I64, model: I64, last: I64, row: int, value: int) -> int:
    """Code a range of a row. last: (4,2) the range before, and its difference from that before it."""
    steady = abs(last[row, 1]) < _STEADY
    step = _difference(data, state, model, _RANGE + (0 if steady else _LONG + 1), value - last[row, 0])
    last[row, 1] = step
    last[row, 0] += step
    return int(last[row, 0])


@helper
def _mask(data: U8, state: I64, model: I64, mask: int) -> int:
    out = 0
    for k in range(5):
        out = 2 * out + code(data, state, model, _HIGH + k, mask >> (7 - k) & 1)
    node = 1
    for k in range(2, -1, -1):
        node = 2 * node + code(data, state, model, _LOW + node, mask >> k & 1)
    return 8 * out + node - 8


@helper
def _range_beside(
    data: U8, state: I64, model: I64, last: I64, row: int, context: int, mask: int, obstacle: int, other: int,
    value: int,
) -> tuple[int, int]:  # fmt: skip
    """Code a range of a row, by one decision where it is that of an obstacle, which is there if mask is not 0.

    other: 1 if the last one beside an obstacle was not the obstacle's. Returns the range, and the same of this one.
    """
    if mask:
        other = code(data, state, model, context + other, 1 if value != obstacle else 0)
        if not other:
            last[row, 0] = obstacle
            return obstacle, other
    return _range(data, state, model, last, row, value), other


@njit
def code_scan(columns: I64, labels: U8, most: int, reading: bool, data: U8) -> int:
    """Code columns (5,n) and labels (m,) 0..2 into data (MAX_CODE,), or fill them from data if reading.

    Rows of columns are OBSTACLE, FREE, FREE_FROM, CLEAR (0 none, up to most) and BANDS (0 exactly where there is no
    obstacle, up to 255). Returns the number of bytes; reading -1 where a number is out of range. Takes any bytes;
    whether they are the code of the numbers, only writing these again tells.
    """
    model = np.empty((2, _FIRST.size), np.int64)
    for i in range(_FIRST.size):
        model[0, i], model[1, i] = 64 * _FIRST[i], _FIRST_RATE
    state = begin_reading(data) if reading else begin_writing()
    last = np.zeros((4, 2), np.int64)
    mask, changed, unclear, clear_else, not_free, free_else = 0, 1, 1, 1, 1, 0
    for i in range(columns.shape[1]):
        column = columns[:, i]
        changed = code(data, state, model, _CHANGED + changed, 1 if column[BANDS] != mask else 0)
        if changed:
            mask = _mask(data, state, model, column[BANDS])
        column[BANDS] = mask
        obstacle = 0
        if mask:
            obstacle = _range(data, state, model, last, OBSTACLE, column[OBSTACLE])
        unclear = code(data, state, model, _UNCLEAR + unclear, 1 if column[CLEAR] == 0 else 0)
        clear = 0
        if not unclear:
            clear, clear_else = _range_beside(
                data, state, model, last, CLEAR, _CLEAR_ELSE, mask, obstacle, clear_else, column[CLEAR]
            )
        not_free = code(data, state, model, _NOT_FREE + not_free, 1 if column[FREE] == 0 else 0)
        free = free_from = 0
        if not not_free:
            free, free_else = _range_beside(
                data, state, model, last, FREE, _FREE_ELSE, mask, obstacle, free_else, column[FREE]
            )
            last[FREE_FROM, 0] += _difference(data, state, model, _FROM, column[FREE_FROM] - last[FREE_FROM, 0])
            free_from = int(last[FREE_FROM, 0])
        column[OBSTACLE], column[FREE], column[FREE_FROM], column[CLEAR] = obstacle, free, free_from, clear
        if min(obstacle, free, free_from, clear) < 0 or max(obstacle, free, free_from, clear) > most:
            return -1
    one = two = 0
    for i in range(labels.size):
        label = int(labels[i])
        if code(data, state, model, _LABEL + _LABELS * one + two, 1 if label != one else 0):
            by = 1 + code(data, state, model, _WHICH + one, 1 if (label - one) % _LABELS == 2 else 0)
            two, one = one, (one + by) % _LABELS
        else:
            two = one
        labels[i] = np.uint8(one)
    return 0 if reading else int(finish(data, state))
