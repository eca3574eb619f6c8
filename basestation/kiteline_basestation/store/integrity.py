"""Is a kept map whole? What contradicts itself is taken out and told; what is only still to come is counted.

`sound` looks at the values before a map is made of them, `contradictions` at the map that was made.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from kiteline_basestation.map.map_tables import EMPTY, LANDMARK, NO_POSE, OBSERVATION
from kiteline_basestation.mapper import Mapper
from kiteline_basestation.store.saved_map import Codes, SavedMap
from kiteline_codec.schema import (
    RECORD_TYPES,
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
    WireError,
    messages,
)
from kiteline_core.ids import (
    KEYPOINT_BITS,
    NO_KEYFRAME,
    AgentId,
    KeyframeId,
    SubmapId,
    agent_of_keyframe,
    agent_of_submap,
    submap_of_keyframe,
)

_RIGID = 1e-6  # by which a turn may fail to be one
_OF_BASE = KeyframePose | RefinedLandmarks | FusedLandmarks | RemovedObservations | CulledLandmarks


@dataclass(frozen=True, slots=True)
class Checked:
    """A map without what contradicts itself. faults: what was taken out, one line each. awaited: keyframes whose
    parent, and sections whose keyframe, have not arrived: their agent sends them again.
    """

    kept: SavedMap
    faults: tuple[str, ...]
    awaited: int


def sound(kept: SavedMap) -> Checked:
    """Check every value, and take out what cannot be."""
    faults: list[str] = []
    decoded = {
        agent: (_decoded(agent, codes.received, faults), _decoded(agent, codes.own, faults))
        for agent, codes in sorted(kept.agents.items())
    }
    heads: dict[KeyframeId, KeyframeHeader] = {}
    for agent, (received, _) in decoded.items():
        for key, record in list(received.items()):
            if isinstance(record, KeyframeHeader):
                if agent_of_keyframe(record.keyframe) != agent or not _parent_fits(record):
                    faults.append(f"keyframe {record.keyframe} of agent {agent} names parent {record.parent}: left out")
                    del received[key]
                else:
                    heads[record.keyframe] = record
    submaps = {submap_of_keyframe(k) for k in heads}
    awaited = sum(head.parent not in heads for head in heads.values() if head.parent != NO_KEYFRAME)
    for agent, (received, own) in decoded.items():
        for key, record in list(received.items()):
            if isinstance(record, NewLandmarks | Observations):
                awaited += record.keyframe not in heads
                if (why := _wrong_section(record, heads)) is not None:
                    faults.append(f"{_name(key)} of agent {agent} {why}: left out")
                    del received[key]
            elif isinstance(record, GravityAlignment | SubmapScale):
                awaited += record.submap not in submaps
        for key, record in list(own.items()):
            if (why := _wrong_own(record, agent, heads, submaps)) is not None:
                faults.append(f"{_name(key)} of the base for agent {agent} {why}: left out")
                del own[key]
    agents = {}
    for agent, codes in kept.agents.items():
        received, own = decoded[agent]
        agents[agent] = Codes({key: codes.received[key] for key in received}, {key: codes.own[key] for key in own})
    return Checked(SavedMap(agents, _sound_memory(kept.memory, submaps, faults)), tuple(faults), awaited)


def _name(key: Key) -> str:
    record_type = RECORD_TYPES.get(key.kind)
    kind = f"kind {key.kind}" if record_type is None else record_type.__name__
    return f"{kind} {key.id}" + (f" part {key.part}" if key.part else "")


def _decoded(agent: AgentId, values: Mapping[Key, bytes], faults: list[str]) -> dict[Key, Record]:
    out: dict[Key, Record] = {}
    for key in sorted(values):
        try:
            out[key] = messages.decode(key, values[key])
        except WireError as error:
            faults.append(f"{_name(key)} of agent {agent} cannot be read ({error}): left out")
    return out


def _parent_fits(head: KeyframeHeader) -> bool:
    older = head.parent < head.keyframe and submap_of_keyframe(head.parent) == submap_of_keyframe(head.keyframe)
    return head.parent == NO_KEYFRAME or older


def _wrong_section(record: NewLandmarks | Observations, heads: Mapping[KeyframeId, KeyframeHeader]) -> str | None:
    head = heads.get(record.keyframe)
    if head is not None and len(record.index) and int(record.index.max()) >= head.keypoints:
        return f"has keypoint {int(record.index.max())} of a keyframe with {head.keypoints}"
    return None


def _wrong_own(
    record: Record, agent: AgentId, heads: Mapping[KeyframeId, KeyframeHeader], submaps: set[SubmapId]
) -> str | None:
    if isinstance(record, SubmapPlacement):
        if record.submap not in submaps or agent_of_submap(record.submap) != agent:
            return "places a submap without keyframes"
    elif isinstance(record, _OF_BASE):
        head = heads.get(record.keyframe)
        if head is None:
            return "tells of a keyframe that is not there"
        if not isinstance(record, KeyframePose) and len(record.index) and int(record.index.max()) >= head.keypoints:
            return f"tells of keypoint {int(record.index.max())} of a keyframe with {head.keypoints}"
        if isinstance(record, FusedLandmarks) and len(record.point):
            named = {KeyframeId(k) for k in np.unique(record.point >> KEYPOINT_BITS).tolist()}
            if named - heads.keys():
                return "names points of a keyframe that is not there"
    return None


def _sound_memory(texts: Mapping[str, str], submaps: set[SubmapId], faults: list[str]) -> dict[str, str]:
    """Texts whose submaps are there. What they say of keyframes is looked at when it is recalled."""
    out: dict[str, str] = {}
    deleted: set[int] = set(json.loads(texts["base"])["deleted"]) if "base" in texts else set()
    for name, text in sorted(texts.items()):
        folder, _, rest = name.partition("/")
        value = json.loads(text)
        if folder == "submap":
            joined = value["island"]
            if SubmapId(int(rest)) not in submaps:
                if value["T_w_m"] is not None or joined is not None:
                    faults.append(f"submap {rest} has a place and no keyframes: left out")
                continue
            if joined is not None and (SubmapId(joined) not in submaps or joined in deleted):
                faults.append(f"submap {rest} is joined to {joined}, which is not there: it is a map of its own")
                text = json.dumps({**value, "island": None, "frame": None})
        elif folder == "merge":
            there = [SubmapId(s) in submaps for s in (value["eldest"], value["into"])]
            if not all(there):
                continue  # one of the two maps was deleted: there is nothing to be undone
        out[name] = text
    if "base" in out:
        base = json.loads(out["base"])
        placed = [s for s in base["placed"] if f"submap/{s}" in out and json.loads(out[f"submap/{s}"])["T_w_m"]]
        if placed != base["placed"]:
            out["base"] = json.dumps({**base, "placed": placed})
    return out


def contradictions(mapper: Mapper) -> list[str]:
    """What cannot be in a map, one line each; empty where it is whole."""
    sparse_map = mapper.map
    frames, table, n = sparse_map.keyframes, sparse_map.keypoints, sparse_map.slots
    out = []
    for keyframe, row in sparse_map.rows.items():
        parent = KeyframeId(int(frames.parent[row]))
        if frames.pose_source[row] == NO_POSE:
            continue
        if parent != NO_KEYFRAME and parent not in sparse_map and frames.pose_source[row] == 1:
            out.append(f"keyframe {keyframe} has its pose from parent {parent}, which is not there")
        for what, T in (("m", frames.T_m_k[row]), ("w", frames.T_w_k[row])):
            if not np.isfinite(T).all() or np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > _RIGID:
                out.append(f"keyframe {keyframe} has no rigid pose in {what}")
    root = table.root[:n]
    hangs = np.flatnonzero(root >= 0)
    kinds = table.kind[:n]
    if np.any(kinds[hangs] == EMPTY):
        out.append(f"{np.count_nonzero(kinds[hangs] == EMPTY)} keypoints that are not there show points")
    on = root[hangs]
    aside = (root[on] != on) & (kinds[on] != EMPTY)  # a point whose section is still to come counts as a root
    if np.any(aside):
        out.append(f"{np.count_nonzero(aside)} keypoints show points that are no roots")
    if np.any(kinds[on] == OBSERVATION):
        out.append(f"{np.count_nonzero(kinds[on] == OBSERVATION)} keypoints show what no keyframe bore")
    born = np.flatnonzero((kinds == LANDMARK) & (root < 0))
    if len(born):
        out.append(f"{len(born)} births show no point")
    roots = np.unique(on).astype(np.int32)
    met = np.zeros(n, np.int64)
    for slot in roots.tolist():
        at, steps = int(table.first[slot]), 0
        while at >= 0 and steps <= n:
            met[at] += 1
            at, steps = int(table.next[at]), steps + 1
    if np.any(met[hangs] != 1) or met.sum() != len(hangs):
        out.append("the lists of observations do not hold every observation once")
    submap = frames.id[table.row[:n]] >> 20
    map_id = {s: int(sparse_map.map_id(SubmapId(s))) for s in np.unique(submap).tolist()}
    across = hangs[submap[hangs] != submap[on]]
    apart = sum(map_id[a] != map_id[b] for a, b in zip(submap[across].tolist(), submap[root[across]].tolist()))
    if apart:
        out.append(f"{apart} keypoints show points of a map that is not theirs")
    for joined, eldest in sparse_map.root_submaps.items():
        if eldest not in sparse_map.submaps or eldest in sparse_map.root_submaps or joined not in sparse_map.submaps:
            out.append(f"submap {joined} is joined to {eldest}, which is no map")
    for placed, T_w_m in mapper.placements.items():
        if placed not in sparse_map.submaps or not np.isfinite(T_w_m).all():
            out.append(f"submap {placed} has a place and no keyframes")
    return out
