"""The rolling shutter of the left camera: its motion in each frame, and its read-out where no calibration says it."""

from collections.abc import Callable
from typing import Any

import numpy as np

from kiteline_agent.config import ReadoutConfig
from kiteline_agent.imaging.raw_grid import grid_for_kernels
from kiteline_agent.local_map import projection_kernels
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.tracking.frame_context import FrameContext
from kiteline_agent.tracking.shutter.readout import ReadoutEstimate
from kiteline_agent.tracking.shutter.readout_kernels import readout_equation
from kiteline_agent.tracking.shutter.rolling_shutter import RollingShutter
from kiteline_agent.tracking.track import Track
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import Rectifier
from kiteline_core.ids import SubmapId

_STILL_PX = 0.3  # by which a rolling shutter moves pixels of a vehicle that stands still, at most
_TURNING_PX = 20.0  # px/s at the image's centre: slower turns tell nothing of a read-out
_SETTLED_EVERY = 8  # frames of which one is looked at once the read-out has settled
_FOUND_EVENT = (
    "rolling shutter: {:.0f} ms from the first row to the last, found in flight; a rig file, or readout_s: {:.3f} in "
    "the calibration, corrects it from the start"
)
_TOLD_S = 0.002  # s; least change of a read-out that is an event again
_SAME_MOTION_NS = 120_000_000  # ns in which the motion of a vehicle hardly changes
_MAX_GAP_S = 0.2  # s between two frames whose poses tell the motion of the second


class ShutterStage:
    """Call `motion` before a frame is tracked, `measure` after it, and `end_frame` once its keyframe is stored."""

    def __init__(
        self,
        local_map: LocalMap,
        rectifier: Rectifier,
        config: ReadoutConfig,
        twist: Callable[[int, float], F64 | None],
        has_motion_sensor: Callable[[], bool],
        known_s: tuple[float, ...] = (),
    ) -> None:
        """twist: predicts that of the camera, (6,) [m/s, rad/s] in its own axes, from a frame's stamp in ns and the
        time in s since the last frame; None: unknown.

        has_motion_sensor: whether an IMU or odometer helps to predict it. known_s: read-out that an earlier flight
        found, and its deviation; (): none.
        """
        self._map = local_map
        self._rectifier = rectifier
        self._twist = twist
        self._has_motion_sensor = has_motion_sensor
        self._estimated = config.on and rectifier.readout_s == 0.0
        self._estimate = (
            ReadoutEstimate(*known_s) if self._estimated and known_s else ReadoutEstimate(rectifier.readout_s)
        )
        self._told_s = self._estimate.readout_s  # as of the last event
        self._motion_known = False  # in the last frame
        self._last: tuple[int, SubmapId, F64] | None = None  # stamp, submap and T_o_c (4,4) of the last tracked frame
        self._measured: F64 | None = None  # twist (6,) of this frame by images
        self._keyframe = local_map.keyframe.copy()
        self._twists = np.full((len(self._keyframe), 6), np.nan)  # of the images of keyframes
        self._keyframe_ns = np.zeros(len(self._keyframe), np.int64)  # their stamps

    @property
    def at_rest(self) -> RollingShutter:
        """The shutter of a camera that does not move; with a read-out of 0 it is a global one."""
        return self._shutter(self._estimate.readout_s, np.zeros(6))

    @property
    def rolls(self) -> bool:
        """True if a read-out is known: rows are exposed at times of their own."""
        return self._estimate.readout_s != 0.0

    @property
    def is_unknown(self) -> bool:
        """True if neither a calibration nor a flight has told a read-out, and one is looked for."""
        return self._estimated and self._estimate.sigma_s is None

    def take(self, readout_s: float, sigma_s: float) -> list[str]:
        """Take the read-out, and its deviation, that the window of a start told. Returns events."""
        return self._changed(self._estimate.take(readout_s, sigma_s))

    def motion(self, t_ns: int, dt_s: float) -> RollingShutter | None:
        """The rolling shutter's motion in a frame; None for a global shutter, and while the motion is unknown."""
        self._measured = None
        twist = self._twist(t_ns, dt_s) if self.rolls and dt_s > 0.0 else None
        if twist is None:
            self._motion_known = False
            return None
        shutter = self._shutter(self._estimate.readout_s, twist)
        if not self._motion_known and shutter.largest_px() < _STILL_PX:
            self._map.rolled[:] = False  # the vehicle stood still when its motion was unknown
        elif not self._motion_known and self._has_motion_sensor():  # the newest keyframes were in the same motion
            for slot in np.flatnonzero(self._map.rolled & (self._keyframe_ns >= t_ns - _SAME_MOTION_NS)).tolist():
                self._move(slot, shutter)
        self._motion_known = True
        return shutter

    def measure(self, ctx: FrameContext, track: Track, submap: SubmapId, T_o_m: F64) -> list[str]:
        """Take what a frame's pose by images tells of the read-out. Returns events.

        T_o_m: (4,4) submap in the odometry frame, which stays where the base moves the map.
        """
        if not self._estimated:
            return []
        T_o_c, last = T_o_m @ track.T_m_c, self._last
        self._last = ctx.t_ns, submap, T_o_c
        if last is None or last[1] != submap or (dt_s := (ctx.t_ns - last[0]) * 1e-9) > _MAX_GAP_S:
            return []
        # 1. How the camera moved since the last frame.
        self._measured = twist = se3.log(se3.inverse(last[2]) @ T_o_c) / dt_s
        still = float(np.linalg.norm(twist[3:])) * self._map.intrinsics[0] < _TURNING_PX
        if still or (self._estimate.settled and ctx.number % _SETTLED_EVERY):
            return []
        # 2. How far observations are off where the map has them, beside what a rolling shutter would move them by.
        m, rows = self._map, track.rows
        warp, parallax = np.empty((len(rows), 2, 2)), np.empty((len(rows), 2))
        projection_kernels.views(
            track.T_c_m, m.intrinsics, rows, m.T_m_k, m.bearing, m.rho, m.slant, warp, parallax
        )  # fmt: skip
        grid = grid_for_kernels(self._rectifier.left_grid)
        change_s = self._estimate.add(
            *readout_equation(
                track.T_c_m, m.intrinsics, float(m.camera.height), grid, twist, rows,
                np.ascontiguousarray(track.observed[:, :2]), m.octave.take(rows), warp, parallax,
                m.T_m_k, m.bearing, m.rho, self._twists,
            )
        )  # fmt: skip
        # 3. Pixels of the map's keyframes are at the stamps, by the read-out in use: they move with it.
        return self._changed(change_s)

    def end_frame(self, t_ns: int) -> None:
        """Note stamp and motion of this frame's image, if a keyframe was made of it."""
        if self._estimated or self.rolls:
            new = self._map.keyframe != self._keyframe
            if new.any():
                known = self._measured is not None and (self._motion_known or not self.rolls)
                self._twists[new] = self._measured if known else np.nan
                self._keyframe_ns[new] = t_ns
                self._keyframe[new] = self._map.keyframe[new]

    def report(self) -> dict[str, Any] | None:
        """The read-out that was found, in ms, with its deviation; None if none was."""
        if self._estimate.sigma_s is None:
            return None
        return {"ms": round(1e3 * self._estimate.readout_s, 1), "sigma_ms": round(1e3 * self._estimate.sigma_s, 1)}

    def known_s(self) -> tuple[float, ...]:
        """The read-out that was found, and its deviation, for the next flight; (): none was."""
        e = self._estimate
        return () if e.sigma_s is None else (round(e.readout_s, 5), round(max(e.sigma_s, 1e-5), 5))

    def _changed(self, change_s: float) -> list[str]:
        """Follow a change of the read-out. Returns events."""
        if change_s == 0.0:
            return []
        self._move_map(change_s)
        readout_s = self._estimate.readout_s
        if abs(readout_s - self._told_s) < _TOLD_S:
            return []
        self._told_s = readout_s
        return [_FOUND_EVENT.format(1e3 * readout_s, readout_s)]

    def _move_map(self, change_s: float) -> None:
        """Move the pixels of landmarks in their keyframes, where the motion of these is known."""
        for slot in np.flatnonzero(~np.isnan(self._twists[:, 0])).tolist():
            self._move(slot, self._shutter(change_s, self._twists[slot]))

    def _move(self, slot: int, shutter: RollingShutter) -> None:
        """Move the pixels of a keyframe's landmarks from where this shutter's rows showed them to its stamp."""
        m, n = self._map, int(self._map.counts[slot])
        uv, rho = m.uv[slot, :n].copy(), m.rho[slot, :n]
        by_stereo = m.measured[slot, :n] & m.camera.stereo
        disparity = shutter.at_once(uv, np.where(by_stereo, rho * m.camera.bf, -1.0))
        rho[by_stereo] = disparity[by_stereo] / m.camera.bf
        moved, parallax_m = shutter.to_frame_with_parallax(uv, rho)
        rho[by_stereo] *= moved[by_stereo, 2]
        m.uv[slot, :n] = moved[:, :2]
        m.bearing[slot, :n] += (moved[:, :2] - uv) / m.intrinsics[:2]
        m.row_parallax.add(slot, parallax_m, rho)
        m.rolled[slot] = False

    def _shutter(self, readout_s: float, twist: F64) -> RollingShutter:
        r = self._rectifier
        return RollingShutter(r.camera, readout_s, r.camera.height, r.left_grid, twist, r.right_grid)
