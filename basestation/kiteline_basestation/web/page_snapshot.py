"""What the status page shows: pure functions from a snapshot of the base to JSON and to binary map messages.

A binary message starts with 16 bytes, little endian: kind u8, agent u8, 0 u16, n u32, scale f32, 0 u32. Then by kind:
1 points: int16 (n,3) times scale = metres in w, uint8 (n) labels.
2 tiles: int32 (n,2) column, row; int8 (n,32,32) percent; scale is the side of a cell in m.
3 path of an agent's keyframes: int16 (n,3) times scale = metres in w.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kiteline_basestation.config import GridConfig
from kiteline_basestation.grid.grid import UNKNOWN, GridMap, differences, empty
from kiteline_codec.schema import GridTile
from kiteline_core.ids import AgentId

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

POINTS, TILES, PATH = 1, 2, 3  # kinds of binary messages

MAX_POINTS = 12_000  # more points than a screen can tell apart; 84 kB a message
MAX_PATH = 4_000  # keyframes a path
FRESH_S = 1.5  # s since the last packet: a heartbeat a second, and half of one late
LOST_S = 10.0  # s since the last packet: by then a reconnecting link would be back

_S = 1e-9  # s in a ns


@dataclass(frozen=True, slots=True)
class AgentView:
    """One agent as the base knows it. T_w_c: (4,4) newest camera in w, None while unplaced. path: (k,3) its keyframes
    in w, in order of time, m. quality: -1 failed, 0 unknown, 1..100. bytes_up, bytes_down: totals on the wire.
    """

    agent: AgentId
    heard_ns: int  # when its last packet came, by the clock of Snapshot.now_ns; -1 never
    quality: int
    T_w_c: F64 | None
    path: F64
    keyframes: int
    points: int
    submaps: int
    bytes_up: int
    bytes_down: int


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The base at one instant. points: (m,3) in w, m. labels: (m,) uint8. Arrays must not be written afterwards.

    map_revision: any number that changes when points, paths or grid do; the page fetches them only then.
    """

    now_ns: int
    started_ns: int
    agents: tuple[AgentView, ...]
    points: F64
    labels: U8
    grid: GridMap | None
    map_revision: int
    loops: int = 0
    merges: int = 0


def status(now: Snapshot, before: Snapshot | None = None) -> dict[str, Any]:
    """What the page writes in words and numbers, as JSON types. `before`: an older snapshot, for rates (else None)."""
    older = {a.agent: a for a in before.agents} if before is not None else {}
    span_s = (now.now_ns - before.now_ns) * _S if before is not None else 0.0
    grid = now.grid
    known = int((grid.cells != UNKNOWN).sum()) if grid is not None else 0
    return {
        "up_s": _rounded((now.now_ns - now.started_ns) * _S, 1),
        "agents": [_agent(a, older.get(a.agent), now.now_ns, span_s) for a in now.agents],
        "keyframes": sum(a.keyframes for a in now.agents),
        "points": len(now.points),
        "loops": now.loops,
        "merges": now.merges,
        "grid_m2": _rounded(known * grid.cell_m**2, 1) if grid is not None else 0.0,
        "map_revision": now.map_revision,
    }


def _agent(a: AgentView, before: AgentView | None, now_ns: int, span_s: float) -> dict[str, Any]:
    silent_s = (now_ns - a.heard_ns) * _S if a.heard_ns >= 0 else None
    pose = a.T_w_c
    placed = pose is not None and bool(np.isfinite(pose).all())
    up = down = None
    if before is not None and span_s > 0:
        up = round((a.bytes_up - before.bytes_up) / span_s)
        down = round((a.bytes_down - before.bytes_down) / span_s)
    return {
        "agent": int(a.agent),
        "link": link_state(silent_s),
        "silent_s": _rounded(silent_s, 1) if silent_s is not None else None,
        "quality": int(a.quality),
        "position": [_rounded(float(v), 3) for v in pose[:3, 3]] if pose is not None and placed else None,
        "heading_deg": _heading_deg(pose) if pose is not None and placed else None,
        "keyframes": a.keyframes,
        "points": a.points,
        "submaps": a.submaps,
        "bytes_up": a.bytes_up,
        "bytes_down": a.bytes_down,
        "rate_up": up,
        "rate_down": down,
    }


def link_state(silent_s: float | None) -> str:
    """never, live, quiet or lost, by the seconds since the last packet."""
    if silent_s is None:
        return "never"
    return "live" if silent_s < FRESH_S else "quiet" if silent_s < LOST_S else "lost"


def _heading_deg(pose: F64) -> float:
    """Where the camera looks (a camera that looks down: where its image's top is), from x of w to the left, degrees."""
    axis = pose[:2, 2] if np.hypot(pose[0, 2], pose[1, 2]) > 0.1 else -pose[:2, 1]
    return _rounded(float(np.degrees(np.arctan2(axis[1], axis[0]))), 1)


def _rounded(value: float, digits: int) -> float:
    return round(value, digits) + 0.0


def map_messages(now: Snapshot, held: GridMap | None) -> list[bytes]:
    """The map for a viewer that holds the grid `held` (None: nothing yet): paths, points, and the tiles that differ."""
    out = [path_message(a.agent, a.path) for a in now.agents]
    out.append(points_message(now.points, now.labels))
    if now.grid is not None and now.grid is not held:
        tiles = differences(held if held is not None else empty(GridConfig()), now.grid)
        if tiles:
            out.append(tiles_message(now.grid.cell_m, tiles))
    return out


def points_message(points: F64, labels: U8) -> bytes:
    """Map points, evenly thinned to MAX_POINTS. points: (m,3), those that are not finite are left out."""
    keep = np.flatnonzero(np.isfinite(points).all(axis=1))
    if len(keep) > MAX_POINTS:
        keep = keep[np.linspace(0, len(keep) - 1, MAX_POINTS).astype(np.int64)]
    scale, coded = _coded(points[keep])
    return _header(POINTS, 0, len(keep), scale) + coded + labels[keep].astype(np.uint8).tobytes()


def path_message(agent: int, path: F64) -> bytes:
    """An agent's keyframes (k,3), evenly thinned to MAX_PATH."""
    path = path[np.isfinite(path).all(axis=1)]
    if len(path) > MAX_PATH:
        path = path[np.linspace(0, len(path) - 1, MAX_PATH).astype(np.int64)]
    scale, coded = _coded(path)
    return _header(PATH, agent, len(path), scale) + coded


def tiles_message(cell_m: float, tiles: tuple[GridTile, ...]) -> bytes:
    """Tiles of the grid."""
    places = np.array([(t.column, t.row) for t in tiles], "<i4").reshape(-1, 2)
    return _header(TILES, 0, len(tiles), cell_m) + places.tobytes() + b"".join(t.cells.tobytes() for t in tiles)


def _header(kind: int, agent: int, n: int, scale: float) -> bytes:
    return struct.pack("<BBHIfI", kind, agent, 0, n, scale, 0)


def _coded(points: F64) -> tuple[float, bytes]:
    scale = float(np.float32(max(float(np.abs(points).max()) if len(points) else 0.0, 1.0) / 32766.0))
    return scale, np.rint(points / scale).astype("<i2").tobytes()
