"""Calibrations and disparity offsets of the agents' cameras."""

from bisect import bisect_right

import numpy as np

from kiteline_basestation.map.map_view import MapView
from kiteline_codec.schema import StereoAlignment
from kiteline_core.arrays import F64
from kiteline_core.geometry import disparity_offset
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import AgentId, KeyframeId, agent_of_keyframe, submap_of_keyframe

_REPAIRED_PX = 0.5  # difference of a number of a disparity offset; flights of one rig differ by a tenth


class RigValues(MapView):
    """A map whose agents' cameras can be set."""

    def __init__(self) -> None:
        super().__init__()
        self.far_poses = 0  # poses that were left out: they are farther off than any flight leads

    def set_camera(self, agent: AgentId, camera: RectifiedCamera) -> None:
        """Set the rectified camera of an agent, also for its keyframes so far.

        Disparity offsets outlive the flight: the agent's next one begins with them. They end with the calibration told.
        """
        before = self.cameras.get(agent)
        if before is not None and parameters(before) != parameters(camera):
            self.rows_px.pop(agent, None)
            self.rows_read.discard(agent)
            self.known_offset_px.pop(agent, None)
            self.good_offset_px.pop(agent, None)
            self.onboard_sigma_px.pop(agent, None)
            self.disparity_sigma_px.pop(agent, None)
            if agent in self.disparity_offset_px:
                self.disparity_offset_px[agent] = disparity_offset.none()
                self.disparity_calibrated.discard(agent)
        self.cameras[agent] = camera
        for keyframe, row in self.rows.items():
            if agent_of_keyframe(keyframe) == agent:
                self.keyframes.camera[row] = parameters(camera)

    def set_stereo_alignment(self, record: StereoAlignment) -> None:
        """Set what an agent knows of its right camera. A disparity offset of earlier flights that was estimated here
        counts more, unless the rig was repaired since; one that the agent finds in this flight counts until the offset
        is better known here. A good calibration's counts unless a worn rig's is known here.
        """
        agent = record.agent
        self.rows_px[agent] = record.rows_px
        self.rows_read.discard(agent)
        if record.rows_read:
            self.rows_read.add(agent)
        if record.good_calibration:
            self._set_good_offset(agent, record.disparity_px)
            return
        if record.sigma_px is None and not np.any(record.disparity_px != 0.0):
            return
        if agent not in self.disparity_offset_px and record.sigma_px is None:
            self.disparity_offset_px[agent] = self.known_offset_px[agent] = record.disparity_px
        if record.sigma_px is None:
            return
        known = self.known_offset_px.get(agent) if agent not in self.onboard_sigma_px else None
        if known is not None and np.abs(record.disparity_px - known).max() < _REPAIRED_PX:
            return
        if known is not None:
            self.disparity_sigma_px.pop(agent, None)
        self.known_offset_px[agent], self.onboard_sigma_px[agent] = record.disparity_px, record.sigma_px
        if self.disparity_sigma_px.get(agent, np.inf) > record.sigma_px:
            self.disparity_offset_px[agent], self.disparity_sigma_px[agent] = record.disparity_px, record.sigma_px
            self.disparity_calibrated.discard(agent)

    def _set_good_offset(self, agent: AgentId, offset: F64) -> None:
        """Set a good calibration's offset (5,) px that the agent found, in place of a worn rig's that was repaired."""
        known = self.known_offset_px.get(agent)
        if known is not None and np.abs(offset - known).max() >= _REPAIRED_PX:
            self.known_offset_px.pop(agent)
            self.onboard_sigma_px.pop(agent, None)
            self.disparity_sigma_px.pop(agent, None)
            self.disparity_calibrated.discard(agent)
        if agent not in self.disparity_sigma_px:
            self.disparity_offset_px[agent] = self.good_offset_px[agent] = offset

    def note_offset(self, keyframe: KeyframeId) -> None:
        """Note the disparity offset that both sides know as a keyframe arrives: its motion was measured with it.

        One that arrives late was measured before the next one of its submap, and shares the offset of that.
        """
        submap = self.submaps[submap_of_keyframe(keyframe)]
        after = submap[bisect_right(submap, keyframe) :]
        if after:
            offset: F64 | None = self.offset_measured_with(after[0])
        else:
            offset = self.disparity_offset_px.get(agent_of_keyframe(keyframe))
        if offset is not None and not np.array_equal(offset, self.offset_measured_with(keyframe)):
            self.measured_with_px[keyframe] = offset


def parameters(camera: RectifiedCamera) -> tuple[float, float, float, float, float]:
    """fx fy cx cy bf of a camera."""
    return camera.fx, camera.fy, camera.cx, camera.cy, camera.bf
