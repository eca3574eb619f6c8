"""Two finished maps in one store. Where the second lies in the first is not known: it is found by its places."""

from __future__ import annotations

import json
from collections.abc import Mapping

from kiteline_basestation.store.saved_map import Codes, SavedMap
from kiteline_codec.schema import WORLD_KINDS, Key, KeyframeHeader, WireError
from kiteline_core.ids import AgentId

_NUMBERED = ("edge", "merge")


def combine(first: SavedMap, second: SavedMap) -> SavedMap:
    """Both maps; the first one's world. What the second has of the same keyframes as the first is passed over.

    Raises WireError where both have other keyframes under the same ids.
    """
    if first.empty:
        return second
    agents: dict[AgentId, Codes] = dict(first.agents)
    new: list[int] = []
    for agent, codes in sorted(second.agents.items()):
        here = agents.get(agent, Codes({}, {}))
        heads = {key for key in codes.received if key.kind == KeyframeHeader.KIND}
        for key in heads:
            if here.received.get(key, codes.received[key]) != codes.received[key]:
                raise WireError(
                    f"both maps hold keyframe {key.id} of agent {agent}, and not the same: another agent with this "
                    "number? Give each its own --agent, and keep its --log folder, where its starts are counted"
                )
        new += sorted(key.id for key in heads if key not in here.received)
        known = {key.id for key in heads if key in here.received}
        agents[agent] = Codes(
            {**codes.received, **here.received},
            {**{key: code for key, code in codes.own.items() if _is_news(key, known)}, **here.own},
        )
    return SavedMap(agents, _combined(first.memory, second.memory, new))


def _is_news(key: Key, known: set[int]) -> bool:
    return key.kind not in WORLD_KINDS and key.id not in known


def _combined(first: Mapping[str, str], second: Mapping[str, str], new: list[int]) -> dict[str, str]:
    out = dict(first)
    for folder in _NUMBERED:
        width = 6 if folder == "edge" else 4
        at = sum(name.startswith(folder + "/") for name in first)
        for name in sorted(name for name in second if name.startswith(folder + "/")):
            out[f"{folder}/{at:0{width}d}"] = second[name]
            at += 1
    for name in second:
        if name.startswith("submap/") and name not in first:
            out[name] = json.dumps({**json.loads(second[name]), "T_w_m": None})
        elif name.startswith(("agent/", "votes/")):
            out.setdefault(name, second[name])
    if "atlas" in second:
        ours = json.loads(first["atlas"]) if "atlas" in first else None
        theirs = json.loads(second["atlas"])
        merged = {**theirs, "revisit": []} if ours is None else ours
        merged["loops"] = theirs["loops"] + (ours["loops"] if ours else 0)
        merged["revisit"] = sorted({*merged["revisit"], *new})
        out["atlas"] = json.dumps(merged)
    if "finder" in second:
        ours = (
            json.loads(first["finder"]) if "finder" in first else {"doubts": [], "born": [], "apart": [], "asked": []}
        )
        theirs = json.loads(second["finder"])
        born = list(dict.fromkeys([*ours["born"], *theirs["born"]]))
        apart = [*ours["apart"], *(pair for pair in theirs["apart"] if pair not in ours["apart"])]
        out["finder"] = json.dumps({**ours, "born": born, "apart": apart})
    if "base" not in out and "base" in second:
        out["base"] = json.dumps({**json.loads(second["base"]), "placed": []})
    return out
