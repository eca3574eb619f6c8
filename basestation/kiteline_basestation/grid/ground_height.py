"""Estimates the ground height under a sparse map (z up) in patches, so that the ground may rise and tilt.

First the lowest peak of the height histogram below the cameras, propagated from the best patch to its neighbours; then
a plane for each patch, fitted to the points near it in narrowing bands (a hard-limited M-estimator).
"""

import numpy as np

from kiteline_basestation.grid import sparse_kernels as kernels
from kiteline_core.arrays import F32, F64, I64, Bool

_CAMERA_ABOVE_M = 0.1  # m; ground points are at least this far below every camera that observes them
_PATCH_M = 2.0  # m; side of a patch; three by three patches share their points
_HEIGHT_BIN_M = 0.05  # m; the points of a floor, with stereo noise, fill two or three bins
_SLOPE = 0.25  # m/m; steepest ground: a ramp, or a map whose z is 10 degrees off the vertical
_PEAK_SHARE = 0.25  # of the highest peak; the lowest peak with this share is the ground, below it is noise
_MIN_PEAK_POINTS = 4.0  # points of a peak
_PLANE_BANDS_M = (0.3, 0.2, 0.12, 0.1)  # m; half-widths around the plane, from a bin's error to noise
_KNOWN_BANDS = 2  # of these that ground which is known about does not need
_MIN_PLANE_POINTS = 12.0  # points that a patch needs for a fit of its plane
_SLOPE_PRIOR_M = 0.3  # m; points with less horizontal spread than this leave the slope near zero


def ground_heights(points: F64, camera_z: F64, plane: F64 | None = None) -> F64:
    """z of the ground at each point (n,). points: (n,3) in w. camera_z: (n,) z of the lowest camera that observes it.

    plane: (3,) z at x = y = 0 and slopes along x and y of ground that is known about; None: the lowest peaks tell.
    NaN at all points if the histogram of heights below the cameras has no peak.
    """
    below = points[:, 2] < camera_z - _CAMERA_ABOVE_M
    patches = _Patches(_PATCH_M, points)
    bands_m: tuple[float, ...] = _PLANE_BANDS_M
    if plane is not None:
        planes, bands_m = patches.of_plane(plane), _PLANE_BANDS_M[_KNOWN_BANDS:]
    else:
        ground_z = _lowest_peaks(patches, points[:, 2], below)
        if ground_z is None:
            return np.full(len(points), np.nan)
        planes = np.stack([ground_z, np.zeros_like(ground_z), np.zeros_like(ground_z)])
    for band_m in bands_m:
        near = below & (np.abs(points[:, 2] - patches.heights(planes)) < band_m)
        planes = _fit(patches, points[:, 2], near, planes)
    return patches.heights(planes)


class _Patches:
    """Points in square patches of the x-y plane."""

    def __init__(self, side_m: float, points: F64) -> None:
        self.corner: F64 = points[:, :2].min(axis=0)
        self.side_m = side_m
        self.xy = points[:, :2] - self.corner
        self.at = np.asarray((self.xy // side_m).astype(np.int64))  # (n,2) column, row
        self.columns, self.rows = (int(v) + 1 for v in self.at.max(axis=0))
        self.flat: I64 = self.at[:, 1] * self.columns + self.at[:, 0]

    def total(self, keep: Bool, values: F64) -> F64:
        """Sums (rows, columns) of values (n,) over three by three patches."""
        sums = np.bincount(self.flat[keep], values[keep], self.rows * self.columns).astype(np.float64)
        return _box3(_box3(sums.reshape(self.rows, self.columns), 0), 1)

    def centres(self) -> tuple[F64, F64]:
        """x and y (rows, columns) of the centres."""
        r, c = np.indices((self.rows, self.columns)).astype(np.float64)
        return (c + 0.5) * self.side_m, (r + 0.5) * self.side_m

    def of_plane(self, plane: F64) -> F64:
        """One plane (3,) as planes (3, rows, columns)."""
        x, y = self.centres()
        z = plane[0] + plane[1] * (x + self.corner[0]) + plane[2] * (y + self.corner[1])
        return np.stack([z, np.full_like(z, plane[1]), np.full_like(z, plane[2])])

    def heights(self, planes: F64) -> F64:
        """z (n,) at the points, interpolated between the four nearest planes.

        planes: (3, rows, columns) z, dz/dx, dz/dy.
        """
        last = np.array([self.columns - 1, self.rows - 1])
        place = np.clip(self.xy / self.side_m - 0.5, 0.0, last)
        low = np.minimum(place.astype(np.int64), np.maximum(last - 1, 0))
        share = place - low
        out = np.zeros(len(self.xy))
        for right in (0, 1):
            for up in (0, 1):
                c, r = np.minimum(low + [right, up], last).T
                weight = np.abs(1 - right - share[:, 0]) * np.abs(1 - up - share[:, 1])
                z, a, b = planes[:, r, c]
                dx, dy = self.xy[:, 0] - (c + 0.5) * self.side_m, self.xy[:, 1] - (r + 0.5) * self.side_m
                out += weight * (z + a * dx + b * dy)
        return out


def _lowest_peaks(patches: _Patches, z: F64, below: Bool) -> F64 | None:
    """z (rows, columns) of the lowest peak in every patch; None if there is no peak."""
    if not below.any():
        return None
    bins = 256  # 12.8 m of heights
    base = float(np.median(z[below])) - bins / 2 * _HEIGHT_BIN_M
    b = np.floor((z - base) / _HEIGHT_BIN_M).astype(np.int64)
    keep = below & (b >= 0) & (b < bins)
    shape = (patches.rows, patches.columns, bins)
    sums = np.bincount(patches.flat[keep] * bins + b[keep], minlength=int(np.prod(shape))).reshape(shape)
    count: F64 = sums.astype(np.float64)
    for axis in range(3):
        count = _box3(count, axis)
    counts = count.astype(np.float32)
    ground_bin = _lowest_peak(counts.sum(axis=(0, 1)))
    if ground_bin is None:
        return None
    reach = max(1, round(_SLOPE * _PATCH_M / _HEIGHT_BIN_M))
    near = counts[:, :, max(0, ground_bin - reach) : ground_bin + reach + 1].sum(axis=2)
    seed = int(np.argmax(near))
    seed_bin = _lowest_peak(counts[seed // patches.columns, seed % patches.columns])
    ground = np.zeros((patches.rows, patches.columns), np.int32)
    kernels.spread_ground(
        counts, seed, ground_bin if seed_bin is None else seed_bin, reach, _PEAK_SHARE, _MIN_PEAK_POINTS,
        ground, np.zeros(ground.size, np.int32),
    )  # fmt: skip
    return np.asarray(base + (ground.astype(np.float64) + 0.5) * _HEIGHT_BIN_M)


def _fit(patches: _Patches, z: F64, near: Bool, planes: F64) -> F64:
    """Least-squares planes (3, rows, columns) of the points `near` in every patch, with limited slope."""
    x, y = patches.xy.T
    n = patches.total(near, np.ones_like(x))
    enough = n >= _MIN_PLANE_POINTS
    m = np.maximum(n, 1.0)
    mx, my, mz = (patches.total(near, v) / m for v in (x, y, z))
    xx, yy = (patches.total(near, u * u) / m - w * w + _SLOPE_PRIOR_M**2 for u, w in ((x, mx), (y, my)))
    xy, xz, yz = (
        patches.total(near, u * v) / m - w * t for u, v, w, t in ((x, y, mx, my), (x, z, mx, mz), (y, z, my, mz))
    )
    det = xx * yy - xy * xy
    a = np.clip((xz * yy - yz * xy) / det, -_SLOPE, _SLOPE)
    b = np.clip((yz * xx - xz * xy) / det, -_SLOPE, _SLOPE)
    cx, cy = patches.centres()
    return np.where(enough, np.stack([mz + a * (cx - mx) + b * (cy - my), a, b]), planes)


def _box3(values: F64, axis: int) -> F64:
    """Sum of each element and its two neighbours along an axis."""
    out = values.copy()
    ahead, back = [slice(None)] * values.ndim, [slice(None)] * values.ndim
    ahead[axis], back[axis] = slice(1, None), slice(None, -1)
    out[tuple(ahead)] += values[tuple(back)]
    out[tuple(back)] += values[tuple(ahead)]
    return out


def _lowest_peak(count: F32) -> int | None:
    """The lowest bin that is a peak with enough points and a share of the highest count; None without a peak."""
    after = np.append(count[1:], 0.0)
    need = max(_PEAK_SHARE * float(count.max()), _MIN_PEAK_POINTS)
    peaks = np.flatnonzero((count >= need) & (count >= after))
    return int(peaks[0]) if len(peaks) else None
