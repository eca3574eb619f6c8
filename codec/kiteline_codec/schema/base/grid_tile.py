"""A tile of the occupancy grid."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from kiteline_codec.coding import quantise
from kiteline_codec.coding.packing import Reader, WireError, Writer
from kiteline_codec.schema.record import IdOf, Key, Priority, Record, register

TILE_CELLS = 32  # along each side
_BITS = 24  # of a column or row number
_OFFSET = 1 << _BITS - 1
_BYTES = np.arange(256, dtype=np.uint8)
_CELLS = quantise.occupancy(np.stack([_BYTES & 15, _BYTES >> 4], axis=1))  # (256,2): the two cells of a byte
_PAIRS = np.ascontiguousarray(_CELLS).view(np.int16)[:, 0]  # (256,): both in one number, which is faster to look up


@register
@dataclass(frozen=True, slots=True)
class GridTile(Record):
    """A square of the occupancy grid. cells: (32,32) int8, 0..100 occupied percent, -1 unknown; row 0 is the lowest y.
    column, row: tile numbers; the tile's corner lies at (column, row) * 32 * cell_m in w.
    """

    KIND = 22
    ID = IdOf.TILE
    PRIORITY = Priority.GRID

    column: int
    row: int
    cell_m: float
    cells: NDArray[np.int8]

    def key(self) -> Key:
        """Column and row, packed. Raises ValueError when out of range."""
        column, row = self.column + _OFFSET, self.row + _OFFSET
        if not (0 <= column < 1 << _BITS and 0 <= row < 1 << _BITS):
            raise ValueError(f"tile ({self.column}, {self.row}) lies beyond +-{_OFFSET}")
        return Key(self.KIND, column << _BITS | row)

    def write(self, out: Writer) -> None:
        """Append the size of a cell and the deflated cells, two to a byte."""
        if self.cells.shape != (TILE_CELLS, TILE_CELLS):
            raise ValueError(f"a tile is {TILE_CELLS}x{TILE_CELLS} cells, found {self.cells.shape}")
        out.f32(self.cell_m)
        levels = quantise.occupancy_codes(self.cells).reshape(-1)
        deflate = zlib.compressobj(9, zlib.DEFLATED, -10)
        out.raw(deflate.compress((levels[0::2] | levels[1::2] << 4).tobytes()) + deflate.flush())

    @classmethod
    def read(cls, source: Reader, key: Key) -> Self:
        """The record of a key and a code."""
        cell_m = source.f32()
        if cell_m <= 0:
            raise WireError(f"a cell has a size, found {cell_m} m")
        inflate = zlib.decompressobj(-15)
        expected = TILE_CELLS * TILE_CELLS // 2
        try:
            data = inflate.decompress(source.raw(source.left), expected + 1)
        except zlib.error as e:
            raise WireError(f"tile: {e}") from None
        if len(data) != expected or not inflate.eof or inflate.unused_data or inflate.unconsumed_tail:
            raise WireError(f"a tile holds {expected} bytes, found {len(data)}")
        cells = _PAIRS.take(np.frombuffer(data, np.uint8)).view(np.int8).reshape(TILE_CELLS, TILE_CELLS)
        column, row = key.id >> _BITS, key.id & (1 << _BITS) - 1
        return cls(column - _OFFSET, row - _OFFSET, cell_m, cells)
