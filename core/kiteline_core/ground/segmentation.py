"""Segments a disparity or depth image into ground and obstacles, and makes its column scan.

The method is that of "Segfloor" (u-disparity, v-disparity, B-spline), in the levelled frame of a camera that banks:
- disparities of columns of equal azimuth with more rows than level ground fills stand upright and are left out,
- the ground is a uniform cubic B-spline of five sections through the v-disparity of the others, fitted robustly,
- pixels within a threshold and their error of it are ground, if the image has texture there.
Beyond it, what a column of azimuth sees is one disparity for each surface, refined by all of its pixels at once.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from kiteline_core.arrays import F32, F64, I64, U8, Bool
from kiteline_core.geometry import disparity_offset
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ground import column_kernels, label_kernels, level_kernels, profile_kernels
from kiteline_core.ground.column_scan import ColumnScan, level_rotation
from kiteline_core.ground.config import GroundConfig
from kiteline_core.ground.disparity import DisparityCamera

_HEIGHT_STEP_M = 0.05  # of the v-disparity
_DEPTH_STEP_M = 0.05  # of the pixels' depth below the camera
_HALF_COUNTS = 30.0  # pixels of a cell of the v-disparity that count half as much as many
_STIFFNESS = 1e-3  # of the spline
_ROUNDS = 5
_BETTER = 1.3  # times the pixels of level ground that make a curve the ground
_NEAREST = 0.25  # of the ground's pixels, which tell its height below the camera
_HALF_SURE = 200.0  # pixels near the expected height that move it half of the way
_REFINED = 0.4  # of a disparity's deviation that remains of a surface that is refined by all of its pixels
_UNDER = 0.5  # pixels below the ground for one on it, at most: nothing is seen through it
_BEYOND_PX = 0.5  # px of disparity beyond the spline's far end where pixels may still be ground
_NEARER = 1.6  # the same at its near end, as a factor: the lowest rows of an image have none below to compare with
_BELOW_PX = 16  # between two pixels of which one lies above the other: the ground's disparity changes by a pixel
_LEAST_IN_IMAGE = 0.2  # part of the vertical direction that lies in the image
_STEEPEST = 0.6  # of the difference in height of a wall's points, up to which they may lie on the ground
_WIDER_RAD = 0.2  # to each side beyond the field of view of a level camera
_WIDEST_RAD = 1.3  # of an azimuth
_NEARER_M = 0.15  # between obstacles of two columns that are not one surface
_GAP_M = 0.25  # without seen ground that are free between free ones: beyond, a pit would fit
_TEXTURE_PX = 16  # px along a row within which a pixel has texture: semi-global matching fills in between
_OBSTACLE_ROWS = 5.0  # rows of one disparity in a column, beyond those of level ground: `a` of Segfloor
_MAX_SLOPE = 0.35  # m a m of the ground, at most: steeper is an obstacle; ramps have up to 0.2
_LEAST_HEIGHT_M = 0.15  # m of the camera above the ground, at least
_LEAST_PIXELS = 150  # on the ground, at least
_LEAST_SHARE = 0.4  # of what is neither upright nor unknown at these distances, that is ground: else it is noise
_LEAST_BINS = 6  # quarter pixels of disparity over which ground is seen, at least: less may be a wall's foot
EXPECTED_M = 0.1  # m between the height found and the one expected, at most: beyond, it is a table or a box
_EXPECTED_PIXELS = 30  # near the expected height, from which the height is that of these pixels
_LOWEST_PIXELS = 60  # that must lie as low to tell that the ground lies no higher: fewer may be errors
_LOWEST_AHEAD_M = 5.0  # m ahead up to which lowest pixels count
_LOWEST_SIGMA_M = 0.1  # m; deviation of the height of lowest pixels, at most
_LOWEST_SLOPE = 0.06  # m a m that the ground may fall ahead
_CURVE_SLOPE = 0.25  # m a m of a curve that takes the place of level ground where its height is known
LOWER_M = 0.25  # m below the ground from which points refute it: their errors are half of that
_GROUND_SIGMAS = 2.5  # standard deviations of the measured height above or below the curve that are still ground
_GROUND_MOST_M = 0.15  # m; farther above or below nothing is ground, however uncertain: it may be a low box
_LEAST_KNOWN = 0.7  # of a column's pixels below the horizon: among more unknown ones an obstacle may hide
_COLUMN_PIXELS = 5  # of an obstacle in a column, at least: fewer are chance
_MAX_RANGE_M = 60.0  # m; farther ground and obstacles are left out
_MAX_RANGE_SIGMA = 0.1  # relative deviation of a range, at most: a disparity of 2.5 px
_TEXTURE = 4  # grey levels over two pixels along a row, at least: six times the noise of a plain floor


@dataclass(frozen=True, slots=True)
class Ground:
    """The ground of an image: a B-spline of slope -z/x over levelled disparities low_px..high_px.

    Beyond low_px..high_px nothing was seen, and the spline goes on as level ground. seen: False where it lies as
    expected, and the image shows too little of it.
    """

    coefficients: F64
    low_px: float
    high_px: float
    height_m: float  # of the camera above the nearest quarter of its pixels
    seen: bool = True


@dataclass(frozen=True, slots=True)
class _View:
    """What was seen. rotation: (3,3) camera to levelled frame. pair, offset_px: see `GroundSegmenter.segment`."""

    up_c: F64
    rotation: F64
    offset_px: F64
    pair: tuple[U8, U8] | None


class ExpectedGround(NamedTuple):
    """Height of a camera above ground that is known, and how far it may be from there."""

    height_m: float
    within_m: float


class Segmented(NamedTuple):
    """What an image shows. ground: whether its scan saw ground.

    lowest_m: depth below the camera that many pixels reach, less what ground may fall; NaN if that is not known.
    """

    scan: ColumnScan
    ground: bool
    lowest_m: float


class GroundSegmenter:
    """Segments disparity images of one camera. Its arrays are used again for each image."""

    def __init__(self, camera: RectifiedCamera, config: GroundConfig) -> None:
        """camera: rectified, of the full image."""
        self.config = config
        self.camera = view = DisparityCamera.of(camera)
        self._last_uv = np.array([camera.width - 1.0, camera.height - 1.0])
        fx, cx, h, w = view.fx, view.cx, view.height, view.width
        self._camera, self.bf = np.array([fx, view.fy, cx, view.cy]), view.bf
        self.sigma_px = config.sigma_px if camera.stereo else config.depth_sigma * self.bf
        right, left = np.arctan([(w - 1 - cx) / fx, cx / fx])
        step = (left + right) / config.columns
        # A camera that looks down or banks sees more azimuths at its lower corners than level.
        beyond = [max(min(round(_WIDER_RAD / step), int((_WIDEST_RAD - side) / step)), 0) for side in (right, left)]
        n = config.columns + sum(beyond)
        self._azimuth0, self._step = float((0.5 - beyond[0]) * step - right), float(step)
        self._azimuths = self._azimuth0 + self._step * np.arange(n)
        self._slopes = np.tan(np.append(self._azimuths - 0.5 * step, self._azimuths[-1] + 0.5 * step))
        self._widths = fx * np.diff(self._slopes)
        self._bins = bins = round(config.disparities / level_kernels.BIN_PX)
        heights = round(config.largest_height_m / _HEIGHT_STEP_M)
        self._far_px = 0.25 if camera.stereo else 0.02 * self.bf
        self._lowest_px = max(self.sigma_px / _MAX_RANGE_SIGMA, self.bf / _MAX_RANGE_M)
        self._bands = np.array(config.bands_m)
        self.x, self.z = np.empty((h, w), np.float32), np.empty((h, w), np.float32)
        self._column, self._known = np.empty((h, w), np.int16), np.empty((n, 2), np.int32)
        self.labels = np.zeros((h, w), np.uint8)
        self._textured = np.ones((h, w), np.bool_)
        self._counts, self._sums = np.empty((7, n, bins), np.int32), np.empty((n, bins))
        self._ground_heights = np.empty((n, bins))
        self._slab_sums = np.empty((n, bins))
        self._surface, self._surface_sums = np.empty((n, 2)), np.empty((n, 2, 5))
        self._upright = np.empty((n, bins), np.bool_)
        self._in_band = np.empty((n, bins, len(self._bands) - 1), np.int32)
        self._heights = np.empty((bins, heights), np.int32)
        self._depths = np.empty(round(config.largest_height_m / _DEPTH_STEP_M), np.int32)
        self._height_sums = np.empty((2, bins, heights))
        self._cells = np.empty((3, bins * heights))  # of the v-disparity near a path

    def segment(
        self, disparity: F32, pair: tuple[U8, U8] | None, up_c: F64, offset_px: F64 | None = None,
        expected: ExpectedGround | None = None,
    ) -> Segmented:  # fmt: skip
        """Label a disparity image (h,w) in px, 0 unknown, into `labels`, and make its column scan.

        pair: the images (h,w) of a stereo pair: ground must have texture, and ranges are refined; None with depth.
        up_c: (3,) unit vector against gravity. offset_px: (5,) error of disparities. expected: where the
        height is known: what lies there is ground, however little of it is seen.
        """
        offset_px = disparity_offset.none() if offset_px is None else offset_px
        view = _View(up_c, np.ascontiguousarray(level_rotation(up_c).T), offset_px, pair)
        self._known.fill(0)
        level_kernels.level_points(
            disparity, view.rotation, self._camera, self.bf, offset_px, self._far_px, self._slopes, self.x, self.z,
            self._column, self._known,
        )  # fmt: skip
        if pair is not None:
            label_kernels.mark_texture(pair[0], _TEXTURE, _TEXTURE_PX, self._textured)
        self._depths.fill(0)
        level_kernels.count_depths(
            self.x, self.z, self._column, (_LOWEST_AHEAD_M, _LOWEST_SIGMA_M), _LOWEST_SLOPE,
            self.sigma_px / self.bf, _DEPTH_STEP_M, self._depths,
        )  # fmt: skip
        below = np.flatnonzero(np.cumsum(self._depths[::-1]) >= _LOWEST_PIXELS)
        lowest_m = (len(self._depths) - 1 - int(below[0])) * _DEPTH_STEP_M if len(below) else float("nan")
        ground = self._find_ground(up_c, expected, lowest_m)
        scan, refuted = self._scan(ground, view, expected)
        return Segmented(scan, ground is not None and ground.seen and not refuted, lowest_m)

    @property
    def surface_sigma_px(self) -> float:
        """Deviation of a surface's disparity, in px of the disparity image."""
        return _REFINED * self.sigma_px

    def label_of(self, uv: F64) -> U8:
        """Labels (n,) of pixels (n,2) of the full image; unknown outside of it."""
        outside = (uv < 0.0).any(1) | (uv > self._last_uv).any(1)
        return np.where(outside, label_kernels.UNKNOWN, self.labels[self.camera.at(uv)]).astype(np.uint8)

    def _find_ground(self, up_c: F64, expected: ExpectedGround | None, lowest_m: float) -> Ground | None:
        """The ground by u- and v-disparity, and by what is expected; None if too little of it is seen."""
        counts, bf = self._counts[0], self.bf
        in_image = float(np.hypot(up_c[0], up_c[1]))
        if in_image < _LEAST_IN_IMAGE:  # the camera looks straight up or down
            return None
        counts.fill(0)
        self._sums.fill(0.0)
        level_kernels.count_columns(self.x, self.z, self._column, bf, counts, self._sums)
        # Rows that level ground 1 m below fills with each pixel of disparity.
        rows_m = float(self._camera[1]) / bf
        level_kernels.find_upright(counts, self._sums, self._widths, 0.5 * _OBSTACLE_ROWS, rows_m, self._upright)
        below = round(-_BELOW_PX * up_c[0] / in_image), round(-0.5 * _BELOW_PX * up_c[1] / in_image)
        self._heights.fill(0)
        self._height_sums.fill(0.0)
        level_kernels.count_heights(
            self.x, self.z, self._column, self._upright, bf, below, _STEEPEST, _HEIGHT_STEP_M, self._heights,
            *self._height_sums,
        )  # fmt: skip
        if expected is None:
            curved = self._curved_ground(expected)
            if curved is None or curved.height_m < lowest_m - LOWER_M:
                return self._lowest_ground(lowest_m)
            return curved
        level = self._expected_ground(expected)
        if _BETTER * self._pixels_near(np.full(self._bins, level.height_m)).sum() > self._heights.sum():
            return level  # no curve passes through so many more
        curved = self._curved_ground(expected)
        if curved is None:
            return level
        if abs(curved.height_m - expected.height_m) > expected.within_m:
            # Where nothing lies as high as expected, ground that is seen lower is the better one.
            return curved if not level.seen and curved.height_m > expected.height_m else level
        return replace(curved, seen=level.seen) if self._is_better(curved, level) else level

    def _is_better(self, curved: Ground, level: Ground) -> bool:
        """True if a curve without steep parts passes through many more pixels than level ground does."""
        centres = (np.arange(self._bins) + 0.5) * level_kernels.BIN_PX
        seen = (centres >= curved.low_px) & (centres <= curved.high_px)
        slope = np.empty(self._bins)
        profile_kernels.sample_spline(curved.coefficients, curved.low_px, curved.high_px, centres, slope)
        ahead = self.bf / centres
        heights = -slope * ahead
        climb = np.abs(np.diff(heights[seen]) / np.diff(ahead[seen]))
        if (climb > _CURVE_SLOPE).any():
            return False
        on_curve, on_level = (
            self._pixels_near(height_m)[seen].sum() for height_m in (-heights, np.full(self._bins, level.height_m))
        )
        return bool(on_curve > _BETTER * on_level)

    def _pixels_near(self, height_m: F64) -> I64:
        """Pixels (bins,) of the v-disparity near a height (bins,) of the camera."""
        found = np.empty(self._bins, np.int64)
        profile_kernels.count_near(self._heights, height_m, _HEIGHT_STEP_M, self.sigma_px, found)
        return found

    def _curved_ground(self, expected: ExpectedGround | None) -> Ground | None:
        """The ground as a curve over the distance; None if too little of it is seen."""
        bf, heights = self.bf, self._heights
        path = np.zeros(self._bins, np.int64)
        first, hint, near = int(_LEAST_HEIGHT_M / _HEIGHT_STEP_M), -1, 0
        if expected is not None:
            hint, near = (max(int(m / _HEIGHT_STEP_M), 0) for m in (expected.height_m, expected.within_m))
        profile_kernels.ground_path(
            heights, first, hint, near, bf, _HEIGHT_STEP_M, _MAX_SLOPE, self.sigma_px, _HALF_COUNTS, path
        )
        # Cells near the path, in bins of which enough pixels lie there.
        centres = (np.arange(self._bins) + 0.5) * level_kernels.BIN_PX
        found, total = np.empty((2, self._bins), np.int64)
        profile_kernels.count_path(heights, path, self.sigma_px, found, total)
        bins = np.flatnonzero((found >= max(0.02 * found.max(), 3.0)) & (centres >= self._lowest_px))
        enough = max(_LEAST_PIXELS, _LEAST_SHARE * total[bins].sum())
        if found[bins].sum() < enough or len(bins) < _LEAST_BINS:
            return None
        disparities, slopes = self._height_sums
        first_bin, last_bin = int(bins[0]), int(bins[-1])
        m = profile_kernels.cells_near(
            heights, disparities, slopes, path, first_bin, last_bin, self.sigma_px, self._cells
        )  # fmt: skip
        n, d, slope = self._cells[:, :m]
        sigma = np.hypot(slope * self.sigma_px / d, 0.3 * _HEIGHT_STEP_M * d / bf)
        low, high = float(centres[bins[0]]), float(centres[bins[-1]])
        coefficients = np.zeros(profile_kernels.COEFFICIENTS)
        if not profile_kernels.fit_spline(d, slope, n, low, high, sigma, _STIFFNESS, _ROUNDS, coefficients):
            return None
        return Ground(coefficients, low, high, _near_height(n, d, slope) * bf)

    def _lowest_ground(self, lowest_m: float) -> Ground | None:
        """Level ground next to the lowest points; None if too little of it is seen."""
        if np.isnan(lowest_m):
            return None
        rows = self._heights.sum(0)
        first = max(int((lowest_m - EXPECTED_M) / _HEIGHT_STEP_M), 0)
        last = int((lowest_m + LOWER_M) / _HEIGHT_STEP_M) + 1
        some = np.convolve(rows, np.ones(3), "same")[first:last]
        if not len(some) or some.max() < _LEAST_PIXELS:
            return None
        height_m = (first + int(np.argmax(some)) + 0.5) * _HEIGHT_STEP_M
        ground = self._expected_ground(ExpectedGround(height_m, EXPECTED_M))
        return ground if ground.seen else None

    def _expected_ground(self, expected: ExpectedGround) -> Ground:
        """Level ground where it is expected, as high as pixels near it say."""
        bf, bins = self.bf, self._bins
        expected_m = expected.height_m
        first = round((expected_m - expected.within_m) / _HEIGHT_STEP_M)
        last = round((expected_m + expected.within_m) / _HEIGHT_STEP_M) + 1
        near = slice(max(first, 0), max(last, 0))
        centres = (np.arange(bins) + 0.5) * level_kernels.BIN_PX
        sure = (centres >= self._lowest_px) & (expected_m * self.sigma_px / centres < EXPECTED_M)
        n = self._heights[sure, near].sum(1)
        disparities, slopes = (sums[sure, near].sum(1) for sums in self._height_sums)
        some, height_m = n > 0, expected_m
        seen = bool(n.sum() >= _EXPECTED_PIXELS)
        if seen:
            found = np.repeat(self.bf * slopes[some] / disparities[some], n[some])
            gain = n.sum() / (n.sum() + _HALF_SURE)
            height_m += gain * (float(np.median(found)) - expected_m)
        low, high = self._lowest_px, bins * level_kernels.BIN_PX
        at = low + (np.arange(profile_kernels.COEFFICIENTS) - 1.0) * (high - low) / profile_kernels.SECTIONS
        return Ground(at * (height_m / bf), low, high, height_m, seen)

    def _scan(self, ground: Ground | None, view: _View, expected: ExpectedGround | None) -> tuple[ColumnScan, bool]:
        """Label the pixels by the ground that was found, or obstacles by the one expected, and collect them.

        And whether too much was seen below that ground: then it is none.
        """
        config, bins, n = self.config, self._bins, len(self._azimuths)
        borders = np.arange(bins + 1) * level_kernels.BIN_PX
        slope, seen, height_m = np.full(bins + 1, np.nan), np.zeros(bins, np.bool_), float("nan")
        if ground is not None:
            profile_kernels.sample_spline(ground.coefficients, ground.low_px, ground.high_px, borders, slope)
            seen = (borders[:-1] >= ground.low_px - _BEYOND_PX) & (borders[1:] <= ground.high_px * _NEARER)
            seen[: _beyond_fall(slope, seen, self.bf, _CURVE_SLOPE)] = False
            height_m = ground.height_m
        elif expected is not None:
            slope, height_m = borders * (expected.height_m / self.bf), expected.height_m
        grounds, obstacles, above, falls, astray, slab = self._counts[1:]
        self.labels.fill(label_kernels.UNKNOWN)
        summed = self._sums, self._ground_heights, self._in_band, self._slab_sums, self._surface_sums
        for counts in (self._counts[1:], *summed):
            counts.fill(0)
        on, under = label_kernels.label_points(
            self.x, self.z, self._column, self._textured, slope, seen, self.bf, self.sigma_px, config.ground_m,
            _GROUND_SIGMAS, _GROUND_MOST_M, self._bands, config.slab_m, self.labels, grounds, obstacles,
            above, falls, astray, self._ground_heights, self._sums, self._in_band, slab, self._slab_sums,
        )  # fmt: skip
        if ground is not None and under > _UNDER * on:
            return self._scan(None, view, expected)[0], True
        lowest = round(self._lowest_px / level_kernels.BIN_PX)
        surface, bands = self._surface, np.empty(n, np.uint8)
        label_kernels.find_surfaces(
            obstacles, above, self._sums, self._in_band, slab, self._slab_sums, _COLUMN_PIXELS, lowest, surface,
            bands,
        )  # fmt: skip
        if view.pair is not None:
            label_kernels.refine_surfaces(
                *view.pair, view.rotation, self._camera, self.bf, view.offset_px, self.x, self.z, self._column,
                self.labels, config.slab_m, surface, self._surface_sums,
            )  # fmt: skip
        free_from, free, obstacle, clear = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
        column_kernels.collect_scan(
            grounds, self._ground_heights, obstacles, falls, astray, _COLUMN_PIXELS, surface, bands, self._bands,
            height_m, self._azimuths, self.bf, 1.0 / float(self._camera[1]), lowest, self.sigma_px, _GAP_M, free_from,
            free, obstacle, clear,
        )  # fmt: skip
        # A column beside a nearer obstacle shows some of it: what is free there ends where that begins.
        padded = np.concatenate([[np.inf], obstacle, [np.inf]])
        nearer = np.minimum(padded[:-2], padded[2:])
        ends = (free_from < nearer) & (nearer < np.minimum(free, obstacle - _NEARER_M))
        free[ends] = nearer[ends]
        hidden = self._known[:, 0] < _LEAST_KNOWN * self._known[:, 1]
        free[hidden] = free_from[hidden] = 0.0
        some = np.flatnonzero((free > 0.0) | (bands > 0) | (clear > 0.0))
        first, last = (int(some[0]), int(some[-1]) + 1) if len(some) else (0, n)
        free_from, free, obstacle, clear = (row[first:last].copy() for row in (free_from, free, obstacle, clear))
        scan = ColumnScan(
            view.up_c, float(self._azimuths[first]), self._step, free_from, free, obstacle, bands[first:last].copy(),
            clear, height_m,
        )  # fmt: skip
        return scan, False


def _near_height(n: F64, d: F64, slope: F64) -> float:
    """Median height, over bf, of the nearest quarter of n pixels with disparities d and slopes (m,).

    The end of a spline hangs on a few pixels.
    """
    by_range = np.argsort(-d, kind="stable")
    last = int(np.searchsorted(np.cumsum(n[by_range]), _NEAREST * n.sum())) + 1
    near = by_range[:last]
    heights = slope[near] / d[near]
    by_height = np.argsort(heights, kind="stable")
    counts = np.cumsum(n[near][by_height])
    return float(heights[by_height[int(np.searchsorted(counts, 0.5 * counts[-1]))]])


def _beyond_fall(slope: F64, seen: Bool, bf: float, steepest: float) -> int:
    """Number of bins, the farthest, that lie beyond ground that falls steeply; 0 if none does.

    slope: (bins+1,) -z/x at the borders of bins. seen: (bins,). steepest: m a m.
    """
    ahead = bf / np.maximum(np.arange(len(slope)) * level_kernels.BIN_PX, 0.5 * level_kernels.BIN_PX)
    steep = np.flatnonzero(seen & (np.diff(slope * ahead) < steepest * np.diff(ahead)))
    return int(steep[-1]) + 1 if len(steep) else 0
