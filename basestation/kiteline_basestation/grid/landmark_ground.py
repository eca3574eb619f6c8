"""The height of the ground below keyframes without scans, by what their landmarks show and those of others around.

Of a room full of furniture one camera may see the tops of boxes long before it sees the floor. Ground is a plane that
landmarks lie on, many more than just above it, and nearly none below. It is believed where keyframes at two places
agree on it, its landmarks are spread wider than a table, and no others were seen lower; what is believed tells the
height for keyframes near, too.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from kiteline_core.arrays import F64, I64, Bool
from kiteline_core.ids import KeyframeId

_LEAST_POINTS = 8  # landmarks on a plane that is ground
_STRAYS = 4  # landmarks below it that refute it, at least: up to three in a view are errors ...
_STRAY_SHARE = 0.02  # ... or this share of those below the camera
_LYING = 2.0  # landmarks of ground for each one as far above it as these are thick: walls down to an edge have 1
_FALL = 0.06  # m a m by which ground may fall away from the camera
_KNOWN_WITHIN_M = 8.0  # m from a keyframe that shows the ground, within which its height is known
_NEAREST = 20  # such keyframes whose median is the height of the ground
_MOST_VIEWS, _MOST_TOLD = 128, 64  # nearest keyframes that are compared, and that are told of: 3 ms
_REFUTED = 2  # views of something lower, until the ground is no ground: one may be an error
_LOWER_M = 0.25  # m below the ground from which landmarks refute it, in other views
_CLIMB = 0.1  # m a m that the ground may climb from one keyframe to another: ramps and hills
_AGREE_M, _MOST_CLIMB_M = 0.1, 0.15  # m by which two views of one ground may differ, and by climbing at most
_APART_M = 0.1  # m between two cameras that saw the same ground, at least
_WIDTH_M = 3.0  # m; diameter of a disc over which ground is spread as widely: tables are narrower
_SLOPE_PRIOR_M = 0.3  # m; a plane whose points are spread less stays level
_FIT_M = 0.05  # m; half weight of a point in the fit of a plane
_FIT_ROUNDS = 3


class GroundView(NamedTuple):
    """What the landmarks around a keyframe show of the ground, in metres of the time when it was made.

    plane: (3,) height of the ground below the camera (negative), its slopes ahead and to the left; None: none seen.
    lowest_m: depth below the camera that landmarks reach, less what ground may fall; NaN without any. centre_k: (3,)
    middle of the ground's landmarks in the camera; spread_m2: their mean squared distance from it. unit_m: metres in a
    unit of the keyframe's submap.
    """

    plane: F64 | None
    lowest_m: float
    centre_k: F64
    spread_m2: float
    unit_m: float


def view_of(local: F64, ground: Bool, band_m: F64, R_c_l: F64, unit_m: float) -> GroundView:
    """What landmarks show of the ground. local: (n,3) about the camera, x ahead, z up. ground: (n,) those that may lie
    on it, within band_m (n,). R_c_l: (3,3) rotation of `local` into the camera.
    """
    below = local[:, 2] < 0.0
    least = max(_STRAYS, int(_STRAY_SHARE * np.count_nonzero(below)))
    reach = np.sort(local[below, 2] + _FALL * np.hypot(local[below, 0], local[below, 1]))
    lowest_m = -float(reach[least - 1]) if len(reach) >= least else float("nan")
    on = local[ground]
    if len(on) >= _LEAST_POINTS:
        centre = on.mean(0)
        spread = float(np.mean(np.sum((on - centre)[:, :2] ** 2, axis=1)))
        for most_slope in (0.0, 1.0):  # a level plane if one will do: the height below the camera is extrapolated
            plane = _fit(on, most_slope)
            bands = (local[:, 2] - (plane[0] + local[:, :2] @ plane[1:])) / band_m
            strays = np.count_nonzero(below & (bands < -1.0))
            lying, standing = np.count_nonzero(np.abs(bands) <= 0.5), np.count_nonzero(np.abs(bands - 1.0) < 0.5)
            if plane[0] < 0.0 and strays < least and lying > _LYING * standing:
                return GroundView(plane, lowest_m, R_c_l @ centre, spread, unit_m)
    return GroundView(None, lowest_m, np.zeros(3), 0.0, unit_m)


def _fit(points: F64, most_slope: float) -> F64:
    """z at the origin and slopes (3,) of a plane through points (n,3), by Cauchy's weights."""
    middle = points[:, :2].mean(0)
    rows = np.column_stack([np.ones(len(points)), most_slope * (points[:, :2] - middle)])
    weight = np.ones(len(points))
    plane = np.zeros(3)
    for _ in range(_FIT_ROUNDS + 1):
        prior = np.diag([0.0, _SLOPE_PRIOR_M**2, _SLOPE_PRIOR_M**2]) * weight.sum()
        plane = np.linalg.solve((rows * weight[:, None]).T @ rows + prior, (rows * weight[:, None]).T @ points[:, 2])
        weight = 1.0 / (1.0 + ((points[:, 2] - rows @ plane) / _FIT_M) ** 2)
    slopes = most_slope * plane[1:]
    return np.array([plane[0] - middle @ slopes, *slopes])


class LandmarkGround:
    """Views of the ground by keyframe, and the heights that they tell."""

    def __init__(self) -> None:
        self._views: dict[KeyframeId, GroundView] = {}

    def put(self, keyframe: KeyframeId, view: GroundView) -> None:
        """Take what a keyframe shows, in place of what it showed before."""
        self._views[keyframe] = view

    def remove(self, keyframe: KeyframeId) -> None:
        """Forget a keyframe."""
        self._views.pop(keyframe, None)

    def __contains__(self, keyframe: KeyframeId) -> bool:
        return keyframe in self._views

    def heights(self, position: F64, keyframes: Sequence[KeyframeId], S_w_k: F64) -> dict[KeyframeId, F64 | None]:
        """The ground (3,) below the keyframes nearest to a position (3,), as in `GroundView.plane`; None: unknown.

        keyframes: of one map, with a view. S_w_k: (n,4,4) their poses, z up.
        """
        apart = np.linalg.norm(S_w_k[:, :3, 3] - position, axis=1)
        chosen = np.argsort(apart, kind="stable")[:_MOST_VIEWS]
        chosen = chosen[apart[chosen] <= 2.0 * _KNOWN_WITHIN_M]
        if not len(chosen):
            return {}
        near = [keyframes[i] for i in chosen.tolist()]
        around = _Around.of(near, [self._views[k] for k in near], S_w_k[chosen])
        return around.heights(min(_MOST_TOLD, int(np.count_nonzero(apart[chosen] <= _KNOWN_WITHIN_M))))


class _Around(NamedTuple):
    """Views (n,). camera, centre: (n,3) in w. scale: (n,) lengths in w of their metres. foot: (n,) z of the ground, NaN
    without. low, spread: (n,).
    """

    keyframes: Sequence[KeyframeId]
    planes: list[F64 | None]
    scale: F64
    camera: F64
    centre: F64
    foot: F64
    low: F64
    spread: F64

    @classmethod
    def of(cls, keyframes: Sequence[KeyframeId], views: Sequence[GroundView], S_w_k: F64) -> "_Around":
        """Views at these poses (n,4,4)."""
        unit_m = np.array([view.unit_m for view in views])
        scale = np.cbrt(np.linalg.det(S_w_k[:, :3, :3])) / unit_m
        camera, planes = S_w_k[:, :3, 3], [view.plane for view in views]
        centre_k = np.array([view.centre_k for view in views]) / unit_m[:, None]
        return cls(
            keyframes, planes, scale, camera, (S_w_k[:, :3, :3] @ centre_k[:, :, None])[:, :, 0] + camera,
            camera[:, 2] + scale * np.array([np.nan if plane is None else plane[0] for plane in planes]),
            camera[:, 2] - scale * np.array([view.lowest_m for view in views]),
            scale**2 * np.array([view.spread_m2 for view in views]),
        )  # fmt: skip

    def heights(self, first: int) -> dict[KeyframeId, F64 | None]:
        """The ground below the first keyframes."""
        across = np.linalg.norm(self.camera[:, None, :2] - self.camera[None, :, :2], axis=2)
        apart = np.hypot(across, self.camera[:, None, 2] - self.camera[None, :, 2])
        believed = self._believed(across, apart)
        out: dict[KeyframeId, F64 | None] = {}
        for i in range(first):
            near = believed[apart[i, believed] <= _KNOWN_WITHIN_M]
            near = near[np.argsort(apart[i, near], kind="stable")[:_NEAREST]]
            drop = self.camera[i, 2] - float(np.median(self.foot[near])) if len(near) else 0.0
            plane = self.planes[i]
            slopes = plane[1:] if plane is not None and i in near else np.zeros(2)
            out[self.keyframes[i]] = np.array([-drop / self.scale[i], *slopes]) if drop > 0.0 else None
        return out

    def _believed(self, across: F64, apart: F64) -> I64:
        """Rows of the views whose ground is believed. across, apart: (n,n) distances of cameras, level and in space."""
        with np.errstate(invalid="ignore"):  # comparisons with NaN are false
            lower = self.foot[:, None] - self.low[None, :] > _LOWER_M + _CLIMB * across
            above = self.camera[None, :, 2] > self.foot[:, None]  # a camera in the storey below says nothing
            seen = np.isfinite(self.foot) & ((lower & above).sum(1) < _REFUTED)
            level = np.abs(self.foot[:, None] - self.foot[None, :]) <= _AGREE_M + np.minimum(
                _CLIMB * across, _MOST_CLIMB_M
            )
        same = level & (apart <= _KNOWN_WITHIN_M) & seen[None, :]
        moved = (same & (apart >= _APART_M)).any(1)
        n = np.maximum(same.sum(1), 1)
        x, y = self.centre[:, 0], self.centre[:, 1]
        square = same @ (x**2 + y**2 + self.spread) / n - (same @ x / n) ** 2 - (same @ y / n) ** 2
        return np.flatnonzero(seen & moved & (8.0 * square >= _WIDTH_M**2))
