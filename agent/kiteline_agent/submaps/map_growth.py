"""How the map grows: tracked frames sharpen it, some become keyframes, and submaps open where none holds."""

from __future__ import annotations

import numpy as np

from kiteline_agent.governor.governor import Extra
from kiteline_agent.initialisation.metric_restart import MetricPoints, metric_points
from kiteline_agent.initialisation.two_view_start import TwoViewMap
from kiteline_agent.relocalisation.map_cache import corners_of, with_depths
from kiteline_agent.stages import Stages
from kiteline_agent.tracking.tracker import FrameImages, Track
from kiteline_codec.schema import SubmapScale
from kiteline_core.frame import ImuBatch
from kiteline_core.geometry import se3


class MapGrowth:
    """Makes keyframes and submaps of frames, and tells the other stages of them."""

    def __init__(self, stages: Stages) -> None:
        self._s = stages
        self._map = stages.map
        self._pose = stages.pose
        self._inertia = stages.inertia
        self._certainty = stages.certainty
        self._maker = stages.maker
        self._mono = stages.mono
        self._reference = stages.reference
        self._submaps = stages.submaps

    def accept(self, track: Track, dt_s: float) -> None:
        """Take over a measured pose and what it says of the points and of the motion."""
        self._pose.measured(se3.inverse(track.T_c_m), dt_s, repeated=self._s.frozen.repeated)
        self._s.failures = 0
        self._certainty.measured(track)
        if self._mono is not None:
            self._mono.tracked(track.depth_m[track.inlier])
        self._map.note_tracking(track.rows, track.inlier, self._s.frame)
        self._map.sharpen(
            track.T_c_m, track.rows, track.inlier, track.observed, track.sigma_px, self._s.config.depth_filter.inflation
        )
        self._reference.refresh(self._pose.T_m_c)

    def keyframe_if_due(self, view: FrameImages, track: Track, t_ns: int) -> None:
        """A keyframe, where the policy asks for one, the link can carry it and there is time for it."""
        wish = self._reference.asks(track, t_ns, self._s.frame, self._s.config, self._s.channel.keyframe_gap_ns())
        if wish is None:
            return
        if not self._s.governor.may(Extra.KEYFRAME, urgent=wish.urgent):
            self._s.events.append("governor: keyframe put off")
        elif not wish.waits:
            self._s.events.append(f"keyframe: {wish.why}")
            self.add_keyframe(view, track, t_ns)

    def add_keyframe(self, view: FrameImages, track: Track, t_ns: int) -> None:
        """A keyframe of this frame, with new points where the image has room."""
        self._yield_to_copies(view, track)
        self._reference.add(view, track, t_ns, self._s.frame, self._submaps.active, self._pose.T_m_c)
        self._note_keyframe(view, Extra.KEYFRAME)

    def _yield_to_copies(self, view: FrameImages, track: Track) -> None:
        """A keyframe's corners meet the base's copies: it takes over their depths, and moves a little towards where
        they say that it is. The odometry frame stays still.
        """
        if not self._s.window.lies_in(self._submaps.active):
            return
        fresh = self._maker.look(view, track)
        limits = self._s.config.window
        met = self._s.window.meet(self._pose.T_c_m, self._submaps.active, corners_of(fresh), limits.hold_radius_px)
        self._s.work.projected += len(self._s.window) * limits.points
        self._maker.begin_with(fresh if met is None else with_depths(fresh, met))
        if met is None:
            return
        goal = self._s.window.yields(self._pose.T_c_m, met)
        if goal is not None:
            self._s.move_map(se3.inverse(goal))

    def _note_keyframe(self, view: FrameImages, extra: Extra) -> None:
        """What follows every keyframe: it is booked, and its place remembered."""
        self._s.governor.note(extra)
        if view.right is not None and self._s.rectifier.bends:
            self._s.work.rectified_px += view.left[1].size
        self._s.recovery.remember(self._reference.keyframe)
        self._certainty.remember(self._reference.keyframe)

    def go_on(self, view: FrameImages, t_ns: int) -> bool:
        """No point of the map was found, but the IMU knows well where the camera is: the map goes on with a keyframe
        there. Returns whether that is so, even where the keyframe has to wait for CPU time.
        """
        limits = self._s.config.recovery
        if self._mono is not None or not self._certainty.blind_within(limits.carried_m, limits.carried_rad):
            return False
        if not self._s.governor.may(Extra.KEYFRAME, urgent=True):
            self._s.events.append("governor: keyframe put off")
            return True
        if not self._maker.enough(view, self._s.config.local_map.first_points):
            return False
        self._s.events.append("keyframe: carried by the IMU")
        self._certainty.bridge(self._pose.T_m_c @ self._s.T_c_b)
        self._reference.add(view, None, t_ns, self._s.frame, self._submaps.active, self._pose.T_m_c)
        self._note_keyframe(view, Extra.KEYFRAME)
        return True

    def begin_submap(self, view: FrameImages, t_ns: int, imu: ImuBatch | None) -> bool:
        """Open a submap when the old map was not found again. Returns whether there is a pose now."""
        first = not self._submaps.any
        if not first:
            tried = self._s.failures >= self._s.config.recovery.failures
            if not tried or not self._submaps.room or not self._s.governor.may(Extra.SUBMAP):
                return False
        # 1. See whether this frame can begin a map: by two views, or by what the pair gives.
        opening = None
        if self._mono is not None:
            if self._s.last_t_ns is None:
                self._pose.T_m_c = self._s.levelling.first_pose(imu)  # the camera moves from here on
            self._s.work.searches += 1
            opening = self._mono.step(view, t_ns)
            if opening is None:
                return False
        elif not self._maker.enough(view, self._s.config.local_map.first_points):
            return False
        # 2. Set the camera into it.
        if not first:
            self._s.carry_certainty()
            self._pose.enter_submap()
            if self._mono is None:  # maps of one eye differ in scale: no rigid motion joins them
                self._s.recovery.search_beside(self._s.frame)
        elif opening is None:
            self._pose.T_m_c = self._s.levelling.first_pose(imu)
        # 3. Open it.
        self._s.events.append("submap: opened")
        self._s.failures = 0
        if opening is not None:
            return self._open_from_two_views(view, t_ns, opening)
        self._certainty.begin(self._pose.T_m_c @ self._s.T_c_b)
        self._submaps.open_from_pair(view, t_ns, self._s.frame)
        if not first:
            self._s.base.begins(self._submaps.active, se3.inverse(self._s.T_o_first))
        self._note_keyframe(view, Extra.SUBMAP)
        return True

    def _open_from_two_views(self, view: FrameImages, t_ns: int, opening: TwoViewMap) -> bool:
        """The first two keyframes of one eye's map."""
        self._s.events.append(f"mono: scale by convention, median depth {opening.median_depth_m:.3g} m")
        self._inertia.forget_unit()
        self._certainty.begin(self._pose.T_m_c @ self._s.T_c_b)
        T_m_a = self._submaps.open_from_two_views(self._s.frame, opening, self._s.config.align.sigma_px)
        self._note_keyframe(view, Extra.SUBMAP)
        track = self._s.tracker.track(view, self._pose.T_c_m, self._s.frame)
        if track.inliers < self._s.config.pose.min_inliers:
            return False
        self.accept(track, 0.0)
        dt_s = (t_ns - opening.t_ns) * 1e-9
        velocity = (self._pose.T_m_c[:3, 3] - T_m_a[:3, 3]) / dt_s if dt_s > 0.0 else np.zeros(3)
        self._pose.go_on(se3.exp(se3.log(opening.T_a_b) / opening.frames), velocity)
        self.add_keyframe(view, track, t_ns)
        return True

    def find_scale(self, view: FrameImages, track: Track, t_ns: int) -> None:
        """One eye with an IMU: once acceleration tells how long the map's unit is, begin a map in metres."""
        limits = self._s.config.mono_start
        if self._s.frame % limits.scale_every or not self._submaps.room:
            return
        unit_m = self._inertia.unit_m(limits.scale_sigma)
        if unit_m is None:
            return
        born = metric_points(view, track, self._map, unit_m, self._s.config.detector.cell_px)
        if len(born.sigma_rho) >= self._s.config.local_map.first_points:
            self._begin_in_metres(view, t_ns, unit_m, born)

    def _begin_in_metres(self, view: FrameImages, t_ns: int, unit_m: float, born: MetricPoints) -> None:
        """Go on in a new submap whose unit is a metre."""
        assert self._mono is not None
        self._s.events += [f"mono: metric, one unit was {unit_m:.3g} m", "submap: opened"]
        self._s.carry_certainty()
        self._s.channel.put(SubmapScale(self._submaps.active, unit_m))
        T_n_m = self._submaps.open_in_metres(view, t_ns, self._s.frame, unit_m, born)
        self._s.channel.put(SubmapScale(self._submaps.active, 1.0))
        self._certainty.begin(self._pose.T_m_c @ self._s.T_c_b)
        self._note_keyframe(view, Extra.SUBMAP)
        self._inertia.begin_metres(unit_m, T_n_m)
        self._mono.rescale(unit_m)
