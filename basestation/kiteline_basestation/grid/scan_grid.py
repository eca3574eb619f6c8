"""The occupancy grid of w, drawn from column scans that hang on keyframes.

    grid = ScanGrid(GridConfig())
    kept = keep(grid.config, scan, bf_px_m)
    grid.put(name, kept, S_w_c)  # draws a scan, or draws it anew where its keyframe is now; names are in order of time
    grid.remove(name)
    grid.cells(Place(0, 2, -1))  # (64,64) int8: -1 unknown, 0 free, else the mask of occupied height bands

Log-odds are sums of integers, and a scan is drawn at a pose on a lattice: to draw the scans that moved anew gives
exactly the grid that all scans give when they are drawn from scratch. A storey holds the scans whose ground lies near
its height; neighbouring storeys overlap. Of scans of one source that look the same way from the same place, the last
few are drawn: a vehicle that hovers says the same a thousand times, and does not outvote what it sees later.

Method: log-odds of A. Hornung et al., "OctoMap", 2013, equation 2, in the sectors of a scan's columns; overlong rays
and the opening of the result after "Segfloor", equation 5.3 and section 5.6.
"""

import itertools
from bisect import insort
from collections import Counter
from collections.abc import Iterable
from math import floor
from typing import NamedTuple

import numpy as np

from kiteline_basestation.config import GridConfig
from kiteline_basestation.grid import scan_kernels as kernels
from kiteline_basestation.grid.kept_scan import KeptScan, Lattice, position_cells, scale_of, storey_at
from kiteline_basestation.grid.scan_kernels import ALL, BANDS, SIDE
from kiteline_basestation.grid.sectors import Sectors, sectors_of
from kiteline_basestation.grid.tile_store import Place, TileStore
from kiteline_core.arrays import F64, I8, I16, I32, U16

Name = int | tuple[int, int]
_MAX_POSITION_M = 100_000.0  # m; scans farther from the origin are not drawn: only a faulty map has them
_MAX_REACH_M = 100.0  # m; scans that reach farther are not drawn: only a faulty scale makes them
_VIEW_M = 0.5  # m; scans of an agent whose cameras lie in a square of this side ...
_VIEW_RAD = 0.39  # rad; ... and head the same way within this, a quarter of the field of view, are one view


class _Placed(NamedTuple):
    lattice: Lattice
    scan: KeptScan
    source: int


class _View(NamedTuple):
    """Place and heading of a camera, coarse."""

    source: int
    storeys: tuple[int, ...]
    x: int
    y: int
    heading: int


class ViewWeights(NamedTuple):
    """Log-odds, in 1/32, that one view adds to an obstacle's cells and takes from free ones."""

    hit: int = 12  # of a near view of an obstacle (p = 0.59); in inverse proportion to the range
    free: int = 6  # of a near view of free space (p = 0.45): half, as an edge is seen beside itself
    free_sure: int = 4  # the same of a far view well before what it sees
    free_fair: int = 3  # of a far view less far before it
    free_far: int = 2  # of a far view elsewhere (box and wall may be one surface), and before seen ground


class CellRules(NamedTuple):
    """Log-odds, in 1/32, from which a cell is occupied or free. A band is occupied, a cell is free in all bands."""

    occupied_from: int = 9  # one near view, two far ones
    free_from: int = 4  # below minus this: one sure view, two far ones
    free_clear: int = 3  # the same with no sign of an obstacle within two cells: one fair view
    free_beside: int = 10  # the same beside an occupied cell: a near view and a sure one, as one may lie a cell off


class ScanGrid:
    """Tiles of log-odds, and the scans that are drawn in them, by name."""

    def __init__(self, config: GridConfig, weights: ViewWeights | None = None, rules: CellRules | None = None) -> None:
        self.config = config
        self._weights = weights or ViewWeights()
        self._rules = rules or CellRules()
        self.revision = 0  # number of changes so far
        self.touched: dict[
            Place, int
        ] = {}  # revision of the last change, the oldest first; also of tiles that are gone
        self._store = TileStore(config.resident_tiles)
        self._placed: dict[Name, _Placed] = {}
        self._views: dict[_View, list[Name]] = {}  # of the placed scans, in order of name; the last are drawn
        self._storeys: Counter[tuple[int, ...]] = Counter()  # scans by the storeys on which they are drawn
        self._hits: U16 = np.zeros((0, 0), np.uint16)  # zero between two draws

    def __len__(self) -> int:
        """Number of scans that are drawn, or would be if others did not show the same."""
        return len(self._placed)

    def __contains__(self, name: Name) -> bool:
        return name in self._placed

    @property
    def places(self) -> list[Place]:
        """Tiles that a scan touches, in order of storey, row, column."""
        return sorted(self._store)

    @property
    def nbytes(self) -> int:
        """Bytes of tiles and scans, without dictionaries."""
        return self._store.nbytes + sum(len(placed.scan.rows) for placed in self._placed.values())

    def put(self, name: Name, scan: KeptScan, S_w_c: F64, source: int = 0) -> bool:
        """Draw a scan at its camera's pose (4,4), or anew if it or its pose changed. True if cells may have changed.

        source: whose scan it is: an agent's replace its own. A scan with a pose that is not finite, beyond the farthest
        tile or storey, or of a scale that makes it reach too far, is not drawn.
        """
        config = self.config
        if not np.isfinite(S_w_c).all() or np.abs(S_w_c[:3, 3]).max() > _MAX_POSITION_M:
            return self.remove(name)
        new = _Placed(scan.lattice(config, S_w_c), scan, source)
        if not new.lattice.storeys or scale_of(new.lattice) * scan.reach_m > _MAX_REACH_M:
            return self.remove(name)
        if new == self._placed.get(name):
            return False
        self.revision += 1
        left = self._leave(name)
        self._placed[name] = new
        names = self._views.setdefault(self._view(new), [])
        insort(names, name)
        if name not in names[-config.views :]:
            return left
        if len(names) > config.views:
            self._draw(self._placed[names[-config.views - 1]], -1)
        self._draw(new, 1)
        return True

    def remove(self, name: Name) -> bool:
        """Take a scan out. True if cells may have changed."""
        self.revision += name in self._placed
        return self._leave(name)

    def _leave(self, name: Name) -> bool:
        held = self._placed.pop(name, None)
        if held is None:
            return False
        view, views = self._view(held), self.config.views
        names = self._views[view]
        was_drawn = name in names[-views:]
        names.remove(name)
        if was_drawn:
            self._draw(held, -1)
            if len(names) >= views:
                self._draw(self._placed[names[-views]], 1)
        if not names:
            del self._views[view]
        return was_drawn

    def _view(self, placed: _Placed) -> _View:
        config, lattice = self.config, placed.lattice
        x, y = (floor(v * config.cell_m / _VIEW_M) for v in position_cells(lattice))
        heading = floor(placed.scan.heading_rad(config, lattice) / _VIEW_RAD)
        return _View(placed.source, lattice.storeys, x, y, heading)

    def storey_of(self, ground_m: float) -> int:
        """The storey whose ground lies nearest to a height in w."""
        return round(storey_at(self.config, ground_m))

    def main_storey(self) -> int:
        """The storey with most scans."""
        scans: Counter[int] = Counter()
        for storeys, n in self._storeys.items():
            scans.update(dict.fromkeys(storeys, n))
        return min(scans, key=lambda s: (-scans[s], abs(s), s), default=0)

    def separate_storeys(self) -> list[int]:
        """Storeys that hold scans which are not in the main one."""
        main = self.main_storey()
        return sorted({s for storeys in self._storeys if main not in storeys for s in storeys if s != main})

    def log_odds(self, place: Place) -> I16:
        """Log-odds (BANDS, 64, 64) int16 of a tile."""
        slot = int(self._store.open_box(place.storey, place.row, place.column, 1, 1)[0, 0])
        if slot < 0:
            return np.zeros((BANDS, SIDE, SIDE), np.int16)
        planes = self._store.pool[slot]
        return np.asarray(planes[:1] + planes[1:])

    def cells(self, place: Place, bands: int = ALL) -> tuple[I8, int]:
        """Cells (64,64) of a tile: -1 unknown, 0 free, else the mask of occupied bands; and how many are known.

        bands: mask of the height bands that count.
        """
        slots = self._store.open_box(place.storey, place.row - 1, place.column - 1, 3, 3)
        cells = np.empty((SIDE, SIDE), np.int8)
        config = self.config
        known = kernels.read_states(
            slots,
            self._store.pool,
            bands,
            *self._rules,
            config.hole_neighbours,
            int(config.opening),
            cells,
        )
        self._store.close()
        return cells, int(known)

    def redrawn(self, config: GridConfig, weights: ViewWeights, rules: CellRules) -> "ScanGrid":
        """The same scans where they lie now, all of them, drawn with other weights and thresholds."""
        grid = ScanGrid(config, weights, rules)
        for placed in self._placed.values():
            grid._draw(placed, 1)
        return grid

    def stale_since(self, revision: int) -> Iterable[Place]:
        """Tiles whose cells may have changed after a revision: those that were drawn on, and those around them."""
        changed = set(itertools.takewhile(lambda place: self.touched[place] > revision, reversed(self.touched)))
        return changed | {
            Place(storey, row + r, column + c)
            for storey, row, column in changed
            for r in (-1, 0, 1)
            for c in (-1, 0, 1)
        }

    def _draw(self, placed: _Placed, sign: int) -> None:
        """Add a scan to its storeys (sign 1), or take it out (-1)."""
        config, (lattice, scan, _) = self.config, placed
        self._storeys[lattice.storeys] += sign
        if not self._storeys[lattice.storeys]:
            del self._storeys[lattice.storeys]
        sectors = sectors_of(config, scan, lattice, self._weights.hit)
        box = sectors.box()
        rows, columns = box[2] - box[0], box[3] - box[1]
        sectors = sectors._replace(x=sectors.x - SIDE * box[1], y=sectors.y - SIDE * box[0])
        hits, cells, found = self._mark_hits(sectors, rows * SIDE, columns * SIDE)
        for storey in lattice.storeys:
            slots = self._store.open_box(storey, box[0], box[1], rows, columns)
            spare = self._store.spare(int(np.count_nonzero(slots < 0)))
            touched, used = np.zeros((rows, columns), np.uint8), np.zeros(1, np.int64)
            kernels.draw_hits(hits, cells, found, sign, slots, spare, used, self._store.pool, touched)
            kernels.draw_free(
                sectors.x, sectors.y, sectors.first_rad, sectors.step_rad, sectors.begin, sectors.start, sectors.end,
                sectors.low, sectors.under, sectors.clear, sectors.camera_band, sectors.accurate, sectors.sure,
                sectors.fair, self._weights[1:], hits,
                sign, slots, spare, used,
                self._store.pool, touched,
            )  # fmt: skip
            for r, c in np.argwhere(touched).tolist():
                place = Place(storey, box[0] + r, box[1] + c)
                self._store.enter(place, int(slots[r, c]), sign)
                self.touched.pop(place, None)
                self.touched[place] = self.revision
        kernels.clear_hits(hits, cells, found)
        self._store.close()

    def _mark_hits(self, sectors: Sectors, rows: int, columns: int) -> tuple[U16, I32, int]:
        """Cells (rows, columns) of obstacles, see `mark_hits`; which they are, and how many."""
        if self._hits.shape[0] < rows or self._hits.shape[1] < columns:
            self._hits = np.zeros((rows, columns), np.uint16)
        hits = self._hits[:rows, :columns]
        solid = sectors.obstacle[sectors.bands > 0]
        samples = 2.0 * (solid.max(1) * sectors.step_rad + np.abs(np.diff(solid, axis=1)).sum(1)) + 2.0
        cells = np.empty((int(np.sum(samples)), 2), np.int32)
        found = kernels.mark_hits(
            sectors.x, sectors.y, sectors.first_rad, sectors.step_rad, sectors.obstacle, sectors.bands, sectors.weight,
            hits, cells,
        )  # fmt: skip
        return hits, cells, found
