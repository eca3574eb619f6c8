"""A tile of the occupancy grid."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from kiteline_codec.coding import tile_kernels as kernels
from kiteline_codec.coding.packing import Reader, WireError, Writer
from kiteline_codec.schema.record import IdOf, Key, Priority, Record, register
from kiteline_core.arrays import I8, I64

TILE_CELLS = kernels.SIDE  # along each side
UNKNOWN, FREE = -1, 0  # values of cells; others are masks of occupied height bands
MAX_STOREY = 127
_BITS = 24  # of a column or row number
_OFFSET = 1 << _BITS - 1
_CELL_STEPS = 10_000  # per m, of the side of a cell
_MAX_CELL = 1 << 20


@register
@dataclass(frozen=True, slots=True)
class GridTile(Record):
    """A square of the occupancy grid of a storey.

    cells: (64,64) int8, -1 unknown, 0 free, else the mask of the height bands that are occupied (bit i: band i of
    `ColumnScan`); row 0 is the lowest y. column, row: tile numbers; the tile's corner lies at
    (column, row) * 64 * cell_m in w. storey: -128..127, the number of the storey whose ground lies there.
    """

    KIND = 22
    ID = IdOf.TILE
    PRIORITY = Priority.GRID
    PARTS = 1 << 8
    FIRST_PARTS = PARTS

    column: int
    row: int
    storey: int
    cell_m: float
    cells: I8

    @property
    def part(self) -> int:
        """The storey, as the key has it."""
        return self.storey + MAX_STOREY + 1

    def key(self) -> Key:
        """Column and row, packed, and the storey. Raises ValueError when out of range."""
        return self.key_of(self.column, self.row, self.storey)

    @classmethod
    def key_of(cls, column: int, row: int, storey: int) -> Key:
        """The key of a place. Raises ValueError when out of range."""
        if not (-_OFFSET <= column < _OFFSET and -_OFFSET <= row < _OFFSET):
            raise ValueError(f"tile ({column}, {row}) lies beyond +-{_OFFSET}")
        if not -MAX_STOREY - 1 <= storey <= MAX_STOREY:
            raise ValueError(f"storey {storey} lies beyond +-{MAX_STOREY}")
        return Key(cls.KIND, column + _OFFSET << _BITS | row + _OFFSET, storey + MAX_STOREY + 1)

    @staticmethod
    def place(key: Key) -> tuple[int, int, int]:
        """Column, row and storey of a key."""
        return (key.id >> _BITS) - _OFFSET, (key.id & (1 << _BITS) - 1) - _OFFSET, key.part - MAX_STOREY - 1

    def write(self, out: Writer) -> None:
        """Append the size of a cell and the cells."""
        if self.cells.shape != (TILE_CELLS, TILE_CELLS):
            raise ValueError(f"a tile is {TILE_CELLS}x{TILE_CELLS} cells, found {self.cells.shape}")
        if self.cells.min() < UNKNOWN or self.cells.max() > kernels.MAX_MASK:
            raise ValueError(f"cells are -1..{kernels.MAX_MASK}, found {self.cells.min()}..{self.cells.max()}")
        cell = round(self.cell_m * _CELL_STEPS)
        if not 0 < cell <= _MAX_CELL:
            raise ValueError(
                f"a cell has a side of {1 / _CELL_STEPS}..{_MAX_CELL / _CELL_STEPS} m, found {self.cell_m}"
            )
        out.varint(cell)
        out.raw(_packed(self.cells))

    @classmethod
    def read(cls, source: Reader, key: Key) -> Self:
        """The record of a key and a code."""
        cell = source.varint(_MAX_CELL)
        if cell == 0:
            raise WireError("a cell has a size, found 0")
        data = source.raw(source.left)
        cells = np.empty((TILE_CELLS, TILE_CELLS), np.int8)
        if len(data) > kernels.MAX_CODE or not kernels.unpack_cells(np.frombuffer(data, np.uint8), _model(), cells):
            raise WireError("a tile of cells is expected")
        if _packed(cells) != data:
            raise WireError("a tile in its shortest code is expected")
        return cls(*cls.place(key), cell / _CELL_STEPS, cells)


def _packed(cells: I8) -> bytes:
    out = np.empty(kernels.MAX_CODE, np.uint8)
    return out[: kernels.pack_cells(np.ascontiguousarray(cells), _model(), out)].tobytes()


def _model() -> I64:
    return np.empty((2, kernels.CONTEXTS), np.int64)
