"""What stands around the vehicle at its height: its own newest scans, and the base's grid where those saw nothing."""

import operator
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from kiteline_agent.scan_config import LocalGridConfig
from kiteline_agent.scans import local_grid_kernels as kernels
from kiteline_agent.scans.range_error import RangeError
from kiteline_agent.scans.scan_stage import Scanned
from kiteline_codec.schema import GridTile
from kiteline_codec.schema.base.grid_tile import FREE, TILE_CELLS
from kiteline_core.arrays import F64, I8
from kiteline_core.ground.column_scan import ColumnScan, level_rotation
from kiteline_core.ground.config import GroundConfig

SECTORS = 72  # of 5 degrees
_CELLS = 512  # along each side of the local grid
_WINDOW = 512  # the same of the tiles around the vehicle
_MOST_DRAWN = 8000  # scans between two drawings of all: marks are 16-bit numbers
_RAYS = 5  # in each sector
_IN_A_FRAME = 8  # scans that are drawn again in a frame: 1 ms
_NONE: I8 = np.zeros((0, 0), np.int8)
_WORSE = 2.0  # times `level_rad` of a scan's vertical from which it is left out: 0.2 m of height at 3 m
_LEAST_HEADING = 0.3  # horizontal part of the vehicle's forward axis: less has no heading
_NEAR_M = 2.0  # m; nearer obstacles are told even if something before them is unknown
_DOUBT_PX = 0.3  # px; deviation of disparities from which tiles of the base do not count: 6 cm at 3 m
_GAP_M = 1.0  # m along a ray that may be unknown before an obstacle is told: a turn between two scans
_LEVEL_RAD = 0.03  # rad; error of the vertical from which scans are levelled again: 0.1 m of height at 3 m
LOST_S = 0.3  # s without a pose after which scans are forgotten: 0.15 m at a change of speed by 3 m/s^2


@dataclass(slots=True)
class _Drawn:
    """A scan in the grid's axes.

    x_m, y_m, z_m: of its camera. heading: of its azimuth 0. up: (3,) the vertical that it was made with. offset_px: see
    `Scanned`.
    """

    x_m: float
    y_m: float
    z_m: float
    heading: float
    up: F64
    scan: ColumnScan
    offset_px: F64
    _ranges: tuple[RangeError, F64, F64] | None = None  # what `ranges` returned last, and by which error

    @staticmethod
    def of(p: F64, ahead: F64, up: F64, scan: ColumnScan, offset_px: F64) -> "_Drawn":
        """That of a camera at p (3,) whose azimuth 0 lies towards ahead (3,)."""
        heading = float(np.arctan2(ahead[1], ahead[0]))
        return _Drawn(float(p[0]), float(p[1]), float(p[2]), heading, up, scan, offset_px)

    def ranges(self, error: RangeError, sigma_m: float) -> tuple[F64, F64]:
        """See `RangeError.ranges`. A scan is drawn again and again."""
        if self._ranges is None or self._ranges[0] is not error:
            self._ranges = error, *error.ranges(self.scan, self.offset_px, sigma_m)
        return self._ranges[1:]

    def turned(self, R: F64) -> "_Drawn":
        """The same in axes turned by R (3,3)."""
        ahead = np.array([np.cos(self.heading), np.sin(self.heading), 0.0])
        return _Drawn.of(R @ [self.x_m, self.y_m, self.z_m], R @ ahead, R @ self.up, self.scan, self.offset_px)


@dataclass(frozen=True, slots=True)
class Surroundings:
    """Distances (SECTORS,) in m to obstacles in sectors clockwise from ahead; inf: none up to reach_m, nan: unknown."""

    distance_m: F64
    reach_m: float

    @property
    def nearest(self) -> tuple[float, float] | None:
        """Distance in m and direction in rad, clockwise from ahead, of the nearest obstacle; None without one."""
        finite = np.where(np.isfinite(self.distance_m), self.distance_m, np.inf)
        k = int(np.argmin(finite))
        if not np.isfinite(finite[k]):
            return None
        turn = 2.0 * np.pi * k / SECTORS
        return float(finite[k]), turn if turn <= np.pi else turn - 2.0 * np.pi

    @property
    def line(self) -> str:
        """The nearest obstacle, for the log."""
        unknown = 100.0 * float(np.isnan(self.distance_m).mean())
        if self.nearest is None:
            return f"nearest obstacle: none seen, {unknown:.0f} % unknown"
        distance_m, turn_rad = self.nearest
        turn_deg = round(float(np.degrees(turn_rad)))
        side = f"{abs(turn_deg)} degrees {'right' if turn_deg > 0 else 'left'}"
        where = {0: "ahead", 180: "behind"}.get(abs(turn_deg), side)
        return f"nearest obstacle: {distance_m:.2f} m {where}, {unknown:.0f} % unknown"


class _Canvas:
    """Cells that scans are drawn into, about a place and at a height. number: of the last; fits: to what is known."""

    def __init__(self) -> None:
        self.cells: I8 = np.zeros((_CELLS, _CELLS), np.int8)
        self.marks = np.zeros((_CELLS, _CELLS), np.int16)
        self.begin(np.zeros(2), 0.0)
        self.fits = False

    def begin(self, corner: F64, z_m: float) -> None:
        """Clear it. corner: in m; z_m: height at which scans are drawn."""
        self.cells[:], self.marks[:] = 0, 0
        self.corner, self.z_m, self.number = corner, z_m, 0


class LocalGrid:
    """The newest scans in a grid about the vehicle, in the odometry frame levelled by gravity: no correction moves it.

    Takes 1.8 MB. A scan is drawn when it comes, as far as its ranges are sure. When the camera has moved on or climbed,
    or more is known of the errors of ranges, all are drawn again on another canvas, some in each frame.
    """

    def __init__(self, config: LocalGridConfig, sight_m: float = GroundConfig().slab_m) -> None:
        """sight_m: above and below the camera that a scan's line of sight covers."""
        self._config, self._sight_m = config, sight_m
        self._error: RangeError | None = None  # by which scans are drawn
        self._told: RangeError | None = None  # the last one that `follow` was given
        self._sure_scans = config.scans  # in a row, since the rig was in doubt
        self._canvas, self._next = _Canvas(), _Canvas()  # the latter while scans are drawn again
        self._again: deque[_Drawn] | None = None  # scans that are still to be drawn on it; None: it is not in use
        self._window: I8 = np.zeros((_WINDOW, _WINDOW), np.int8)
        self._window_of: tuple[object, ...] = ()
        self._window_tiles: tuple[GridTile, ...] = ()  # kept, so that no new tile takes the place of one in memory
        self._scans: deque[_Drawn] = deque(maxlen=config.scans)
        self._repeats = 0  # of the newest ones: of the same view
        self._R_g_o: F64 | None = None
        self._ground_m: float | None = None  # z of the ground; None while it is not known

    def add(self, scanned: Scanned, error: RangeError) -> None:
        """Draw a new scan. error: of the ranges of all scans, as it is known now."""
        self._sure_scans += not scanned.repeats  # those in doubt leave with other views
        self._take(error)
        T, scan = scanned.T_o_c, scanned.scan
        R_l_o = level_rotation(scan.up_c).T @ T[:3, :3].T
        if self._R_g_o is None or float(self._R_g_o[2] @ R_l_o[2]) < np.cos(_LEVEL_RAD):
            self._level(R_l_o)
        assert self._R_g_o is not None
        R = self._R_g_o
        drawn = _Drawn.of(R @ T[:3, 3], R @ R_l_o[0], R @ R_l_o[2], scan, scanned.offset_px)
        self._keep(drawn, scanned.repeats)
        self._ground_m = None if scanned.height_m is None else drawn.z_m - scanned.height_m
        self._draw(self._canvas, drawn)
        if self._again is not None:
            self._again.append(drawn)
        self._move_on(drawn.x_m, drawn.y_m, drawn.z_m)

    def _keep(self, drawn: _Drawn, repeats: bool) -> None:
        """Keep a scan; of the repeated ones of a view only the newest, so that other views are not forgotten."""
        if not repeats:
            self._repeats = 0
        elif self._repeats == self._config.repeats:
            del self._scans[-self._repeats]
        else:
            self._repeats += 1
        self._scans.append(drawn)

    def forget(self) -> None:
        """The camera has moved by an unknown way: what was seen before lies elsewhere in o."""
        self._scans.clear()
        self._repeats = 0
        self._clear()
        self._R_g_o = self._ground_m = None

    def _clear(self) -> None:
        self._canvas.begin(np.zeros(2), 0.0)
        self._canvas.fits, self._again = False, None

    def _level(self, R_g_o: F64) -> None:
        """Level the grid by a better vertical: in a flight that begins in motion it is known late.

        Scans that were made with a much worse one go: they took floor or ceiling for what stands at their height.
        """
        if self._R_g_o is not None:
            turn, least = R_g_o @ self._R_g_o.T, np.cos(_WORSE * _LEVEL_RAD)
            turned = (drawn.turned(turn) for drawn in self._scans)
            self._scans = deque((drawn for drawn in turned if drawn.up[2] >= least), maxlen=self._scans.maxlen)
            self._repeats = min(self._repeats, len(self._scans))
            self._clear()
        self._R_g_o = R_g_o

    def _take(self, error: RangeError) -> None:
        """Take over what is known of ranges."""
        if error.common_px > _DOUBT_PX or (self._error is not None and error.moved(self._error)):
            self._sure_scans = 0
        if self._error is None or error.differs(self._error):
            self._error, self._canvas.fits = error, False

    def follow(self, T_o_c: F64, error: RangeError | None = None) -> None:
        """Keep the grid about the camera, at T_o_c (4,4). Questions never move it: a replay asks fewer of them.

        error: see `add`; None: as before.
        """
        if error is not None and error is not self._told:
            self._told = error
            self._take(error)
        if self._R_g_o is not None:
            p = self._R_g_o @ T_o_c[:3, 3]
            self._move_on(float(p[0]), float(p[1]), float(p[2]))

    def around(
        self, T_o_f: F64, T_w_f: F64 | None, tiles: Mapping[tuple[int, int], GridTile], bands_m: tuple[float, ...]
    ) -> Surroundings | None:
        """Obstacles around the vehicle (forward, right, down) at T_o_f (4,4) in o, and T_w_f in w if that is known.

        bands_m: limits of the height bands of tiles. None without a scan or tile, and with the nose up or down.
        Tiles hold what was told of a rig that was in doubt: they count once as many scans as are kept were sure.
        """
        config = self._config
        tiles = tiles if self._sure_scans >= config.scans else {}
        if self._R_g_o is None and (not tiles or T_w_f is None):
            return None
        R = np.eye(3) if self._R_g_o is None else self._R_g_o
        p, ahead = R @ T_o_f[:3, 3], R @ T_o_f[:3, 0]
        if float(np.hypot(ahead[0], ahead[1])) < _LEAST_HEADING:
            return None
        canvas, window = self._canvas, _NONE
        own_at = np.array([*(p[:2] - canvas.corner), np.arctan2(ahead[1], ahead[0])])
        cell_m, tile_at = config.cell_m, np.zeros(3)
        if tiles and T_w_f is not None:
            cell_m, corner = self._place_window(T_w_f, tiles, self._bands_at(float(p[2]), bands_m))
            tile_at = np.array([*(T_w_f[:2, 3] - corner), np.arctan2(T_w_f[1, 0], T_w_f[0, 0])])
            window = self._window
        out = np.empty(SECTORS)
        climbed_m = abs(float(p[2]) - canvas.z_m)  # since the frame
        own = canvas.cells if climbed_m < config.slab_m + config.body_m else _NONE
        kernels.read_distances(
            own, canvas.marks, config.cell_m, own_at, window, cell_m, tile_at, config.vehicle_m, _GAP_M,
            _NEAR_M, config.reach_m, _RAYS, out,
        )  # fmt: skip
        return Surroundings(out, config.reach_m)

    def _bands_at(self, z_m: float, bands_m: tuple[float, ...]) -> int:
        """Mask of the height bands of tiles that a vehicle at z_m is in.

        None above the bands, and none where own scans lost the ground: what lies below would be told as ahead. All of a
        vehicle without scans, which never knows its height.
        """
        if self._ground_m is None:
            return 0 if self._scans else _mask(bands_m, None, self._config.body_m)
        height_m = z_m - self._ground_m
        return _mask(bands_m, height_m, self._config.body_m) if height_m <= bands_m[-1] else 0

    def _move_on(self, x_m: float, y_m: float, z_m: float) -> None:
        """Draw scans again about a place if the canvas does not fit it any more, as many as a frame has time for."""
        config, canvas = self._config, self._canvas
        if self._again is None:
            away_m = float(np.abs(canvas.corner + 0.5 * _CELLS * config.cell_m - [x_m, y_m]).max())
            near = away_m < 0.5 * _CELLS * config.cell_m - config.reach_m - 0.2
            fits = canvas.fits and near and abs(z_m - canvas.z_m) < config.slab_m and canvas.number < _MOST_DRAWN
            if fits:
                return
            self._next.begin(np.array([x_m, y_m]) - 0.5 * _CELLS * config.cell_m, z_m)
            self._again, canvas.fits = deque(self._scans), True
        drawn = 0
        while self._again and drawn < _IN_A_FRAME:
            drawn += self._draw(self._next, self._again.popleft())
        if not self._again:
            self._next.fits = canvas.fits  # unless more is known of ranges since
            self._canvas, self._next, self._again = self._next, canvas, None

    def _draw(self, canvas: _Canvas, drawn: _Drawn) -> bool:
        """Draw a scan, if it was made at about this height: what is clear a little higher may not be clear here.

        Returns whether it was drawn.
        """
        config, scan = self._config, drawn.scan
        assert self._error is not None
        away_m = abs(drawn.z_m - canvas.z_m)
        if away_m > config.body_m:
            return False
        canvas.number += 1
        clear_m, certain_m = drawn.ranges(self._error, config.sigma_m)
        seen_m = np.minimum(np.maximum(certain_m, _NEAR_M), config.reach_m)
        kernels.draw_rays(
            canvas.cells, canvas.marks, canvas.number, drawn.x_m - canvas.corner[0], drawn.y_m - canvas.corner[1],
            drawn.heading, scan.azimuths_rad, scan.azimuth_step_rad, clear_m, seen_m, config.cell_m,
            away_m <= self._sight_m - config.slab_m,
        )  # fmt: skip
        return True

    def _place_window(self, T_w_f: F64, tiles: Mapping[tuple[int, int], GridTile], mask: int) -> tuple[float, F64]:
        """Copy the tiles around the vehicle together, if they have changed. Returns size of a cell and corner in w."""
        first = next(iter(tiles.values()))
        cell_m = first.cell_m
        side_m = TILE_CELLS * cell_m
        column, row = (int(np.clip(v // side_m, -(1 << 23), 1 << 23)) for v in T_w_f[:2, 3])
        reach = _WINDOW // TILE_CELLS // 2
        window_of, held = (column, row, mask, cell_m), tuple(tiles.values())
        corner = np.array([column - reach, row - reach]) * side_m
        same = len(held) == len(self._window_tiles) and all(map(operator.is_, held, self._window_tiles))
        if same and window_of == self._window_of:
            return cell_m, corner
        self._window_of, self._window_tiles = window_of, held
        self._window[:] = 0
        for (c, r), tile in tiles.items():
            i, j = r - row + reach, c - column + reach
            if tile.cell_m != cell_m or not (0 <= i < 2 * reach and 0 <= j < 2 * reach):
                continue
            if not mask:
                continue
            solid = (tile.cells > FREE) & ((tile.cells & mask) > 0)
            values = np.where(solid, kernels.OCCUPIED, np.where(tile.cells == FREE, kernels.FREE, 0))
            self._window[i * TILE_CELLS : (i + 1) * TILE_CELLS, j * TILE_CELLS : (j + 1) * TILE_CELLS] = values
        return cell_m, corner


def _mask(bands_m: tuple[float, ...], height_m: float | None, slab_m: float) -> int:
    """Height bands that a vehicle at a height above the ground is in; all if that is unknown."""
    mask = 0
    for i in range(len(bands_m) - 1):
        low, high = bands_m[i], bands_m[i + 1]
        if height_m is None or (height_m + slab_m > low and height_m - slab_m < high):
            mask |= 1 << i
    return mask
