"""Kernels that draw a column scan into tiles of log-odds, and that read the state of their cells.

Cells are numbered from the lower left corner of a box of tiles; `slots` (rows, columns) int32 maps a tile of the box to
its place in the pool (capacity, PLANES, 64, 64) int16, -1 none. Plane 0 holds what all height bands have in common, and
plane 1 + b what band b has beyond it. All drawing is the sum of integers, so that a scan that is drawn with sign -1
leaves no trace.
"""

import numpy as np

from kiteline_core.arrays import F64, I8, I16, I32, I64, U8, U16
from kiteline_core.jit import helper, njit

SIDE = 64  # cells along a side of a tile: the shape of a GridTile record
BANDS = 3  # height bands
PLANES = 1 + BANDS
_SHIFT, _MASK = 6, SIDE - 1  # quotient and remainder by SIDE
ALL = (1 << BANDS) - 1
_MOST = 32767  # log-odds saturate: a cell that was seen so often stays what it is


@helper
def _tile(row: int, column: int, slots: I32, spare: I32, used: I64) -> int:
    """Slot of the tile of a cell, taken from `spare` if it has none. used: (1,) number of spare slots taken."""
    slot = slots[row >> _SHIFT, column >> _SHIFT]
    if slot < 0:
        slot = spare[used[0]]
        used[0] += 1
        slots[row >> _SHIFT, column >> _SHIFT] = slot
    return int(slot)


@helper
def _add(pool: I16, slot: int, row: int, column: int, bands: int, value: int) -> None:
    for b in range(BANDS):
        if bands >> b & 1:
            total = int(pool[slot, 1 + b, row & _MASK, column & _MASK]) + value
            pool[slot, 1 + b, row & _MASK, column & _MASK] = min(max(total, -_MOST), _MOST)


@helper
def _take(pool: I16, slot: int, row: int, column: int, bands: int, value: int) -> None:
    """Add to the plane of all bands, or to those of some."""
    if bands == ALL:
        total = int(pool[slot, 0, row & _MASK, column & _MASK]) + value
        pool[slot, 0, row & _MASK, column & _MASK] = min(max(total, -_MOST), _MOST)
    else:
        _add(pool, slot, row, column, bands, value)


@helper
def _between(lower: float, middle: float, upper: float, part: float) -> float:
    """A range at a part of a column, by those at its lower edge, in its middle and at its upper edge."""
    if part < 0.5:
        return lower + 2.0 * part * (middle - lower)
    return middle + (2.0 * part - 1.0) * (upper - middle)


@njit
def mark_hits(
    x: float, y: float, first_rad: float, step_rad: float, range_cells: F64, bands: U8, weight: I64, hits: U16,
    cells: I32,
) -> int:  # fmt: skip
    """Enter the cells of the nearest obstacles of a scan's columns into `hits` (rows, columns), zero before.

    x, y: camera in cells of the box. first_rad: lower edge of column 0. range_cells: (n,3) at a column's lower edge, in
    its middle and at its upper edge, inf without an obstacle.
    weight: (n,) below 128. A cell gets 256 weight + bands; of several columns the largest weight and all bands.
    cells: (m,2) row, column of the cells, out. Returns how many.
    """
    found = 0
    for i in range(range_cells.shape[0]):
        lower, middle, upper = range_cells[i, 0], range_cells[i, 1], range_cells[i, 2]
        if not middle < np.inf:
            continue
        deep = abs(middle - lower) + abs(upper - middle)  # there and back, where the middle juts out
        samples = max(1, int(np.ceil(2.0 * (max(lower, middle, upper) * step_rad + deep))))
        for k in range(samples):
            part = (k + 0.5) / samples
            reach = _between(lower, middle, upper, part)
            angle = first_rad + (i + part) * step_rad
            row, column = int(np.floor(y + reach * np.sin(angle))), int(np.floor(x + reach * np.cos(angle)))
            if row < 0 or column < 0 or row >= hits.shape[0] or column >= hits.shape[1]:
                continue
            before = np.int64(hits[row, column])
            if before == 0:
                cells[found, 0], cells[found, 1] = row, column
                found += 1
            hits[row, column] = (max(before >> 8, weight[i]) << 8) | (before & 255) | np.int64(bands[i])
    return found


@njit
def draw_hits(
    hits: U16, cells: I32, found: int, sign: int, slots: I32, spare: I32, used: I64, pool: I16, touched: U8
) -> None:
    """Add the weights of marked cells to their bands. touched: (rows, columns) of tiles, out."""
    for i in range(found):
        row, column = cells[i, 0], cells[i, 1]
        slot = _tile(row, column, slots, spare, used)
        touched[row >> _SHIFT, column >> _SHIFT] = 1
        value = int(np.int64(hits[row, column]))  # unsigned and signed numbers would make a float
        _add(pool, slot, row, column, value & ALL, sign * (value >> 8))


@helper
def _run(x: float, dy: float, reach: float, edges: tuple[float, float, float, float]) -> tuple[int, int]:
    """First and last column of the cells of a row within reach and between two edges; the last below the first: none.

    dy: of the row from the camera at column x. edges: cosine and sine of the lower one and of the upper one. A cell
    whose centre lies on the lower edge counts, on the upper one not: each is in exactly one sector.
    """
    c0, s0, c1, s1 = edges
    width2 = reach * reach - dy * dy
    if width2 <= 0.0:
        return 0, -1
    width = np.sqrt(width2)
    first, last = int(np.ceil(x - width - 0.5)), int(np.floor(x + width - 0.5))
    if s0 > 0.0:
        last = min(last, int(np.floor(c0 / s0 * dy + x - 0.5)))
    elif s0 < 0.0:
        first = max(first, int(np.ceil(c0 / s0 * dy + x - 0.5)))
    elif c0 * dy < 0.0:
        return 0, -1
    if s1 > 0.0:
        first = max(first, int(np.floor(c1 / s1 * dy + x - 0.5)) + 1)
    elif s1 < 0.0:
        last = min(last, int(np.ceil(c1 / s1 * dy + x - 0.5)) - 1)
    elif c1 * dy >= 0.0:
        return 0, -1
    return first, last


@helper
def _freed(
    dx: float, dy: float, begin2: float, ends: tuple[float, float, float], edges: tuple[float, float, float, float]
) -> bool:
    """True if a cell lies where all bands of a column are free. begin2: squared; ends, edges: see `draw_free`."""
    lower, middle, upper = ends
    distance2 = dx * dx + dy * dy
    least, most = max(min(lower, middle, upper), 0.0), max(lower, middle, upper, 0.0)
    if distance2 < begin2 or distance2 > most * most:
        return False
    if distance2 <= least * least:
        return True
    left = edges[0] * dy - edges[1] * dx
    part = left / (left + edges[3] * dx - edges[2] * dy)
    return distance2 <= _between(lower, middle, upper, part) ** 2


@njit
def draw_free(
    x: float, y: float, first_rad: float, step_rad: float, begins: F64, starts: F64, ends: F64, lows: F64, under: U8,
    clears: F64, camera_band: int, nears: F64, sures: F64, fairs: F64, weights: tuple[int, int, int, int],
    hits: U16, sign: int, slots: I32, spare: I32, used: I64, pool: I16, touched: U8,
) -> None:  # fmt: skip
    """Take evidence of free space from the cells of each column's sector; each cell belongs to one column.

    Ranges in cells: begins, starts: (n,) from where the rays to the nearest seen ground are low, and from where the
    ground was seen. ends: (n,3) up to where all bands are free, at a column's lower edge, in its middle and at its
    upper edge; lows: (n,) up to where the bands `under` (n,) are free too. clears: (n,) up to where the line of sight
    is clear, which frees camera_band (-1: none). weights: of seen ground up to nears (n,); beyond, up to sures (n,);
    beyond that up to fairs (n,); and elsewhere, as where rays are low but no ground was seen: a pit may lie there.
    Marked cells keep the bands of their obstacles.
    """
    rows, columns = hits.shape
    for i in range(ends.shape[0]):
        end = ends[i, 0], ends[i, 1], ends[i, 2]
        low, clear = max(lows[i], 0.0), max(clears[i], 0.0) if camera_band >= 0 else 0.0
        reach = max(end[0], end[1], end[2], low, clear)
        if reach <= 0.0:
            continue
        begin2, start2, low2, clear2, near2 = begins[i] ** 2, starts[i] ** 2, low * low, clear * clear, nears[i] ** 2
        sure2, fair2 = max(sures[i] ** 2, start2), max(fairs[i] ** 2, start2)
        a0, a1 = first_rad + i * step_rad, first_rad + (i + 1) * step_rad
        edges = np.cos(a0), np.sin(a0), np.cos(a1), np.sin(a1)
        bottom = max(0, int(np.floor(y + min(0.0, reach * edges[1], reach * edges[3]) - 1.0)))
        top = min(rows - 1, int(np.ceil(y + max(0.0, reach * edges[1], reach * edges[3]) + 1.0)))
        for row in range(bottom, top + 1):
            dy = row + 0.5 - y
            first, last = _run(x, dy, reach, edges)
            slot, tile = -1, -1
            for column in range(max(first, 0), min(last, columns - 1) + 1):
                dx = column + 0.5 - x
                distance2 = dx * dx + dy * dy
                bands = 0
                if _freed(dx, dy, begin2, end, edges):
                    bands = ALL
                elif begin2 <= distance2 <= low2:
                    bands = int(np.int64(under[i]))
                ground = bands != 0
                if distance2 <= clear2:
                    bands |= 1 << camera_band
                bands &= ~int(np.int64(hits[row, column]))
                if bands == 0:
                    continue
                if tile != column >> _SHIFT:
                    slot, tile = _tile(row, column, slots, spare, used), column >> _SHIFT
                    touched[row >> _SHIFT, tile] = 1
                value = weights[2] if distance2 > sure2 else weights[1]
                value = weights[3] if distance2 > fair2 or (ground and distance2 < start2) else value
                value = weights[0] if start2 <= distance2 <= near2 else value
                _take(pool, slot, row, column, bands, -sign * value)


@njit
def clear_hits(hits: U16, cells: I32, found: int) -> None:
    """Set the marked cells to zero again."""
    for i in range(found):
        hits[cells[i, 0], cells[i, 1]] = 0


@helper
def _state(pool: I16, slots: I32, row: int, column: int, bands: int, occupied_from: int) -> tuple[int, int]:
    """Mask of occupied bands, and the largest log-odds, of some. row, column: from the corner of the middle tile."""
    slot = slots[(row + SIDE) >> _SHIFT, (column + SIDE) >> _SHIFT]
    if slot < 0:
        return 0, 0
    mask, most, common = 0, -2 * _MOST, int(pool[slot, 0, row & _MASK, column & _MASK])
    for b in range(BANDS):
        if bands >> b & 1:
            value = common + int(pool[slot, 1 + b, row & _MASK, column & _MASK])
            mask |= (value >= occupied_from) << b
            most = max(most, value)
    return mask, most


@njit
def read_states(
    slots: I32, pool: I16, bands: int, occupied_from: int, free_from: int, free_clear: int, free_beside: int, hole: int,
    opening: int, cells: I8,
) -> int:  # fmt: skip
    """States of the cells (64,64) of a tile: -1 unknown, 0 free, else the mask of occupied bands.

    slots: (3,3) of the tile and those around it. bands: mask of those that count. occupied_from, free_from: log-odds
    from which a band is occupied, and minus which all bands must not exceed for the cell to be free. free_clear: the
    same where no cell of the five by five around has positive log-odds; free_beside: beside an occupied cell.
    hole: neighbours that must be free, none being occupied, for an unknown cell without sign of an obstacle to be free.
    opening: 1 keeps free only what lies in a square of three by three free cells. Returns the number of known cells.
    """
    margin = (
        6  # what is read around the tile: a square reaches two cells far, holes in it one more, all have neighbours,
        # and those have signs two cells away
    )
    wide = SIDE + 2 * margin
    states, odds = np.empty((wide, wide), np.int8), np.empty((wide, wide), np.int32)
    for row in range(wide):
        for column in range(wide):
            mask, most = _state(pool, slots, row - margin, column - margin, bands, occupied_from)
            states[row, column] = mask if mask else 0 if most <= -free_from else -1
            odds[row, column] = most
    for row in range(2, wide - 2):
        for column in range(2, wide - 2):
            if states[row, column] == -1 and odds[row, column] <= -free_clear:
                if odds[row - 2 : row + 3, column - 2 : column + 3].max() <= 0:
                    states[row, column] = 0
    for row in range(3, wide - 3):
        for column in range(3, wide - 3):
            if states[row, column] == 0 and odds[row, column] > -free_beside:
                for r in range(row - 1, row + 2):
                    for c in range(column - 1, column + 2):
                        if states[r, c] > 0:
                            states[row, column] = -1
    held = states.copy()
    for row in range(4, wide - 4):
        for column in range(4, wide - 4):
            if held[row, column] == -1 and odds[row, column] <= 0:
                free = 0
                for r in range(row - 1, row + 2):
                    for c in range(column - 1, column + 2):
                        free += (held[r, c] == 0) - 9 * (held[r, c] > 0)
                if free >= hole:
                    states[row, column] = 0
    known = 0
    if opening:
        kept = np.zeros((wide, wide), np.uint8)
        for row in range(5, wide - 5):
            for column in range(5, wide - 5):
                whole = True
                for r in range(row - 1, row + 2):
                    for c in range(column - 1, column + 2):
                        whole = whole and states[r, c] == 0
                if whole:
                    for r in range(row - 1, row + 2):
                        for c in range(column - 1, column + 2):
                            kept[r, c] = 1
        for row in range(margin, wide - margin):
            for column in range(margin, wide - margin):
                if states[row, column] == 0 and kept[row, column] == 0:
                    states[row, column] = -1
    for row in range(SIDE):
        for column in range(SIDE):
            cells[row, column] = states[row + margin, column + margin]
            known += cells[row, column] >= 0
    return known
