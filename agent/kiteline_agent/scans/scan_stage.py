"""Makes column scans of keyframes, spread over frames: a stripe of the disparity image each, then ground and labels."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.governor.cost_model import Work
from kiteline_agent.governor.governor import Governor
from kiteline_agent.keyframes.keyframe_maker import KeyframeMaker
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.mapping.camera_state import CameraState
from kiteline_agent.scan_config import ScanConfig
from kiteline_agent.tracking.frame_context import FrameContext
from kiteline_codec.channel import RecordChannel
from kiteline_codec.schema import Key, KeyframeScan
from kiteline_core.geometry import se3
from kiteline_core.ground.config import GroundConfig
from kiteline_core.ground.disparity import DisparityStripes
from kiteline_core.ground.segmentation import GroundSegmenter
from kiteline_core.ids import KeyframeId

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_MOST_PARTS = 2  # of a scan in one frame, after a gap too
_UNDER_WAY = 4  # scans that are sent before the first of them is known to have arrived
_RECENT = 16  # scans that are taken back if a lower ground is seen
_WAITING = 256  # scans kept while the link has no room, 1 MB


@dataclass(frozen=True, slots=True)
class Scanned:
    """A finished scan. T_o_c: (4,4) of its camera in the odometry frame, in which that does not move any more."""

    record: KeyframeScan
    T_o_c: F64


@dataclass(slots=True)
class _Begun:
    """A scan that is being made. uv: (n,2) keypoints to label. stripe: the next one; disparity: of a depth camera."""

    keyframe: KeyframeId
    up_c: F64
    T_o_c: F64
    uv: F64
    disparity: F32 | None
    stripe: int = 0


class ScanStage:
    """Chooses keyframes to scan, makes the scans, and shares them. For cameras that measure depth."""

    def __init__(
        self, camera: CameraState, local_map: LocalMap, maker: KeyframeMaker, governor: Governor,
        channel: RecordChannel, config: ScanConfig, ground: GroundConfig, work: Work,
    ) -> None:  # fmt: skip
        self._camera = camera
        self._map = local_map
        self._maker = maker
        self._governor = governor
        self._channel = channel
        self._config = config
        self._work = work
        self._segmenter = GroundSegmenter(local_map.camera, ground)
        self._stripes = DisparityStripes(self._segmenter.camera, ground) if local_map.camera.stereo else None
        self._begun: _Begun | None = None
        self._last_T_o_c: F64 | None = None  # of the newest scan
        self._ground_m: float | None = None  # height of the ground along the vertical, in the odometry frame
        self._without_ground = 0  # scans since ground was seen
        self._under_way: list[Key] = []
        self._waiting: deque[KeyframeScan] = deque(maxlen=_WAITING)
        self._recent: deque[tuple[KeyframeScan, float]] = deque(maxlen=_RECENT)  # and the height of their ground

    def certain_m(self, sigma_m: float) -> float:
        """Distance up to which ranges of scans deviate by less than sigma_m."""
        return self._segmenter.certain_m(sigma_m)

    def step(self, ctx: FrameContext) -> Scanned | None:
        """Go on with the scan in work, or begin one if this frame became a keyframe that shows something new."""
        self._share_waiting()
        if not ctx.config.scan.on:
            return None
        if self._begun is None:
            if self._camera.reference.is_of(ctx.number) and self._shows_more():
                self._begin(ctx)
            return None
        if self._camera.reference.is_of(ctx.number) or not self._governor.may_scan():
            return None  # a keyframe is work enough for a frame
        begun = self._begun
        parts = min(_MOST_PARTS, max(1, round(ctx.dt_s / self._config.part_s)))
        for _ in range(parts):
            if begun.disparity is None and not self._match_stripe(begun):
                continue
            assert begun.disparity is not None
            self._begun = None
            return self._finish(begun, begun.disparity)
        return None

    def _match_stripe(self, begun: _Begun) -> bool:
        """Match the next stripe; True if there was none left, and the disparity is whole."""
        assert self._stripes is not None
        if begun.stripe == self._stripes.stripes:
            begun.disparity = self._stripes.finish()
            return True
        self._stripes.match(begun.stripe)
        self._work.matched_px += self._stripes.stripe_px
        begun.stripe += 1
        return False

    def _shows_more(self) -> bool:
        """True if the camera has moved or turned since the last scan by enough to see something else."""
        if self._last_T_o_c is None:
            return True
        change = se3.inverse(self._last_T_o_c) @ self._T_o_c()
        moved_m, turned_rad = np.linalg.norm(change[:3, 3]), np.linalg.norm(se3.so3_log(change[:3, :3]))
        return bool(moved_m > self._config.moved_m or turned_rad > self._config.turned_rad)

    def _T_o_c(self) -> F64:
        return np.asarray(self._camera.pose.T_o_m @ self._camera.pose.T_m_c)

    def _begin(self, ctx: FrameContext) -> None:
        """Take what a scan of this keyframe needs of the frame."""
        images, disparity = ctx.images, None
        if images.depth_m is not None:
            disparity = self._segmenter.camera.disparity_of_depth(images.depth_m)
        elif images.right is None or self._stripes is None:
            return
        else:
            self._stripes.begin(images.aligned[1], images.right.coarse()[1])
        up = self._camera.motion.up()
        up_c = self._camera.pose.T_m_c[2, :3].copy() if up is None else up[0]  # z of a submap points up
        keyframe = self._camera.reference.keyframe
        self._begun = _Begun(keyframe, up_c, self._T_o_c(), self._maker.new_uv, disparity)
        self._last_T_o_c = self._begun.T_o_c

    def _finish(self, begun: _Begun, disparity: F32) -> Scanned:
        segmenter, stereo = self._segmenter, self._stripes is not None
        up_o = begun.T_o_c[:3, :3] @ begun.up_c
        height_m = float(up_o @ begun.T_o_c[:3, 3])
        expected_m = None if self._ground_m is None else height_m - self._ground_m
        scan = segmenter.segment(
            disparity, self._stripes.pair if self._stripes is not None else None, begun.up_c,
            self._map.disparity_offset * (segmenter.camera.bf / self._map.camera.bf) if stereo else None, expected_m,
            certain=self._without_ground < self._config.doubted,
        )  # fmt: skip
        self._work.segmented_px += disparity.size
        self._without_ground += 1
        if segmenter.saw_ground:
            self._ground_m, self._without_ground = height_m - scan.camera_height_m, 0
            self._withdraw(self._ground_m + segmenter.config.expected_m)
        labels = segmenter.label_of(begun.uv)
        record = KeyframeScan(begun.keyframe, scan, labels[:0] if self._channel.profile.thin else labels)
        if self._ground_m is not None:
            self._recent.append((record, self._ground_m))
        self._waiting.append(record)
        self._share_waiting()
        return Scanned(record, begun.T_o_c)

    def _withdraw(self, highest_m: float) -> None:
        """Take back recent scans whose ground lies higher: nothing is seen through the ground, so it was a table."""
        for record, ground_m in self._recent:
            if ground_m > highest_m:
                n = len(record.scan)
                blank = replace(
                    record.scan, free_from_m=np.zeros(n), free_m=np.zeros(n), obstacle_m=np.full(n, np.inf),
                    bands=np.zeros(n, np.uint8), camera_height_m=float("nan"),
                )  # fmt: skip
                self._waiting.append(KeyframeScan(record.keyframe, blank, record.labels[:0]))
        kept = [(record, ground_m) for record, ground_m in self._recent if ground_m <= highest_m]
        self._recent = deque(kept, maxlen=_RECENT)

    def _share_waiting(self) -> None:
        """Share scans, newest first, while those before arrive: they never fill a link that is short of bytes."""
        if not self._waiting:
            return
        self._under_way = [key for key in self._under_way if not self._channel.arrived(key)]
        while self._waiting and len(self._under_way) < _UNDER_WAY:
            record = self._waiting.pop()
            others = [r for r in self._waiting if r.keyframe != record.keyframe]  # an older one was taken back
            self._waiting = deque(others, maxlen=_WAITING)
            self._channel.put(record)
            self._under_way.append(record.key())
