"""The grid for others than its own stage: coded tiles for pages and links, and files for map_server."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from kiteline_basestation.grid.scan_grid import CellRules, ScanGrid, ViewWeights
from kiteline_basestation.grid.scan_kernels import SIDE
from kiteline_basestation.grid.tile_store import Place
from kiteline_codec.schema import GridTile, messages
from kiteline_codec.schema.base.grid_tile import FREE, UNKNOWN
from kiteline_core.arrays import F64, I8, I64

FREE_GREY, UNKNOWN_GREY, SOLID_GREY = 254, 205, 0  # as map_server writes them
_BLOCK = 16  # tiles along a block; blocks without a neighbour lie apart
_OUTLIERS = 0.5  # of the largest part's tiles: parts that hold fewer are left out of files that would be too large
_NEVER = 1 << 20  # log-odds that no cell has
_MOST_PIXELS = 1 << 26  # of a file; larger maps are written with coarser cells


class CodedTile(NamedTuple):
    """A tile as a code of its cells. known: number of known cells."""

    code: bytes
    known: int


@dataclass(frozen=True, slots=True)
class GridView:
    """The grid at one instant, for other threads. Its tiles are those with known cells.

    storey: the one with most scans. others: how many storeys lie apart from it.
    """

    cell_m: float
    revision: int = 0
    storey: int = 0
    tiles: Mapping[Place, CodedTile] = field(default_factory=dict)
    others: int = 0

    def known_m2(self) -> float:
        """Area of the known cells of the main storey."""
        return sum(tile.known for place, tile in self.tiles.items() if place.storey == self.storey) * self.cell_m**2

    def tile(self, place: Place) -> GridTile:
        """A tile as a record; unknown where there is none."""
        held = self.tiles.get(place)
        if held is None:
            cells = np.full((SIDE, SIDE), UNKNOWN, np.int8)
            return GridTile(place.column, place.row, place.storey, self.cell_m, cells)
        record = messages.decode(GridTile.key_of(place.column, place.row, place.storey), held.code)
        assert isinstance(record, GridTile)
        return record


def differences(old: GridView, new: GridView) -> list[Place]:
    """Tiles of the main storey that differ between two views, in order; those that vanished too."""
    if old.storey != new.storey:
        old = GridView(old.cell_m, 0, new.storey, {p: t for p, t in old.tiles.items() if p.storey == old.storey})
        gone = {Place(new.storey, p.row, p.column) for p in old.tiles}
    else:
        gone = {p for p in old.tiles if p.storey == new.storey}
    here = {p for p in new.tiles if p.storey == new.storey}
    return sorted(p for p in gone | here if old.tiles.get(p) is not new.tiles.get(p))


class GridViews:
    """Makes views of a grid; tiles that did not change since the last one are not coded again."""

    def __init__(self, grid: ScanGrid) -> None:
        self._grid = grid
        self._last = GridView(grid.config.cell_m)

    def take(self) -> GridView:
        """The grid now."""
        grid, last = self._grid, self._last
        if grid.revision == last.revision:
            return last
        tiles = dict(last.tiles)
        for place in sorted(grid.stale_since(last.revision)):
            cells, known = grid.cells(place)
            held = tiles.pop(place, None)
            if known:
                record = GridTile(place.column, place.row, place.storey, last.cell_m, cells)
                new = CodedTile(messages.encode(record), known)
                tiles[place] = held if held == new and held is not None else new
        others = len(grid.separate_storeys())
        self._last = GridView(last.cell_m, grid.revision, grid.main_storey(), tiles, others)
        return self._last


def dense(grid: ScanGrid, storey: int, cells_of: Callable[[Place], I8] | None = None) -> tuple[I8, F64, float]:
    """A storey as one array: cells (rows, columns) int8, row 0 the lowest y, its corner (2,) in w and a cell's side, m.

    cells_of: of a tile with known cells; None: those of the grid.
    A map of more pixels than a file can have is written without outliers, and then with coarser cells: occupied if any
    is, free if at least half are.
    """
    cell = grid.config.cell_m
    tiles = {p: cells for p in grid.places if p.storey == storey for cells, known in [grid.cells(p)] if known}
    if not tiles:
        return np.full((1, 1), UNKNOWN, np.int8), np.zeros(2), cell
    places = np.array([(p.row, p.column) for p in tiles], np.int64)
    if np.prod(np.ptp(places, axis=0) + 1) * SIDE**2 > _MOST_PIXELS:
        places = _without_outliers(places)
    first, last = places.min(axis=0), places.max(axis=0) + 1
    rows, columns = ((last - first) * SIDE).tolist()
    factor = 1
    while rows * columns > _MOST_PIXELS * factor**2 and factor < SIDE:
        factor *= 2
    side = SIDE // factor
    # A map that is too large even so is shown around its middle.
    if (rows // factor) * (columns // factor) > _MOST_PIXELS:
        centre, reach = np.median(places, axis=0).astype(np.int64), int(np.sqrt(_MOST_PIXELS)) // (2 * side)
        first, last = np.maximum(first, centre - reach), np.minimum(last, centre + reach)
        rows, columns = ((last - first) * SIDE).tolist()
    out = np.full((rows // factor, columns // factor), UNKNOWN, np.int8)
    for place, own in tiles.items():
        cells = own if cells_of is None else cells_of(place)
        r, c = place.row - int(first[0]), place.column - int(first[1])
        if r >= 0 and c >= 0 and (r + 1) * side <= out.shape[0] and (c + 1) * side <= out.shape[1]:
            out[r * side : (r + 1) * side, c * side : (c + 1) * side] = _coarser(cells, factor)
    return out, np.array([first[1], first[0]]) * (SIDE * cell), cell * factor


def _without_outliers(places: I64) -> I64:
    """The places (n,2) that do not lie with few others, far from the rest."""
    blocks, of_place = np.unique(places // _BLOCK, axis=0, return_inverse=True)
    tiles = np.bincount(of_place.reshape(-1), minlength=len(blocks))
    open_ = {(int(r), int(c)): k for k, (r, c) in enumerate(blocks)}
    groups: list[list[int]] = []
    while open_:
        group, front = [], [next(iter(open_))]
        group.append(open_.pop(front[0]))
        while front:
            r, c = front.pop()
            for near in ((r + dr, c + dc) for dr in (-1, 0, 1) for dc in (-1, 0, 1)):
                if near in open_:
                    group.append(open_.pop(near))
                    front.append(near)
        groups.append(group)
    sizes = [int(tiles[group].sum()) for group in groups]
    large = [k for group, n in zip(groups, sizes, strict=True) if n >= _OUTLIERS * max(sizes) for k in group]
    return places[np.isin(of_place.reshape(-1), large)]


def _coarser(cells: I8, factor: int) -> I8:
    if factor == 1:
        return cells
    side = SIDE // factor
    blocks = cells.reshape(side, factor, side, factor).transpose(0, 2, 1, 3).reshape(side, side, -1)
    mask = np.bitwise_or.reduce(np.maximum(blocks, 0), axis=2)
    free = 2 * np.count_nonzero(blocks == FREE, axis=2) >= factor**2
    return np.where(mask > 0, mask, np.where(free, FREE, UNKNOWN)).astype(np.int8)


def grid_files(grid: ScanGrid, stem: str = "grid") -> dict[str, bytes]:
    """Images (binary PGM, highest y first: 254 free, 0 occupied, 205 unknown) and YAML files of map_server, by name.

    The main storey is STEM.pgm; others STEM_storeyN.pgm, counted from the main one. As the options say, beside each
    lie those of its height bands, STEM_LOW-HIGH.pgm in m above the ground, and STEM_binary.pgm.
    """
    config, main, out = grid.config, grid.main_storey(), dict[str, bytes]()
    layers: dict[str, Callable[[Place], I8] | None] = {"": None}
    if config.band_files:
        for b, (low, high) in enumerate(pairwise(config.bands_m)):
            layers[f"_{low:g}-{high:g}"] = lambda place, band=1 << b: grid.cells(place, band)[0]  # type: ignore[misc]
    if config.binary_files:
        layers["_binary"] = _binary(grid)
    for storey in sorted({main, *grid.separate_storeys()}):
        name = stem if storey == main else f"{stem}_storey{storey - main:+d}"
        for layer, cells_of in layers.items():
            out.update(_file(name + layer, *dense(grid, storey, cells_of)))
    return out


def _binary(grid: ScanGrid) -> Callable[[Place], I8]:
    """Cells of a tile, occupied where any scan saw an obstacle, else free where any saw ground (Segfloor, 5.6)."""
    config, any_view = replace(grid.config, hole_neighbours=9), CellRules(1, 1, 1, 1)
    hit = grid.redrawn(config, ViewWeights(free=0, free_sure=0, free_fair=0, free_far=0), any_view)
    only_seen = (0.0, *config.bands_m[1:])
    seen = grid.redrawn(
        replace(config, bands_m=only_seen), ViewWeights(0, 1, 1, 1, 1), any_view._replace(occupied_from=_NEVER)
    )

    def cells_of(place: Place) -> I8:
        occupied = hit.cells(place)[0]
        return np.where(occupied > 0, occupied, seen.cells(place)[0])

    return cells_of


def _file(name: str, cells: I8, corner: F64, cell_m: float) -> dict[str, bytes]:
    greys = np.full(256, SOLID_GREY, np.uint8)
    greys[FREE], greys[UNKNOWN] = FREE_GREY, UNKNOWN_GREY
    grey = greys[cells.view(np.uint8)]
    return {
        f"{name}.pgm": f"P5\n{grey.shape[1]} {grey.shape[0]}\n255\n".encode() + grey[::-1].tobytes(),
        f"{name}.yaml": (
            f"image: {name}.pgm\nmode: trinary\nresolution: {cell_m:.6g}\n"
            f"origin: [{corner[0]:.6f}, {corner[1]:.6f}, 0.000000]\n"
            "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
        ).encode(),
    }
