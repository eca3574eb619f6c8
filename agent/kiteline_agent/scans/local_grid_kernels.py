"""Kernels of the local grid: rays of scans are drawn into it, and distances are read from it."""

import numpy as np

from kiteline_core.jit import njit

HIT, MISS = 2, -1  # what a seen surface and a clear ray add to a cell
LONE_HIT = 1  # what one adds that a single column saw: a matched block is wider, so many are errors of matching
_LONE = 0.1  # of a range by which those of the columns beside it differ, at least: a wall seen at 14 degrees
MOST, LEAST = 8, -6
_THICK_M = 0.3  # m of a smeared surface, at most: it may be a solid that was seen from other sides
OCCUPIED, FREE = 2, -1  # from which, and up to which a cell is so; unknown between


@njit
def _add(cells, drawn, number, i, j, value):  # type: ignore[no-untyped-def]
    """Add to a cell once for each scan; a surface counts more than a ray beside it."""
    mark = 2 * number + (1 if value > 0 else 0)
    if drawn[i, j] >= mark:
        return
    before = MISS if drawn[i, j] == mark - 1 and value > 0 else 0
    drawn[i, j] = mark
    cells[i, j] = min(max(cells[i, j] - before + value, LEAST), MOST)


@njit
def _is_lone(clear_m, c):  # type: ignore[no-untyped-def]
    """True if no column beside column c has its range."""
    for i in range(max(c - 1, 0), min(c + 2, len(clear_m))):
        if i != c and abs(clear_m[i] - clear_m[c]) < _LONE * clear_m[c]:
            return False
    return True


@njit
def draw_rays(cells, drawn, number, x, y, heading, azimuth, step, clear_m, reach_m, cell_m, clears):  # type: ignore[no-untyped-def]
    """Draw a scan into cells (n,n): clear up to clear_m (m,), where a surface is unless it lies beyond reach_m (m,).

    x, y: of the camera in cells' axes, m from their corner; heading: of its azimuth 0. drawn: (n,n) marks of scans;
    number: of this one, from 1. clears: False if it was made at another height: then only its surfaces count.
    """
    n = len(cells)
    for c in range(len(azimuth)):
        if clear_m[c] <= 0.0:
            continue
        hit = LONE_HIT if _is_lone(clear_m, c) else HIT
        until = min(clear_m[c], reach_m[c])
        parts = int(step * until / cell_m) + 1
        for p in range(parts):
            angle = heading + azimuth[c] + ((p + 0.5) / parts - 0.5) * step
            dx, dy = np.cos(angle), np.sin(angle)
            if clear_m[c] < reach_m[c]:
                i, j = int((y + dy * until) / cell_m), int((x + dx * until) / cell_m)
                if 0 <= i < n and 0 <= j < n:
                    _add(cells, drawn, number, i, j, hit)
            if not clears:
                continue
            for k in range(int((until - 1.5 * cell_m) / (0.7 * cell_m))):
                r = k * 0.7 * cell_m
                i, j = int((y + dy * r) / cell_m), int((x + dx * r) / cell_m)
                if 0 <= i < n and 0 <= j < n:
                    _add(cells, drawn, number, i, j, MISS)


@njit
def _state(cells, x, y, cell_m):  # type: ignore[no-untyped-def]
    """1 occupied, 0 free, -1 unknown, at a place in m from the corner of cells (n,n)."""
    i, j = int(np.floor(y / cell_m)), int(np.floor(x / cell_m))
    if i < 0 or j < 0 or i >= cells.shape[0] or j >= cells.shape[1]:
        return -1
    value = cells[i, j]
    return 1 if value >= OCCUPIED else 0 if value <= FREE else -1


@njit
def _state_of_both(own, drawn, x, y, cell_m, tiles, tile_x, tile_y, tile_cell_m):  # type: ignore[no-untyped-def]
    """The same by own cells; by tiles where no own scan was drawn. Own scans that disagree leave a cell unknown."""
    i, j = int(np.floor(y / cell_m)), int(np.floor(x / cell_m))
    if i < 0 or j < 0 or i >= own.shape[0] or j >= own.shape[1] or drawn[i, j] == 0:
        return _state(tiles, tile_x, tile_y, tile_cell_m)
    value = own[i, j]
    return 1 if value >= OCCUPIED else 0 if value <= FREE else -1


@njit
def read_distances(  # type: ignore[no-untyped-def]
    own, drawn, own_cell_m, own_at, tiles, tile_cell_m, tile_at, around_m, gap_m, near_m, reach_m, rays, out
):  # fmt: skip
    """Distance (s,) in m to the nearest occupied cell in each sector, clockwise from ahead.

    inf: all is free up to reach_m; nan: more than gap_m along a ray is unknown before that, unless an obstacle lies
    within near_m. own, drawn: (n,n) cells, and 0 where no scan was drawn: there tiles (n,n) count. own_at, tile_at: x,
    y in m from their corner, and heading of the vehicle. around_m: about the vehicle, where it is itself.
    """
    sectors = len(out)
    width = 2.0 * np.pi / sectors
    step_m = 0.5 * own_cell_m
    for s in range(sectors):
        nearest, unknown = np.inf, np.inf
        for k in range(rays):
            turn = (s + (k + 0.5) / rays - 0.5) * width
            ax, ay = np.cos(own_at[2] - turn), np.sin(own_at[2] - turn)
            bx, by = np.cos(tile_at[2] - turn), np.sin(tile_at[2] - turn)
            r, gap = around_m, 0.0
            while r < min(reach_m, nearest):
                state = _state_of_both(
                    own, drawn, own_at[0] + ax * r, own_at[1] + ay * r, own_cell_m,
                    tiles, tile_at[0] + bx * r, tile_at[1] + by * r, tile_cell_m,
                )  # fmt: skip
                if state > 0:
                    end, state = r, 1
                    while state > 0 and end < r + _THICK_M:  # noise smears a surface: it is in the middle
                        end += step_m
                        state = _state_of_both(
                            own, drawn, own_at[0] + ax * end, own_at[1] + ay * end, own_cell_m,
                            tiles, tile_at[0] + bx * end, tile_at[1] + by * end, tile_cell_m,
                        )  # fmt: skip
                    nearest = min(nearest, 0.5 * (r + end))
                    break
                gap = gap + step_m if state < 0 else 0.0
                if gap > gap_m:
                    unknown = min(unknown, r)
                    if r > near_m:
                        break  # what lies behind is not told
                r += step_m
        out[s] = nearest if nearest < reach_m else np.inf
        if unknown < min(nearest, reach_m) and nearest > near_m:
            out[s] = np.nan
