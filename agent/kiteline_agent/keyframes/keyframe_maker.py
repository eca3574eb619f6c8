"""Making a keyframe: sightings of tracked points, births of new ones, shared and remembered as their codes' values."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.config import AgentConfig
from kiteline_agent.governor.cost_model import Work
from kiteline_agent.imaging import alignment_kernels
from kiteline_agent.keyframes.policy import NewPoints, new_points
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.tracking.tracker import FrameImages, Track
from kiteline_codec.channel import RecordChannel
from kiteline_codec.schema import KeyframeHeader, NewLandmarks, Observations
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import NO_KEYFRAME, KeyframeId

F64 = NDArray[np.float64]

_LEAST_RHO = 1e-4  # 1/m; farther is nowhere


class KeyframeMaker:
    """Turns a tracked frame into records for the base and into a slot of the local map."""

    def __init__(
        self, local_map: LocalMap, camera: RectifiedCamera, config: AgentConfig, channel: RecordChannel, work: Work
    ) -> None:
        self._map = local_map
        self._camera = camera
        self._config = config
        self._channel = channel
        self._work = work
        self._fresh: NewPoints | None = None  # found by `enough`, for the keyframe that follows at once

    def configure(self, config: AgentConfig) -> None:
        """From now on so much effort."""
        self._config = config

    def enough(self, view: FrameImages, points: int) -> bool:
        """Whether a view by itself gives at least so many points with depth."""
        fresh = new_points(view, np.zeros((0, 2)), self._camera, self._config)
        enough = int(np.count_nonzero(fresh.disparity > 0.0)) >= points
        self._fresh = fresh if enough else None
        return enough

    def look(self, view: FrameImages, track: Track) -> NewPoints:
        """What would be born in a keyframe of a tracked frame."""
        return new_points(view, self._seen(track)[1][:, :2], self._camera, self._config)

    def _seen(self, track: Track) -> tuple[NDArray[np.int64], F64]:
        """Rows (n,) and places (n,3) of the inliers, in order of point."""
        keep = np.flatnonzero(track.inlier)
        keep = keep[np.argsort(self._map.point_ids(track.rows[keep]), kind="stable")]
        return track.rows[keep], track.observed[keep]

    def begin_with(self, points: NewPoints) -> None:
        """What is born in the keyframe that follows at once."""
        self._fresh = points

    def make(
        self, view: FrameImages, track: Track | None, keyframe: KeyframeId, t_ns: int, parent: KeyframeId, T_p_k: F64,
        frame_number: int,
    ) -> F64:  # fmt: skip
        """Share and remember a keyframe; its pose T_m_k (4,4) as both sides hold it. Without a track, a map begins."""
        if track is None:
            rows, seen = np.zeros(0, np.int64), np.zeros((0, 3))
        else:
            rows, seen = self._seen(track)
        fresh, self._fresh = self._fresh, None
        if fresh is None:
            fresh = new_points(view, seen[:, :2], self._camera, self._config)
        # Births first, in the order of image rows: neighbours code shortest.
        band = fresh.uv[:, 1] // self._config.detector.cell_px
        profile = self._channel.profile
        order = np.lexsort((fresh.uv[:, 0], band, np.arange(len(band)) >= profile.landmarks))
        births, strength = self._births(keyframe, fresh, order)
        shared = self._map.is_shared(rows)
        sightings = self._sightings(keyframe, rows[shared], seen[shared], min(len(order), profile.landmarks))
        sections = profile.choose(births, strength, sightings)
        n_keypoints = sum(len(b.index) for b in sections[0]) + sum(len(s.index) for s in sections[1])
        head = KeyframeHeader(keyframe, t_ns, parent, T_p_k, n_keypoints)
        self._work.keyframes += 1
        self._work.detected_px += view.left[max(view.first, self._config.detector.first)].size
        self._work.births += len(births.index)
        self._work.sightings += len(sightings.index)
        shared_head = self._channel.put(head)
        assert isinstance(shared_head, KeyframeHeader)
        uv, rho = births.uv.astype(np.float64), births.inv_depth.astype(np.float64)
        for part in sections[0]:
            agreed = self._channel.put(part)
            assert isinstance(agreed, NewLandmarks)
            uv[agreed.index], rho[agreed.index] = agreed.uv, agreed.inv_depth
        for section in sections[1]:
            self._channel.put(section)
        rho = np.where(rho > 0.0, np.maximum(rho - self._map.offset_px(uv) / self._camera.bf, _LEAST_RHO), 0.0)
        T_m_k = self._placed(shared_head)
        lent_rho = np.zeros(len(order)) if fresh.lent_rho is None else fresh.lent_rho[order]
        self._remember(view, shared_head, T_m_k, uv, rho, lent_rho, births, frame_number)
        self._map.share(keyframe, sum(len(part.index) for part in sections[0]))
        return T_m_k

    def _births(self, keyframe: KeyframeId, fresh: NewPoints, order: NDArray[np.int64]) -> tuple[NewLandmarks, F64]:
        disparity = fresh.disparity[order]
        n = len(order)
        births = NewLandmarks(
            keyframe,
            0,
            np.arange(n, dtype=np.uint16),
            fresh.uv[order].astype(np.float32),
            self._as_measured(disparity, fresh.uv[order]),
            fresh.octave[order],
            fresh.angle[order],
            fresh.descriptor[order],
        )
        return births, np.where(disparity > 0.0, 1.0, 0.0) - order / (2.0 * max(n, 1))

    def _sightings(self, keyframe: KeyframeId, rows: NDArray[np.int64], seen: F64, first: int) -> Observations:
        return Observations(
            keyframe,
            0,
            np.arange(first, first + len(rows), dtype=np.uint16),
            seen[:, :2].astype(np.float32),
            self._as_measured(seen[:, 2], seen[:, :2]),
            self._map.octave[rows],
            self._map.point_ids(rows),
        )

    def _as_measured(self, disparity: F64, uv: F64) -> NDArray[np.float32]:
        """Inverse depths (n,) 1/m to be shared, 0 for none: as the pair measures, for the base to judge its offset."""
        raw = disparity + self._map.offset_px(uv)
        return np.where((disparity > 0.0) & (raw > 0.0), raw / self._camera.bf, 0.0).astype(np.float32)

    def _placed(self, head: KeyframeHeader) -> F64:
        if head.parent == NO_KEYFRAME:
            return head.T_p_k
        return se3.orthonormalise(self._map.T_m_k[self._map.slot_of(head.parent)] @ head.T_p_k)

    def _remember(
        self,
        view: FrameImages,
        head: KeyframeHeader,
        T_m_k: F64,
        uv: F64,
        rho: F64,
        lent_rho: F64,
        births: NewLandmarks,
        frame_number: int,
    ) -> None:
        octave = births.octave
        templates = np.empty(
            (len(uv), alignment_kernels.TEMPLATE_LEVELS, alignment_kernels.TEMPLATE, alignment_kernels.TEMPLATE),
            np.uint8,
        )
        alignment_kernels.cut_templates(view.left, uv, octave, templates)
        sigma = self._config.stereo.sigma_px * (1 << octave).astype(np.float64) / self._camera.bf
        if view.depth_m is not None and not self._camera.stereo:
            sigma = np.maximum(sigma, _depth_camera_sigma(rho))
        lent = lent_rho > 0.0
        rho = np.where(lent, lent_rho, rho)
        sigma[lent] = np.minimum(sigma[lent], self._config.window.sigma_px / self._camera.bf)
        self._map.add(
            head, T_m_k, uv, rho, sigma, octave, births.angle, births.descriptor, templates, frame_number
        )  # fmt: skip


def _depth_camera_sigma(rho: F64) -> F64:
    """Deviation of inverse depth (n,) 1/m of a structured-light camera: constant (K. Khoshelham, S. Elberink, 2012)."""
    return np.full(len(rho), 2.85e-3)
