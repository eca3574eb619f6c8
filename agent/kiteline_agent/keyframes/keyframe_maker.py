"""Makes a keyframe of a frame: shares its records with the base, adds it to the local map.

The local map keeps what was measured, whatever is shared of it and however it is rounded: a link does not change how
the agent tracks.
"""

from dataclasses import replace

import numpy as np

from kiteline_agent.governor.cost_model import Work
from kiteline_agent.imaging import alignment_kernels
from kiteline_agent.imaging.row_alignment import RowAlignment
from kiteline_agent.keyframes.new_landmarks import EarlierView, NewPoints, moved_to_frame, nearby, new_points
from kiteline_agent.keyframes.pair_search import Fault, PairSearch
from kiteline_agent.keyframes.policy import coverage
from kiteline_agent.local_map.keyframe_landmarks import KeyframeLandmarks
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.tracking.frame_context import FrameContext
from kiteline_agent.tracking.track import Track
from kiteline_codec.channel import RecordChannel
from kiteline_codec.coding import quantise
from kiteline_codec.schema import KeyframeHeader, NewLandmarks, Observations
from kiteline_core.arrays import F32, F64, I64
from kiteline_core.geometry import se3
from kiteline_core.ids import NO_KEYFRAME, KeyframeId, point_id

_MIN_RHO = 1e-4  # 1/m; farther counts as infinitely far
_HARDLY = 0.25  # share of the corners with a disparity where rows are off; else there are three quarters and more
_DEPTH_CAMERA_SIGMA_RHO = 2.85e-3  # 1/m, of a structured-light camera, constant (K. Khoshelham, S. Elberink, 2012)


class KeyframeMaker:
    """Turns a frame into records for the base and a slot of the local map."""

    def __init__(
        self, local_map: LocalMap, channel: RecordChannel, rows: RowAlignment | None, work: Work, *, has_depth: bool
    ) -> None:  # fmt: skip
        """rows: of the right image; None without one. has_depth: of a stereo or depth camera."""
        self._map = local_map
        self._rows = rows
        self._camera = local_map.camera
        self._pairs = None if rows is None else PairSearch(rows, work)
        self._has_depth = has_depth
        self._channel = channel
        self._work = work
        self.fault: Fault | None = None  # why the last frame without a track had too few new landmarks
        self.new_uv: F64 = np.zeros((0, 2))  # px of the first keypoints of the last keyframe that was shared

    def lacks_depth(self, ctx: FrameContext) -> bool:
        """True if a frame of a stereo or depth camera came without its right or depth image."""
        return self._has_depth and ctx.images.right is None and ctx.images.depth_m is None

    def first_points(self, ctx: FrameContext, least_cover: float = 0.0) -> NewPoints | None:
        """New landmarks for a keyframe without a track; None if too few of them have a depth: `fault` says why.

        Also None, without a fault, if they cover less than least_cover, a share of the image as of `coverage`.
        """
        points = self._points(ctx, np.zeros((0, 2)))
        if coverage(points.uv, self._camera) < least_cover:
            self.fault = None
            return None
        least = ctx.config.local_map.first_points
        if _with_depth(points) >= least:
            return points
        if len(points.uv) < least:
            self.fault = Fault.CORNERS
        elif ctx.images.right is None:
            self.fault = Fault.DEPTH
        else:
            self.fault = Fault.PAIR
        return None

    def points_beside(self, ctx: FrameContext, track: Track) -> NewPoints:
        """New landmarks where a tracked frame has none."""
        return self._points(ctx, self._inliers(track)[1][:, :2], track)

    def _points(self, ctx: FrameContext, taken: F64, track: Track | None = None) -> NewPoints:
        """New landmarks away from pixels `taken` (n,2), at the frame's stamp. track: tells depths nearby.

        If rows of the right image are off by pixels, hardly any is found along them: then they are searched for.
        """
        points = self._points_of_image(ctx, taken)
        hardly = len(points.uv) >= ctx.config.local_map.first_points and _with_depth(points) < _HARDLY * len(points.uv)
        if hardly and self._pairs is not None and self._pairs.find_rows(ctx, points):
            points = self._points_of_image(ctx, taken)
        if ctx.shutter is None:
            return points
        rho = None
        if track is not None:
            seen = track.inlier
            rho = nearby(points.uv, track.observed[seen, :2], 1.0 / track.depth_m[seen])
        return moved_to_frame(points, self._camera, ctx.shutter, rho)

    def _points_of_image(self, ctx: FrameContext, taken: F64) -> NewPoints:
        """New landmarks where the image shows them; their matches also measure the offset of the right image's rows."""
        points = new_points(ctx.images, taken, self._camera, ctx.config)
        right = ctx.images.right
        if self._rows is None or right is None:
            return points
        raw = np.where(points.disparity > 0.0, points.disparity + self._map.offset_px(points.uv), -1.0)
        measured = self._rows.add(ctx.images.aligned, right.raw(), points.uv, points.octave, raw)
        if measured and self._rows.apply() > 0.0:
            points = new_points(ctx.images, taken, self._camera, ctx.config)
        return points

    def make(
        self, ctx: FrameContext, track: Track | None, points: NewPoints, T_m_k: F64, keyframe: KeyframeId,
        parent: KeyframeId, T_p_k: F64, up: tuple[F64, float] | None = None,
    ) -> F64:  # fmt: skip
        """Share and store a keyframe at T_m_k (4,4). Returns T_p_k (4,4) as the base holds it, after quantisation.

        T_p_k: (4,4) in its parent as the base holds that, which rounds the former. track: None for a keyframe without
        observations of older landmarks. up: (3,) against gravity in the camera, its deviation in rad; None if unknown.
        """
        rows, seen = (np.zeros(0, np.int64), np.zeros((0, 3))) if track is None else self._inliers(track)
        profile = self._channel.profile
        order = _in_order_of_rows(points, ctx.config.detector.cell_px, profile.landmarks)
        landmarks, strength = self._new_landmarks(keyframe, points, order)
        shared = self._map.is_shared(rows)
        observations = self._observations(keyframe, rows[shared], seen[shared], min(len(order), profile.landmarks))
        sections = profile.choose(landmarks, strength, observations)
        self._count(ctx, len(landmarks.index), len(observations.index))
        header = self._put(keyframe, ctx.t_ns, parent, T_p_k, sections, up)
        seen_uv = self._store(ctx, header, T_m_k, points, order, landmarks)
        self._map.share(keyframe, sum(len(part.index) for part in sections[0]))
        self.new_uv = seen_uv[: min(len(order), profile.landmarks)]
        return header.T_p_k

    def make_unshared(
        self, ctx: FrameContext, points: NewPoints, T_m_k: F64, keyframe: KeyframeId, parent: KeyframeId
    ) -> None:  # fmt: skip
        """Store a keyframe at T_m_k (4,4) for the tracker alone. parent: a keyframe that is shared."""
        order = _in_order_of_rows(points, ctx.config.detector.cell_px, len(points.uv))
        landmarks, _ = self._new_landmarks(keyframe, points, order)
        self._count(ctx, len(order), 0)
        self._store(ctx, KeyframeHeader(keyframe, ctx.t_ns, parent, T_m_k, 0), T_m_k, points, order, landmarks)
        self._map.share(keyframe, 0)

    def share(
        self, ctx: FrameContext, view: EarlierView, keyframe: KeyframeId, parent: KeyframeId, T_p_k: F64,
        landmarks: dict[int, int],
    ) -> F64:  # fmt: skip
        """Share a keyframe of an earlier frame with the base alone. Returns T_p_k (4,4) as the base holds it.

        landmarks: ids by the number of a corner, of those that were shared before; these are observations here.
        """
        seen = np.array([corner in landmarks for corner in view.ids.tolist()], np.bool_)
        points, profile = view.points.part(~seen), self._channel.profile
        order = _in_order_of_rows(points, ctx.config.detector.cell_px, profile.landmarks)
        new, strength = self._new_landmarks(keyframe, points, order)
        at = np.array([landmarks[corner] for corner in view.ids[seen].tolist()], np.int64)
        by_id, first = np.argsort(at), min(len(order), profile.landmarks)
        old = view.points.part(seen)
        observations = Observations(
            keyframe, 0, np.arange(first, first + len(at), dtype=np.uint16), old.uv[by_id].astype(np.float32),
            np.zeros(len(at), np.float32), old.octave[by_id], at[by_id],
        )  # fmt: skip
        for index, corner in enumerate(view.ids[~seen][order][:first].tolist()):
            if corner >= 0:
                landmarks[corner] = point_id(keyframe, index)
        self._count(ctx, len(new.index), len(at))
        return self._put(keyframe, view.t_ns, parent, T_p_k, profile.choose(new, strength, observations), None).T_p_k

    def _put(
        self, keyframe: KeyframeId, t_ns: int, parent: KeyframeId, T_p_k: F64,
        sections: tuple[list[NewLandmarks], list[Observations]], up: tuple[F64, float] | None,
    ) -> KeyframeHeader:  # fmt: skip
        """Share a keyframe's records. Returns its header as the base holds it."""
        n_keypoints = sum(len(b.index) for b in sections[0]) + sum(len(s.index) for s in sections[1])
        header = self._channel.put(KeyframeHeader(keyframe, t_ns, parent, T_p_k, n_keypoints, *(up or ())))
        assert isinstance(header, KeyframeHeader)
        for section in (*sections[0], *sections[1]):
            self._channel.put(section)
        return header

    def _inliers(self, track: Track) -> tuple[I64, F64]:
        """Rows (n,) and observations (n,3) of the inliers, by landmark id."""
        keep = np.flatnonzero(track.inlier)
        keep = keep[np.argsort(self._map.landmark_ids(track.rows[keep]), kind="stable")]
        return track.rows[keep], track.observed[keep]

    def _count(self, ctx: FrameContext, landmarks: int, observations: int) -> None:
        self._work.keyframes += 1
        self._work.detected_px += ctx.images.left[max(ctx.images.first, ctx.config.detector.first)].size
        self._work.new_landmarks += landmarks
        self._work.observations += observations

    def _new_landmarks(self, keyframe: KeyframeId, points: NewPoints, order: I64) -> tuple[NewLandmarks, F64]:
        """The record of all new landmarks, and their strengths (n,)."""
        disparity = points.disparity[order]
        n = len(order)
        landmarks = NewLandmarks(
            keyframe,
            0,
            np.arange(n, dtype=np.uint16),
            quantise.pixels(quantise.pixel_codes(points.uv[order].astype(np.float32))),  # the landmark is what is there
            self._measured_rho(disparity, points.uv[order]),
            points.octave[order],
            points.angle[order],
            points.descriptor[order],
        )
        return landmarks, np.where(disparity > 0.0, 1.0, 0.0) - order / (2.0 * max(n, 1))

    def _observations(self, keyframe: KeyframeId, rows: I64, seen: F64, first: int) -> Observations:
        return Observations(
            keyframe,
            0,
            np.arange(first, first + len(rows), dtype=np.uint16),
            seen[:, :2].astype(np.float32),
            self._measured_rho(seen[:, 2], seen[:, :2]),
            self._map.octave[rows],
            self._map.landmark_ids(rows),
        )

    def _measured_rho(self, disparity: F64, uv: F64) -> F32:
        """Inverse depths (n,) 1/m to share, 0 for none: with the stereo offset, which the base estimates."""
        raw = disparity + self._map.offset_px(uv)
        return np.where((disparity > 0.0) & (raw > 0.0), raw / self._camera.bf, 0.0).astype(np.float32)

    def _store(
        self, ctx: FrameContext, header: KeyframeHeader, T_m_k: F64, points: NewPoints, order: I64,
        landmarks: NewLandmarks,
    ) -> F64:  # fmt: skip
        """Cut the templates where the image shows the landmarks, and add the keyframe to the local map.

        landmarks: points in `order`. Returns where the image shows them, (n,2) px.
        """
        uv, rho = landmarks.uv.astype(np.float64), landmarks.inv_depth.astype(np.float64)
        seen_uv = uv if points.row_shift is None else uv + points.row_shift.shift_px[order]
        rho = np.where(rho > 0.0, np.maximum(rho - self._map.offset_px(uv) / self._camera.bf, _MIN_RHO), 0.0)
        octave, config = landmarks.octave, ctx.config
        side = alignment_kernels.TEMPLATE
        templates = np.empty((len(uv), alignment_kernels.TEMPLATE_LEVELS, side, side), np.uint8)
        alignment_kernels.cut_templates(ctx.images.aligned, seen_uv, octave, templates)
        sigma = config.stereo.sigma_px * (1 << octave).astype(np.float64) / self._camera.bf
        if ctx.images.depth_m is not None and not self._camera.stereo:
            sigma = np.maximum(sigma, _DEPTH_CAMERA_SIGMA_RHO)
        parent = self._map.slot_of(header.parent)
        if header.parent != NO_KEYFRAME and parent >= 0:
            header = replace(header, T_p_k=se3.orthonormalise(se3.inverse(self._map.T_m_k[parent]) @ T_m_k))
        new = KeyframeLandmarks(
            uv, rho, sigma, octave, landmarks.angle, landmarks.descriptor, templates, np.argsort(order)
        )
        slot = self._map.add(header, T_m_k, new, ctx.number)
        self._map.rolled[slot] = ctx.shutter is None
        if points.row_shift is None:
            self._map.row_parallax.clear(slot)
        else:
            shift = points.row_shift.part(order)
            self._map.row_parallax.set(slot, shift.parallax_m, shift.rho)
        return seen_uv


def _with_depth(points: NewPoints) -> int:
    return int(np.count_nonzero(points.disparity > 0.0))


def _in_order_of_rows(points: NewPoints, cell_px: float, first: int) -> I64:
    """Order of the strongest `first` points, then of the others, by image rows: neighbours code shortest."""
    band = points.uv[:, 1] // cell_px
    return np.lexsort((points.uv[:, 0], band, np.arange(len(band)) >= first))
