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
    from kiteline_basestation.merging.map_merger import MapMerger


def memory(merger: MapMerger) -> Memory:
    """What a successor needs to go on from here; corrections under way are due again."""
    sparse_map = merger._map
    out = {f"edge/{i:06d}": votes_entry(sparse_map, [v], points=False) for i, v in enumerate(merger._edges)}
    out |= {f"fresh/{s}": votes_entry(sparse_map, votes, points=True) for s, votes in sorted(merger._fresh.items())}
    for i, merge in enumerate(merger.merges):
        mark = (merge.eldest, merge.into, tuple(T.tobytes() for T in merge.moved.values()), len(merge.fused))
        out[f"merge/{i:04d}"] = Entry(mark, partial(_merge_text, merger, merge))
    out["atlas"] = plain(
        {
            "loops": merger.loops,
            "undone": merger.undone,
            "returned": [[int(s), at] for s, at in merger._returned.items()],
            "doubted": [[int(s), size] for s, size in sorted(merger._doubted.items())],
            "graphs": sorted({int(s) for s in merger._graph_due | set(merger._graphs.values())}),
            "fulls": sorted({int(s) for s in merger._full_due | {full[0] for full in merger._fulls.values()}}),
            "revisit": [int(k) for k in merger._revisit],
        }
    )
    return out | merger.detector.memory()


def _merge_text(merger: MapMerger, merge: Merge) -> Json:
    fused = np.array(merge.fused, np.int32).reshape(-1, 2)
    return {
        "eldest": int(merge.eldest),
        "into": int(merge.into),
        "moved": [[int(s), matrix(T)] for s, T in merge.moved.items()],
        "fused": [merger._map.landmark_ids(fused[:, side]).tolist() for side in (0, 1)],
    }


def recall(merger: MapMerger, texts: Mapping[str, str]) -> None:
    """Go on from what a forerunner remembered; every keyframe is a known place."""
    sparse_map = merger._map
    for keyframe in sorted(sparse_map.rows):
        if sparse_map.pose(keyframe) is not None and not sparse_map.keyframes.culled[sparse_map.rows[keyframe]]:
            merger.detector.add(keyframe)
    merger.detector.recall(texts)
    for _, votes in parsed(texts, "edge"):
        merger._edges.extend(votes_of(sparse_map, votes))
    for (submap,), votes in parsed(texts, "fresh"):
        merger._fresh[SubmapId(int(submap))] = votes_of(sparse_map, votes)
    for _, m in parsed(texts, "merge"):
        moved = {SubmapId(s): similarity_of(S) for s, S in m["moved"]}
        fused = [(int(a), int(b)) for a, b in zip(*slots_of(sparse_map, *m["fused"]))]
        merger.merges.append(Merge(SubmapId(m["eldest"]), SubmapId(m["into"]), moved, fused))
    for _, value in parsed(texts, "atlas"):
        merger.loops, merger.undone = value["loops"], value["undone"]
        merger._returned = {SubmapId(s): at for s, at in value["returned"]}
        merger._doubted = {SubmapId(s): size for s, size in value.get("doubted", [])}
        merger._graph_due = {SubmapId(s) for s in value["graphs"] if s in sparse_map.submaps}
        merger._full_due = {SubmapId(s) for s in value["fulls"] if s in sparse_map.submaps}
        merger._revisit = [KeyframeId(k) for k in value["revisit"] if k in sparse_map]
