"""Commands of users and other programs on maps: list, get, name, merge, split, delete. JSON in, JSON out.

A command is an input of the mapper's step, logged and replayed with it; see docs/how-to/manage-maps.md. A submap is
named AGENT.BOOT.NUMBER; a map by any of its submaps, or by a name that a user gave it.
"""

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from kiteline_basestation.intake.intake import Intake
from kiteline_basestation.map.matrices import numbers_of, similarity_from
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.merging.map_merger import MapMerger
from kiteline_basestation.merging.merges import NOTHING, MergeResult
from kiteline_codec.coding.quantise import MAX_SCALE, MIN_SCALE
from kiteline_core.arrays import F64
from kiteline_core.errors import INPUT_FAULTS
from kiteline_core.geometry import sim3
from kiteline_core.ids import SUBMAP_BITS, SubmapId, agent_of_submap, boot_of_submap, submap_id, submap_of_keyframe

_NAME_CHARS = 64
_TEXT_CHARS = 1 << 14  # of a command
_FAR_M = 1e7  # of a merge that a user asks for
_FLYING_NS = 10_000_000_000  # ns after its last contact during which an agent counts as flying

Json = Any


@dataclass(frozen=True, slots=True)
class Command:
    """A command. id: chosen by the sender. verb: one of VERBS. text: a JSON object with its arguments."""

    id: int
    verb: str
    text: str


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer to a command. text: a JSON object; {"error": ...} if it was refused."""

    id: int
    ok: bool
    text: str


class _Refused(Exception):
    """A command that cannot be carried out."""


def submap_name(submap: SubmapId) -> str:
    """AGENT.BOOT.NUMBER of a submap."""
    return f"{agent_of_submap(submap)}.{boot_of_submap(submap)}.{submap & (1 << SUBMAP_BITS) - 1}"


class MapManager:
    """Answers commands. names, placements: those of the mapper. delete: drops submaps from all of the mapper."""

    def __init__(
        self, sparse_map: SparseMap, names: dict[SubmapId, str], placements: Mapping[SubmapId, F64],
        intake: Intake, merger: MapMerger | None, delete: Callable[[Collection[SubmapId]], None],
    ) -> None:  # fmt: skip
        self._map = sparse_map
        self._names = names
        self._placements = placements
        self._intake = intake
        self._merger = merger
        self._delete_submaps = delete

    def carry_out(
        self, commands: Sequence[Command], now_ns: int
    ) -> tuple[Callable[[], tuple[Answer, ...]], MergeResult]:
        """Carry commands out, or refuse them with a reason.

        Returns what tells the answers once the step's changes are applied, and what the commands changed in whole maps.
        """
        done = [self._carry_out(command, now_ns) for command in commands]
        return lambda: tuple(tell() for tell, _ in done), sum((changes for _, changes in done), NOTHING)

    def _carry_out(self, command: Command, now_ns: int) -> tuple[Callable[[], Answer], MergeResult]:
        try:
            if command.verb not in VERBS:
                raise _Refused(f"no command {command.verb!r}; there are: {', '.join(VERBS)}")
            verb, allowed = VERBS[command.verb]
            if len(command.text) > _TEXT_CHARS:
                raise _Refused(f"{len(command.text)} characters, expected at most {_TEXT_CHARS}")
            try:
                given = json.loads(command.text or "{}")
            except (ValueError, *INPUT_FAULTS) as error:
                raise _Refused(f"{command.text[:80]!r} is no JSON") from error
            if not isinstance(given, dict):
                raise _Refused("expected a JSON object")
            if unknown := sorted(given.keys() - set(allowed)):
                raise _Refused(f"unknown key {unknown[0]!r}; {command.verb} takes: {', '.join(allowed) or 'nothing'}")
            out, changes = verb(self, given, now_ns)
            return lambda: Answer(command.id, True, json.dumps(out() if callable(out) else out)), changes
        except _Refused as error:
            refusal = Answer(command.id, False, json.dumps({"error": str(error)}))
            return lambda: refusal, NOTHING

    # -- verbs: arguments and the time in ns -> JSON value, or what makes it after the step; changes ---------------

    def _list(self, given: Mapping[str, Json], now_ns: int) -> tuple[Json, MergeResult]:
        points = self._map.live_by_submap()
        maps = sorted({self._map.map_id(s) for s in self._map.submaps if s not in self._intake.deleted})
        return {"maps": [self._overview(map_id, points) for map_id in maps]}, NOTHING

    def _get(self, given: Mapping[str, Json], now_ns: int) -> tuple[Json, MergeResult]:
        map_id = self._named_map(given, "map")
        out = self._overview(map_id, self._map.live_by_submap())
        for submap, entry in zip(self._map.submaps_of_map(map_id), out["submaps"], strict=True):
            entry["T_map_m"] = numbers_of(sim3.inverse(self._map.submap_pose(map_id)) @ self._map.submap_pose(submap))
            entry["poses"] = [
                {"id": int(k), "t_ns": int(self._map.keyframes.t_ns[self._map.rows[k]]), "T_m_k": numbers_of(pose)}
                for k in self._map.submaps[submap]
                if (pose := self._map.pose(k)) is not None
            ]
        return out, NOTHING

    def _name(self, given: Mapping[str, Json], now_ns: int) -> tuple[Json, MergeResult]:
        map_id, name = self._named_map(given, "map"), given.get("name")
        if not isinstance(name, str) or not name.isprintable() or len(name) > _NAME_CHARS:
            raise _Refused(f'"name" is a text of at most {_NAME_CHARS} printable characters; "" removes the name')
        others = {text for s, text in self._names.items() if s != map_id}
        if name in others or _parsed(name) is not None:
            raise _Refused(f"{name!r} is taken: no two maps have one name, and no name looks like an id")
        self._names.pop(map_id, None)
        if name:
            self._names[map_id] = name
        return self._overview(map_id, self._map.live_by_submap()), NOTHING

    def _merge(self, given: Mapping[str, Json], now_ns: int) -> tuple[Json, MergeResult]:
        merger = self._required_merger()
        into, other = self._named_map(given, "into"), self._named_map(given, "map")
        if into == other:
            raise _Refused("these are one map already")
        if merger.is_busy(into) or merger.is_busy(other):
            raise _Refused("one of the two is being corrected; try again in a moment")
        if "T_into_map" not in given:
            merger.search_overlap(other, into)
            count = sum(len(self._map.submaps[s]) for s in self._map.submaps_of_map(other))
            return {"merged": False, "looking": count}, NOTHING
        try:
            S = similarity_from(given["T_into_map"])
            if not (np.abs(S[:3, 3]) <= _FAR_M).all() or not MIN_SCALE <= sim3.scale_of(S) <= MAX_SCALE:
                raise ValueError("beyond all maps")
        except (TypeError, ValueError, *INPUT_FAULTS) as error:
            raise _Refused(
                '"T_into_map" is a rigid motion, or a similarity for a monocular map: 16 numbers, rows of a 4x4 matrix'
            ) from error
        if sim3.scale_of(S) != 1.0 and not self._map.is_up_to_scale(other):
            raise _Refused(f"{submap_name(other)} is in metres: it is merged without a scale")
        into_pose, other_pose = self._map.submap_pose(into), self._map.submap_pose(other)
        changes = merger.merge(other, into, sim3.normalise(into_pose @ S @ sim3.inverse(other_pose)))
        return lambda: {"merged": True, **self._overview(into, self._map.live_by_submap())}, changes

    def _split(self, given: Mapping[str, Json], now_ns: int) -> tuple[Json, MergeResult]:
        merger = self._required_merger()
        submap = self._named_submap(given, "map")
        map_id = self._map.map_id(submap)
        changes = merger.split(submap)
        if changes is None:
            raise _Refused(f"{submap_name(submap)} was not merged into another map: there is nothing to be undone")
        both = (map_id, self._map.map_id(submap))
        return lambda: {"maps": [self._overview(m, self._map.live_by_submap()) for m in both]}, changes

    def _delete(self, given: Mapping[str, Json], now_ns: int) -> tuple[Json, MergeResult]:
        submaps = self._map.submaps_of_map(self._named_map(given, "map"))
        for submap in submaps:
            agent = agent_of_submap(submap)
            live = self._intake.live.get(agent)
            inside = live is not None and submap_of_keyframe(live.keyframe) == submap
            contact_ns = self._intake.last_contact_ns.get(agent) if inside else None
            if contact_ns is not None and now_ns - contact_ns < _FLYING_NS:
                raise _Refused(f"agent {agent} flies in {submap_name(submap)} now; land it first")
        self._delete_submaps(submaps)
        return {"deleted": [submap_name(s) for s in submaps]}, NOTHING

    # -- arguments and overviews ---------------------------------------------------------------------------------------

    def _required_merger(self) -> MapMerger:
        if self._merger is None:
            raise _Refused("this base merges no maps: gtsam is not installed, or [base.loops] enabled is false")
        return self._merger

    def _named_submap(self, given: Mapping[str, Json], key: str) -> SubmapId:
        text = given.get(key)
        if not isinstance(text, str):
            raise _Refused(f'"{key}" is missing: the id or the name of a map')
        found = _parsed(text)
        if found is None:
            found = next((s for s, name in self._names.items() if name == text), None)
        if found is None or found not in self._map.submaps or found in self._intake.deleted:
            raise _Refused(f"no map {text[:80]!r}; `list` names all maps")
        return found

    def _named_map(self, given: Mapping[str, Json], key: str) -> SubmapId:
        return self._map.map_id(self._named_submap(given, key))

    def _overview(self, map_id: SubmapId, points: Mapping[SubmapId, int]) -> Json:
        submaps: list[dict[str, Json]] = []
        for submap in self._map.submaps_of_map(map_id):
            keyframes = self._map.submaps[submap]
            stamps = [int(self._map.keyframes.t_ns[self._map.rows[k]]) for k in keyframes]
            submaps.append(
                {
                    "id": submap_name(submap),
                    "agent": int(agent_of_submap(submap)),
                    "keyframes": len(keyframes),
                    "points": points.get(submap, 0),
                    "first_t_ns": min(stamps),
                    "last_t_ns": max(stamps),
                    "unit": "own" if self._map.is_up_to_scale(submap) else "metre",
                    "scale": self._map.scale(submap),
                    "T_w_m": numbers_of(self._placements.get(submap)),
                }
            )
        return {
            "id": submap_name(map_id),
            "name": self._names.get(map_id, ""),
            "placed": map_id in self._placements,
            "unit": "own" if self._map.is_up_to_scale(map_id) else "metre",
            "agents": sorted({s["agent"] for s in submaps}),
            "keyframes": sum(s["keyframes"] for s in submaps),
            "points": sum(s["points"] for s in submaps),
            "submaps": submaps,
        }


_Verb = Callable[[MapManager, Mapping[str, Json], int], tuple[Json, MergeResult]]  # Json: or a function that makes it
# Verbs, and the keys that each takes.
VERBS: dict[str, tuple[_Verb, tuple[str, ...]]] = {
    "list": (MapManager._list, ()),
    "get": (MapManager._get, ("map",)),
    "name": (MapManager._name, ("map", "name")),
    "merge": (MapManager._merge, ("map", "into", "T_into_map")),
    "split": (MapManager._split, ("map",)),
    "delete": (MapManager._delete, ("map",)),
}

READING = frozenset({"list", "get"})  # verbs that change nothing


def _parsed(text: str) -> SubmapId | None:
    """The submap of AGENT.BOOT.NUMBER; None for any other text."""
    parts = text.split(".")
    if len(parts) != 3 or not all(part.isdecimal() for part in parts):
        return None
    try:
        return submap_id(*(int(part) for part in parts))
    except ValueError:
        return None
