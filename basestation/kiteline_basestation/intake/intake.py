"""Puts the agents' records into the map, in any order of arrival, and names keyframes that are ready to be used."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from itertools import compress
from typing import Any

import numpy as np

from kiteline_basestation.config import IntakeConfig
from kiteline_basestation.inertial.ties import InertialTies
from kiteline_basestation.map.map_tables import NO_POSE
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.map.world_poses import is_near
from kiteline_codec.schema import (
    CameraIntrinsics,
    GravityAlignment,
    IdOf,
    InertialSteps,
    KeyframeHeader,
    KeyframeScan,
    LivePose,
    NewLandmarks,
    Observations,
    Record,
    ScanImages,
    StereoAlignment,
    SubmapScale,
    SubmapTie,
)
from kiteline_codec.schema.owners import submap_of
from kiteline_core.ids import (
    NO_KEYFRAME,
    SEQUENCE_BITS,
    SUBMAP_BITS,
    AgentId,
    KeyframeId,
    SubmapId,
    agent_of_keyframe,
    agent_of_submap,
    submap_of_keyframe,
)

# T_m_c of a level camera that looks along x of m: x right is -y, y down is -z, z forward is x.
_LEVEL_T_M_C = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
_PATIENCE_S = 2.0  # s; after this long a keyframe is used without its missing sections
_MISSING_ROOT_S = 10.0  # s; after this long a submap without its first keyframe begins at its oldest one
_MAX_PER_STEP = 4  # keyframes; used in one step, so that a backlog does not delay the rest


@dataclass(frozen=True, slots=True)
class IntakeState:
    """State of an `Intake` that outlives the process. unused: keyframes not used yet, or used incomplete."""

    last_pose: Mapping[SubmapId, LivePose] = field(default_factory=dict)
    tracked_ns: Mapping[SubmapId, int] = field(default_factory=dict)
    unused: tuple[KeyframeId, ...] = ()
    deleted: tuple[SubmapId, ...] = ()


class Intake:
    """Records on their way from the agents into the map."""

    def __init__(self, config: IntakeConfig, sparse_map: SparseMap) -> None:
        self._config = config
        self._map = sparse_map
        # Sections that arrived before their header, by whether they hold new landmarks and by part.
        self._pending: dict[KeyframeId, dict[tuple[bool, int], NewLandmarks | Observations]] = {}
        self._pending_count = 0
        self._waiting: dict[KeyframeId, int] = {}  # keyframes not used yet, and when their header came
        self._partial: set[KeyframeId] = set()  # keyframes used before they were complete
        self.live: dict[AgentId, LivePose] = {}
        self.last_pose: dict[SubmapId, LivePose] = {}  # newest live pose in each submap
        self.tracked_ns: dict[SubmapId, int] = {}  # time stamp of the newest pose in each submap that images support
        self.gravity: dict[SubmapId, GravityAlignment] = {}
        self.loss_ties: dict[SubmapId, SubmapTie] = {}  # how a submap lies to the one before it, over a loss
        self.fresh_ties: set[SubmapId] = set()  # of those, the ones that no placement follows yet
        self.fresh_scales: set[SubmapId] = set()  # whose metres were told, and no placement follows yet
        self.last_contact_ns: dict[AgentId, int] = {}
        self.deleted: set[SubmapId] = set()  # records of these submaps are ignored
        self._rooted: list[KeyframeId] = []  # at which submaps begin without their first keyframe, not taken yet
        self._scans: list[KeyframeScan] = []  # that arrived and were not taken yet
        self._images: list[ScanImages] = []  # the same
        self.inertial_ties = InertialTies(sparse_map)
        self.refused = 0  # records that contradict the map, are too far off, or of another agent than their writer
        self._handlers: dict[type[Record], Callable[[Any, int], None]] = {
            CameraIntrinsics: lambda record, now_ns: sparse_map.set_camera(record.agent, record.camera),
            StereoAlignment: lambda record, now_ns: sparse_map.set_stereo_alignment(record),
            LivePose: self._take_live_pose,
            KeyframeHeader: self._take_header,
            NewLandmarks: self._take_section,
            Observations: self._take_section,
            KeyframeScan: lambda record, now_ns: self._scans.append(record),
            ScanImages: lambda record, now_ns: self._images.append(record),
            InertialSteps: self._take_steps,
            GravityAlignment: self._take_gravity,
            SubmapScale: self._take_scale,
            SubmapTie: self._take_tie,
        }

    def take(self, agent: AgentId, records: tuple[Record, ...], now_ns: int, *, in_contact: bool = True) -> None:
        """Put an agent's records into the map. in_contact: the agent sent them now; they are no copy of a log."""
        if records and in_contact:
            self.last_contact_ns[agent] = now_ns
        for record in records:
            if not _is_own(agent, record) or _is_far(record):
                self.refused += 1
                continue
            if self.deleted and _submap_of(record) in self.deleted:
                continue
            handler = self._handlers.get(type(record))
            if handler is not None:
                handler(record, now_ns)

    def take_scans(self) -> list[KeyframeScan]:
        """The scans that arrived since the last call, or before the camera of their agent was known."""
        known = [agent_of_keyframe(scan.keyframe) in self._map.cameras for scan in self._scans]
        scans = list(compress(self._scans, known))
        early = [scan for scan, is_known in zip(self._scans, known, strict=True) if not is_known]
        self._scans = early[-self._config.max_pending :]
        return scans

    def take_images(self) -> list[ScanImages]:
        """The images of scans that arrived since the last call."""
        images, self._images = self._images, []
        return images

    def take_rooted(self) -> list[KeyframeId]:
        """Keyframes that were given a pose since the last call: their submaps begin there, without their first ones."""
        rooted, self._rooted = self._rooted, []
        return rooted

    def ready(self, now_ns: int) -> list[KeyframeId]:
        """Keyframes to use now, in order of id: complete ones, those past the patience, and late completions."""
        self._place_orphans(now_ns)
        out: list[KeyframeId] = []
        patience_ns = round(_PATIENCE_S * 1e9)
        for keyframe, since_ns in sorted(self._waiting.items()):
            if len(out) == _MAX_PER_STEP:
                break
            if not self._is_usable(keyframe):
                continue
            complete = self._map.is_complete(keyframe)
            if complete or now_ns - since_ns >= patience_ns:
                out.append(keyframe)
                if not complete:
                    self._partial.add(keyframe)
        for keyframe in out:
            del self._waiting[keyframe]
        late = [k for k in sorted(self._partial) if k not in out and self._map.is_complete(k)][:_MAX_PER_STEP]
        self._partial.difference_update(late)
        return sorted(out + late)

    def is_used(self, submap: SubmapId) -> bool:
        """True if a keyframe of a submap is used."""
        return any(keyframe not in self._waiting for keyframe in self._map.submaps.get(submap, ()))

    @property
    def backlog(self) -> bool:
        """True if a keyframe is ready and not used yet."""
        return any(self._map.is_complete(k) and self._is_usable(k) for k in self._waiting)

    def state(self) -> IntakeState:
        """State to be saved."""
        unused = sorted({*self._waiting, *self._partial})
        return IntakeState(dict(self.last_pose), dict(self.tracked_ns), tuple(unused), tuple(sorted(self.deleted)))

    def restore(self, state: IntakeState) -> None:
        """Continue from a saved state, after the received records were taken."""
        self.last_pose.update(state.last_pose)
        self.tracked_ns.update(state.tracked_ns)
        unused = set(state.unused)
        self._waiting = {k: t for k, t in self._waiting.items() if k in unused}
        self.inertial_ties.clear()  # they were used, or undone
        self.fresh_ties.clear()
        self.fresh_scales.clear()
        self.deleted.update(state.deleted)

    def forget(self, submaps: Collection[SubmapId]) -> None:
        """Forget what concerns deleted submaps, also keyframes that came in this step and are not used yet."""
        for waiting in (self._pending, self._waiting):
            for keyframe in [k for k in waiting if submap_of_keyframe(k) in submaps]:
                del waiting[keyframe]
        self._pending_count = sum(map(len, self._pending.values()))
        self._partial = {k for k in self._partial if submap_of_keyframe(k) not in submaps}
        self.live = {a: pose for a, pose in self.live.items() if submap_of_keyframe(pose.keyframe) not in submaps}
        self._scans = [scan for scan in self._scans if submap_of_keyframe(scan.keyframe) not in submaps]
        self._images = [images for images in self._images if submap_of_keyframe(images.keyframe) not in submaps]
        self.fresh_ties.difference_update(submaps)
        self.fresh_scales.difference_update(submaps)
        self.inertial_ties.forget(submaps)
        for submap in submaps:
            for known in (self.last_pose, self.tracked_ns, self.gravity, self.loss_ties):
                known.pop(submap, None)

    def _is_usable(self, keyframe: KeyframeId) -> bool:
        """True if a keyframe has a pose and a camera."""
        has_pose = self._map.keyframes.pose_source[self._map.rows[keyframe]] != NO_POSE
        return bool(has_pose) and agent_of_keyframe(keyframe) in self._map.cameras

    # handlers of records

    def _take_live_pose(self, record: LivePose, now_ns: int) -> None:
        held = self.live.get(record.agent)
        if held is not None and _start(record) == _start(held) and record.t_ns < held.t_ns:
            return
        submap = submap_of_keyframe(record.keyframe)
        if submap not in self.last_pose and len(self.last_pose) >= self._config.max_pending:
            self.refused += 1  # each may name another submap that does not exist
            return
        self.live[record.agent] = record
        self.last_pose[submap] = record
        if record.quality > 0:
            self.tracked_ns[submap] = record.t_ns

    def _take_gravity(self, record: GravityAlignment, now_ns: int) -> None:
        self.gravity[record.submap] = record

    def _take_scale(self, record: SubmapScale, now_ns: int) -> None:
        self._map.metres_per_unit[record.submap] = record.metres
        self.fresh_scales.add(record.submap)
        if record.metres == 1.0:
            self._map.metric_submaps.add(record.submap)

    def _take_tie(self, record: SubmapTie, now_ns: int) -> None:
        self.loss_ties[record.submap] = record
        self.fresh_ties.add(record.submap)

    def _take_steps(self, record: InertialSteps, now_ns: int) -> None:
        self._map.inertial_steps[record.keyframe] = record
        self.inertial_ties.add(record)

    def _take_header(self, header: KeyframeHeader, now_ns: int) -> None:
        fresh = header.keyframe not in self._map
        try:
            self._map.add_keyframe(header.keyframe, header.t_ns, header.parent, header.T_p_k, header.keypoints)
        except ValueError:
            self.refused += 1
            return
        if header.up is not None:
            self._map.up[header.keyframe] = header.up, header.up_rad
        if fresh:
            self._waiting[header.keyframe] = now_ns
        sections = self._pending.pop(header.keyframe, {})
        self._pending_count -= len(sections)
        for _, section in sorted(sections.items(), key=lambda item: item[0]):
            self._put_section(section)

    def _take_section(self, section: NewLandmarks | Observations, now_ns: int) -> None:
        """Put a section into the map; one whose header has not come waits for it."""
        if section.keyframe in self._map:
            self._put_section(section)
        elif self._pending_count < self._config.max_pending:
            sections = self._pending.setdefault(section.keyframe, {})
            sections[isinstance(section, NewLandmarks), section.part] = section
            self._pending_count += 1
        else:
            self.refused += 1

    def _put_section(self, section: NewLandmarks | Observations) -> None:
        if isinstance(section, NewLandmarks):
            self._map.put_new_landmarks(
                section.keyframe, section.part, section.index, section.uv, section.inv_depth, section.octave,
                section.angle, section.descriptor,
            )  # fmt: skip
        else:
            self._map.put_observations(
                section.keyframe, section.part, section.index, section.uv, section.inv_depth, section.octave,
                section.point,
            )  # fmt: skip

    def _place_orphans(self, now_ns: int) -> None:
        """Root a submap at its oldest keyframe if its first never comes (the base lost its store)."""
        orphan_ns = round(_MISSING_ROOT_S * 1e9)
        late = [k for k, since_ns in self._waiting.items() if now_ns - since_ns >= orphan_ns]
        for submap in sorted({submap_of_keyframe(k) for k in late}):
            keyframes = self._map.submaps[submap]
            if all(self._map.pose(k) is None for k in keyframes):
                table, row = self._map.keyframes, self._map.rows[keyframes[0]]
                if table.parent[row] != NO_KEYFRAME:
                    self._map.set_pose(keyframes[0], _LEVEL_T_M_C)
                    self._rooted.append(keyframes[0])


def _start(live: LivePose) -> int:
    """The start of its agent that a live pose is of: clocks of different ones do not compare."""
    return live.keyframe >> SEQUENCE_BITS + SUBMAP_BITS


def _submap_of(record: Record) -> SubmapId | None:
    """The submap that a record is of; None for one of the whole agent."""
    if isinstance(record, LivePose):
        return submap_of_keyframe(record.keyframe)
    return submap_of(record.key())


def _is_far(record: Record) -> bool:
    """True for a motion that leads farther than any flight; a keyframe's is checked where its pose is composed."""
    if isinstance(record, LivePose):
        return not is_near(record.T_k_c)
    if isinstance(record, SubmapTie):
        return not is_near(record.T_k_f)
    return isinstance(record, GravityAlignment) and not is_near(record.T_l_m)


def _is_own(agent: AgentId, record: Record) -> bool:
    """True if a record is of its writer's own submaps. Landmarks that it observes may be of other agents."""
    submap = _submap_of(record)
    if submap is not None and agent_of_submap(submap) != agent:
        return False
    if isinstance(record, InertialSteps | SubmapTie):
        return agent_of_keyframe(record.since) == agent
    return record.ID is not IdOf.AGENT or record.key().id == agent
