"""Draws the grid: the scans of new keyframes, and anew those of keyframes that moved."""

import copy
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.grid.kept_scan import KeptScan, keep
from kiteline_basestation.grid.landmark_ground import LandmarkGround
from kiteline_basestation.grid.scan_grid import ScanGrid
from kiteline_basestation.grid.sparse_scan import LandmarksAround, sparse_ground, sparse_scan
from kiteline_basestation.map.map_tables import LANDMARK, NO_POSE
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_codec.schema import KeyframeScan
from kiteline_core.arrays import F64, I32, U8
from kiteline_core.geometry import se3, sim3
from kiteline_core.ids import AgentId, KeyframeId, SubmapId, agent_of_keyframe, agent_of_submap, submap_of_keyframe

_MOST_WAITS = 3  # busy steps in a row that leave the drawing to the next one
_LOOKED = 16  # keyframes looked at for each that one step may draw: most may not have moved
_SPARSE_LAG = 5  # keyframes after which the landmarks of one without a scan are drawn again: they are refined by then
_SPARSE_WINDOW = 4  # keyframes before and after it whose landmarks tell where its ground lies
_STANDING_WINDOW = 12  # the same of those that stand: a table top is seen from one side, the floor below from others
_GROUND_MOVED_M = 0.05  # m by which the ground below a keyframe has to be known better until its scan is made again
_GROUND_KEYFRAMES = 20  # newest keyframes among which one must know the height of the ground: 20 s


class _Hung(NamedTuple):
    """A scan, and where its camera lies in that of its keyframe; None: there."""

    scan: KeptScan
    T_k_s: F64 | None


class GridUpdates:
    """The grid of all placed submaps in metres. placements: S_w_m (4,4) of each, kept up to date by its owner.

    Keyframes of agents that send no scans get one from their landmarks.
    """

    def __init__(self, config: BaseConfig, sparse_map: SparseMap, placements: Mapping[SubmapId, F64]) -> None:
        self._config = config.grid
        self._map = sparse_map
        self._placements = placements
        self.grid = ScanGrid(config.grid)
        self._scans: dict[KeyframeId, dict[int, _Hung]] = {}  # by part
        self._labels: dict[KeyframeId, U8] = {}  # of keypoints
        self._scanning: set[AgentId] = set()  # agents that send scans
        self._due: dict[KeyframeId, None] = {}  # may have moved, or are new
        self._unplaced: dict[SubmapId, dict[KeyframeId, None]] = {}  # have scans, and no place in w yet
        self._unmade: dict[KeyframeId, None] = {}  # their scan is to be made from landmarks
        self._ground = LandmarkGround()  # of keyframes whose landmarks are drawn
        self._planes: dict[KeyframeId, F64 | None] = {}  # the ground that their scans were made with; None: unknown
        self._waited = 0  # busy steps since something could be drawn

    def expect_scans(self, agent: AgentId) -> None:
        """Draw an agent's scans alone from now on, not its landmarks: it makes some, though it may believe none yet."""
        if agent in self._scanning:
            return
        self._scanning.add(agent)
        for keyframe in [k for k in self._scans.keys() | self._planes.keys() if agent_of_keyframe(k) == agent]:
            self._drop(keyframe)
        self._unmade = {k: None for k in self._unmade if agent_of_keyframe(k) != agent}

    def add_scan(self, record: KeyframeScan) -> None:
        """Take an agent's scan. From the first one on, only its scans are drawn."""
        agent = agent_of_keyframe(record.keyframe)
        self.expect_scans(agent)
        if record.part == 0:
            self._labels[record.keyframe] = record.labels
        camera = self._map.cameras.get(agent)
        self._hang(
            record.keyframe,
            record.part,
            keep(self._config, record.scan, 0.0 if camera is None else camera.bf),
            record.T_k_s,
        )

    def add_keyframe(self, keyframe: KeyframeId) -> None:
        """Take a new keyframe. Without scans, its landmarks are drawn now, and once more when they are better known."""
        if agent_of_keyframe(keyframe) in self._scanning:
            return
        siblings = self._map.submaps[submap_of_keyframe(keyframe)]
        self._unmade[keyframe] = None
        if len(siblings) > _SPARSE_LAG:
            self._unmade[siblings[-1 - _SPARSE_LAG]] = None

    def rebuild(self) -> None:
        """Draw what moved, after whole submaps may have; what was not drawn before is drawn if it can be now."""
        for submap, keyframes in self._map.submaps.items():
            if agent_of_keyframe(keyframes[0]) in self._scanning:
                self._due.update(dict.fromkeys(keyframes))
            elif submap in self._placements:
                self._unmade.update({k: None for k in keyframes if k not in self._planes})
                self._due.update(dict.fromkeys(keyframes))

    def remove(self, keyframes: Sequence[KeyframeId]) -> None:
        """Forget keyframes that a user deleted."""
        for keyframe in keyframes:
            self._drop(keyframe)
            self._labels.pop(keyframe, None)

    def update(self, *, busy: bool = False) -> None:
        """Draw as many keyframes as one step has time for, the oldest first.

        busy: the step has taken long already, so that the next one draws, unless several before were busy, too.
        """
        self._gather_moved()
        self._waited = self._waited + 1 if busy else 0
        if 0 < self._waited <= _MOST_WAITS:
            return
        self._waited = 0
        self._make_some(self._config.made_per_step)
        drawn = 0
        for keyframe in sorted(self._due)[: _LOOKED * self._config.drawn_per_step]:
            if drawn >= self._config.drawn_per_step:
                break
            del self._due[keyframe]
            drawn += self._draw(self.grid, keyframe)

    def make_all(self) -> None:
        """Make the scans of all landmarks that wait for one: those of a restored map in which no step follows."""
        for _ in range(2):  # once more where later keyframes tell of the ground below earlier ones
            self._make_some(len(self._unmade))

    def _make_some(self, most: int) -> None:
        """Make scans of landmarks, of the oldest keyframes first."""
        scanless = {a for a in map(agent_of_keyframe, self._unmade) if self._is_scanless(a)}
        ready = [keyframe for keyframe in sorted(self._unmade) if agent_of_keyframe(keyframe) in scanless]
        for keyframe in ready[:most]:
            del self._unmade[keyframe]
            self._make(keyframe)

    def _is_scanless(self, agent: AgentId) -> bool:
        """True if an agent's landmarks are to be drawn: it has one camera, or would have sent a scan by now."""
        camera = self._map.cameras.get(agent)
        own = (len(keyframes) for submap, keyframes in self._map.submaps.items() if agent_of_submap(submap) == agent)
        return camera is None or not camera.stereo or sum(own) > self._config.scanless_keyframes

    @property
    def behind(self) -> bool:
        """True while scans wait to be drawn where their keyframes are now: parts of the grid are old."""
        return bool(self._due)

    def settled(self) -> ScanGrid:
        """A grid in which all scans lie where their keyframes are now; a copy, if they do not in this one."""
        self._gather_moved()
        if not self._due:
            return self.grid
        grid = copy.deepcopy(self.grid)
        for keyframe in sorted(self._due):
            self._draw(grid, keyframe)
        return grid

    def _gather_moved(self) -> None:
        ids = self._map.keyframes.id
        for row in sorted(self._map.moved_rows):
            keyframe = KeyframeId(int(ids[row]))
            if keyframe in self._scans:
                self._due[keyframe] = None
        self._map.moved_rows.clear()
        for submap in [s for s in self._unplaced if self._is_placed(s)]:
            self._due.update(self._unplaced.pop(submap))

    def _draw(self, grid: ScanGrid, keyframe: KeyframeId) -> int:
        """Draw the scans of a keyframe where it is now. Returns how many changed."""
        S_w_k, changed = self._pose(keyframe), 0
        scans, submap = self._scans.get(keyframe, {}), submap_of_keyframe(keyframe)
        if scans and not self._is_placed(submap):
            self._unplaced.setdefault(submap, {})[keyframe] = None
        for part, (scan, T_k_s) in scans.items():
            if S_w_k is None:
                changed += grid.remove((keyframe, part))
            else:
                S_w_s = S_w_k if T_k_s is None else S_w_k @ T_k_s
                changed += grid.put((keyframe, part), scan, S_w_s, agent_of_keyframe(keyframe))
        return changed

    def ground_below(self, keyframe: KeyframeId) -> float | None:
        """Height in w of the ground below a keyframe, or below the last one before it with a scan; None without one."""
        siblings = self._map.submaps.get(submap_of_keyframe(keyframe), [])
        for other in siblings[: bisect_right(siblings, keyframe)][: -1 - _GROUND_KEYFRAMES : -1]:
            S_w_k = self._pose(other)
            if S_w_k is None:
                continue
            for scan, T_k_s in self._scans.get(other, {}).values():
                z_m = (S_w_k if T_k_s is None else S_w_k @ T_k_s)[2, 3]
                return float(z_m) - sim3.scale_of(S_w_k) / scan.unit_m * scan.height_m
        return None

    def labels(self, landmarks: I32) -> U8:
        """Labels (n,) of landmarks: 0 unlabelled, 1 ground, 2 obstacle."""
        table = self._map.keypoints
        out = np.zeros(len(landmarks), np.uint8)
        keyframes, index = self._map.keyframes.id[table.row[landmarks]], self._map.keypoint_of(landmarks)
        order = np.argsort(keyframes, kind="stable")
        for rows in np.split(order, np.flatnonzero(np.diff(keyframes[order])) + 1):
            labels = self._labels.get(KeyframeId(int(keyframes[rows[0]]))) if len(rows) else None
            if labels is not None:
                known = rows[index[rows] < len(labels)]
                out[known] = labels[index[known]]
        return out

    def _hang(self, keyframe: KeyframeId, part: int, scan: KeptScan | None, T_k_s: F64 | None = None) -> None:
        """Hang a scan on a keyframe, in place of the same part; None: take that away."""
        if scan is not None:
            self._scans.setdefault(keyframe, {})[part] = _Hung(scan, T_k_s)
            self._due[keyframe] = None
        elif self._scans.get(keyframe, {}).pop(part, None) is not None:
            self.grid.remove((keyframe, part))

    def _drop(self, keyframe: KeyframeId) -> None:
        for part in self._scans.pop(keyframe, {}):
            self.grid.remove((keyframe, part))
        self._ground.remove(keyframe)
        self._planes.pop(keyframe, None)
        self._due.pop(keyframe, None)
        self._unplaced.get(submap_of_keyframe(keyframe), {}).pop(keyframe, None)
        self._unmade.pop(keyframe, None)

    def _pose(self, keyframe: KeyframeId) -> F64 | None:
        """S_w_k (4,4) of a keyframe; None if its submap is not placed, or not in metres."""
        submap = submap_of_keyframe(keyframe)
        T_m_k = self._map.pose(keyframe)
        return None if T_m_k is None or not self._is_placed(submap) else self._placements[submap] @ T_m_k

    def _is_placed(self, submap: SubmapId) -> bool:
        """True if a submap has a place in w, and is in metres."""
        return submap in self._placements and not self._map.is_up_to_scale(self._map.map_id(submap))

    def _make(self, keyframe: KeyframeId) -> None:
        """Make a scan of the landmarks of a keyframe and of those before it, and label those that are new in it."""
        S_w_k = self._pose(keyframe) if keyframe in self._map else None
        camera = self._map.cameras.get(agent_of_keyframe(keyframe))
        if S_w_k is None or camera is None:
            return
        submap = submap_of_keyframe(keyframe)
        siblings = self._map.submaps[submap]
        at = self._map.number_of(keyframe)
        near, far = (siblings[max(0, at - n) : at + n + 1] for n in (_SPARSE_WINDOW, _STANDING_WINDOW))
        around = self._map.sorted_by_id(np.concatenate([self._map.landmarks_of(k) for k in far]))
        xyz, known = self._map.positions(around)
        around, xyz = around[known], xyz[known]
        T_map_k = self._map.world_pose(keyframe)
        assert T_map_k is not None
        T_k_map = se3.inverse(se3.orthonormalise(T_map_k))
        scale = self._map.scale(submap)
        unit_m = sim3.scale_of(S_w_k)
        local = (xyz @ T_k_map[:3, :3].T + T_k_map[:3, 3]) * (unit_m / scale)
        close = np.isin(around, np.concatenate([self._map.landmarks_of(k) for k in near]))
        view = sparse_ground(self._config, S_w_k, local[close], unit_m)
        if view is None:
            return
        self._ground.put(keyframe, view)
        plane = self._know_ground(keyframe, S_w_k)
        made = None
        if plane is not None:
            views = np.diff(self._map.observations(around)[0]).astype(np.int64)
            seen = np.isin(around, self._map.landmarks_of(keyframe))
            made = sparse_scan(self._config, camera, S_w_k, LandmarksAround(local, seen, close, views), plane)
        if made is None:
            self._labels.pop(keyframe, None)
            self._hang(keyframe, 0, None)
            return
        scan, labels = made
        table = self._map.keypoints
        slots = self._map.slots_of(keyframe)
        mine = np.zeros(len(slots), np.uint8)
        here = (table.row[around] == self._map.rows[keyframe]) & (table.kind[around] == LANDMARK)
        mine[self._map.keypoint_of(around[here])] = labels[here]
        self._labels[keyframe] = mine
        kept = keep(self._config, scan, camera.bf, unit_m)
        if kept is not None:
            self._hang(keyframe, 0, kept)

    def _know_ground(self, keyframe: KeyframeId, S_w_k: F64) -> F64 | None:
        """The ground below a keyframe, as in `GroundView.plane`. Others whose ground it tells are to be made again."""
        submaps = self._map.submaps_of_map(submap_of_keyframe(keyframe))
        viewed, poses = list[KeyframeId](), list[F64]()
        for submap in submaps:
            if not self._is_placed(submap):
                continue
            some = [k for k in self._map.submaps.get(submap, []) if k in self._ground]
            rows = np.array([self._map.rows[k] for k in some], np.int64)
            posed = self._map.keyframes.pose_source[rows] != NO_POSE
            viewed += [k for k, one in zip(some, posed.tolist(), strict=True) if one]
            poses.append(self._placements[submap] @ self._map.keyframes.T_m_k[rows[posed]])
        planes = self._ground.heights(S_w_k[:3, 3], viewed, np.concatenate(poses))
        for other, plane in planes.items():
            if other != keyframe and other in self._planes and _differ(plane, self._planes[other]):
                self._unmade[other] = None
        self._planes[keyframe] = planes[keyframe]
        return planes[keyframe]


def _differ(plane: F64 | None, before: F64 | None) -> bool:
    """True if the ground is known now and was not, or the other way round, or lies elsewhere."""
    if plane is None or before is None:
        return plane is not before
    return abs(float(plane[0] - before[0])) > _GROUND_MOVED_M
