"""Checks a saved map: inconsistent values are left out and reported, values still to come are counted.

`check` works on the saved values, `relinked` and `contradictions` on the map that was restored from them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from kiteline_basestation.map import sparse_map_kernels as kernels
from kiteline_basestation.map.map_tables import EMPTY, LANDMARK, NO_POSE, OBSERVATION
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.mapper import Mapper
from kiteline_basestation.mapper_state import MapperState
from kiteline_basestation.store.saved_map import SavedMap, SavedValues, value_name
from kiteline_basestation.store.state_texts import state_of, texts_of
from kiteline_codec.schema import (
    CulledLandmarks,
    FusedLandmarks,
    GravityAlignment,
    Key,
    KeyframeHeader,
    KeyframePose,
    NewLandmarks,
    Observations,
    Record,
    RefinedLandmarks,
    RemovedObservations,
    SubmapPlacement,
    SubmapScale,
    SubmapTie,
    WireError,
    messages,
)
from kiteline_core.arrays import I32
from kiteline_core.ids import (
    KEYPOINT_BITS,
    NO_KEYFRAME,
    SEQUENCE_BITS,
    AgentId,
    KeyframeId,
    SubmapId,
    agent_of_keyframe,
    agent_of_submap,
    submap_of_keyframe,
)
from kiteline_core.wording import counted

_RIGID = 1e-6  # tolerance of a rotation matrix
_OF_BASE = KeyframePose | RefinedLandmarks | FusedLandmarks | RemovedObservations | CulledLandmarks


@dataclass(frozen=True, slots=True)
class Checked:
    """A saved map without inconsistent values. faults: what was left out, a line each. awaited: keyframes whose parent,
    and sections whose keyframe, have not arrived; their agent sends them again.
    """

    saved: SavedMap
    faults: tuple[str, ...]
    awaited: int


def check(saved: SavedMap) -> Checked:
    """Check every value of a saved map."""
    faults = list(saved.faults)
    decoded = {
        agent: (_decoded(agent, codes.received, faults), _decoded(agent, codes.own, faults))
        for agent, codes in sorted(saved.agents.items())
    }
    headers: dict[KeyframeId, KeyframeHeader] = {}
    for agent, (received, _) in decoded.items():
        for key, record in list(received.items()):
            if isinstance(record, KeyframeHeader):
                if agent_of_keyframe(record.keyframe) != agent or not _parent_fits(record):
                    faults.append(f"keyframe {record.keyframe} of agent {agent} names parent {record.parent}: left out")
                    del received[key]
                else:
                    headers[record.keyframe] = record
    submaps = {submap_of_keyframe(k) for k in headers}
    awaited = sum(header.parent not in headers for header in headers.values() if header.parent != NO_KEYFRAME)
    for agent, (received, own) in decoded.items():
        for key, record in list(received.items()):
            if isinstance(record, NewLandmarks | Observations):
                awaited += record.keyframe not in headers
                if (why := _wrong_section(record, headers)) is not None:
                    faults.append(f"{value_name(key)} of agent {agent} {why}: left out")
                    del received[key]
            elif isinstance(record, GravityAlignment | SubmapScale | SubmapTie):
                awaited += record.submap not in submaps
        for key, record in list(own.items()):
            if (why := _wrong_own(record, agent, headers, submaps)) is not None:
                faults.append(f"{value_name(key)} of the base for agent {agent} {why}: left out")
                del own[key]
    agents = {}
    for agent, codes in saved.agents.items():
        received, own = decoded[agent]
        agents[agent] = SavedValues(
            {key: codes.received[key] for key in received}, {key: codes.own[key] for key in own}
        )
    texts: Mapping[str, str] = {}
    try:
        if saved.texts:
            texts = texts_of(_sound_state(state_of(saved.texts), submaps, faults))
    except (KeyError, TypeError, ValueError):
        if not saved.faults:
            raise
        faults.append("the state beside the values is incomplete: maps are apart until places are recognised again")
    return Checked(SavedMap(agents, texts), tuple(faults), awaited)


def _decoded(agent: AgentId, values: Mapping[Key, bytes], faults: list[str]) -> dict[Key, Record]:
    out: dict[Key, Record] = {}
    for key in sorted(values):
        try:
            out[key] = messages.decode(key, values[key])
        except WireError as error:
            faults.append(f"{value_name(key)} of agent {agent} cannot be read ({error}): left out")
    return out


def _parent_fits(header: KeyframeHeader) -> bool:
    older = header.parent < header.keyframe and submap_of_keyframe(header.parent) == submap_of_keyframe(header.keyframe)
    return header.parent == NO_KEYFRAME or older


def _wrong_section(record: NewLandmarks | Observations, headers: Mapping[KeyframeId, KeyframeHeader]) -> str | None:
    header = headers.get(record.keyframe)
    if header is not None and len(record.index) and int(record.index.max()) >= header.keypoints:
        return f"has keypoint {int(record.index.max())} of a keyframe with {header.keypoints}"
    return None


def _wrong_own(
    record: Record, agent: AgentId, headers: Mapping[KeyframeId, KeyframeHeader], submaps: set[SubmapId]
) -> str | None:
    if isinstance(record, SubmapPlacement):
        if record.submap not in submaps or agent_of_submap(record.submap) != agent:
            return "places a submap without keyframes"
    elif isinstance(record, _OF_BASE):
        header = headers.get(record.keyframe)
        if header is None:
            return "is of a keyframe that is not there"
        if not isinstance(record, KeyframePose) and len(record.index) and int(record.index.max()) >= header.keypoints:
            return f"is of keypoint {int(record.index.max())} of a keyframe with {header.keypoints}"
        if isinstance(record, FusedLandmarks) and len(record.point):
            named = {KeyframeId(k) for k in np.unique(record.point >> KEYPOINT_BITS).tolist()}
            if named - headers.keys():
                return "names landmarks of a keyframe that is not there"
    return None


def _sound_state(state: MapperState, submaps: set[SubmapId], faults: list[str]) -> MapperState:
    """The state without submaps that are not there. Keyframes are checked when the state is restored."""
    deleted = set(state.intake.deleted)
    roots, poses = dict(state.map.root_submaps), dict(state.map.submap_poses)
    for submap in sorted({*roots, *state.placements.S_w_m} - submaps):
        faults.append(f"submap {submap} has a placement and no keyframes: left out")
        roots.pop(submap, None)
    for submap, root in sorted(roots.items()):
        if root not in submaps or root in deleted:
            faults.append(f"submap {submap} is merged with {root}, which is not there: it is a map of its own")
            del roots[submap]
            poses.pop(submap, None)
    placed = {s: S for s, S in state.placements.S_w_m.items() if s in submaps}
    merges = tuple(m for m in state.merger.merges if m.map_id in submaps and m.into in submaps)
    return replace(
        state,
        names={s: name for s, name in state.names.items() if s in submaps},
        map=replace(state.map, root_submaps=roots, submap_poses={s: S for s, S in poses.items() if s in submaps}),
        intake=replace(
            state.intake,
            last_pose={s: pose for s, pose in state.intake.last_pose.items() if s in submaps},
            tracked_ns={s: t_ns for s, t_ns in state.intake.tracked_ns.items() if s in submaps},
        ),
        placements=replace(state.placements, S_w_m=placed),
        merger=replace(state.merger, merges=merges),
    )


def linked_across(sparse_map: SparseMap) -> I32:
    """Slots (n,) of keypoints that are linked to landmarks of another map."""
    table, root = sparse_map.keypoints, sparse_map.keypoints.root[: sparse_map.slots]
    linked = np.flatnonzero(root >= 0).astype(np.int32)
    submaps, of_slot = np.unique(
        sparse_map.keyframes.id[table.row[: sparse_map.slots]] >> SEQUENCE_BITS, return_inverse=True
    )
    maps = np.array([sparse_map.map_id(SubmapId(s)) for s in submaps.tolist()], np.int64)
    across: I32 = linked[maps[of_slot[linked]] != maps[of_slot[root[linked]]]]
    return across


def relinked(mapper: Mapper) -> list[str]:
    """Unlink keypoints from landmarks of other maps, and from what is none: a damaged store lost what joined the maps,
    or an agent sent other values under old keys. A line if any were.
    """
    sparse_map, table = mapper.map, mapper.map.keypoints
    wrong = _linked_wrongly(sparse_map)
    if not len(wrong):
        return []
    fused = wrong[table.kind[wrong] == LANDMARK]
    sparse_map.unfuse(fused)  # observations of them follow
    left = _linked_wrongly(sparse_map)
    to = np.where(table.kind[left] == LANDMARK, left, -1).astype(np.int32)
    kernels.link(left, to, table.root, table.first, table.next)
    mapper.tell_fused(fused)
    return [f"{counted(len(wrong), 'keypoint')} linked to landmarks of another map, or to none: maps are apart there"]


def _linked_wrongly(sparse_map: SparseMap) -> I32:
    """Slots (n,) of keypoints that are linked to landmarks of another map, to fused ones, or to what is none."""
    table, root = sparse_map.keypoints, sparse_map.keypoints.root[: sparse_map.slots]
    linked = np.flatnonzero(root >= 0).astype(np.int32)
    on = root[linked]
    wrong = (table.kind[linked] == EMPTY) | (table.kind[on] == OBSERVATION)
    wrong |= (root[on] != on) & (table.kind[on] != EMPTY)
    slots: I32 = np.union1d(linked[wrong], linked_across(sparse_map)).astype(np.int32)
    return slots


def contradictions(mapper: Mapper) -> list[str]:
    """Inconsistencies of a map, a line each."""
    sparse_map = mapper.map
    keyframes, table, n = sparse_map.keyframes, sparse_map.keypoints, sparse_map.slots
    out: list[str] = []
    for keyframe, row in sparse_map.rows.items():
        parent = KeyframeId(int(keyframes.parent[row]))
        if keyframes.pose_source[row] == NO_POSE:
            continue
        if parent != NO_KEYFRAME and parent not in sparse_map and keyframes.pose_source[row] == 1:
            out.append(f"keyframe {keyframe} takes its pose from parent {parent}, which is not there")
        for what, T in (("m", keyframes.T_m_k[row]), ("w", keyframes.T_w_k[row])):
            if not np.isfinite(T).all() or np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > _RIGID:
                out.append(f"keyframe {keyframe} has no rigid pose in {what}")
    root = table.root[:n]
    linked = np.flatnonzero(root >= 0)
    kinds = table.kind[:n]
    if np.any(kinds[linked] == EMPTY):
        out.append(f"{counted(int(np.count_nonzero(kinds[linked] == EMPTY)), 'empty keypoint')} linked to landmarks")
    on = root[linked]
    fused = (root[on] != on) & (kinds[on] != EMPTY)  # a landmark whose section is still to come counts as a root
    if np.any(fused):
        out.append(f"{counted(int(np.count_nonzero(fused)), 'keypoint')} linked to fused landmarks")
    if np.any(kinds[on] == OBSERVATION):
        out.append(
            f"{counted(int(np.count_nonzero(kinds[on] == OBSERVATION)), 'keypoint')} linked to what is no landmark"
        )
    unlinked = np.flatnonzero((kinds == LANDMARK) & (root < 0))
    if len(unlinked):
        out.append(f"{counted(len(unlinked), 'landmark')} without a root")
    roots = np.unique(on).astype(np.int32)
    listed = np.zeros(n, np.int64)
    for slot in roots.tolist():
        at, steps = int(table.first[slot]), 0
        while at >= 0 and steps <= n:
            listed[at] += 1
            at, steps = int(table.next[at]), steps + 1
    if np.any(listed[linked] != 1) or listed.sum() != len(linked):
        out.append("the lists of observations do not hold every observation once")
    if apart := len(linked_across(sparse_map)):
        out.append(f"{apart} keypoints are linked to landmarks of another map")
    for merged, root_submap in sparse_map.root_submaps.items():
        known = root_submap in sparse_map.submaps and merged in sparse_map.submaps
        if not known or root_submap in sparse_map.root_submaps:
            out.append(f"submap {merged} is merged with {root_submap}, which is no map")
    for placed, T_w_m in mapper.placements.items():
        if placed not in sparse_map.submaps or not np.isfinite(T_w_m).all():
            out.append(f"submap {placed} has a placement and no keyframes")
    return out
