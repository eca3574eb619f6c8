"""Keyframes on the filter's path: shared with the base, whose corrections of them move the live pose.

The filter keeps what it estimates: o stays continuous. A corrected keyframe moves m under the camera.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.corrections import Corrections
from kiteline_agent.governor.cost_model import Work
from kiteline_agent.governor.governor import Extra, Governor
from kiteline_agent.imaging import features
from kiteline_agent.imaging.alignment_kernels import TEMPLATE, TEMPLATE_LEVELS
from kiteline_agent.imaging.feature_kernels import BORDER
from kiteline_agent.imaging.features import Pyramid
from kiteline_agent.keyframes.policy import KeyframeNeed, Situation, coverage, keyframe_need
from kiteline_agent.keyframes.reference import ReferenceKeyframe
from kiteline_agent.local_map.keyframe_landmarks import KeyframeLandmarks
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.mapping.submaps import TRACKED_M, TRACKED_RAD, Submaps
from kiteline_agent.relocalisation.map_cache import MapCache
from kiteline_agent.step import Identity
from kiteline_codec.channel import RecordChannel
from kiteline_codec.coding import quantise
from kiteline_codec.schema import (
    CameraIntrinsics,
    GridTile,
    Key,
    KeyframeHeader,
    LivePose,
    NewLandmarks,
    Observations,
    Record,
    SubmapScale,
    SubmapTie,
)
from kiteline_core.arrays import F64, I64, U8, Bool
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import KEYPOINT_BITS, NO_KEYFRAME, KeyframeId, SubmapId
from kiteline_core.order_statistics import median

_USUAL_DEPTH_M = 4.0  # of a scene none of whose landmarks has a depth yet
_LEAST_FRESH = 8  # corners without a landmark at the base for which a keyframe is worth its bytes


@dataclass(frozen=True, slots=True)
class FilteredFrame:
    """A frame after the filter's update.

    T_o_c: (4,4). ids: (n,) of the tracked corners, increasing. uv: (n,2) px. octave: (n,). depth_m: (n,), 0: unknown.
    """

    number: int
    t_ns: int
    pyramid: Pyramid
    T_o_c: F64
    ids: I64
    uv: F64
    octave: U8
    depth_m: F64


class SharedKeyframes:
    """Decides which frames become keyframes, shares them, and applies what the base sends of them.

    T_m_o: (4,4) odometry frame in the submap, which begins as the identity.
    """

    def __init__(
        self, camera: RectifiedCamera, config: AgentConfig, identity: Identity, channel: RecordChannel,
        governor: Governor, work: Work,
    ) -> None:  # fmt: skip
        self._agent, self._camera, self._channel = identity.agent, camera, channel
        self._governor, self._work = governor, work
        self._submaps = Submaps(identity)
        self._submaps.open_next()
        few = min(config.keyframe.min_inliers, config.ekf.corners // 3)
        self._policy = replace(config.keyframe, min_inliers=few)
        # Poses of keyframes alone; one point at their typical depth tells by how much a correction moves the image.
        self._map = LocalMap(camera, replace(config.local_map, landmarks=1))
        self._map.activate(self.submap)
        self._reference = ReferenceKeyframe(self._map)
        cache = MapCache(camera, config.map_cache, None)
        self._corrections = Corrections(self._map, cache, config.smoothing, None, config.local_grid.tiles)
        self._landmark_of: dict[int, int] = {}  # id at the base of the landmark of a track
        self._anchored = 0  # tracks with such an id in the first frame after the newest keyframe
        self._made_ns = self._made_frame = 0  # of the newest keyframe
        self.T_m_o: F64 = np.eye(4)
        channel.put(CameraIntrinsics(identity.agent, camera))

    @property
    def submap(self) -> SubmapId:
        """The submap in which the camera is tracked."""
        return self._submaps.active

    # what the base sends

    def take(self, records: list[Record], removed: Sequence[Key]) -> list[str]:
        """Apply records of the base, and what it removed; the camera moves with its keyframe. Returns events."""
        T_m_k = self._reference.T_m_k
        moved, events = self._corrections.take(records, removed)
        after = self._reference.T_m_k
        if moved and T_m_k is not None and after is not None:
            self.T_m_o = se3.orthonormalise(after @ se3.inverse(T_m_k) @ self.T_m_o)
        return events

    @property
    def tiles(self) -> dict[tuple[int, int], GridTile]:
        """Tiles of the base's grid, by column and row."""
        return self._corrections.tiles

    # poses

    @property
    def keyframe(self) -> KeyframeId:
        """The keyframe relative to which poses are reported."""
        return self._reference.keyframe

    @property
    def T_k_c(self) -> F64:
        """(4,4) camera in that keyframe at the last frame."""
        return self._reference.T_k_c

    def share_pose(self, t_ns: int, quality: int) -> None:
        """Share the live pose of the last frame."""
        if self.keyframe != NO_KEYFRAME:
            self._channel.put(LivePose(self._agent, t_ns, self.keyframe, self.T_k_c, quality))

    def in_world(self, T_o_b: F64, t_ns: int) -> F64 | None:
        """T_w_b (4,4), with corrections smoothed; None until the base has placed the submap."""
        return self._corrections.in_world(
            self.submap, self.T_m_o @ T_o_b, se3.inverse(self.T_m_o), t_ns, metric=True
        )  # fmt: skip

    # keyframes

    def add(self, frame: FilteredFrame, *, tracked: bool) -> list[str]:
        """Take a frame in; make a keyframe if it is needed and time and link allow it. Returns events."""
        T_m_c = self.T_m_o @ frame.T_o_c
        self._reference.set_camera(T_m_c)
        anchored = np.array([i in self._landmark_of for i in frame.ids.tolist()], np.bool_)
        need = self._need(frame, anchored) if tracked else None
        if need is None:
            return []
        if self.keyframe != NO_KEYFRAME:
            if not need.pressing and frame.t_ns - self._made_ns < self._channel.keyframe_gap_ns():
                return []
            if not self._governor.may(Extra.KEYFRAME):
                return ["governor: keyframe postponed"]
        self._make(frame, T_m_c, anchored)
        events = [f"keyframe: {need.rule}"]
        if self._reference.is_full(self.submap) and self._submaps.room:
            self._continue_full(frame, T_m_c)
            events += ["submap: full", "submap: opened"]
        return events

    def _need(self, frame: FilteredFrame, anchored: Bool) -> KeyframeNeed | None:
        """Why a frame should become a keyframe; None if it need not."""
        if self.keyframe == NO_KEYFRAME:
            return KeyframeNeed("first", True)
        if self._reference.is_full(self.submap):
            return None  # nor are ids of submaps left
        held, since = int(np.count_nonzero(anchored)), frame.number - self._made_frame
        if since == 1:
            self._anchored = held
        shift_m, turn_rad = se3.shift_and_turn(self.T_k_c)
        situation = Situation(
            since, (frame.t_ns - self._made_ns) * 1e-9, held, self._anchored,
            coverage(frame.uv[anchored], self._camera), shift_m / self._typical_depth(frame) if held else 0.0, turn_rad,
        )  # fmt: skip
        if int(np.count_nonzero(~anchored)) < _LEAST_FRESH:  # another keyframe would not help where corners are few
            enough = max(held, self._anchored, self._policy.min_inliers)
            situation = replace(situation, inliers=enough, cover=1.0)
        return keyframe_need(situation, self._policy)

    def _typical_depth(self, frame: FilteredFrame) -> float:
        known = frame.depth_m[frame.depth_m > 0.0]
        return max(float(median(known)), 0.1) if len(known) else _USUAL_DEPTH_M

    def _make(self, frame: FilteredFrame, T_m_c: F64, anchored: Bool) -> None:
        """Share a keyframe, and make it the reference."""
        reference, profile = self._reference, self._channel.profile
        T_m_p = reference.T_m_k
        keyframe, parent, T_p_k = reference.next_keyframe(self.submap, T_m_c)
        order = self._new_rows(frame, anchored, profile.landmarks)
        landmarks = self._new_landmarks(keyframe, frame, order)
        first = min(len(order), profile.landmarks)
        observations = self._observations(keyframe, frame, np.flatnonzero(anchored), first)
        strength = np.where(landmarks.inv_depth > 0.0, 1.0, 0.5)
        sections = profile.choose(landmarks, strength, observations)
        keypoints = sum(len(p.index) for p in sections[0]) + sum(len(p.index) for p in sections[1])
        header = self._channel.put(KeyframeHeader(keyframe, frame.t_ns, parent, T_p_k, keypoints))
        assert isinstance(header, KeyframeHeader)
        for part in sections[0]:
            self._channel.put(part)
        for seen in sections[1]:
            self._channel.put(seen)
        if parent == NO_KEYFRAME:
            self._channel.put(SubmapScale(self.submap, 1.0))  # metres, by the odometer
        shared = sum(len(part.index) for part in sections[0])
        self._landmark_of = {i: self._landmark_of[i] for i in frame.ids[anchored].tolist()}
        for index, track in enumerate(frame.ids[order[:shared]].tolist()):
            self._landmark_of[track] = (keyframe << KEYPOINT_BITS) | index
        self._store(header, T_m_c, frame)
        T_m_k = se3.orthonormalise(header.T_p_k if T_m_p is None or parent == NO_KEYFRAME else T_m_p @ header.T_p_k)
        reference.set_new(keyframe, self.submap, T_m_c, T_m_k, frame.t_ns, frame.number)
        self._made_ns, self._made_frame = frame.t_ns, frame.number
        self._work.keyframes += 1
        self._work.new_landmarks += len(order)
        self._work.observations += len(observations.index)

    def _continue_full(self, frame: FilteredFrame, T_m_c: F64) -> None:
        """Continue in another submap, as the ids of keyframes in this one are used up.

        It has the axes of the old one. The base merges the two by their keyframes of this frame.
        """
        since, T_k_c = self.keyframe, self.T_k_c.copy()
        submap = self._submaps.open_next()
        self._map.activate(submap)
        self._make(frame, T_m_c, np.zeros(len(frame.ids), np.bool_))
        self._channel.put(SubmapTie(submap, since, T_k_c, TRACKED_M, TRACKED_RAD))
        self._corrections.note_continued(submap)

    def _new_rows(self, frame: FilteredFrame, anchored: Bool, most: int) -> I64:
        """Rows of the corners that become landmarks, the best `most` first, each group by image rows."""
        margin = (BORDER + 1.0) * (1 << frame.octave.astype(np.int64))[:, None]
        size = np.array([self._camera.width, self._camera.height], np.float64)
        inside = (frame.uv >= margin).all(axis=1) & (frame.uv < size - margin).all(axis=1)
        rows = np.flatnonzero(inside & ~anchored)
        rank = np.empty(len(rows), np.int64)
        rank[np.argsort(frame.depth_m[rows] <= 0.0, kind="stable")] = np.arange(len(rows))  # older tracks first
        return np.asarray(rows[np.lexsort((frame.uv[rows, 0], frame.uv[rows, 1] // 32.0, rank >= most))])

    def _new_landmarks(self, keyframe: KeyframeId, frame: FilteredFrame, rows: I64) -> NewLandmarks:
        uv, octave, depth_m = frame.uv[rows], frame.octave[rows], frame.depth_m[rows]
        angle, descriptor = features.describe(frame.pyramid, uv, octave)
        return NewLandmarks(
            keyframe, 0, np.arange(len(rows), dtype=np.uint16),
            quantise.pixels(quantise.pixel_codes(uv.astype(np.float32))),
            np.where(depth_m > 0.0, 1.0 / np.maximum(depth_m, 1e-3), 0.0).astype(np.float32), octave, angle, descriptor,
        )  # fmt: skip

    def _observations(self, keyframe: KeyframeId, frame: FilteredFrame, rows: I64, first: int) -> Observations:
        """Observations of landmarks of older keyframes, without depths: one image measures none."""
        landmarks = np.array([self._landmark_of[i] for i in frame.ids[rows].tolist()], np.int64)
        rows, landmarks = rows[np.argsort(landmarks)], np.sort(landmarks)
        return Observations(
            keyframe, 0, np.arange(first, first + len(rows), dtype=np.uint16), frame.uv[rows].astype(np.float32),
            np.zeros(len(rows), np.float32), frame.octave[rows], landmarks,
        )  # fmt: skip

    def _store(self, header: KeyframeHeader, T_m_k: F64, frame: FilteredFrame) -> None:
        """Keep the pose, to compose later ones from it."""
        parent = self._map.slot_of(header.parent)
        if header.parent != NO_KEYFRAME and parent >= 0:
            header = replace(header, T_p_k=se3.orthonormalise(se3.inverse(self._map.T_m_k[parent]) @ T_m_k))
        centre, rho = np.array([[self._camera.cx, self._camera.cy]]), np.array([1.0 / self._typical_depth(frame)])
        blank = np.zeros((1, TEMPLATE_LEVELS, TEMPLATE, TEMPLATE), np.uint8)
        none = np.zeros(1, np.uint8)
        one = KeyframeLandmarks(centre, rho, rho, none, none, np.zeros((1, 32), np.uint8), blank)
        self._map.add(header, T_m_k, one, frame.number)
        self._map.share(header.keyframe, 0)
