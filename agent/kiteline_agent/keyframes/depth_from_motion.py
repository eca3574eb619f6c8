"""Depth of landmarks without one (seeds): each tracked frame searches them along their epipolar segments.

Two rays are intersected by least squares; successive inverse depths are averaged by their variances (C. Forster et al.,
"SVO", 2014, section V). A seed becomes a landmark of the map once its depth is known well enough.
"""

import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_agent.governor.cost_model import Work
from kiteline_agent.imaging import alignment_kernels
from kiteline_agent.imaging.alignment_kernels import ALIGN_ITERATIONS, FINE_STEP_PX, MIN_NCC
from kiteline_agent.imaging.epipolar_kernels import search_segments
from kiteline_agent.keyframes import seed_kernels as kernels
from kiteline_agent.keyframes.seed_shutter import SeedShutter
from kiteline_agent.local_map.local_map import Candidates, LocalMap
from kiteline_agent.tracking.frame_context import FrameContext
from kiteline_agent.tracking.frame_images import FrameImages
from kiteline_agent.tracking.track import Track
from kiteline_core.arrays import F64, I8, I64, Bool
from kiteline_core.order_statistics import quantiles

_MARGIN_PX = 8.0
_PER_FRAME_STEREO = 24  # seeds searched in a frame with stereo, which leaves only far and doubtful ones
_MAX_STEPS = 40  # tries on an epipolar segment; longer ones are searched on a smaller image
_MIN_SEARCH_NCC = 0.7  # correlation at a try, up to half a step from the peak
_FAR_SHARE = 0.4  # of the typical inverse depth: _KNOWN counts from there for farther landmarks
_MAX_TRIES = 60  # frames in view without a depth
_FILTER_INFLATION = 6.0  # factor on variances of tracked landmarks: successive observations share the template's error
_REACH = 2.5  # standard deviations of inverse depth that are searched
_STEP_PX = 0.7  # px of the level between two tries: half the width of the correlation peak
_DISTINCT = 0.93  # share of the best correlation that nothing else on the segment may reach
_INFLATION = 2.0  # factor on variances of seeds: successive frames share the template's error
_NEARER = 2.0  # times the inverse depth of the nearest twentieth of the landmarks: end of the search
_KNOWN = 0.12  # deviation over inverse depth below which a seed becomes a landmark


class DepthFromMotion:
    """Updates depths of a local map from each tracked frame, and searches its seeds there."""

    def __init__(self, local_map: LocalMap, config: AgentConfig, work: Work) -> None:
        self._map = local_map
        self._config = config
        self._work = work

    def update_landmarks(self, ctx: FrameContext, track: Track) -> None:
        """Count tries and hits of the tracked landmarks, and update their depths."""
        self._map.note_tracking(track.rows, track.inlier, ctx.number)
        self._map.update_depths(
            track.T_c_m, track.rows, track.inlier, track.observed, track.sigma_px, _FILTER_INFLATION
        )
        self._map.follow_depths(track.rows[track.inlier])

    def search_seeds(self, ctx: FrameContext, track: Track) -> int:
        """Search seeds in a tracked frame, and update their depths. Returns how many became landmarks."""
        config, images = self._config.depth_from_motion, ctx.images
        near = 1.0 / track.depth_m[track.inlier]
        if len(near) < self._config.pose.min_inliers:
            return 0
        typical, steepest = quantiles(near, (0.5, 0.95))
        ceiling = steepest * _NEARER
        self._map.initialise_seeds(typical, ceiling)
        seeds = self._map.candidates(track.T_c_m, _MARGIN_PX, seeds=True)
        chosen = self._choose(seeds, images.first)
        if len(chosen) == 0:
            return 0
        self._work.bearings += len(chosen)
        rows, warp = seeds.rows[chosen], seeds.warp[chosen]
        m, n = self._map, len(rows)
        rho, sigma = m.rho.take(rows), m.sigma_rho.take(rows)
        # The landmark is (direction + centre * rho) / rho in the camera: gives its pixel for any inverse depth.
        direction, centre = np.empty((2, n, 3))
        start, end = np.empty((2, n, 2))
        kernels.seed_segments(
            track.T_c_m, m.intrinsics, rows, m.T_m_k, m.bearing, rho, sigma, _REACH, ceiling,
            direction, centre, start, end,
        )  # fmt: skip
        rolling = None
        if ctx.shutter is not None:
            rolling = SeedShutter(ctx.shutter, direction, centre, m.rolled.take(rows // m.slot_size))
            start, end = rolling.segments(start, end, rho)
        uv, found = self._search(images, rows, warp, start, end)
        measured, variance, off_line = np.empty((3, n))
        octave = m.octave.take(rows)
        # The depth that was measured says where a rolling shutter's pixels were at the stamp.
        for depths in (rho,) if rolling is None else (rho, measured):
            place = uv if rolling is None else rolling.at_frame(uv, np.maximum(depths, 0.0))
            kernels.intersect(
                direction, centre, place, octave, m.intrinsics, config.sigma_px, measured, variance, off_line
            )
        agree = np.square(measured - rho) < config.gate**2 * (variance + sigma**2)
        scale = (1 << self._map.octave[rows]).astype(np.float64)
        hit = (found == 1) & agree & (off_line < config.off_line_px * scale) & np.isfinite(variance)
        self._count(rows, hit, failed=(found == 0) | ((found == 1) & ~hit))
        return self._fuse(rows[hit], measured[hit], variance[hit], typical) if hit.any() else 0

    def _choose(self, seeds: Candidates, first: int) -> I64:
        """The seeds to search in this frame: most hits first, then the newest. first: finest pyramid level."""
        limit = _PER_FRAME_STEREO if self._map.camera.stereo else self._config.depth_from_motion.per_frame
        fine = (self._map.octave.take(seeds.rows) >= first).nonzero()[0]
        if len(fine) <= limit:
            return fine
        rows = seeds.rows.take(fine)
        order = np.lexsort((-fine, self._map.tried.take(rows), -self._map.hits.take(rows)))
        return np.sort(fine[order[:limit]])

    def _search(self, images: FrameImages, rows: I64, warp: F64, start: F64, end: F64) -> tuple[F64, I8]:
        """Find the templates: correlation along the segment, then alignment. Pixels (n,2), found (n,) 1 or 0."""
        octave = self._map.octave[rows]
        uv, found = np.zeros((len(rows), 2)), np.zeros(len(rows), np.int8)
        search_segments(
            images.sampled, images.grid, self._map.templates, rows, octave, warp, start, end, _STEP_PX,
            _MAX_STEPS, _MIN_SEARCH_NCC, _DISTINCT, uv, found,
        )  # fmt: skip
        seen = (found == 1).nonzero()[0]
        place, aligned, ncc = uv[seen], np.zeros(len(seen), np.bool_), np.zeros(len(seen))
        alignment_kernels.align(
            images.sampled, images.grid, self._map.templates, rows[seen], octave[seen], warp[seen], place, 1, 0,
            ALIGN_ITERATIONS, FINE_STEP_PX, MIN_NCC, aligned, ncc,
        )  # fmt: skip
        uv[seen] = place
        found[seen[~aligned]] = 0
        return uv, found

    def _count(self, rows: I64, hit: Bool, failed: Bool) -> None:
        """Count tries and hits; drop seeds that keep failing or never get a depth."""
        config = self._config.depth_from_motion
        self._map.tried[rows] += 1
        self._map.hits[rows[hit]] += 1
        self._map.misses[rows[failed]] += 1
        hopeless = (self._map.misses[rows] >= config.max_misses) | (self._map.tried[rows] >= _MAX_TRIES)
        gone = rows[hopeless & ~hit]
        self._map.seed.reshape(-1)[gone] = False
        self._map.tried[gone] = 0  # reads as never searched: the base may still give it a depth

    def _fuse(self, rows: I64, measured: F64, variance: F64, typical: float) -> int:
        """Average inverse depths. Returns how many seeds are known well enough and became landmarks."""
        config = self._config.depth_from_motion
        rho, sigma = self._map.rho.reshape(-1), self._map.sigma_rho.reshape(-1)
        variance = variance * _INFLATION
        prior = sigma[rows] ** 2
        rho[rows] = np.maximum((rho[rows] * variance + measured * prior) / (variance + prior), 1e-6)
        sigma[rows] = np.sqrt(variance * prior / (variance + prior))
        self._map.follow_depths(rows)
        known = (sigma[rows] < _KNOWN * np.maximum(rho[rows], _FAR_SHARE * typical)) & (
            self._map.hits[rows] >= config.min_hits
        )
        self._map.promote(rows[known])
        return int(np.count_nonzero(known))


def triangulated_sigma(bearing: F64, rho: F64, T_c_k: F64, f_px: float, sigma_px: F64) -> F64:
    """Standard deviation (n,) of inverse depths triangulated by a second view.

    bearing: (n,2) x/z, y/z. T_c_k: (4,4) keyframe to the second view.
    """
    p = np.column_stack([bearing, np.ones(len(rho))]) @ T_c_k[:3, :3].T + T_c_k[:3, 3] * rho[:, None]
    z = np.maximum(p[:, 2], 1e-3)
    slope = f_px * (T_c_k[:2, 3] - p[:, :2] / z[:, None] * T_c_k[2, 3]) / z[:, None]
    return np.asarray(sigma_px / np.maximum(np.linalg.norm(slope, axis=1), 1e-9))
