"""From an image pair and a predicted pose to a measured pose: align templates, look along the row, optimise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.config import AgentConfig
from kiteline_agent.governor.cost_model import Work
from kiteline_agent.imaging import alignment_kernels
from kiteline_agent.imaging.features import Pyramid
from kiteline_agent.local_map import projection_kernels as local_map_kernels
from kiteline_agent.local_map.local_map import Candidates, LocalMap
from kiteline_agent.tracking.frame_images import RightImage
from kiteline_core.geometry import se3
from kiteline_core.pose import pose_kernels

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Bools = NDArray[np.bool_]

_SURE = 0.4  # px of the octave: below such a deviation of the predicted disparity, no coarser level is needed
_MARGIN_PX = 8.0  # nearer to the border a template hangs over the edge


@dataclass(frozen=True, slots=True)
class FrameImages:
    """The pyramids of one instant. depth_m: (h,w) float32 aligned with left, or None. first: finest level not blank."""

    left: Pyramid
    right: RightImage | None
    depth_m: NDArray[np.float32] | None
    first: int = 0


@dataclass(frozen=True, slots=True)
class Track:
    """What the tracker measured. T_c_m: (4,4). rows: (n,) of the local map. observed: (n,3) u, v, disparity px (< 0:
    none). sigma_px: (n,). depth_m: (n,) of the points in the camera. inlier: (n,). information: (6,6) of T_c_m, left
    perturbation. inliers: how many. rms: whitened error of the inliers. tried: how many points were looked for.
    xyz: (n,3) m where the points are thought to be. ray: (n,3) m, one deviation of their depth.
    """

    T_c_m: F64
    rows: I64
    observed: F64
    sigma_px: F64
    depth_m: F64
    inlier: Bools
    information: F64
    inliers: int
    rms: float
    tried: int
    xyz: F64
    ray: F64


def without_points(T_c_m: F64, inliers: int) -> Track:
    """A pose (4,4) that so many corners prove, none of which is a point of the local map."""
    none = np.zeros(0)
    return Track(
        T_c_m, np.zeros(0, np.int64), np.zeros((0, 3)), none, none, np.zeros(0, np.bool_), np.zeros((6, 6)), inliers,
        0.0, inliers, np.zeros((0, 3)), np.zeros((0, 3)),
    )  # fmt: skip


class Tracker:
    """Stateless but for its buffers: the local map and the prediction are handed in."""

    def __init__(self, local_map: LocalMap, config: AgentConfig, work: Work) -> None:
        self._map = local_map
        self._config = config
        self._work = work
        self._zero_prior = np.zeros(6)

    def configure(self, config: AgentConfig) -> None:
        """From now on so much effort."""
        self._config = config

    def track(self, view: FrameImages, predicted_T_c_m: F64, frame_number: int) -> Track:
        """One frame: a coarse pass over few points mends the prediction, a fine pass over many measures the pose."""
        T_c_m = predicted_T_c_m.copy()
        # Coarse pass: big steps on small images.
        coarse = self._map.candidates(T_c_m, _MARGIN_PX, self._config.align.max_scale)
        chosen = self._choose(coarse, frame_number, self._config.align.coarse_points, per_cell=1, cell_factor=2)
        rough = self._measure(view, coarse, chosen, T_c_m, coarse_only=True)
        if rough.inliers >= self._config.pose.min_inliers // 2:
            T_c_m = rough.T_c_m
        # Fine pass: sub-pixel, with stereo.
        fine = self._map.candidates(T_c_m, _MARGIN_PX, self._config.align.max_scale)
        chosen = self._choose(fine, frame_number, self._config.align.points, per_cell=2, cell_factor=1)
        return self._measure(view, fine, chosen, T_c_m, coarse_only=False)

    def _choose(self, candidates: Candidates, frame_number: int, limit: int, per_cell: int, cell_factor: int) -> I64:
        """Candidates spread over the image; those tracked in the last frame first, then the best known."""
        rows = candidates.rows
        recent = frame_number - self._map.last_hit[rows] <= 1
        sigma = self._map.sigma_rho.reshape(-1)[rows]
        order = np.lexsort((rows, sigma, ~recent))
        cell = self._config.align.cell_px * cell_factor
        camera = self._map.camera
        cells = np.zeros((-(-camera.height // cell), -(-camera.width // cell)), np.int32)
        chosen = np.empty(limit, np.int64)
        n = local_map_kernels.select(order, candidates.uv, float(cell), limit, per_cell, cells, chosen)
        return chosen[:n]

    def _measure(
        self, view: FrameImages, candidates: Candidates, chosen: I64, T_c_m: F64, *, coarse_only: bool
    ) -> Track:
        config = self._config
        rows = candidates.rows[chosen]
        uv = candidates.uv[chosen]
        octave = self._map.octave[rows]
        found = np.zeros(len(rows), np.bool_)
        last = 1 if coarse_only else 0
        step = config.align.coarse_step_px if coarse_only else config.align.fine_step_px
        first = 2 if coarse_only else config.align.fine_from
        fine = np.maximum(octave, 0 if coarse_only else view.first) - octave  # cut finer than anything that is seen now
        for finest in (last, last + 1) if fine.any() else (last,):
            some = np.flatnonzero(fine == finest - last)
            place, seen, score = uv[some], np.zeros(len(some), np.bool_), np.zeros(len(some))
            alignment_kernels.align(
                view.left, self._map.templates, rows[some], octave[some], candidates.warp[chosen[some]], place,
                max(first, finest), finest, config.align.iterations, step, config.align.min_ncc, seen, score,
            )  # fmt: skip
            uv[some], found[some] = place, seen
        self._work.projected += len(candidates.rows)
        self._work.alignments += len(rows) * (first - last + 1)
        self._work.posed_points += int(np.count_nonzero(found))
        uv, octave, chosen = uv[found], (octave + fine)[found], chosen[found]
        scale = (1 << octave).astype(np.float64) * (2.0 if coarse_only else 1.0)
        sigma_px = config.align.sigma_px * scale
        return self._solve(
            view, candidates, chosen, uv, octave, sigma_px, T_c_m, tried=len(found), stereo=not coarse_only
        )

    def _solve(
        self, view: FrameImages, candidates: Candidates, chosen: I64, uv: F64, octave: NDArray[np.uint8], sigma_px: F64,
        T_c_m: F64, *, tried: int, stereo: bool,
    ) -> Track:  # fmt: skip
        """The pose from candidates[chosen] (n,), seen at uv (n,2) px on octave (n,), each to sigma_px (n,); stereo:
        disparities count too. tried: how many were looked for.
        """
        config = self._config
        rows, depth = candidates.rows[chosen], candidates.depth[chosen]
        observed = np.column_stack([uv, np.full(len(uv), -1.0)])
        if stereo:
            self._add_disparities(view, rows, uv, octave, depth, observed)
        T = T_c_m.copy()
        inlier = np.ones(len(rows), np.bool_)
        information = np.zeros((6, 6))
        xyz, ray = candidates.xyz[chosen], candidates.ray[chosen]
        inliers, rms = pose_kernels.optimise_pose(
            T, xyz, ray, observed, sigma_px, self._map.intrinsics,
            T_c_m, self._zero_prior, config.pose.rounds, config.pose.iterations, config.pose.chi2, inlier, information,
        )  # fmt: skip
        return Track(
            T_c_m=se3.orthonormalise(T), rows=rows, observed=observed, sigma_px=sigma_px, depth_m=depth, inlier=inlier,
            information=information, inliers=int(inliers), rms=float(rms), tried=tried, xyz=xyz, ray=ray,
        )  # fmt: skip

    def _add_disparities(
        self, view: FrameImages, rows: I64, uv: F64, octave: NDArray[np.uint8], depth: F64, observed: F64
    ) -> None:
        """Fill observed[:, 2] from the right image or from the depth image, where they agree to be measurable."""
        bf = self._map.camera.bf
        if view.right is not None and self._config.stereo.points:
            stereo = self._config.stereo
            disparity = bf / depth
            sure = self._map.sigma_rho.reshape(-1)[rows] * bf < _SURE * (1 << octave)
            if len(uv) > stereo.points:
                picked = np.linspace(0, len(uv) - 1, stereo.points).astype(np.int64)
                skipped = np.ones(len(uv), np.bool_)
                skipped[picked] = False
                disparity[skipped] = -1.0
            self._work.stereo_points += min(len(uv), stereo.points)
            found = np.zeros(len(uv), np.bool_)
            view.right.refine(view.left, uv, octave, sure, stereo, stereo.search_px, disparity, found)
            observed[found, 2] = disparity[found]
        elif view.depth_m is not None:
            d = depth_at(view.depth_m, uv)
            observed[d > 0.0, 2] = bf / d[d > 0.0]


def depth_at(depth_m: NDArray[np.float32], uv: F64) -> F64:
    """Depth (n,) in m at pixels (n,2); 0 where unknown or where the 3x3 neighbourhood is an edge (spread above 5 %)."""
    h, w = depth_m.shape
    x = np.clip(np.round(uv[:, 0]).astype(np.int64), 1, w - 2)
    y = np.clip(np.round(uv[:, 1]).astype(np.int64), 1, h - 2)
    around = np.stack([depth_m[y + dy, x + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)]).astype(np.float64)
    low, high = around.min(axis=0), around.max(axis=0)
    sure = (low > 0.0) & (high - low < 0.05 * low)
    return np.where(sure, np.median(around, axis=0), 0.0)
