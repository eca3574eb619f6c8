"""Knows how high the ground lies, by the scans of a flight, and which of these scans may be believed."""

from collections import deque
from dataclasses import dataclass, replace
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.ground.column_scan import ColumnScan, level_rotation
from kiteline_core.ground.segmentation import EXPECTED_M, LOWER_M, ExpectedGround

Tag = TypeVar("Tag")

_HELD = 16  # scans that wait until the height is known
_BELIEVED = 64  # newest ones that can be withdrawn
_LOW = 32  # newest ones whose lowest points count
_REFUTED = 2  # views of something lower, until the ground is no ground: one may be an error
_CLIMB = 0.1  # m a m that the ground may climb from one scan to another: ramps and hills
_MOST_CLIMB_M = 0.15  # m that the ground may climb from one scan to another, at most: boxes are higher
_AGREEING_M = 0.1  # m between two cameras that saw the same ground, at least, until it is believed
_GROUND_WIDTH_M = 3.0  # m that ground is wide before it is believed: tables are narrower
_KNOWN_FOR_M = 8.0  # m of flight without a view of the ground after which its height is unknown
_OTHER_VERTICAL = 0.06  # rad from one scan to the next: it was not known before, and heights were 0.2 m off at 3 m


class Seen(NamedTuple):
    """What `GroundSegmenter` saw in one image.

    T_o_c: (4,4) of its camera in a frame that does not jump. ground: whether the scan saw ground. lowest_m: depth below
    the camera that many pixels reach, less what ground may fall; NaN if it is not known.
    """

    T_o_c: F64
    scan: ColumnScan
    ground: bool
    lowest_m: float


class Verdict(NamedTuple, Generic[Tag]):
    """Tags of scans that are believed from now on, and of those that are not any more."""

    believed: list[Tag]
    withdrawn: list[Tag]


@dataclass(frozen=True, slots=True)
class _Place(Generic[Tag]):
    """A scan. camera, foot: (3,) in o, foot on the ground below the camera. ends: (n,3) of its free ground."""

    tag: Tag
    camera: F64
    foot: F64
    ends: F64


class GroundHeight(Generic[Tag]):
    """The height of the ground near the vehicle, unknown until scans from two places agree and none saw lower.

    A box or a table that is all that was seen of a room looks like its floor. Scans are held back until the ground that
    they saw is known to be as wide as no table is, and are withdrawn if something lower appears.
    """

    def __init__(self) -> None:
        self._foot: F64 | None = None  # (3,) in o, of the ground that was seen last
        self._up: F64 | None = None  # (3,) in o, the vertical of the newest scan
        self._refuted = 0
        self._lower = 0  # newest scans that saw ground below the foot, and none as high
        self._held: deque[_Place[Tag]] = deque(maxlen=_HELD)
        self._believed: deque[_Place[Tag]] = deque(maxlen=_BELIEVED)
        self._low: deque[F64] = deque(maxlen=_LOW)  # (3,) in o: the ground lies no higher

    def start_at(self, foot: F64) -> None:
        """Begin with a known point (3,) of the ground in o."""
        self._foot = foot

    def expected(self, T_o_c: F64, up_c: F64) -> ExpectedGround | None:
        """Where the ground lies below a camera; None if that is not known."""
        if self._foot is None:
            return None
        along, across = _apart(T_o_c[:3, 3], self._foot, T_o_c[:3, :3] @ up_c)
        if across > _KNOWN_FOR_M:
            self._foot = None
            return None
        return ExpectedGround(along, self._level_m(across))

    def note(self, tag: Tag, seen: Seen) -> Verdict[Tag]:
        """Take in a scan that was made with the height of `expected`."""
        scan, T = seen.scan, seen.T_o_c
        up = T[:3, :3] @ scan.up_c
        before, self._up = self._up, up
        if before is not None and float(before @ up) < np.cos(_OTHER_VERTICAL):
            return Verdict([], self._begin_anew())
        camera = T[:3, 3].copy()
        low = camera - seen.lowest_m * up
        if np.isfinite(seen.lowest_m):
            self._low.append(low)
            if self._foot is not None:
                self._refuted = self._refuted + 1 if self._is_above(self._foot, low, up) else 0
                if self._refuted >= _REFUTED:
                    self._foot = None
                    return Verdict([], self._withdraw(up))
        if np.isnan(scan.camera_height_m):
            return Verdict([], [])
        foot = camera - scan.camera_height_m * up
        place = _Place(tag, camera, foot, _ends(T, scan))
        if self._foot is not None:
            if not self._is_level(foot, self._foot, up):
                lower = seen.ground and float((self._foot - foot) @ up) > 0.0
                self._lower = self._lower + 1 if lower else 0
                if self._lower >= _REFUTED:  # a step down, or the height was a little too large from the start
                    self._foot = None
                return Verdict([], [])
            self._lower = 0
            if seen.ground:
                self._foot = foot
            self._believed.append(place)
            return Verdict([tag], [])
        if self._is_above(foot, low, up) or self._too_high(foot, up):
            return Verdict([], [])
        self._held.append(place)
        same = [
            other for other in self._held if self._is_level(other.foot, foot, up) and not self._too_high(other.foot, up)
        ]
        ends = np.concatenate([other.ends for other in same])
        moved_m = max(float(np.linalg.norm(other.camera - camera)) for other in same)
        if moved_m < _AGREEING_M or _width(ends, up) < _GROUND_WIDTH_M:
            return Verdict([], [])
        self._foot, self._refuted, self._lower = foot, 0, 0
        self._held.clear()
        withdrawn = self._withdraw(up)
        self._believed.extend(same)
        return Verdict([other.tag for other in same], withdrawn)

    def _begin_anew(self) -> list[Tag]:
        """Forget all that was seen. Returns the tags of scans that were believed."""
        tags = [place.tag for place in self._believed]
        self._foot = None
        for seen in (self._held, self._believed, self._low):
            seen.clear()
        return tags

    def _withdraw(self, up: F64) -> list[Tag]:
        """Forget scans whose ground lies above what was seen. Returns their tags."""
        high = [place for place in self._believed if self._too_high(place.foot, up)]
        self._believed = deque((p for p in self._believed if not any(p is h for h in high)), maxlen=_BELIEVED)
        return [place.tag for place in high]

    def _too_high(self, foot: F64, up: F64) -> bool:
        """True if points were seen lower than this ground, in several images."""
        return sum(self._is_above(foot, low, up) for low in self._low) >= _REFUTED

    def _is_above(self, foot: F64, low: F64, up: F64) -> bool:
        along, across = _apart(foot, low, up)
        return along > LOWER_M + _CLIMB * across

    def _is_level(self, a: F64, b: F64, up: F64) -> bool:
        along, across = _apart(a, b, up)
        return abs(along) <= self._level_m(across)

    def _level_m(self, across_m: float) -> float:
        """By how much heights of ground may differ over a distance."""
        return EXPECTED_M + min(_CLIMB * across_m, _MOST_CLIMB_M)


def without_ground(scan: ColumnScan) -> ColumnScan:
    """A scan of which only the line of sight at the camera's height is believed."""
    n = len(scan)
    return replace(
        scan, free_from_m=np.zeros(n), free_m=np.zeros(n), obstacle_m=np.full(n, np.inf), bands=np.zeros(n, np.uint8),
        camera_height_m=float("nan"),
    )  # fmt: skip


def _apart(a: F64, b: F64, up: F64) -> tuple[float, float]:
    """How far point a lies above b, and how far beside it."""
    apart = a - b
    along = float(apart @ up)
    return along, float(np.linalg.norm(apart - along * up))


def _ends(T_o_c: F64, scan: ColumnScan) -> F64:
    """Where free ground begins and ends (n,3), in o."""
    seen = scan.free_m > 0.0
    azimuth, height = np.tile(scan.azimuths_rad[seen], 2), scan.camera_height_m
    range_m = np.concatenate([scan.free_from_m[seen], scan.free_m[seen]])
    points = np.column_stack([range_m * np.cos(azimuth), range_m * np.sin(azimuth), np.full(len(azimuth), -height)])
    return points @ (T_o_c[:3, :3] @ level_rotation(scan.up_c)).T + T_o_c[:3, 3]


def _width(points: F64, up: F64) -> float:
    """Twice the distance of the outermost point (n,3) from the middle, seen from above."""
    if not len(points):
        return 0.0
    apart = points - points.mean(0)
    return 2.0 * float(np.linalg.norm(apart - np.outer(apart @ up, up), axis=1).max())
