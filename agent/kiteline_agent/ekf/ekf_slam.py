"""The filter over a flight: odometry moves it, tracked pixels correct it, landmarks enter late and leave."""

from dataclasses import dataclass

import numpy as np

from kiteline_agent.ekf import landmark_update
from kiteline_agent.ekf.filter_state import FilterState, OdometryMotion
from kiteline_agent.ekf.ray_initialisation import (
    RayTrack,
    distance_share,
    largest_parallax,
    linearised,
    new_landmark,
    rays_meet,
)
from kiteline_agent.ekf.ray_kernels import supporting_views
from kiteline_agent.ekf.ray_tracks import RayTracks
from kiteline_agent.ekf.ray_update import update_by_rays
from kiteline_agent.ekf_config import EkfConfig
from kiteline_core.arrays import F64, I64, U8, Bool
from kiteline_core.geometry.cameras import RectifiedCamera

_VIEW_M = 0.15  # m between two camera poses in the state: nearer ones add no parallax indoors
_LEAST_RAYS = 4  # observations from which a landmark is positioned
_RAY_PX = 10.0  # px from the point that two views give beyond which a third one's ray is a wrong match
_PARALLAX_RAD = 0.05  # rad: three degrees between a landmark's first and last ray, at least
_DEPTH_SHARE = (
    0.05  # deviation of a new landmark's distance over that distance, at most: at 0.1 lengths come out 3 % long
)
_ENDED_RAYS = (
    5  # rays of an ended track that correct the views: seven equations each, the cost of as many landmarks in view
)
_UPDATED = 16  # landmarks that one frame updates at most: bounds its cost
_ENDED_TRACKS = 6  # tracks lost before they were landmarks that correct the views at one frame at most
_ENTRIES = 6  # landmarks that enter at one frame at most
_IN_VIEW = 45  # landmarks in view from which no more enter: the state is kept for what is seen next
_MISSES = 4  # rejected matches in excess of the good ones after which a landmark is dropped
_RESIDUAL_GATE = 2.0  # chi-square over its degrees of freedom above which its rays do not meet


@dataclass(frozen=True, slots=True)
class FrameUpdate:
    """What a frame did: ids of landmarks that were compatible, rejected, and new; whether it became a past view."""

    compatible: I64
    rejected: I64
    entered: I64


class EkfSlam:
    """Estimates pose, odometry scale and landmarks. Sans-IO, deterministic."""

    def __init__(self, camera: RectifiedCamera, config: EkfConfig, T_o_b: F64 | None = None) -> None:
        """T_o_b: (4,4) of the body at the first frame; None: it is the origin of o."""
        self._config = config
        self._focal = np.array([camera.fx, camera.fy])
        self._centre = np.array([camera.cx, camera.cy])
        self._sigma = config.sigma_px / camera.fx
        self._walk = config.walk_px**2 / camera.fx
        self.state = FilterState(camera.T_b_c if T_o_b is None else T_o_b @ camera.T_b_c, config)
        self.slot_of: dict[int, int] = {}  # landmark's slot by the id of its track
        self._ids = np.full(config.landmarks, -1, np.int64)
        self._good = np.zeros(config.landmarks, np.int64)
        self._bad = np.zeros(config.landmarks, np.int64)
        self._updated_at = np.zeros(config.landmarks, np.int64)  # frame of the last update
        self._seen_at = np.zeros(config.landmarks, np.int64)
        self._tracks = RayTracks(config.views)
        self._view_way = np.zeros(config.views)  # m travelled up to each past view
        self._way = 0.0
        self._frame = 0

    def predict(self, motion: OdometryMotion) -> None:
        """Move by odometry."""
        self.state.propagate(motion)
        self._way += float(np.linalg.norm(motion.T_c0_c1[:3, 3]))

    def update(self, ids: I64, uv: F64, octave: U8 | None = None) -> FrameUpdate:
        """Correct the state by the pixels (n,2) of tracks (n,), ids increasing; new landmarks enter.

        octave: (n,) level of the pyramid at which each was found: its error is that of a pixel there; None: the finest.
        """
        self._frame += 1
        coarse = np.ones(len(ids)) if octave is None else (1 << octave.astype(np.int64)).astype(np.float64)
        xy = (uv - self._centre) / self._focal
        slots = np.array([self.slot_of.get(i, -1) for i in ids.tolist()], np.int64)
        good, bad = self._update_landmarks(slots, xy, coarse)
        fresh = np.flatnonzero(slots < 0)
        entered: I64 = np.zeros(0, np.int64)
        if self._is_view_due():
            if int(good.sum()) < _IN_VIEW:  # else the landmarks tell enough
                entered = self._enter(ids[fresh], xy[fresh], coarse[fresh], self._ended(ids))
            self._tracks.keep(ids)
            self._add_view(ids[fresh], xy[fresh], coarse[fresh])
        return FrameUpdate(ids[good], ids[bad], entered)

    def depths(self, tracks: I64) -> F64:
        """Depths (n,) in m of the landmarks of tracks (n,) in the camera now; 0 without a landmark, or behind it."""
        slots = np.array([self.slot_of.get(i, -1) for i in tracks.tolist()], np.int64)
        ahead = (self.state.points[slots] - self.state.T_o_c[:3, 3]) @ self.state.T_o_c[:3, 2]
        return np.where((slots >= 0) & (ahead > 0.0), ahead, 0.0)

    def forget(self, track: int) -> None:
        """Drop the landmark of a track."""
        slot = self.slot_of.pop(track)
        self.state.drop_landmark(slot)
        self._ids[slot] = -1

    # steps

    def _update_landmarks(self, slots: I64, xy: F64, coarse: F64) -> tuple[Bool, Bool]:
        """Update by the observations of landmarks; masks (n,) of the compatible and of the rejected ones.

        coarse: (n,) factors of their deviations.
        """
        good, bad = np.zeros(len(slots), np.bool_), np.zeros(len(slots), np.bool_)
        at = np.flatnonzero(slots >= 0)
        if not len(at):
            return good, bad
        found, ahead = landmark_update.innovation(self.state, slots[at], xy[at], coarse[at], self._sigma)
        bad[at[~ahead]] = True
        at = at[ahead]
        if len(at):
            fits = landmark_update.compatible(found, self._config)
            good[at[fits]] = True
            bad[at[~fits]] = True
            # Those that waited longest: all that are in view get their turn.
            waiting = np.flatnonzero(fits)
            order = np.argsort(self._updated_at[found.slots[waiting]], kind="stable")
            chosen = np.sort(waiting[order[:_UPDATED]])
            self._updated_at[found.slots[chosen]] = self._frame
            landmark_update.update(self.state, found.part(chosen))
        self._good[slots[good]] += 1
        self._bad[slots[bad]] += 1
        self._seen_at[slots[good]] = self._frame
        for slot in slots[bad][self._bad[slots[bad]] - self._good[slots[bad]] > _MISSES].tolist():
            self.forget(int(self._ids[slot]))
        return good, bad

    def _is_view_due(self) -> bool:
        used = self.state.view_used
        return not used.any() or self._way - float(self._view_way[used].max()) >= _VIEW_M

    def _enter(self, ids: I64, xy: F64, coarse: F64, ended: list[RayTrack]) -> I64:
        """Correct the state by new landmarks and ended tracks, and let the former in; returns their ids.

        ids, xy, coarse: (n,), (n,2), (n,) tracks that are no landmarks, see `update`.
        """
        state = self.state
        new = [(int(ids[k]), track) for k, track in self._positioned(ids, xy, coarse) if self._may_enter(track)]
        update_by_rays(state, [track for _, track in new] + ended)
        entered = []
        for k, track in new:
            rays = linearised(state, track, state.T_o_c, state.view_T_o_c)
            slot = self._free_slot() if rays is not None else None
            if rays is None or slot is None:
                continue
            state.add_landmark(slot, *new_landmark(state, rays), walk=self._walk * (track.sigma / self._sigma) ** 2)
            self.slot_of[k] = slot
            self._ids[slot], self._good[slot], self._bad[slot] = k, 0, 0
            self._updated_at[slot] = self._seen_at[slot] = self._frame
            entered.append(k)
        out = np.array(sorted(entered), np.int64)
        self._tracks.drop(np.array([k for k, _ in new], np.int64))
        return out

    def _positioned(self, ids: I64, xy: F64, coarse: F64) -> list[tuple[int, RayTrack]]:
        """Places in `ids` of tracks whose rays meet under enough parallax, widest first, with what agrees of each."""
        config, state = self._config, self.state
        known, rows = self._tracks.find(ids)
        enough = self._tracks.seen[rows].sum(axis=1) >= _LEAST_RAYS - 1
        known, rows = known[enough], rows[enough]
        if not len(known):
            return []
        poses = np.concatenate([state.view_T_o_c, state.T_o_c[None]])
        points = np.concatenate([self._tracks.xy[rows], xy[known][:, None]], axis=1)
        seen = np.concatenate([self._tracks.seen[rows], np.ones((len(rows), 1), np.bool_)], axis=1)
        rays = np.einsum("vij,nvj->nvi", poses[:, :3, :2], points) + poses[:, :3, 2]
        rays /= np.linalg.norm(rays, axis=2, keepdims=True)
        wide = np.flatnonzero(largest_parallax(rays, seen) > _PARALLAX_RAD)
        if not len(wide):
            return []
        known, points, rays = known[wide], points[wide], rays[wide]
        agrees = np.empty((len(wide), config.views + 1), np.bool_)
        supporting_views(poses[:, :3, 3], rays, seen[wide], _RAY_PX / float(self._focal[0]), agrees)
        parallax = largest_parallax(rays, agrees)
        order = np.argsort(-parallax, kind="stable")
        enough = (parallax > _PARALLAX_RAD) & (agrees.sum(axis=1) >= _LEAST_RAYS)
        out = []
        for k in order[enough[order]][:_ENTRIES].tolist():
            views = np.flatnonzero(agrees[k, :-1])
            observations = points[k, np.append(views, config.views)]
            out.append((int(known[k]), RayTrack(views, observations, self._sigma * float(coarse[known[k]]))))
        return out

    def _may_enter(self, track: RayTrack) -> bool:
        """True if the rays of a track intersect well enough to give its distance."""
        state = self.state
        rays = linearised(state, track, state.T_o_c, state.view_T_o_c)
        if rays is None or not rays_meet(state, rays, _RESIDUAL_GATE):
            return False
        return distance_share(state, rays) <= _DEPTH_SHARE

    def _ended(self, ids: I64) -> list[RayTrack]:
        """Tracks that are followed no more, were seen often enough, and whose rays meet. ids: (n,) followed ones."""
        tracks = self._tracks
        ended = np.flatnonzero(~np.isin(tracks.ids, ids))
        out: list[RayTrack] = []
        for row in ended[tracks.seen[ended].sum(axis=1) >= _LEAST_RAYS].tolist():
            if len(out) == _ENDED_TRACKS:
                break
            views = np.flatnonzero(tracks.seen[row])
            views = views[np.argsort(self._view_way[views], kind="stable")]
            views = views[np.unique(np.linspace(0, len(views) - 1, _ENDED_RAYS).round().astype(np.int64))]
            track = RayTrack(views, tracks.xy[row, views], self._sigma * float(tracks.coarse[row]))
            rays = linearised(self.state, track, self.state.T_o_c, self.state.view_T_o_c)
            if rays is not None and rays_meet(self.state, rays, _RESIDUAL_GATE):
                out.append(track)
        return out

    def _free_slot(self) -> int | None:
        """A free slot; if there is none, that of the least seen landmark out of view, if any."""
        free = np.flatnonzero(~self.state.used)
        if len(free):
            return int(free[0])
        old = np.flatnonzero(self._seen_at < self._frame - 1)
        if not len(old):
            return None
        slot = int(old[np.argmin(self._good[old])])
        self.forget(int(self._ids[slot]))
        return slot

    def _add_view(self, ids: I64, xy: F64, coarse: F64) -> None:
        """Keep the camera's pose and what it sees of tracks without a landmark. coarse: see `update`."""
        left = np.array([int(i) not in self.slot_of for i in ids.tolist()], np.bool_)
        free = np.flatnonzero(~self.state.view_used)
        view = int(free[0]) if len(free) else self._view_to_drop()
        if not len(free):
            self.state.drop_view(view)
            self._tracks.drop_view(view)
        self.state.add_view(view)
        self._view_way[view] = self._way
        self._tracks.add(view, ids[left], xy[left], coarse[left])

    def _view_to_drop(self) -> int:
        """The view without which the others lie most evenly over the logarithm of the way since."""
        order = np.argsort(self._view_way, kind="stable")
        way = self._view_way[order]
        if self._tracks.seen[:, order[0]].sum() < 4:
            return int(order[0])
        gap = (way[2:] - way[:-2]) / (self._way - way[1:-1] + _VIEW_M)
        return int(order[1 + int(np.argmin(gap))])
