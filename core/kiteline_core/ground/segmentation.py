"""Segments a disparity or depth image into ground and obstacles, and makes its column scan.

The method is that of "Segfloor" (u-disparity, v-disparity, B-spline), in the levelled frame of a camera that banks:
- disparities of columns of equal azimuth with more rows than level ground fills stand upright and are left out,
- the ground is a uniform cubic B-spline of five sections through the v-disparity of the others, fitted robustly,
- pixels within a threshold and their error of it are ground, if the image has texture there.
Beyond it, what a column of azimuth sees is one disparity for each surface, refined by all of its pixels at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kiteline_core.geometry import disparity_offset
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ground import label_kernels, level_kernels, profile_kernels
from kiteline_core.ground.column_scan import ColumnScan, level_rotation
from kiteline_core.ground.config import GroundConfig
from kiteline_core.ground.disparity import DisparityCamera

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

_HEIGHT_STEP_M = 0.05  # of the v-disparity
_HALF_COUNTS = 30.0  # pixels of a cell of the v-disparity that count half as much as many
_STIFFNESS = 1e-3  # of the spline
_ROUNDS = 5
_REFINED = 0.4  # of a disparity's deviation that remains of a surface that is refined by all of its pixels
_UNDER = 0.5  # pixels below the ground for one on it, at most: nothing is seen through it
_BEYOND_PX = 0.5  # px of disparity beyond the spline's far end where pixels may still be ground
_NEARER = 1.6  # the same at its near end, as a factor: the lowest rows of an image have none below to compare with
_BELOW_PX = 16  # between two pixels of which one lies above the other: the ground's disparity changes by a pixel
_LEAST_IN_IMAGE = 0.2  # part of the vertical direction that lies in the image
_STEEPEST = 0.6  # of the difference in height of a wall's points, up to which they may lie on the ground
_GAP_M = 0.25  # without seen ground that are free between free ones: beyond, a pit would fit


@dataclass(frozen=True, slots=True)
class Ground:
    """The ground of an image: a B-spline of slope -z/x over levelled disparities low_px..high_px.

    Beyond low_px..high_px nothing was seen, and the spline goes on as level ground.
    """

    coefficients: F64
    low_px: float
    high_px: float
    height_m: float  # of the camera above its nearest part


@dataclass(frozen=True, slots=True)
class _View:
    """What was seen. rotation: (3,3) camera to levelled frame. pair, offset_px: see `GroundSegmenter.segment`."""

    up_c: F64
    rotation: F64
    offset_px: F64
    pair: tuple[U8, U8] | None


class GroundSegmenter:
    """Segments disparity images of one camera. Its arrays are used again for each image."""

    def __init__(self, camera: RectifiedCamera, config: GroundConfig) -> None:
        """camera: rectified, of the full image."""
        self.config = config
        self.camera = view = DisparityCamera.of(camera)
        fx, cx, h, w = view.fx, view.cx, view.height, view.width
        self._camera, self.bf = np.array([fx, view.fy, cx, view.cy]), view.bf
        self.sigma_px = config.sigma_px if camera.stereo else config.depth_sigma * self.bf
        n = config.columns
        right, left = np.arctan([(w - 1 - cx) / fx, cx / fx])
        step = (left + right) / n
        self._azimuth0, self._step = float(0.5 * step - right), float(step)
        self._azimuths = self._azimuth0 + self._step * np.arange(n)
        self._slopes = np.tan(np.append(self._azimuths - 0.5 * step, left))
        self._widths = fx * np.diff(self._slopes)
        self._bins = bins = round(config.disparities / level_kernels.BIN_PX)
        heights = round(config.largest_height_m / _HEIGHT_STEP_M)
        self._far_px = 0.25 if camera.stereo else 0.02 * self.bf
        self._lowest_px = max(self.sigma_px / config.max_range_sigma, self.bf / config.max_range_m)
        self._bands = np.array(config.bands_m)
        self.x, self.z = np.empty((h, w), np.float32), np.empty((h, w), np.float32)
        self._column = np.empty((h, w), np.int16)
        self.labels = np.zeros((h, w), np.uint8)
        self.saw_ground = False  # in the last image
        self._textured = np.ones((h, w), np.bool_)
        self._counts, self._sums = np.empty((4, n, bins), np.int32), np.empty((n, bins))
        self._slab_sums = np.empty((n, bins))
        self._surface, self._surface_sums = np.empty((n, 2)), np.empty((n, 2, 5))
        self._upright = np.empty((n, bins), np.bool_)
        self._in_band = np.empty((n, bins, len(self._bands) - 1), np.int32)
        self._heights = np.empty((bins, heights), np.int32)
        self._height_sums = np.empty((2, bins, heights))

    def segment(
        self, disparity: F32, pair: tuple[U8, U8] | None, up_c: F64, offset_px: F64 | None = None,
        expected_m: float | None = None, *, certain: bool = True,
    ) -> ColumnScan:  # fmt: skip
        """Label a disparity image (h,w) in px, 0 unknown, into `labels`, and make its column scan.

        pair: the images (h,w) of a stereo pair: ground must have texture, and ranges are refined; None with depth.
        up_c: (3,) unit vector against gravity. offset_px: (5,) error of disparities. expected_m: of the camera above
        the ground as scans saw it; while that is certain, ground that lies higher is taken for a table or a box.
        """
        config = self.config
        offset_px = disparity_offset.none() if offset_px is None else offset_px
        view = _View(up_c, np.ascontiguousarray(level_rotation(up_c).T), offset_px, pair)
        level_kernels.level_points(
            disparity, view.rotation, self._camera, self.bf, offset_px, self._far_px, self._slopes, self.x, self.z,
            self._column,
        )  # fmt: skip
        if pair is not None:
            label_kernels.mark_texture(pair[0], config.texture, config.texture_px, self._textured)
        ground = self._find_ground(up_c, expected_m)
        if ground is not None and expected_m is not None and certain:
            ground = ground if ground.height_m > expected_m - config.expected_m else None
        return self._scan(ground, view, expected_m)

    def certain_m(self, sigma_m: float) -> float:
        """Distance up to which a surface's deviation stays below sigma_m."""
        return float(np.sqrt(sigma_m * self.bf / (_REFINED * self.sigma_px)))

    def label_of(self, uv: F64) -> U8:
        """Labels (n,) of pixels (n,2) of the full image."""
        return np.asarray(self.labels[self.camera.at(uv)])

    def _find_ground(self, up_c: F64, expected_m: float | None) -> Ground | None:
        """The ground by u- and v-disparity; None if too little of it is seen."""
        config, counts, bf = self.config, self._counts[0], self.bf
        in_image = float(np.hypot(up_c[0], up_c[1]))
        if in_image < _LEAST_IN_IMAGE:  # the camera looks straight up or down
            return None
        counts.fill(0)
        self._sums.fill(0.0)
        level_kernels.count_columns(self.x, self.z, self._column, bf, counts, self._sums)
        # Rows that level ground 1 m below fills with each pixel of disparity.
        rows_m = float(self._camera[1]) / bf
        level_kernels.find_upright(counts, self._sums, self._widths, 0.5 * config.obstacle_rows, rows_m, self._upright)
        below = round(-_BELOW_PX * up_c[0] / in_image), round(-0.5 * _BELOW_PX * up_c[1] / in_image)
        heights, (disparities, slopes) = self._heights, self._height_sums
        heights.fill(0)
        self._height_sums.fill(0.0)
        level_kernels.count_heights(
            self.x, self.z, self._column, self._upright, bf, below, _STEEPEST, _HEIGHT_STEP_M, heights, disparities,
            slopes,
        )  # fmt: skip
        path = np.zeros(self._bins, np.int64)
        first, near = (int(m / _HEIGHT_STEP_M) for m in (config.least_height_m, config.expected_m))
        hint = -1 if expected_m is None else max(int(expected_m / _HEIGHT_STEP_M), 0)
        profile_kernels.ground_path(
            heights, first, hint, near, bf, _HEIGHT_STEP_M, config.max_slope, self.sigma_px, _HALF_COUNTS, path
        )
        # Cells near the path, in bins of which enough pixels lie there.
        centres = (np.arange(self._bins) + 0.5) * level_kernels.BIN_PX
        spread = 2.0 + 3.0 * (path + 0.5) * self.sigma_px / centres
        used = (np.abs(np.arange(heights.shape[1]) - path[:, None]) <= spread[:, None]) & (heights > 0)
        found = (heights * used).sum(1)
        bins = np.flatnonzero((found >= max(0.02 * found.max(), 3.0)) & (centres >= self._lowest_px))
        enough = max(config.least_pixels, config.least_share * heights[bins].sum())
        if found[bins].sum() < enough or len(bins) < config.least_bins:
            return None
        used[: bins[0]] = used[bins[-1] + 1 :] = False
        n = heights[used].astype(np.float64)
        d, slope = disparities[used] / n, slopes[used] / n
        sigma = np.hypot(slope * self.sigma_px / d, 0.3 * _HEIGHT_STEP_M * d / bf)
        low, high = float(centres[bins[0]]), float(centres[bins[-1]])
        coefficients = np.zeros(profile_kernels.COEFFICIENTS)
        if not profile_kernels.fit_spline(d, slope, n, low, high, sigma, _STIFFNESS, _ROUNDS, coefficients):
            return None
        return Ground(
            coefficients, low, high, float(profile_kernels.spline_at(coefficients, low, high, high)) * bf / high
        )

    def _scan(self, ground: Ground | None, view: _View, expected_m: float | None) -> ColumnScan:
        """Label the pixels by the ground that was found, or obstacles by the one expected, and collect them."""
        config, bins, n = self.config, self._bins, self.config.columns
        borders = np.arange(bins + 1) * level_kernels.BIN_PX
        self.saw_ground = ground is not None
        slope, seen, height_m = np.full(bins + 1, np.nan), np.zeros(bins, np.bool_), float("nan")
        if ground is not None:
            profile_kernels.sample_spline(ground.coefficients, ground.low_px, ground.high_px, borders, slope)
            seen = (borders[:-1] >= ground.low_px - _BEYOND_PX) & (borders[1:] <= ground.high_px * _NEARER)
            height_m = ground.height_m
        elif expected_m is not None:
            slope, height_m = borders * (expected_m / self.bf), expected_m
        grounds, obstacles, slab = self._counts[1:]
        self.labels.fill(label_kernels.UNKNOWN)
        for counts in (self._counts[1:], self._sums, self._in_band, self._slab_sums, self._surface_sums):
            counts.fill(0)
        on, under = label_kernels.label_points(
            self.x, self.z, self._column, self._textured, slope, seen, self.bf, self.sigma_px, config.ground_m,
            config.ground_sigmas, self._bands, config.slab_m, self.labels, grounds, obstacles, self._sums,
            self._in_band, slab, self._slab_sums,
        )  # fmt: skip
        if ground is not None and under > _UNDER * on:
            return self._scan(None, view, expected_m)
        lowest = round(self._lowest_px / level_kernels.BIN_PX)
        surface, bands = self._surface, np.empty(n, np.uint8)
        label_kernels.find_surfaces(
            obstacles, self._sums, self._in_band, slab, self._slab_sums, config.column_pixels, lowest, surface, bands
        )
        if view.pair is not None:
            label_kernels.refine_surfaces(
                *view.pair, view.rotation, self._camera, self.bf, view.offset_px, self.x, self.z, self._column,
                self.labels, config.slab_m, surface, self._surface_sums,
            )  # fmt: skip
        free_from, free, obstacle, clear = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
        label_kernels.collect_scan(
            grounds, surface, self._azimuths, self.bf, lowest, self.sigma_px, _GAP_M, free_from, free, obstacle, clear
        )
        return ColumnScan(view.up_c, self._azimuth0, self._step, free_from, free, obstacle, bands, clear, height_m)
