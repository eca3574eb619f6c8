"""Estimates the errors of the right camera's rows and disparities in flight, and shares them with the base."""

import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_agent.governor.cost_model import Work
from kiteline_agent.imaging.row_alignment import RowAlignment
from kiteline_agent.known_rig import KnownRigConfig, known_rig
from kiteline_agent.local_map.disparity_alignment import DisparityAlignment
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.mapping.camera_state import CameraState
from kiteline_agent.tracking.track import Track
from kiteline_codec.channel import RecordChannel
from kiteline_codec.schema import DisparityCalibration, StereoAlignment
from kiteline_core.arrays import F64
from kiteline_core.geometry import disparity_offset
from kiteline_core.geometry.cameras import Rectifier
from kiteline_core.ids import AgentId


class RightCamera:
    """Rows and disparity offset of the right camera of a stereo rig, estimated as it flies."""

    def __init__(
        self, agent: AgentId, camera: CameraState, local_map: LocalMap, rectifier: Rectifier, config: AgentConfig,
        channel: RecordChannel, work: Work,
    ) -> None:  # fmt: skip
        self._agent = agent
        self._work = work
        self._camera = camera
        self._map = local_map
        self._channel = channel
        self.rows = RowAlignment(rectifier, config.rows)
        self.disparities = DisparityAlignment(local_map, config.disparities) if config.disparities.on else None
        self._good_cov = np.eye(disparity_offset.TERMS) * disparity_offset.GOOD_PX**2
        self._cov_of: tuple[F64, F64] | None = None  # see disparity_cov: of which expected_cov it is, and its value
        self._found_px = disparity_offset.none()  # error of disparities, without the base's part
        self._sigma_px: float | None = None  # of it, once this flight found it

    def begin_with(self, known: KnownRigConfig) -> None:
        """Take over what earlier flights found, unless the camera was calibrated anew."""
        if not known.is_of(self._map.camera) or not known.rows_px:
            return
        self.rows.begin_with(known.rows, read=known.rows_read)
        self._map.set_disparity_offset(known.disparity)
        if self.disparities is not None and known.disparity_sigma_px > 0.0:
            self.disparities.begin_with(known.disparity, known.disparity_sigma_px)
        elif self.disparities is not None:
            self.disparities.expected_px = known.disparity
        self._found_px = known.disparity
        self._put(known.rows)

    def add(self, t_ns: int, track: Track) -> tuple[bool, list[str]]:
        """Estimate the disparity offset with a frame tracked at t_ns. Returns whether it moved the map, and events."""
        if self.disparities is None:
            return False, []
        covariance, disparities = self._camera.covariance, self.disparities
        disparities.add_row_evidence(self.rows.worn_evidence)
        if self.rows.roll_px is not None:
            covariance.set_roll(self.rows.roll_px)
        before = disparities.pairs
        change = disparities.add(t_ns, track.T_c_m, track.rows[track.inlier], track.observed[track.inlier])
        self._work.pairs += disparities.pairs - before
        cov, known = disparities.expected_cov, (disparities.rig_worn, disparities.good_information)
        moves = change is not None and disparities.moves_map(change)
        if change is not None and moves:
            # the odometry frame keeps the error that the map had until now
            covariance.set_disparity_error(cov + np.outer(change, change), *known)
            self._camera.correct_disparities(change)
            if disparities.voids_turns(change):
                self._camera.motion.forget_turns()
        covariance.set_disparity_error(cov, *known)
        if change is None:
            return False, []
        self._found_px = self._map.disparity_offset
        self._sigma_px = disparities.sigma_px if disparities.applied else None
        self._put(self.rows.estimate_px)
        return moves, disparities.take_events()

    @property
    def disparity_cov(self) -> F64:
        """(5,5) px^2: mean square of what the map's disparity offset is off by. The same object until it changes."""
        if self.disparities is None:
            return self._good_cov
        expected = self.disparities.expected_cov
        if self._cov_of is None or self._cov_of[0] is not expected:
            self._cov_of = expected, expected + self._good_cov
        return self._cov_of[1]

    def share_rows(self) -> list[str]:
        """Tell the base of rows that have changed. Returns events."""
        rows_px = self.rows.take_change()
        if rows_px is not None:
            self._put(rows_px)
        return self.rows.take_events()

    def take_base(self, record: DisparityCalibration) -> list[str]:
        """Take over the base's disparity offset, unless more is known here. Returns events."""
        before = self._map.disparity_offset
        if self.disparities is None:
            self._map.set_disparity_offset(record.disparity_px)
        elif not self.disparities.take_base(record.disparity_px, record.sigma_px):
            return []
        elif self.disparities.voids_turns(record.disparity_px - before):
            self._camera.motion.forget_turns()
        return [f"disparities in the middle are {record.disparity_px[0]:+.3f} px too large"]

    def _put(self, rows_px: F64) -> None:
        good = self.disparities is not None and self.disparities.is_good_offset
        self._channel.put(StereoAlignment(self._agent, rows_px, self.rows.read, self._found_px, self._sigma_px, good))

    def known(self) -> KnownRigConfig | None:
        """What is known now, for the next flight; None before anything was measured."""
        if not self.rows.known:
            return None
        sigma_px = None if self.disparities is None else self.disparities.applied_sigma_px
        offset_px = self._map.disparity_offset
        if self.disparities is not None and self.disparities.is_good_offset:
            # What this flight found beside it may be hardly determined: each flight finds that for itself.
            offset_px = self.disparities.expected_px
        return known_rig(self._map.camera, self.rows.estimate_px, offset_px, sigma_px, rows_read=self.rows.read)
