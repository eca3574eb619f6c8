"""Makes column scans, spread over frames: a stripe of the disparity image each, then ground and labels.

Keyframes are scanned, and frames between them in which something new is seen; a view that stays is scanned again now
and then. The height of the ground is followed from scan to scan; those that saw another are held back or withdrawn.
If the base makes the scans, their images are sent in place of all that, except while the link does not carry them.
"""

from dataclasses import dataclass, replace

import numpy as np

from kiteline_agent.governor.cost_model import Work
from kiteline_agent.governor.governor import Governor
from kiteline_agent.keyframes.keyframe_maker import KeyframeMaker
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.mapping.camera_state import CameraState
from kiteline_agent.scan_config import ScanConfig
from kiteline_agent.scans.range_error import RangeError
from kiteline_agent.scans.scan_queue import ScanQueue
from kiteline_agent.scans.sent_images import SentImages
from kiteline_agent.tracking.frame_context import FrameContext
from kiteline_codec.channel import RecordChannel
from kiteline_codec.schema import KeyframeScan, ScanImages
from kiteline_core.arrays import F32, F64, U8, Bool
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import Rectifier
from kiteline_core.ground.column_scan import ColumnScan
from kiteline_core.ground.config import GroundConfig
from kiteline_core.ground.disparity import DisparityStripes
from kiteline_core.ground.ground_height import GroundHeight, Seen, Verdict
from kiteline_core.ground.image_codes import encode_pair
from kiteline_core.ground.segmentation import GroundSegmenter
from kiteline_core.ground.wide_view import WideView
from kiteline_core.ids import NO_KEYFRAME, KeyframeId

_MOST_PARTS = 2  # of a scan in one frame, after a gap too
_AGAIN_S = 0.5  # s after which a camera that stays where it is scans again for the local grid: people walk in
_TELLS_OF = 4  # scans of which none is believed, after which the base is told that there are some
_PART_S = 0.05  # s between frames in which a stripe is matched: two at 10 Hz, so that every keyframe can be scanned


@dataclass(frozen=True, slots=True)
class Scanned:
    """A finished scan. T_o_c: (4,4) of its camera in the odometry frame, in which that does not move any more.

    height_m: of the camera above the ground; None while that is not known.
    offset_px: (5,) the disparity offset that it was made with (`disparity_offset`). repeats: the view of the scan
    before, which the base has.
    """

    scan: ColumnScan
    T_o_c: F64
    height_m: float | None
    offset_px: F64
    repeats: bool = False


@dataclass(slots=True)
class _Begun:
    """A scan that is being made. uv: (n,2) keypoints to label. stripe: the next one; disparity: of a depth camera.

    part: 0 of the keyframe itself; else T_k_s (4,4) is the pose of a later camera in it. repeats: see `Scanned`.
    as_images: the base makes it.
    """

    keyframe: KeyframeId
    part: int
    T_k_s: F64 | None
    up_c: F64
    T_o_c: F64
    uv: F64
    disparity: F32 | None
    stripe: int = 0
    repeats: bool = False
    as_images: bool = False

    @property
    def is_replaceable(self) -> bool:
        """True if a keyframe may take the place of its frame: nothing is matched, and it shows something new."""
        return not (self.stripe or self.repeats) and self.disparity is None


class ScanStage:
    """Chooses keyframes to scan, makes the scans, and shares them. For cameras that measure depth."""

    def __init__(
        self, camera: CameraState, rectifier: Rectifier, local_map: LocalMap, maker: KeyframeMaker,
        governor: Governor, channel: RecordChannel, config: ScanConfig, ground: GroundConfig, work: Work,
        covered: F64,
    ) -> None:  # fmt: skip
        """covered: (n,4) left, top, right, bottom of parts that show no surroundings, in shares of the image."""
        self._camera = camera
        self._map = local_map
        self._maker = maker
        self._governor = governor
        self._channel = channel
        self._config = config
        self._work = work
        # The base knows the rectified camera alone.
        self._view = WideView(rectifier, replace(ground, wider=0.0, lower=0.0) if config.by_base else ground)
        self._segmenter = GroundSegmenter(self._view.camera, ground)
        self._stripes = DisparityStripes(self._segmenter.camera, ground) if local_map.camera.stereo else None
        self._covered = self._covered_slices(covered)
        self._covered_right: Bool | None = None  # (h,w) of a disparity image
        self._raw: tuple[U8, U8] | None = None  # images of the scan that was begun, until they are matched
        self._begun: _Begun | None = None
        self._last_T_o_c: F64 | None = None  # of the newest scan of another view
        self._last_ns = 0  # when the newest scan was begun
        self._ground: GroundHeight[KeyframeScan] = GroundHeight()
        self._keyframe = NO_KEYFRAME  # the newest one, whose scans are numbered
        self._part = 0  # of its newest scan
        self._queue = ScanQueue(channel)
        self._unbelieved = 0  # scans, before the base has got any
        self._images = SentImages(channel)
        self._stretch = 0  # of the flight: counts losses after which the odometry frame lies elsewhere
        bf, at_scan = local_map.camera.bf, self._segmenter.camera.bf
        self._error = RangeError.of_noise(bf, self._segmenter.surface_sigma_px * bf / at_scan)

    def cover(self, left: F64, right: F64) -> None:
        """Leave out these parts (n,4) of the left image from now on, and what is matched with those of the right."""
        self._covered = self._covered_slices(left)
        seen = self._segmenter.camera
        self._covered_right = np.zeros((seen.height, seen.width), np.bool_) if len(right) else None
        for part in self._covered_slices(right):
            assert self._covered_right is not None
            self._covered_right[part] = True

    def _without_covered(self, disparity: F32) -> None:
        """Write 0 where a disparity image (h,w) shows covered parts."""
        for part in self._covered:
            disparity[part] = 0.0
        if self._covered_right is not None:
            rows, columns = np.nonzero(disparity > 0.0)
            there = np.maximum(np.round(columns - disparity[rows, columns]).astype(np.int64), 0)
            hidden = self._covered_right[rows, there]
            disparity[rows[hidden], columns[hidden]] = 0.0

    def range_error(self, cov_px: F64 | None) -> RangeError:
        """What is known of errors of ranges: the same object until more is known.

        cov_px: (5,5) of the disparity offset; None of a camera without one.
        """
        error, offset_px = self._error, self._map.disparity_offset
        if cov_px is not None and (cov_px is not error.cov_px or offset_px is not error.offset_px):
            self._error = replace(error, offset_px=offset_px, cov_px=cov_px)
        return self._error

    def step(self, ctx: FrameContext) -> Scanned | None:
        """Go on with the scan in work, or begin one if this frame became a keyframe that shows something new."""
        self._queue.share()
        self._images.remove_arrived()
        if not ctx.config.scan.on:
            return None
        reference = self._camera.reference
        of_keyframe = reference.is_of(ctx.number)
        if reference.is_newest and reference.keyframe != self._keyframe:
            self._keyframe, self._part = reference.keyframe, 0
        if self._begun is None or (of_keyframe and self._begun.is_replaceable):
            self._begin_if_due(ctx, of_keyframe)
            return None
        if of_keyframe or not self._governor.may_do_part():
            return None  # a keyframe is work enough for a frame
        begun = self._begun
        if begun.as_images:
            self._begun = None
            self._send_images(begun)
            return None
        parts = min(_MOST_PARTS, max(1, round(ctx.dt_s / _PART_S)))
        for _ in range(parts):
            if begun.disparity is None and not self._match_stripe(begun):
                continue
            assert begun.disparity is not None
            self._begun = None
            scanned = self._finish(begun, begun.disparity)
            if parts < _MOST_PARTS:  # a slow camera's next keyframe would come in the midst of it
                self._begin_if_due(ctx, of_keyframe)
            return scanned
        return None

    def _begin_if_due(self, ctx: FrameContext, of_keyframe: bool) -> None:
        """Begin a scan of a frame that shows something new, or of any one after a while."""
        shows_more = self._shows_more() or (of_keyframe and self._begun is not None)
        if shows_more or ctx.t_ns - self._last_ns > _AGAIN_S * 1e9:
            self._begin(ctx, of_keyframe, repeats=not shows_more)

    def forget(self) -> None:
        """The camera has moved by an unknown way: the ground lies elsewhere than where it was seen, in o."""
        self._begun = self._last_T_o_c = None
        self._stretch += 1
        self._ground = GroundHeight()

    def _match_stripe(self, begun: _Begun) -> bool:
        """Match the next stripe; True if there was none left, and the disparity is whole."""
        assert self._stripes is not None
        if begun.stripe == self._stripes.stripes:
            begun.disparity = self._view.mask(self._stripes.finish())
            self._stripes.learn_brightness(begun.disparity)
            return True
        if begun.stripe == 0:  # not in the frame of the keyframe
            self._stripes.begin(*self._take_pair())
        self._stripes.match(begun.stripe)
        self._work.matched_px += self._stripes.stripe_px
        begun.stripe += 1
        return False

    def _take_pair(self) -> tuple[U8, U8]:
        """The rectified half-size images (h,w) of the scan that was begun."""
        assert self._raw is not None
        left, right = self._view.pair(*self._raw)
        self._work.rectified_px += 2 * left.size
        self._raw = None
        return left, right

    def _send_images(self, begun: _Begun) -> None:
        """Let the base make a scan."""
        left, right = (self._segmenter.camera.reduced(half) for half in self._take_pair())
        self._work.coded_px += 2 * left.size
        code = encode_pair((left, right), self._config.jpeg_quality)
        self._images.put(
            ScanImages(begun.keyframe, begun.T_o_c, self._stretch, begun.up_c, code, begun.part, begun.T_k_s)
        )

    def _shows_more(self) -> bool:
        """True if the camera has moved or turned since the last scan by enough to see something else."""
        if self._last_T_o_c is None:
            return True
        change = se3.inverse(self._last_T_o_c) @ self._T_o_c()
        moved_m, turned_rad = np.linalg.norm(change[:3, 3]), np.linalg.norm(se3.so3_log(change[:3, :3]))
        return bool(moved_m > self._config.moved_m or turned_rad > self._config.turned_rad)

    def _T_o_c(self) -> F64:
        return np.asarray(self._camera.pose.T_o_m @ self._camera.pose.T_m_c)

    def _begin(self, ctx: FrameContext, of_keyframe: bool, *, repeats: bool) -> None:
        """Take what a scan of this frame needs."""
        images, disparity, reference = ctx.images, None, self._camera.reference
        as_images = self._config.by_base and images.depth_m is None and self._images.has_room
        if as_images and repeats:
            return
        # An older keyframe, to which a relocalisation led, has scans under the next numbers already.
        hangs = reference.keyframe != NO_KEYFRAME and reference.keyframe == self._keyframe
        if not (of_keyframe or repeats) and (not hangs or self._part == KeyframeScan.PARTS - 1):
            return
        if images.depth_m is not None:
            disparity = self._segmenter.camera.disparity_of_depth(images.depth_m)
        elif images.right is None or self._stripes is None:
            return
        else:
            self._raw = images.raw_half(), images.right.raw_half()
        up = self._camera.motion.up()
        up_c = self._camera.pose.T_m_c[2, :3].copy() if up is None else up[0]  # z of a submap points up
        T_o_c, self._last_ns = self._T_o_c(), ctx.t_ns
        if repeats:
            self._begun = _Begun(reference.keyframe, 0, None, up_c, T_o_c, np.empty((0, 2)), disparity, repeats=True)
            return
        self._last_T_o_c = T_o_c
        part, T_k_s, uv = 0, None, self._maker.new_uv
        if not of_keyframe:
            self._part += 1
            part, T_k_s, uv = self._part, reference.T_k_c.copy(), np.empty((0, 2))
        self._begun = _Begun(reference.keyframe, part, T_k_s, up_c, T_o_c, uv, disparity, as_images=as_images)

    def _covered_slices(self, covered: F64) -> tuple[tuple[slice, slice], ...]:
        """Rows and columns of disparity images that show covered parts; what ends at a border ends at theirs."""
        camera, seen = self._map.camera, self._segmenter.camera
        slices = []
        for left, top, right, bottom in covered:
            corners = np.array([[left, top], [right, bottom]]) * [camera.width, camera.height]
            rows, columns = seen.at(self._view.at(corners))
            first_row, first_column = (0 if top <= 0.0 else rows[0]), (0 if left <= 0.0 else columns[0])
            end_row = seen.height if bottom >= 1.0 else rows[1] + 1
            end_column = seen.width if right >= 1.0 else columns[1] + 1
            slices.append((slice(first_row, end_row), slice(first_column, end_column)))
        return tuple(slices)

    def _finish(self, begun: _Begun, disparity: F32) -> Scanned:
        segmenter, stereo = self._segmenter, self._stripes is not None
        self._without_covered(disparity)
        seen = segmenter.segment(
            disparity, self._stripes.pair if self._stripes is not None else None, begun.up_c,
            self._map.disparity_offset * (segmenter.camera.bf / self._map.camera.bf) if stereo else None,
            self._ground.expected(begun.T_o_c, begun.up_c),
        )  # fmt: skip
        self._work.segmented_px += disparity.size
        if not begun.repeats:
            labels = segmenter.label_of(self._view.at(begun.uv))
            labels = labels[:0] if self._channel.profile.thin else labels
            record = KeyframeScan(begun.keyframe, seen.scan, labels, begun.part, begun.T_k_s)
            verdict = self._ground.note(record, Seen(begun.T_o_c, *seen))
            self._take(verdict)
            if not verdict.believed:
                self._tell_of(record)
        ground = self._ground.expected(begun.T_o_c, begun.up_c)
        height_m = None if ground is None else ground.height_m
        return Scanned(seen.scan, begun.T_o_c, height_m, self._map.disparity_offset, begun.repeats)

    def _take(self, verdict: Verdict[KeyframeScan]) -> None:
        """Share scans that are believed, and take back those that are not any more."""
        for wrong in verdict.withdrawn:
            self._queue.put(wrong.without_ground())
        for record in verdict.believed:
            self._queue.put(record)

    def _tell_of(self, record: KeyframeScan) -> None:
        """Share what a scan shows without a ground, once, while none is believed.

        The base takes an agent without scans for one that makes none, and draws its landmarks: the lowest ones may be
        the top of a box where no floor was seen.
        """
        if self._queue.any_put:
            return
        self._unbelieved += 1
        if self._unbelieved == _TELLS_OF:
            self._queue.put(record.without_ground())
