"""Integer columns in as few bits as their spread needs. The layout is in SPEC.md, "Residual columns".

Numbers are Golomb-Rice coded with a parameter that follows their size (M. Weinberger, G. Seroussi, G. Sapiro, "The
LOCO-I lossless image compression algorithm", 2000, section III.C), or in a fixed width where that is shorter.
"""

import numpy as np

from kiteline_codec.coding.packing_kernels import get_bits, get_varint, put_bits, put_varint, varint_bytes, zigzag
from kiteline_core.arrays import I64, U8
from kiteline_core.jit import njit

FIXED, ABOVE_LEAST, STEPS, AROUND_ZERO = 0, 1, 2, 3  # modes
MAX_WIDTH = 30  # bits of one number in fixed width
MAX_START = 15  # of the Rice parameter
MAX_SHIFT = 4  # trailing zero bits that a column may leave out
ESCAPE = 20  # so many ones precede a number of RAW_BITS bits
RAW_BITS = 32
LIMIT = 1 << 30  # magnitude of values
_HALVE = 16  # numbers after which older ones count half
_MAX_NUMBER_SHIFT = 28  # a column's number takes at most 5 bytes


@njit
def _parameter(total: int, count: int) -> int:
    k = 0
    while (count << k) < total and k < MAX_START:
        k += 1
    return k


@njit
def _symbol(values: I64, j: int, mode: int, shift: int, low: int) -> int:
    """The number that codes values[j]; in mode STEPS from j = 1 on."""
    v = values[j] >> shift
    if mode < STEPS:
        return int(v - low)
    if mode == STEPS:
        v -= values[j - 1] >> shift
    return int(2 * v if v >= 0 else -2 * v - 1)


@njit
def _rice_bits(values: I64, mode: int, shift: int, low: int, start: int) -> int:
    total = 1 << start
    count = 1
    bits = 0
    for j in range(1 if mode == STEPS else 0, values.size):
        s = _symbol(values, j, mode, shift, low)
        k = _parameter(total, count)
        q = s >> k
        bits += q + 1 + k if q < ESCAPE else ESCAPE + RAW_BITS
        total += s
        count += 1
        if count == _HALVE:
            total >>= 1
            count >>= 1
    return bits


@njit
def _shape(values: I64, out: I64) -> None:
    """Mode, shift, first number and width or start of the shortest form of a column (n,), n >= 1, into out (4,)."""
    n = values.size
    union, least, most = 0, int(values[0]), int(values[0])
    for j in range(n):
        v = int(values[j])
        union |= v
        least, most = min(least, v), max(most, v)
    shift = 0
    while shift < MAX_SHIFT and union and not union >> shift & 1:
        shift += 1
    low = least >> shift
    first = int(values[0]) >> shift
    span = (most >> shift) - low
    width = 0
    while span >> width:
        width += 1
    out[0], out[1], out[2], out[3] = FIXED, shift, low, width
    best = n * width + 8 * varint_bytes(zigzag(low))
    for mode in (ABOVE_LEAST, STEPS, AROUND_ZERO):
        number = low if mode == ABOVE_LEAST else first if mode == STEPS else 0
        rest = 0 if mode == AROUND_ZERO else 8 * varint_bytes(zigzag(number))
        last = 1 << 60
        for start in range(MAX_START + 1):
            bits = rest + _rice_bits(values, mode, shift, low, start)
            if bits < best:
                best = bits
                out[0], out[1], out[2], out[3] = mode, shift, number, start
            if bits > last:
                break
            last = bits


@njit
def pack_residuals(values: I64, out: U8) -> int:
    """Pack values (c, n) int64, n >= 1, |value| < LIMIT, into `out` (zeroed, at least c * (7 * n + 16) + 8 bytes).

    Returns the number of bytes written; -1, and writes none, where a value is too large.
    """
    c, n = values.shape
    for i in range(c):
        for j in range(n):
            if values[i, j] >= LIMIT or values[i, j] <= -LIMIT:
                return -1
    shape = np.zeros((c, 4), np.int64)
    at = 0
    for i in range(c):
        _shape(values[i], shape[i])
        out[at] = np.uint8(shape[i, 0] << 3 | shape[i, 1])
        out[at + 1] = np.uint8(shape[i, 3])
        at += 2
        if shape[i, 0] != AROUND_ZERO:
            at = put_varint(out, at, zigzag(int(shape[i, 2])))
    bit = 8 * at
    for i in range(c):
        mode, shift, low, start = int(shape[i, 0]), int(shape[i, 1]), int(shape[i, 2]), int(shape[i, 3])
        total = 1 << start
        count = 1
        for j in range(1 if mode == STEPS else 0, n):
            s = _symbol(values[i], j, mode, shift, low)
            if mode == FIXED:
                bit = put_bits(out, bit, s, start)
                continue
            k = _parameter(total, count)
            q = s >> k
            if q < ESCAPE:
                bit = put_bits(out, bit, (1 << q) - 1, q + 1)
                bit = put_bits(out, bit, s, k)
            else:
                bit = put_bits(out, bit, (1 << ESCAPE) - 1, ESCAPE)
                bit = put_bits(out, bit, s, RAW_BITS)
            total += s
            count += 1
            if count == _HALVE:
                total >>= 1
                count >>= 1
    return (bit + 7) >> 3


@njit
def unpack_residuals(data: U8, at: int, values: I64) -> int:
    """Read columns into values (c, n), n >= 1. Returns the position after them, or -1 when they are malformed."""
    c, n = values.shape
    shape = np.zeros((c, 4), np.int64)
    for i in range(c):
        if at + 2 > data.size:
            return -1
        mode, shift, start = int(data[at]) >> 3, int(data[at]) & 7, int(data[at + 1])
        at += 2
        if mode > AROUND_ZERO or shift > MAX_SHIFT or start > (MAX_WIDTH if mode == FIXED else MAX_START):
            return -1
        number = 0
        if mode != AROUND_ZERO:
            number, at = get_varint(data, at, _MAX_NUMBER_SHIFT)
            if at < 0:
                return -1
        shape[i, 0], shape[i, 1], shape[i, 2], shape[i, 3] = mode, shift, (number >> 1) ^ -(number & 1), start
    bit = 8 * at
    end = 8 * data.size
    for i in range(c):
        mode, shift, low, start = int(shape[i, 0]), int(shape[i, 1]), int(shape[i, 2]), int(shape[i, 3])
        total = 1 << start
        count = 1
        last = low
        for j in range(n):
            if mode == STEPS and j == 0:
                values[i, 0] = last << shift
                continue
            if mode == FIXED:
                if bit + start > end:
                    return -1
                v = low + get_bits(data, bit, start)
                bit += start
            else:
                k = _parameter(total, count)
                q = 0
                while q < ESCAPE:
                    if bit >= end:
                        return -1
                    one = int(data[bit >> 3]) >> (bit & 7) & 1
                    bit += 1
                    if not one:
                        break
                    q += 1
                width = k if q < ESCAPE else RAW_BITS
                if bit + width > end:
                    return -1
                s = get_bits(data, bit, width)
                bit += width
                if q < ESCAPE:
                    s |= q << k
                total += s
                count += 1
                if count == _HALVE:
                    total >>= 1
                    count >>= 1
                v = low + s if mode == ABOVE_LEAST else (s >> 1) ^ -(s & 1)
            if mode == STEPS:
                v += last
                last = v
            if v <= -LIMIT or v >= LIMIT:
                return -1
            v <<= shift
            if v <= -LIMIT or v >= LIMIT:
                return -1
            values[i, j] = v
    while bit & 7:
        if int(data[bit >> 3]) >> (bit & 7) & 1:
            return -1
        bit += 1
    return bit >> 3
