"""Measures the pose of a frame: align templates, search disparities along the row, optimise the pose."""

import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_agent.governor.cost_model import Work
from kiteline_agent.imaging import alignment_kernels
from kiteline_agent.imaging.alignment_kernels import ALIGN_ITERATIONS, FINE_STEP_PX, MIN_NCC
from kiteline_agent.local_map import projection_kernels
from kiteline_agent.local_map.local_map import Candidates, LocalMap
from kiteline_agent.tracking.frame_context import FrameContext
from kiteline_agent.tracking.frame_images import FrameImages, depth_at
from kiteline_agent.tracking.track import Track
from kiteline_core.arrays import F64, I64, U8
from kiteline_core.geometry import se3
from kiteline_core.order_statistics import median
from kiteline_core.pose import pose_kernels

_SURE_PX = 0.4  # px of the octave: deviation of the predicted disparity below which no coarser level is searched
_COARSE = 3  # times fewer landmarks in the coarse pass than in the fine one
_COARSEST = 2  # template level at which the coarse pass begins
_MARGIN_PX = 8.0  # nearer to the border a template hangs over the edge
_AXIS_STEPS = (0.08, 0.16, 0.24, 0.32)  # of the median depth: steps along the axis that are tried
_COARSE_STEP_PX = 7.0  # px of the coarse level: half a template
_STEEPEST = 0.5  # gradient of a disparity, at most: as steep a surface is hardly seen by both cameras
_ROUNDS = 3  # rounds of the pose optimisation: outliers are chosen anew after each


class Tracker:
    """Tracks the active submap of a local map. Holds no state of its own."""

    def __init__(self, local_map: LocalMap, work: Work) -> None:
        self._map = local_map
        self._work = work

    def track(self, ctx: FrameContext, predicted_T_c_m: F64) -> Track:
        """Measure the pose of a frame from a prediction (4,4) that is good to some 28 px."""
        align, least = ctx.config.align, 2 * ctx.config.pose.min_inliers
        T_c_m = predicted_T_c_m.copy()
        # Coarse pass: few landmarks and large steps on small images correct the prediction. Its patches are wider than
        # those of which slants were measured.
        coarse = self._map.candidates(T_c_m, _MARGIN_PX, facing=True)
        chosen = self._choose(coarse, ctx.number, max(align.points // _COARSE, least), 1, 2 * align.cell_px)
        rough = self._measure(ctx, coarse, chosen, T_c_m, _COARSEST, coarse_only=True)
        if rough.inliers >= ctx.config.pose.min_inliers // 2:
            T_c_m = rough.T_c_m
        return self._fine(ctx, T_c_m, align.fine_from)

    def track_along_axis(self, ctx: FrameContext, T_c_m: F64) -> Track:
        """The best track from poses ahead of T_c_m (4,4) and behind it, along the optical axis.

        For the first step of a vehicle whose speed is unknown: no rotation of the image stands in for it. Without a
        landmark in view the track from T_c_m.
        """
        depths_m = self._map.candidates(T_c_m, 0.0).depth
        if not len(depths_m):
            return self.track(ctx, T_c_m)
        depth_m, tracks = median(depths_m), list[Track]()
        for share in _AXIS_STEPS:
            for sign in (1.0, -1.0):
                ahead = T_c_m.copy()
                ahead[2, 3] -= sign * share * depth_m
                tracks.append(self.track(ctx, ahead))
        return max(tracks, key=lambda track: track.inliers)

    def track_by_imu(self, ctx: FrameContext) -> Track | None:
        """The same from the prediction of an IMU, which is mostly good to half a pixel: on the finest level alone.

        None if the track is farther from the prediction, or holds too little: then both passes have to measure it.
        """
        pose = ctx.config.pose
        track = self._fine(ctx, ctx.T_c_m, 0)
        return track if track.holds(pose) and self._off_px(track, ctx.T_m_c) < pose.dragged_px else None

    def _fine(self, ctx: FrameContext, T_c_m: F64, first: int, near_px: float = np.inf) -> Track:
        """Measure the pose from a prediction (4,4) that is good to some pixels: many landmarks, with disparities.

        first: template level at which alignment begins. near_px: see `_measure`.
        """
        align = ctx.config.align
        fine = self._map.candidates(T_c_m, _MARGIN_PX)
        chosen = self._choose(fine, ctx.number, align.points, 2, align.cell_px)
        return self._measure(ctx, fine, chosen, T_c_m, first, coarse_only=False, near_px=near_px)

    def nearer(self, ctx: FrameContext, track: Track) -> Track:
        """The track, or one of landmarks that agree with a prediction by an IMU, if it is far from that prediction.

        Where people walk through the view, landmarks on them may outvote those of the room for a frame. The IMU tells
        which of the two stand still: it is right to a fraction of a pixel since the last frame.
        """
        pose = ctx.config.pose
        off_px = self._off_px(track, ctx.T_m_c)
        if off_px < pose.dragged_px:
            return track
        other = self._fine(ctx, ctx.T_c_m, ctx.config.align.fine_from, pose.near_px)
        enough = other.inliers >= max(2 * pose.min_inliers, track.inliers // 2)
        return other if enough and self._off_px(other, ctx.T_m_c) < 0.5 * off_px else track

    def _off_px(self, track: Track, predicted_T_m_c: F64) -> float:
        """By how much the image of a track differs from the prediction, px at the inliers' median depth."""
        if not track.inlier.any():
            return 0.0
        shift_m, turn = se3.shift_and_turn(track.T_c_m @ predicted_T_m_c)
        return self._map.camera.fx * (shift_m / median(track.depth_m[track.inlier]) + turn)

    def _choose(self, candidates: Candidates, frame_number: int, limit: int, per_cell: int, cell_px: int) -> I64:
        """Candidates spread over image cells: landmarks of the last frame first, then those of least uncertainty."""
        recent = self._map.last_hit.take(candidates.rows) >= frame_number - 1
        sigma = self._map.sigma_rho.take(candidates.rows)
        order = sigma.argsort(kind="stable")  # candidates come in order of rows, which decides between equals
        camera = self._map.camera
        cells = np.zeros((-(-camera.height // cell_px), -(-camera.width // cell_px)), np.int32)
        chosen = np.empty(limit, np.int64)
        n = projection_kernels.select(order, recent, candidates.uv, float(cell_px), limit, per_cell, cells, chosen)
        return chosen[:n]

    def _measure(
        self, ctx: FrameContext, candidates: Candidates, chosen: I64, T_c_m: F64, first: int, *,
        coarse_only: bool, near_px: float = np.inf,
    ) -> Track:  # fmt: skip
        """Align the templates of the chosen candidates (n,), and optimise the pose from T_c_m (4,4).

        first: template level at which alignment begins. near_px: at most so far from where that pose has them.
        """
        images, config, shutter = ctx.images, ctx.config, ctx.shutter
        align = config.align
        rows, uv, warp = candidates.rows.take(chosen), candidates.uv.take(chosen, 0), candidates.warp.take(chosen, 0)
        if shutter is not None:
            at_row = shutter.to_rows(uv, 1.0 / candidates.depth.take(chosen))[:, :2]
            uv = np.where(self._map.rolled[rows // self._map.slot_size, None], uv, at_row)
        octave = self._map.octave.take(rows)
        found = np.zeros(len(rows), np.bool_)
        last = 1 if coarse_only else 0
        step = _COARSE_STEP_PX if coarse_only else FINE_STEP_PX
        # Templates from a finer level than this frame has are aligned one level up.
        least = 0 if coarse_only else images.first
        raised = np.maximum(octave, least) - octave if least else np.zeros_like(octave)
        parts = (last, last + 1) if least and raised.any() else (last,)
        for finest in parts:
            some = slice(None) if len(parts) == 1 else np.flatnonzero(raised == finest - last)
            place, aligned = uv[some], found[some]  # views, or copies that are written back
            alignment_kernels.align(
                images.sampled, images.grid, self._map.templates, rows[some], octave[some], warp[some], place,
                max(first, finest), finest, ALIGN_ITERATIONS, step, MIN_NCC, aligned, np.empty(len(place)),
            )  # fmt: skip
            if len(parts) > 1:
                uv[some], found[some] = place, aligned
        self._work.projected += len(candidates.rows)
        self._work.alignments += len(rows) * (first - last + 1)
        self._work.posed_points += int(np.count_nonzero(found))
        kept = found.nonzero()[0]
        octave, chosen = (octave + raised).take(kept), chosen.take(kept)
        observed = np.empty((len(kept), 3))
        observed[:, :2], observed[:, 2] = uv.take(kept, 0), -1.0
        if not coarse_only:
            self._add_disparities(
                images, candidates.rows[chosen], octave, candidates.depth[chosen], T_c_m, observed, config
            )
        if shutter is not None:
            at_frame = shutter.to_frame(observed[:, :2], 1.0 / candidates.depth.take(chosen))
            disparity = shutter.at_once(observed[:, :2], observed[:, 2])
            at_frame[:, 2] = np.where(disparity >= 0.0, disparity * at_frame[:, 2], disparity)
            rolled = self._map.rolled[candidates.rows.take(chosen) // self._map.slot_size]
            observed = np.where(rolled[:, None], observed, at_frame)
        if near_px < np.inf:
            expected = self._pixels(T_c_m, candidates.xyz.take(chosen, 0))
            near = (np.linalg.norm(expected - observed[:, :2], axis=1) < near_px).nonzero()[0]
            octave, chosen, observed = octave.take(near), chosen.take(near), observed.take(near, 0)
        sigma_px = align.sigma_px * (1 << octave).astype(np.float64) * (2.0 if coarse_only else 1.0)
        return self._solve(candidates, chosen, observed, sigma_px, T_c_m, config, tried=len(found))

    def _pixels(self, T_c_m: F64, xyz: F64) -> F64:
        """Where a camera at T_c_m (4,4) sees points (n,3)."""
        fx, fy, cx, cy = self._map.intrinsics[:4]
        q = xyz @ T_c_m[:3, :3].T + T_c_m[:3, 3]
        return np.asarray(q[:, :2] / q[:, 2:] * (fx, fy) + (cx, cy), np.float64)

    def _solve(
        self, candidates: Candidates, chosen: I64, observed: F64, sigma_px: F64, T_c_m: F64, config: AgentConfig,
        *, tried: int,
    ) -> Track:  # fmt: skip
        """The pose from observations (n,3) of the chosen candidates (n,), by robust motion-only optimisation."""
        pose, n = config.pose, len(chosen)
        T, inlier = T_c_m.copy(), np.ones(n, np.bool_)
        xyz, ray = candidates.xyz.take(chosen, 0), candidates.ray.take(chosen, 0)
        inliers, rms = pose_kernels.optimise_pose(
            T, xyz, ray, observed, sigma_px, self._map.intrinsics, _ROUNDS, pose.iterations, pose.chi2, inlier
        )
        return Track(
            T_c_m=se3.orthonormalise(T), rows=candidates.rows[chosen], observed=observed, sigma_px=sigma_px,
            depth_m=candidates.depth[chosen], inlier=inlier, inliers=int(inliers),
            rms=float(rms), tried=tried, xyz=xyz, ray=ray,
        )  # fmt: skip

    def _add_disparities(
        self, images: FrameImages, rows: I64, octave: U8, depth: F64, T_c_m: F64, observed: F64, config: AgentConfig
    ) -> None:
        """Fill observed[:, 2] from the right image or the depth image, where it can be measured.

        T_c_m: (4,4) predicted pose of the frame: how disparities change over slanted surfaces.
        """
        m, stereo, uv = self._map, config.stereo, np.ascontiguousarray(observed[:, :2])
        bf = m.camera.bf
        if images.right is not None and stereo.points:
            disparity = bf / depth
            sure = m.sigma_rho.reshape(-1)[rows] * bf < _SURE_PX * (1 << octave)
            if len(uv) > stereo.points:
                picked = np.linspace(0, len(uv) - 1, stereo.points).astype(np.int64)
                skipped = np.ones(len(uv), np.bool_)
                skipped[picked] = False
                disparity[skipped] = -1.0
            self._work.stereo_points += min(len(uv), stereo.points)
            found = np.zeros(len(uv), np.bool_)
            slopes = np.zeros((len(uv), 2))
            if config.slant.points:
                projection_kernels.disparity_slopes(
                    T_c_m, m.intrinsics, rows, m.T_m_k, m.bearing, m.rho, m.slant, _STEEPEST, slopes
                )
            images.right.refine(
                images.sampled, images.grid, uv, octave, sure, slopes, stereo.search_px, disparity, found
            )
            observed[found, 2] = disparity[found]
        elif images.depth_m is not None:
            depth_m = depth_at(images.depth_m, uv)
            observed[depth_m > 0.0, 2] = bf / depth_m[depth_m > 0.0]
