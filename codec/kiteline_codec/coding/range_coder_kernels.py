"""Adaptive binary decisions as bytes. The layout is described in SPEC.md, "Decisions".

Method: the range coder of G. N. N. Martin, 1979, in the binary form of LZMA. A model (2, contexts) holds for each
context the probability of 0, in 1/4096, and the rate at which that adapts.
"""

import numpy as np

from kiteline_core.arrays import I64, U8
from kiteline_core.jit import helper

HALF = 1 << 11
_ONE = 1 << 12
_TOP = 1 << 24
_RANGE = 0xFFFFFFFF
_LAST_RATE = 5  # probabilities move by 1/2^rate of what they lack


@helper
def begin_writing() -> I64:
    """State of a writer: low (below 2^32), range, bytes written, 0."""
    state = np.zeros(4, np.int64)
    state[1] = _RANGE
    return state


@helper
def begin_reading(data: U8) -> I64:
    """State of a reader: number less low, range, bytes read, 1. Behind the last byte there are zeros."""
    state = np.zeros(4, np.int64)
    state[1], state[3] = _RANGE, 1
    for _ in range(4):
        state[0] = (state[0] << 8) | _next_byte(data, state)
    return state


@helper
def put(out: U8, state: I64, model: I64, context: int, bit: int) -> None:
    """Write a decision."""
    _put(out, state, (state[1] >> 12) * model[0, context], bit)
    _adapt(model, context, bit)


@helper
def get(data: U8, state: I64, model: I64, context: int) -> int:
    """Read a decision."""
    bit = _get(data, state, (state[1] >> 12) * model[0, context])
    _adapt(model, context, bit)
    return int(bit)


@helper
def code(data: U8, state: I64, model: I64, context: int, bit: int) -> int:
    """Write a decision, or read it, as the state says. Returns it."""
    if state[3]:
        return int(get(data, state, model, context))
    put(data, state, model, context, bit)
    return bit


@helper
def code_even(data: U8, state: I64, bit: int) -> int:
    """The same of a decision that is always even."""
    bound = state[1] >> 1
    if state[3]:
        return int(_get(data, state, bound))
    _put(data, state, bound, bit)
    return bit


@helper
def finish(out: U8, state: I64) -> int:
    """End a code before its last zero bytes. Returns the number of bytes."""
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
def _carry(out: U8, at: int) -> None:
    """Add one to the number before a position."""
    k = at - 1
    while out[k] == 255:
        out[k] = 0
        k -= 1
    out[k] += np.uint8(1)


@helper
def _put(out: U8, state: I64, bound: int, bit: int) -> None:
    if bit == 0:
        state[1] = bound
    else:
        state[0] += bound
        state[1] -= bound
        if state[0] > _RANGE:
            state[0] &= _RANGE
            _carry(out, state[2])
    while state[1] < _TOP:
        out[state[2]] = np.uint8(state[0] >> 24)
        state[2] += 1
        state[0] = (state[0] << 8) & _RANGE
        state[1] <<= 8


@helper
def _get(data: U8, state: I64, bound: int) -> int:
    if state[0] < bound:
        bit = 0
        state[1] = bound
    else:
        bit = 1
        state[0] -= bound
        state[1] -= bound
    while state[1] < _TOP:
        state[0] = (state[0] << 8) | _next_byte(data, state)
        state[1] <<= 8
    return bit


@helper
def _next_byte(data: U8, state: I64) -> int:
    k = state[2]
    state[2] += 1
    return int(data[k]) if k < data.size else 0
