"""Messages to the status page: JSON for texts and numbers, binary for the map. Pure.

A binary message starts with 16 bytes, little endian: kind u8, agent u8, 0 u16, n u32, scale f32, 0 u32. Then by kind:
1 points: int16 (n,3) times scale = metres in w, uint8 (n) labels.
2 tiles: int32 (n,2) column, row; int8 (n,64,64): -1 unknown, 0 free, else occupied; scale is the side of a cell in m.
3 path of an agent's keyframes: int16 (n,3) times scale = metres in w; -32768 where it is interrupted.
"""

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np

from kiteline_basestation.grid.grid_view import GridView
from kiteline_basestation.grid.tile_store import Place
from kiteline_basestation.web.numbers import AGENT_COUNTS, TOTALS, as_json
from kiteline_basestation.web.snapshot import AgentStatus, PageSnapshot
from kiteline_core.arrays import F64, I16, U8

POINTS, TILES, PATH = 1, 2, 3  # kinds of binary messages

MAX_POINTS = 12_000  # more than a screen can resolve; 84 kB a message
MAX_PATH = 4_000  # keyframes of a path
FRESH_S = 1.5  # s since the last packet: a heartbeat a second, and half of one late
LOST_S = 10.0  # s since the last packet: by then a reconnecting link would be back

_S = 1e-9  # s in a ns
_INTERRUPTED = -32768  # of a path: no position, and no line to it


def status(now: PageSnapshot, before: PageSnapshot | None = None) -> dict[str, Any]:
    """The page's texts and numbers as JSON types. before: an older snapshot, for byte rates."""
    older = {a.agent: a for a in before.agents} if before is not None else {}
    span_s = (now.now_ns - before.now_ns) * _S if before is not None else 0.0
    return {
        "up_s": _rounded((now.now_ns - now.started_ns) * _S, 1),
        "agents": [_agent(a, older.get(a.agent), now.now_ns, span_s) for a in now.agents],
        "totals": as_json(TOTALS, now),
        "troubles": list(now.troubles),
        "unit": _unit(now.own_unit),
        "other_storeys": now.grid.others,
        "map_revision": now.map_revision,
    }


def _agent(a: AgentStatus, before: AgentStatus | None, now_ns: int, span_s: float) -> dict[str, Any]:
    silent_s = None if a.last_packet_ns is None else (now_ns - a.last_packet_ns) * _S
    pose = a.T_w_c if a.T_w_c is not None and bool(np.isfinite(a.T_w_c).all()) else None
    up = down = None
    if before is not None and span_s > 0:
        up = round((a.bytes_up - before.bytes_up) / span_s)
        down = round((a.bytes_down - before.bytes_down) / span_s)
    link = link_state(silent_s)
    heard = link in ("live", "quiet")  # what was long ago says nothing of now
    return {
        "agent": int(a.agent),
        "link": link,
        "silent_s": None if silent_s is None else _rounded(silent_s, 1),
        "quality": int(a.quality) if a.quality is not None and heard else None,
        "position": None if pose is None else [_rounded(float(v), 3) for v in pose[:3, 3]],
        "heading_deg": None if pose is None else _heading_deg(pose),
        "unit": _unit(a.own_unit),
        "counts": as_json(AGENT_COUNTS, a),
        "bytes_up": a.bytes_up,
        "bytes_down": a.bytes_down,
        "rate_up": up,
        "rate_down": down,
    }


def _unit(own: bool) -> str:
    """Name of a unit of length, as in the replies to `kiteline maps`."""
    return "own" if own else "metre"


def link_state(silent_s: float | None) -> str:
    """State of the link: never, live, quiet or lost. silent_s: s since the last packet, None without any."""
    if silent_s is None:
        return "never"
    return "live" if silent_s < FRESH_S else "quiet" if silent_s < LOST_S else "lost"


def _heading_deg(pose: F64) -> float:
    """Heading of the camera (of its image's top if it looks down) from x of w to the left, degrees."""
    axis = pose[:2, 2] if np.hypot(pose[0, 2], pose[1, 2]) > 0.1 else -pose[:2, 1]
    return _rounded(float(np.degrees(np.arctan2(axis[1], axis[0]))), 1)


def _rounded(value: float, digits: int) -> float:
    return round(value, digits) + 0.0


def map_messages(now: PageSnapshot) -> list[bytes]:
    """Paths and points."""
    out = [path_message(a.agent, a.path) for a in now.agents]
    out.append(points_message(now.points, now.labels))
    return out


def points_message(points: F64, labels: U8) -> bytes:
    """Landmark positions (m,3), evenly thinned to MAX_POINTS; those that are not finite are left out."""
    keep = np.flatnonzero(np.isfinite(points).all(axis=1))
    if len(keep) > MAX_POINTS:
        keep = keep[np.linspace(0, len(keep) - 1, MAX_POINTS).astype(np.int64)]
    scale, coded = _coded(points[keep])
    return _header(POINTS, 0, len(keep), scale) + coded.tobytes() + labels[keep].astype(np.uint8).tobytes()


def path_message(agent: int, path: F64) -> bytes:
    """Positions (k,3) of an agent's keyframes, evenly thinned to MAX_PATH; interrupted where they are not finite."""
    lost = np.asarray(~np.isfinite(path).all(axis=1))
    if len(path) > MAX_PATH:
        kept = lost.copy()
        kept[np.linspace(0, len(path) - 1, MAX_PATH).astype(np.int64)] = True
        path, lost = path[kept], lost[kept]
    scale, codes = _coded(np.where(lost[:, None], 0.0, path))
    codes[lost] = _INTERRUPTED
    return _header(PATH, agent, len(path), scale) + codes.tobytes()


def tiles_message(grid: GridView, places: Sequence[Place]) -> bytes:
    """Grid tiles; one that is gone as unknown."""
    tiles = [grid.tile(place) for place in places]
    where = np.array([(t.column, t.row) for t in tiles], "<i4").reshape(-1, 2)
    return _header(TILES, 0, len(tiles), grid.cell_m) + where.tobytes() + b"".join(t.cells.tobytes() for t in tiles)


def _header(kind: int, agent: int, n: int, scale: float) -> bytes:
    return struct.pack("<BBHIfI", kind, agent, 0, n, scale, 0)


def _coded(points: F64) -> tuple[float, I16]:
    scale = float(np.float32(max(float(np.abs(points).max()) if len(points) else 0.0, 1.0) / 32766.0))
    return scale, np.rint(points / scale).astype("<i2")
