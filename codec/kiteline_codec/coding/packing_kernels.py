"""Integer columns as one stream of bits. The layout is described in SPEC.md, "Columns"."""

import numpy as np

from kiteline_core.arrays import I64, U8
from kiteline_core.jit import helper, njit

MAX_WIDTH = 40  # bits of one packed number: wider than any column needs
_MAX_VARINT = 1 << 42  # keeps sums of 2048 differences far from the limits of int64
_MAX_SHIFT = 42


@njit
def first_fault(values: I64, low: I64, high: I64, increasing: bool) -> int:
    """The first of the columns (c, n) with a number outside low..high (c,); -1 if there is none.

    increasing: whether c is returned where, all being inside, numbers do not increase along the first column.
    """
    c, n = values.shape
    for i in range(c):
        for j in range(n):
            if values[i, j] < low[i] or values[i, j] > high[i]:
                return i
    if increasing:
        for j in range(1, n):
            if values[0, j] <= values[0, j - 1]:
                return int(c)
    return -1


@helper
def put_varint(out: U8, at: int, value: int) -> int:
    """Write an unsigned number in groups of seven bits. Returns the position after it."""
    while value >= 128:
        out[at] = np.uint8((value & 127) | 128)
        value >>= 7
        at += 1
    out[at] = np.uint8(value)
    return at + 1


@njit
def varint_bytes(value: int) -> int:
    """Bytes that `put_varint` takes."""
    n = 1
    while value >= 128:
        value >>= 7
        n += 1
    return n


@njit
def zigzag(value: int) -> int:
    """0, -1, 1, -2 to 0, 1, 2, 3."""
    return 2 * value if value >= 0 else -2 * value - 1


@helper
def put_bits(out: U8, bit: int, value: int, width: int) -> int:
    """Or a number of `width` bits into zeroed bytes, lowest bit first. Returns the position after it."""
    left = width
    while left > 0:
        offset = bit & 7
        take = min(8 - offset, left)
        out[bit >> 3] |= np.uint8((value & ((1 << take) - 1)) << offset)
        value >>= take
        bit += take
        left -= take
    return bit


@helper
def get_bits(data: U8, bit: int, width: int) -> int:
    """The number of `width` bits at a position."""
    value = 0
    got = 0
    while got < width:
        offset = bit & 7
        take = min(8 - offset, width - got)
        value |= ((int(data[bit >> 3]) >> offset) & ((1 << take) - 1)) << got
        bit += take
        got += take
    return value


@njit
def _width(value: int) -> int:
    n = 0
    while value > 0:
        value >>= 1
        n += 1
    return n


@njit
def pack_columns(values: I64, out: U8) -> int:
    """Pack values (c, n) int64, n >= 1, |value| < 2^38, into `out` (zeroed, at least c * (5 * n + 16) + 8 bytes).

    Returns the number of bytes written. Each column is coded as offsets from its least value, or as differences of
    neighbours if that is shorter.
    """
    c, n = values.shape
    shape = np.zeros((c, 2), np.int64)  # subtracted number and width of each column
    delta = np.zeros(c, np.bool_)
    at = 0
    for i in range(c):
        low = int(values[i, 0])
        high = low
        low_d = 0
        high_d = 0
        for j in range(1, n):
            v = int(values[i, j])
            low = min(low, v)
            high = max(high, v)
            d = v - int(values[i, j - 1])
            if j == 1:
                low_d = d
                high_d = d
            low_d = min(low_d, d)
            high_d = max(high_d, d)
        width = _width(high - low)
        width_d = _width(high_d - low_d)
        first = int(values[i, 0])
        bits = 8 * varint_bytes(zigzag(low)) + width * n
        bits_d = 8 * (varint_bytes(zigzag(first)) + varint_bytes(zigzag(low_d))) + width_d * (n - 1)
        if bits_d < bits:
            delta[i] = True
            out[at] = np.uint8(64 | width_d)
            at = put_varint(out, at + 1, zigzag(first))
            at = put_varint(out, at, zigzag(low_d))
            shape[i, 0] = low_d
            shape[i, 1] = width_d
        else:
            out[at] = np.uint8(width)
            at = put_varint(out, at + 1, zigzag(low))
            shape[i, 0] = low
            shape[i, 1] = width
    bit = 8 * at
    for i in range(c):
        base = int(shape[i, 0])
        width = int(shape[i, 1])
        start = 1 if delta[i] else 0
        for j in range(start, n):
            v = int(values[i, j]) - base
            if delta[i]:
                v -= int(values[i, j - 1])
            bit = put_bits(out, bit, v, width)
    return (bit + 7) >> 3


@helper
def get_varint(data: U8, at: int, max_shift: int) -> tuple[int, int]:
    """(value, position after it); position -1 when the bytes end or the number is too large or not in shortest form.

    max_shift: of the last group of seven bits.
    """
    value = 0
    shift = 0
    while at < data.size and shift <= max_shift:
        b = np.int64(data[at])
        at += 1
        value |= int(b & 127) << shift
        if b < 128:
            if value > _MAX_VARINT or (b == 0 and shift > 0):
                return 0, -1
            return value, at
        shift += 7
    return 0, -1


@njit
def unpack_columns(data: U8, at: int, values: I64) -> int:
    """Fill values (c, n), n >= 1, from data[at:]. Returns the position after the columns, or -1 for invalid bytes."""
    c, n = values.shape
    shape = np.zeros((c, 4), np.int64)  # mode, first, subtracted number, width
    total = 0
    for i in range(c):
        if at >= data.size:
            return -1
        head = np.int64(data[at])
        at += 1
        mode = head >> 6
        width = head & 63
        if mode > 1 or width > MAX_WIDTH:
            return -1
        z, at = get_varint(data, at, _MAX_SHIFT)
        if at < 0:
            return -1
        first = (z >> 1) ^ -(z & 1)
        shape[i, 0] = mode
        shape[i, 1] = first
        shape[i, 2] = first
        shape[i, 3] = width
        if mode == 1:
            z, at = get_varint(data, at, _MAX_SHIFT)
            if at < 0:
                return -1
            shape[i, 2] = (z >> 1) ^ -(z & 1)
        total += width * (n - mode)
    end = at + ((total + 7) >> 3)
    if end > data.size:
        return -1
    bit = 8 * at
    for i in range(c):
        mode = shape[i, 0]
        base = shape[i, 2]
        width = shape[i, 3]
        if mode == 1:
            values[i, 0] = shape[i, 1]
        for j in range(mode, n):
            values[i, j] = get_bits(data, bit, width) + base
            bit += width
            if mode == 1:
                values[i, j] += values[i, j - 1]
    if bit & 7 and (np.int64(data[bit >> 3]) >> (bit & 7)) != 0:
        return -1
    return end
