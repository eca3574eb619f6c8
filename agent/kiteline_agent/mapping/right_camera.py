"""What the flight finds of the right camera: errors of its rows and disparities, and what the base is told of them."""

from __future__ import annotations

import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_agent.imaging.row_alignment import RowAlignment
from kiteline_agent.known_rig import KnownRigConfig, known_rig
from kiteline_agent.local_map.disparity_alignment import DisparityAlignment
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.mapping.camera_state import CameraState
from kiteline_agent.tracking.track import Track
from kiteline_codec.channel import RecordChannel
from kiteline_codec.schema import StereoAlignment
from kiteline_core.geometry import disparity_offset
from kiteline_core.geometry.cameras import Rectifier
from kiteline_core.ids import AgentId


class RightCamera:
    """Rows and disparity offset of the right camera of a stereo rig, estimated as it flies."""

    def __init__(
        self, agent: AgentId, camera: CameraState, local_map: LocalMap, rectifier: Rectifier, config: AgentConfig,
        channel: RecordChannel,
    ) -> None:  # fmt: skip
        self._agent = agent
        self._camera = camera
        self._map = local_map
        self._channel = channel
        self.rows = RowAlignment(rectifier, config.rows)
        self.disparities = DisparityAlignment(local_map, config.disparities) if config.disparities.on else None
        self._began_with_px = np.zeros(disparity_offset.TERMS)  # error of disparities

    def begin_with(self, known: KnownRigConfig) -> None:
        """Take over what earlier flights found, unless the camera was calibrated anew."""
        if not known.is_of(self._map.camera):
            return
        self.rows.begin_with(known.rows, read=known.rows_read)
        self._map.set_disparity_offset(known.disparity)
        if self.disparities is not None and known.disparity.any():  # zero: not found yet
            self.disparities.begin_with(known.disparity)
        self._began_with_px = known.disparity
        self._channel.put(StereoAlignment(self._agent, known.rows, known.rows_read, known.disparity))

    def add(self, track: Track) -> list[str]:
        """Estimate the disparity offset with a tracked frame; map and camera move with it. Returns events."""
        if self.disparities is None:
            return []
        change = self.disparities.add(track.T_c_m, track.rows[track.inlier], track.observed[track.inlier])
        self._camera.covariance.set_disparity_error(self.disparities.expected_cov, self.disparities.worn)
        if change is None:
            return []
        self._camera.correct_disparities(change)
        return self.disparities.take_events()

    def share_rows(self) -> list[str]:
        """Tell the base of rows that have changed. Returns events."""
        rows_px = self.rows.take_change()
        if rows_px is not None:
            self._channel.put(StereoAlignment(self._agent, rows_px, self.rows.read, self._began_with_px))
        return self.rows.take_events()

    def known(self) -> KnownRigConfig | None:
        """What is known now, for the next flight; None before anything was measured."""
        if not self.rows.known:
            return None
        return known_rig(
            self._map.camera, self.rows.estimate_px, self._map.disparity_offset, rows_read=self.rows.read
        )  # fmt: skip
