"""Tiles of log-odds by place, in memory as few as are drawn on at a time; the others are kept deflated."""

import zlib
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from kiteline_basestation.grid.scan_kernels import PLANES, SIDE
from kiteline_core.arrays import I16, I32

_SHAPE = (PLANES, SIDE, SIDE)


class Place(NamedTuple):
    """A tile of a storey; its corner lies at (column, row) * 64 * cell_m in w."""

    storey: int
    row: int
    column: int


class TileStore:
    """Planes of log-odds (PLANES, 64, 64) int16 by place. A tile exists while a scan touches it.

    `pool` holds the inflated ones; `open_box` inflates those of a box and names their slots.
    """

    def __init__(self, resident: int) -> None:
        """resident: tiles that stay inflated between two draws."""
        self._resident = resident
        self.pool: I16 = np.zeros((0, *_SHAPE), np.int16)
        self._slots: dict[Place, int] = {}  # of inflated tiles, what was used last at the end
        self._spare: list[int] = []
        self._deflated: dict[Place, bytes] = {}
        self._scans: dict[Place, int] = {}  # number of scans that touch a tile

    def __len__(self) -> int:
        return len(self._scans)

    def __iter__(self) -> Iterator[Place]:
        return iter(self._scans)

    def __contains__(self, place: Place) -> bool:
        return place in self._scans

    @property
    def nbytes(self) -> int:
        """Bytes of all tiles, without dictionaries."""
        return int(self.pool.nbytes) + sum(len(data) for data in self._deflated.values())

    def open_box(self, storey: int, first_row: int, first_column: int, rows: int, columns: int) -> I32:
        """Slots (rows, columns) of the tiles of a box, -1 where there is none."""
        slots = np.full((rows, columns), -1, np.int32)
        for r in range(rows):
            for c in range(columns):
                place = Place(storey, first_row + r, first_column + c)
                if place in self._scans:
                    slots[r, c] = self._inflate(place)
        return slots

    def spare(self, n: int) -> I32:
        """At least n slots that no tile uses, zero; `enter` says which of them were taken."""
        if len(self._spare) < n:
            used = len(self.pool)
            grown = used + max(n, min(used // 2, 256), 16)
            pool = np.zeros((grown, *_SHAPE), np.int16)
            pool[:used] = self.pool
            self.pool = pool
            self._spare.extend(range(grown - 1, used - 1, -1))
        return np.array(self._spare[::-1], np.int32)

    def enter(self, place: Place, slot: int, change: int) -> None:
        """Note that one scan more (change 1) or less (-1) touches a tile; without any it is gone."""
        if place not in self._scans:
            self._scans[place] = 0
            self._spare.remove(slot)
        self._slots.pop(place, None)
        self._slots[place] = slot
        self._scans[place] += change
        if self._scans[place] == 0:
            del self._scans[place], self._slots[place]
            self._release(slot)

    def close(self) -> None:
        """Deflate the tiles that were used least recently, so that as many as are resident stay inflated."""
        while len(self._slots) > self._resident:
            place = next(iter(self._slots))
            slot = self._slots.pop(place)
            planes = self.pool[slot]
            used = [k for k in range(PLANES) if planes[k].any()]
            self._deflated[place] = bytes(used) + b"\xff" + zlib.compress(planes[used].tobytes(), 1)
            self._release(slot)

    def _release(self, slot: int) -> None:
        self.pool[slot] = 0
        self._spare.append(slot)

    def _inflate(self, place: Place) -> int:
        held = self._slots.pop(place, None)
        if held is None:
            used, data = self._deflated.pop(place).split(b"\xff", 1)
            self.spare(1)
            held = self._spare.pop()
            self.pool[held, list(used)] = np.frombuffer(zlib.decompress(data), np.int16).reshape(-1, SIDE, SIDE)
        self._slots[place] = held
        return held
