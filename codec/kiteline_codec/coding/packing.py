"""Numbers to bytes and back: variable-length integers, floats, and columns of integers."""

import struct

import numpy as np

from kiteline_codec.coding.packing_kernels import pack_columns, unpack_columns
from kiteline_codec.coding.residual_column_kernels import LIMIT, pack_residuals, unpack_residuals
from kiteline_core.arrays import I64
from kiteline_core.errors import KitelineError

_F64 = struct.Struct("<d")
_F32 = struct.Struct("<f")
_MAX_VARINT_BYTES = 10  # 64 bits in groups of seven


class WireError(KitelineError):
    """Bytes that are no valid packet or code: the only exception that a decoder raises, on any bytes."""


def zigzag(value: int) -> int:
    """Signed to unsigned, small magnitudes first: 0, -1, 1, -2 become 0, 1, 2, 3."""
    return 2 * value if value >= 0 else -2 * value - 1


def unzigzag(value: int) -> int:
    """The inverse of `zigzag`."""
    return (value >> 1) ^ -(value & 1)


def varint_bytes(value: int) -> int:
    """Bytes that `Writer.varint` takes for a value."""
    return (value.bit_length() + 6) // 7 or 1


class Writer:
    """Appends numbers to a code."""

    __slots__ = ("_out",)

    def __init__(self) -> None:
        self._out = bytearray()

    def __len__(self) -> int:
        return len(self._out)

    def u8(self, value: int) -> None:
        """Append one byte. Raises ValueError when it does not fit."""
        self._out.append(value)

    def varint(self, value: int) -> None:
        """Append an unsigned number in groups of seven bits, lowest first; the top bit is set if more follow."""
        if value < 0:
            raise ValueError(f"an unsigned number is expected, found {value}")
        out = self._out
        if value < 128:  # most numbers
            out.append(value)
            return
        while value >= 128:
            out.append(value & 127 | 128)
            value >>= 7
        out.append(value)

    def signed(self, value: int) -> None:
        """Append a signed number: zigzag, then varint."""
        self.varint(zigzag(value))

    def f64(self, value: float) -> None:
        """Append an IEEE double, little endian."""
        self._out += _F64.pack(value)

    def f32(self, value: float) -> None:
        """Append an IEEE single, little endian."""
        self._out += _F32.pack(value)

    def raw(self, data: bytes) -> None:
        """Append bytes."""
        self._out += data

    def columns(self, values: I64) -> None:
        """Append columns (c, n) of integers, |value| < 2^38; nothing for n = 0."""
        c, n = values.shape
        if n and c:
            out = np.zeros(c * (5 * n + 16) + 8, np.uint8)
            self._out += out[: pack_columns(values, out)].data

    def residual_columns(self, values: I64) -> None:
        """Append columns (c, n) of integers, |value| < 2^30, Golomb-Rice coded; nothing for n = 0."""
        c, n = values.shape
        if n and c:
            out = np.zeros(c * (7 * n + 16) + 8, np.uint8)
            size = pack_residuals(np.ascontiguousarray(values), out)
            if size < 0:
                raise ValueError(f"numbers below {LIMIT} are expected, found {values.min()}..{values.max()}")
            self._out += out[:size].data

    def bytes(self) -> bytes:
        """What has been written."""
        return bytes(self._out)


class Reader:
    """Reads numbers from the front of a code. Every method raises WireError, and nothing else, on invalid bytes."""

    __slots__ = ("_at", "_data")

    def __init__(self, data: bytes, at: int = 0) -> None:
        self._data = data
        self._at = at

    @property
    def left(self) -> int:
        """Bytes that remain."""
        return len(self._data) - self._at

    def u8(self) -> int:
        """One byte."""
        if self._at >= len(self._data):
            raise WireError("the bytes end before the value does")
        self._at += 1
        return self._data[self._at - 1]

    def varint(self, limit: int = (1 << 63) - 1) -> int:
        """An unsigned number of at most `limit`, in its shortest form."""
        data, at = self._data, self._at
        if at < len(data) and data[at] < 128 and data[at] <= limit:  # most numbers
            self._at = at + 1
            return data[at]
        value = 0
        for i in range(_MAX_VARINT_BYTES):
            if at + i >= len(data):
                raise WireError("the bytes end within a number")
            b = data[at + i]
            value |= (b & 127) << 7 * i
            if b < 128:
                if b == 0 and i:
                    raise WireError("a number is not in its shortest form")
                if value > limit:
                    raise WireError(f"found the number {value}, expected at most {limit}")
                self._at = at + i + 1
                return value
        raise WireError("a number is longer than 64 bits")

    def signed(self, limit: int) -> int:
        """A signed number of magnitude at most `limit`."""
        value = unzigzag(self.varint((1 << 64) - 1))
        if abs(value) > limit:
            raise WireError(f"found the number {value}, expected a magnitude of at most {limit}")
        return value

    def f64(self) -> float:
        """A finite double."""
        return self._finite(_F64.unpack(self.raw(8))[0])

    def f32(self) -> float:
        """A finite single."""
        return self._finite(_F32.unpack(self.raw(4))[0])

    def raw(self, n: int) -> bytes:
        """The next n bytes."""
        at, stop = self._at, self._at + n
        if stop > len(self._data):
            raise WireError(f"the bytes end before the value does: {self.left} left, {n} expected")
        self._at = stop
        return self._data[at:stop]

    def columns(self, c: int, n: int) -> I64:
        """Columns (c, n) of integers."""
        values = np.zeros((c, n), np.int64)
        if n and c:
            at = unpack_columns(np.frombuffer(self._data, np.uint8), self._at, values)
            if at < 0:
                raise WireError("columns are cut short or malformed")
            self._at = at
        return values

    def residual_columns(self, c: int, n: int) -> I64:
        """Residual columns (c, n) of integers."""
        values = np.zeros((c, n), np.int64)
        if n and c:
            at = unpack_residuals(np.frombuffer(self._data, np.uint8), self._at, values)
            if at < 0:
                raise WireError("residual columns are cut short or malformed")
            self._at = at
        return values

    def end(self) -> None:
        """Raise WireError if anything is left."""
        if self.left:
            raise WireError(f"{self.left} bytes too many")

    @staticmethod
    def _finite(value: float) -> float:
        if value - value != 0.0:
            raise WireError("a number is infinite or not a number")
        return value
