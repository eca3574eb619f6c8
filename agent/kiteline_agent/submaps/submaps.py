"""Submaps: which one is active, and how a new one begins: from a pair, from two views, or with a scale found late."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.initialisation.metric_restart import MetricPoints
from kiteline_agent.initialisation.two_view_start import TwoViewMap
from kiteline_agent.keyframes.keyframe_maker import KeyframeMaker
from kiteline_agent.keyframes.reference import ReferenceKeyframe
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.relocalisation.relocaliser import Relocalisation
from kiteline_agent.step import Identity
from kiteline_agent.tracking.pose_state import PoseState
from kiteline_agent.tracking.tracker import FrameImages
from kiteline_core.geometry import se3
from kiteline_core.ids import MAX_SUBMAPS, SubmapId, submap_id

F64 = NDArray[np.float64]


class Submaps:
    """Opens submaps and returns to older ones; the odometry frame stays still through all of it."""

    def __init__(
        self,
        identity: Identity,
        local_map: LocalMap,
        pose: PoseState,
        reference: ReferenceKeyframe,
        maker: KeyframeMaker,
    ) -> None:
        self._identity = identity
        self._map = local_map
        self._pose = pose
        self._reference = reference
        self._maker = maker
        self._number = -1  # of the active one
        self.opened = 0

    @property
    def any(self) -> bool:
        """Whether there is a map."""
        return self._number >= 0

    @property
    def room(self) -> bool:
        """Whether ids are left for another one."""
        return self.opened < MAX_SUBMAPS

    @property
    def active(self) -> SubmapId:
        """The submap in which the agent tracks (the first one before it has begun)."""
        return submap_id(self._identity.agent, self._identity.boot, max(self._number, 0))

    @property
    def first(self) -> SubmapId:
        """The submap in which the flight begins."""
        return submap_id(self._identity.agent, self._identity.boot, 0)

    def open_from_pair(self, view: FrameImages, t_ns: int, frame: int) -> None:
        """The first keyframe gives depth by itself. Where the camera is has been set."""
        self._next()
        self._pose.stand()
        self._reference.add(view, None, t_ns, frame, self.active, self._pose.T_m_c)

    def open_from_two_views(self, frame: int, opening: TwoViewMap, sigma_px: float) -> F64:
        """The first keyframe of one eye's map. The second view stays where the camera was thought to be; T_m_a (4,4)
        says where that puts the first one.
        """
        self._next()
        self._pose.stand()
        self._maker.begin_with(opening.points)
        T_m_a = self._pose.T_m_c @ se3.inverse(opening.T_a_b)
        self._reference.add(opening.view, None, opening.t_ns, frame, self.active, T_m_a)
        self._reference.refresh(self._pose.T_m_c)
        opening.sharpen(self._map, self._reference.keyframe, sigma_px)
        return T_m_a

    def open_in_metres(self, view: FrameImages, t_ns: int, frame: int, unit_m: float, born: MetricPoints) -> F64:
        """Go on in a new submap whose unit is a metre, from points that are tracked now; the old one is left behind.
        T_new_old (4,4), of lengths in m.
        """
        T_n_m = self._pose.rescale(unit_m)
        self._map.forget(self.active)
        self._next()
        self._maker.begin_with(born.points)
        self._reference.add(view, None, t_ns, frame, self.active, self._pose.T_m_c)
        born.sharpen(self._map, self._reference.keyframe)
        return T_n_m

    def return_to(self, found: Relocalisation, frame: int) -> None:
        """Go on in the submap and from the keyframe where the old map was found."""
        self._number = found.submap % MAX_SUBMAPS
        self._map.activate(found.submap)
        self._reference.move_to(found.keyframe, found.track.inliers, frame)
        self._pose.move_map(se3.inverse(found.T_c_m))
        self._reference.refresh(self._pose.T_m_c)
        self._map.note_tracking(found.track.rows, found.track.inlier, frame)

    def _next(self) -> None:
        self._number = self.opened
        self.opened += 1
        self._map.activate(self.active)
