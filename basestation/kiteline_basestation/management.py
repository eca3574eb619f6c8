"""Maps in the hands of people and other programs: list, get, name, merge, split, delete. JSON in, JSON out.

A command is an input of the mapper's step like any other, logged and replayed with it; see docs/how-to/manage-maps.md.
A submap is called AGENT.BOOT.NUMBER; a map by its eldest submap, any other of its submaps, or its name.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from kiteline_basestation.store.state import matrix, similarity_of
from kiteline_core.geometry import sim3
from kiteline_core.ids import (
    BOOT_BITS,
    KEYPOINT_BITS,
    SEQUENCE_BITS,
    SUBMAP_BITS,
    KeyframeId,
    SubmapId,
    agent_of_keyframe,
    agent_of_submap,
    submap_id,
)

if TYPE_CHECKING:
    from kiteline_basestation.mapper import Mapper
    from kiteline_basestation.merging.map_merger import MapMerger

_NAME_CHARS = 64
_FLIES_NS = 10_000_000_000  # ns after its last word that an agent counts as flying: its map is not deleted

Json = Any


@dataclass(frozen=True, slots=True)
class Command:
    """One question or order. id: chosen by whoever asks. verb: one of VERBS. text: a JSON object."""

    id: int
    verb: str
    text: str


@dataclass(frozen=True, slots=True)
class Answer:
    """What became of it. text: a JSON object; where the command could not be carried out, {"error": …}."""

    id: int
    ok: bool
    text: str


class _Refused(Exception):
    """A command that cannot be carried out."""


def answer(mapper: Mapper, command: Command, now_ns: int) -> Answer:
    """Carry a command out, or say why not."""
    try:
        verb = VERBS.get(command.verb)
        if verb is None:
            raise _Refused(f"no command {command.verb!r}; there are: {', '.join(VERBS)}")
        try:
            given = json.loads(command.text or "{}")
        except ValueError as error:
            raise _Refused(f"{command.text[:80]!r} is no JSON") from error
        if not isinstance(given, dict):
            raise _Refused("expected a JSON object")
        allowed = _KEYS[command.verb]
        if unknown := sorted(given.keys() - set(allowed)):
            raise _Refused(f"unknown key {unknown[0]!r}; {command.verb} takes: {', '.join(allowed) or 'nothing'}")
        return Answer(command.id, True, json.dumps(verb(mapper, given, now_ns)))
    except _Refused as error:
        return Answer(command.id, False, json.dumps({"error": str(error)}))


def called(submap: SubmapId) -> str:
    """A submap's name for people: AGENT.BOOT.NUMBER."""
    boot, number = submap >> SUBMAP_BITS & (1 << BOOT_BITS) - 1, submap & (1 << SUBMAP_BITS) - 1
    return f"{agent_of_submap(submap)}.{boot}.{number}"


# -- verbs -------------------------------------------------------------------------------------------------------------


def _list(mapper: Mapper, given: Mapping[str, Json], now_ns: int) -> Json:
    points = _points(mapper)
    return {"maps": [_overview(mapper, map_id, points) for map_id in _map_ids(mapper)]}


def _get(mapper: Mapper, given: Mapping[str, Json], now_ns: int) -> Json:
    map_id = _map(mapper, given, "map")
    out = _overview(mapper, map_id, _points(mapper))
    for submap, told in zip(mapper.map.submaps_of_map(map_id), out["submaps"], strict=True):
        told["T_map_m"] = matrix(sim3.inverse(mapper.map.submap_pose(map_id)) @ mapper.map.submap_pose(submap))
        told["poses"] = [
            {"id": int(k), "t_ns": int(mapper.map.keyframes.t_ns[mapper.map.rows[k]]), "T_m_k": matrix(pose)}
            for k in mapper.map.submaps[submap]
            if (pose := mapper.map.pose(k)) is not None
        ]
    return out


def _name(mapper: Mapper, given: Mapping[str, Json], now_ns: int) -> Json:
    map_id, name = _map(mapper, given, "map"), given.get("name")
    if not isinstance(name, str) or not name.isprintable() or len(name) > _NAME_CHARS:
        raise _Refused(f'"name" is a text of at most {_NAME_CHARS} printable characters; "" takes it back')
    others = {text for s, text in mapper.names.items() if s != map_id}
    if name in others or _parsed(name) is not None:
        raise _Refused(f"{name!r} is taken: names and ids of maps are told apart")
    mapper.names.pop(map_id, None)
    if name:
        mapper.names[map_id] = name
    return _overview(mapper, map_id, _points(mapper))


def _merge(mapper: Mapper, given: Mapping[str, Json], now_ns: int) -> Json:
    merger = _merger(mapper)
    into, other = _map(mapper, given, "into"), _map(mapper, given, "map")
    if into == other:
        raise _Refused("these are one map already")
    if merger.busy_with(into) or merger.busy_with(other):
        raise _Refused("one of the two is being corrected just now; ask again in a moment")
    if "T_into_map" not in given:
        merger.look_for(other, into)
        return {
            "merged": False,
            "looking": len([k for s in mapper.map.submaps_of_map(other) for k in mapper.map.submaps[s]]),
        }
    try:
        S = similarity_of(given["T_into_map"])
    except (TypeError, ValueError) as error:
        raise _Refused(
            '"T_into_map" is a rigid motion, or with a scale where one eye mapped: 16 numbers, the rows of a 4x4 matrix'
        ) from error
    if sim3.scale_of(S) != 1.0 and not mapper.map.is_up_to_scale(other):
        raise _Refused(f"{called(other)} is in metres: it is laid into another map as long as it is")
    frames = mapper.map.submap_pose(into), mapper.map.submap_pose(other)
    merger.join(other, into, sim3.normalise(frames[0] @ S @ sim3.inverse(frames[1])))
    return {"merged": True, **_overview(mapper, into, _points(mapper))}


def _split(mapper: Mapper, given: Mapping[str, Json], now_ns: int) -> Json:
    merger = _merger(mapper)
    submap = _submap(mapper, given, "map")
    map_id = mapper.map.map_id(submap)
    if not merger.split(submap):
        raise _Refused(f"{called(submap)} was not merged into another map: there is nothing to be undone")
    apart = mapper.map.map_id(submap)
    points = _points(mapper)
    return {"maps": [_overview(mapper, s, points) for s in (map_id, apart)]}


def _delete(mapper: Mapper, given: Mapping[str, Json], now_ns: int) -> Json:
    map_id = _map(mapper, given, "map")
    submaps = mapper.map.submaps_of_map(map_id)
    for submap in submaps:
        last_contact_ns = mapper.last_contact_ns(submap)
        if last_contact_ns is not None and now_ns - last_contact_ns < _FLIES_NS:
            raise _Refused(f"agent {agent_of_submap(submap)} flies in {called(submap)} now; land it first")
    mapper.delete(submaps)
    return {"deleted": [called(s) for s in submaps]}


VERBS: dict[str, Callable[[Mapper, Mapping[str, Json], int], Json]] = {
    "list": _list,
    "get": _get,
    "name": _name,
    "merge": _merge,
    "split": _split,
    "delete": _delete,
}
_KEYS: dict[str, tuple[str, ...]] = {
    "list": (),
    "get": ("map",),
    "name": ("map", "name"),
    "merge": ("map", "into", "T_into_map"),
    "split": ("map",),
    "delete": ("map",),
}


# -- what they share ---------------------------------------------------------------------------------------------------


def _map_ids(mapper: Mapper) -> list[SubmapId]:
    return sorted({mapper.map.map_id(s) for s in mapper.map.submaps if s not in mapper.deleted})


def _merger(mapper: Mapper) -> MapMerger:
    if mapper.merger is None:
        raise _Refused("this base joins no maps: gtsam is not installed, or [base.loops] enabled is false")
    return mapper.merger


def _parsed(text: str) -> SubmapId | None:
    parts = text.split(".")
    if len(parts) != 3 or not all(part.isdecimal() for part in parts):
        return None
    try:
        return submap_id(*(int(part) for part in parts))
    except ValueError:
        return None


def _submap(mapper: Mapper, given: Mapping[str, Json], key: str) -> SubmapId:
    text = given.get(key)
    if not isinstance(text, str):
        raise _Refused(f'"{key}" is missing: the id or the name of a map')
    found = _parsed(text)
    if found is None:
        found = next((s for s, name in mapper.names.items() if name == text), None)
    if found is None or found not in mapper.map.submaps or found in mapper.deleted:
        raise _Refused(f"no map {text!r}; `list` tells what there is")
    return found


def _map(mapper: Mapper, given: Mapping[str, Json], key: str) -> SubmapId:
    return mapper.map.map_id(_submap(mapper, given, key))


def _points(mapper: Mapper) -> dict[int, int]:
    """How many live points each submap has."""
    born = mapper.map.landmark_ids(mapper.map.live_landmarks()) >> (SEQUENCE_BITS + KEYPOINT_BITS)
    submaps, counts = np.unique(born, return_counts=True)
    return dict(zip(submaps.tolist(), counts.tolist(), strict=True))


def _overview(mapper: Mapper, map_id: SubmapId, points: Mapping[int, int]) -> Json:
    submaps = mapper.map.submaps_of_map(map_id)
    told: list[dict[str, Json]] = []
    for submap in submaps:
        keyframes = mapper.map.submaps[submap]
        stamps = [int(mapper.map.keyframes.t_ns[mapper.map.rows[k]]) for k in keyframes]
        told.append(
            {
                "id": called(submap),
                "agent": int(agent_of_keyframe(KeyframeId(keyframes[0]))),
                "keyframes": len(keyframes),
                "points": points.get(submap, 0),
                "first_t_ns": min(stamps),
                "last_t_ns": max(stamps),
                "unit": "own" if mapper.map.is_up_to_scale(submap) else "metre",
                "scale": mapper.map.scale(submap),
                "T_w_m": matrix(mapper.placements.get(submap)),
            }
        )
    return {
        "id": called(map_id),
        "name": mapper.names.get(map_id, ""),
        "placed": map_id in mapper.placements,
        "unit": "own" if mapper.map.is_up_to_scale(map_id) else "metre",
        "agents": sorted({s["agent"] for s in told}),
        "keyframes": sum(s["keyframes"] for s in told),
        "points": sum(s["points"] for s in told),
        "submaps": told,
    }
