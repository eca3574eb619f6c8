"""Read occupancy grids in the format of ROS's map_server: a YAML file and the PGM image that it names."""

import contextlib
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kiteline_core.arrays import F64, I8
from kiteline_core.errors import KitelineError

FREE, OCCUPIED, UNKNOWN = 0, 100, -1


class GridFileError(KitelineError):
    """A grid that cannot be read; the text says what was expected."""


@dataclass(frozen=True, slots=True)
class GridFile:
    """A map_server grid. state: (rows, columns) int8, 0 free, 100 occupied, -1 unknown; row 0 is the lowest y.
    origin: (x, y, yaw) of the lower left corner, m and rad.
    """

    cell_m: float
    origin: tuple[float, float, float]
    state: I8

    @property
    def T_map_cell(self) -> F64:
        """(3,3) from fractional cells (column, row, 1) to m."""
        x, y, yaw = self.origin
        c, s = np.cos(yaw) * self.cell_m, np.sin(yaw) * self.cell_m
        return np.array([[c, -s, x], [s, c, y], [0.0, 0.0, 1.0]])

    def cells(self, points: F64) -> F64:
        """Fractional cells (n,2), column and row, of points (n,2) in m."""
        T = np.linalg.inv(self.T_map_cell)
        return np.asarray(points @ T[:2, :2].T + T[:2, 2])

    def points(self, cells: F64) -> F64:
        """Points (n,2) in m of fractional cells (n,2), column and row."""
        return np.asarray(cells @ self.T_map_cell[:2, :2].T + self.T_map_cell[:2, 2])


def read_grid(path: Path) -> GridFile:
    """Read a map_server YAML file and its PGM image (P2 or P5). Raises GridFileError."""
    try:
        lines = path.read_text(encoding="utf-8", errors="surrogateescape").split("\n")
    except OSError as e:
        raise GridFileError(f"{path}: {e.strerror}; expected the YAML file of a grid") from None
    fields = {k.strip(): _value(v) for k, colon, v in (line.partition(":") for line in lines) if colon and "#" not in k}
    missing = [k for k in ("image", "resolution", "origin") if not fields.get(k)]
    if missing:
        raise GridFileError(f"{path}: no {', '.join(missing)}; expected map_server's image, resolution and origin")
    try:
        cell_m = float(fields["resolution"])
        origin = tuple(float(v) for v in fields["origin"].strip("[]").split(","))
        negate = int(fields.get("negate", "0"))
        occupied, free = float(fields.get("occupied_thresh", "0.65")), float(fields.get("free_thresh", "0.196"))
    except ValueError as e:
        raise GridFileError(f"{path}: {e}; expected numbers as map_server writes them") from None
    if len(origin) != 3 or not cell_m > 0:
        raise GridFileError(f"{path}: expected a positive resolution and an origin [x, y, yaw]")
    shade = read_pgm(path.parent / fields["image"])
    solid = shade if negate else 1.0 - shade
    state = np.full(solid.shape, -1, np.int8)
    state[solid < free] = 0
    state[solid > occupied] = 100
    return GridFile(cell_m, (origin[0], origin[1], origin[2]), np.ascontiguousarray(state[::-1]))


def _value(text: str) -> str:
    """The value of a line, without quotes and without a comment."""
    text = text.strip()
    if text.startswith('"'):
        with contextlib.suppress(ValueError):
            value, _ = json.JSONDecoder().raw_decode(text)
            return str(value)
    return text.split("#")[0].strip().strip("'\"")


def read_pgm(path: Path) -> F64:
    """A PGM image (P2 or P5, at most 16 bits) as (rows, columns), 0 black to 1 white. Raises GridFileError."""
    try:
        data = path.read_bytes()
    except OSError as e:
        raise GridFileError(f"{path}: {e.strerror or e}") from None
    words: list[bytes] = []
    at = 0
    while len(words) < 4 and at < len(data):  # the header: four words, with comments between them
        end = at
        while end < len(data) and not data[end : end + 1].isspace() and data[end : end + 1] != b"#":
            end += 1
        if end > at:
            words.append(data[at:end])
        if data[end : end + 1] == b"#":
            end = data.find(b"\n", end)
            end = len(data) if end < 0 else end
        at = end + 1
    try:
        kind, columns, rows, most = words[0], int(words[1]), int(words[2]), int(words[3])
        if kind not in (b"P2", b"P5") or columns < 1 or rows < 1 or not 0 < most < 65536:
            raise ValueError
        if kind == b"P2":
            values = np.array(data[at:].split(), np.float64)[: rows * columns]
        else:
            values = np.frombuffer(data, ">u2" if most > 255 else "u1", rows * columns, at).astype(np.float64)
        return values.reshape(rows, columns) / most
    except (ValueError, IndexError):
        raise GridFileError(f"{path}: no complete PGM image (P2 or P5)") from None


def planar(x_m: float, y_m: float, yaw_deg: float) -> F64:
    """(3,3) planar motion."""
    c, s = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    return np.array([[c, -s, x_m], [s, c, y_m], [0.0, 0.0, 1.0]])
