"""What an atlas leaves to a successor, and how one goes on from it; `memory` names the texts."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from kiteline_basestation.merging.merge import Merge
from kiteline_basestation.store.state import (
    Entry,
    Json,
    Memory,
    matrix,
    parsed,
    plain,
    similarity_of,
    slots_of,
    votes_entry,
    votes_of,
)
from kiteline_core.ids import KeyframeId, SubmapId

if TYPE_CHECKING:
    from kiteline_basestation.merging.map_merger import Atlas


def memory(atlas: Atlas) -> Memory:
    """What a successor needs to go on from here; corrections under way are due again."""
    sparse_map = atlas._map
    out = {f"edge/{i:06d}": votes_entry(sparse_map, [v], points=False) for i, v in enumerate(atlas._edges)}
    out |= {f"fresh/{s}": votes_entry(sparse_map, votes, points=True) for s, votes in sorted(atlas._fresh.items())}
    for i, merge in enumerate(atlas.merges):
        mark = (merge.eldest, merge.into, tuple(T.tobytes() for T in merge.moved.values()), len(merge.fused))
        out[f"merge/{i:04d}"] = Entry(mark, partial(_merge_text, atlas, merge))
    out["atlas"] = plain(
        {
            "loops": atlas.loops,
            "undone": atlas.undone,
            "returned": [[int(s), at] for s, at in atlas._returned.items()],
            "doubted": [[int(s), size] for s, size in sorted(atlas._doubted.items())],
            "graphs": sorted({int(s) for s in atlas._graph_due | set(atlas._graphs.values())}),
            "fulls": sorted({int(s) for s in atlas._full_due | {full[0] for full in atlas._fulls.values()}}),
            "revisit": [int(k) for k in atlas._revisit],
        }
    )
    return out | atlas.finder.memory()


def _merge_text(atlas: Atlas, merge: Merge) -> Json:
    fused = np.array(merge.fused, np.int32).reshape(-1, 2)
    return {
        "eldest": int(merge.eldest),
        "into": int(merge.into),
        "moved": [[int(s), matrix(T)] for s, T in merge.moved.items()],
        "fused": [atlas._map.point_ids(fused[:, side]).tolist() for side in (0, 1)],
    }


def recall(atlas: Atlas, texts: Mapping[str, str]) -> None:
    """Go on from what a forerunner remembered; every keyframe is a known place."""
    sparse_map = atlas._map
    for keyframe in sorted(sparse_map.rows):
        if sparse_map.pose(keyframe) is not None and not sparse_map.keyframes.culled[sparse_map.rows[keyframe]]:
            atlas.finder.add(keyframe)
    atlas.finder.recall(texts)
    for _, votes in parsed(texts, "edge"):
        atlas._edges.extend(votes_of(sparse_map, votes))
    for (submap,), votes in parsed(texts, "fresh"):
        atlas._fresh[SubmapId(int(submap))] = votes_of(sparse_map, votes)
    for _, m in parsed(texts, "merge"):
        moved = {SubmapId(s): similarity_of(S) for s, S in m["moved"]}
        fused = [(int(a), int(b)) for a, b in zip(*slots_of(sparse_map, *m["fused"]))]
        atlas.merges.append(Merge(SubmapId(m["eldest"]), SubmapId(m["into"]), moved, fused))
    for _, value in parsed(texts, "atlas"):
        atlas.loops, atlas.undone = value["loops"], value["undone"]
        atlas._returned = {SubmapId(s): at for s, at in value["returned"]}
        atlas._doubted = {SubmapId(s): size for s, size in value.get("doubted", [])}
        atlas._graph_due = {SubmapId(s) for s in value["graphs"] if s in sparse_map.submaps}
        atlas._full_due = {SubmapId(s) for s in value["fulls"] if s in sparse_map.submaps}
        atlas._revisit = [KeyframeId(k) for k in value["revisit"] if k in sparse_map]
