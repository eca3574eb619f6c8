"""Merges of maps, what rests on them, and what a step of the map merger changed."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from kiteline_basestation.map.map_tables import LANDMARK
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.merging.loop_detector import DetectorState, SubmapPair
from kiteline_basestation.merging.loop_edges import LoopEdge, LoopMatch
from kiteline_core.arrays import F64, I32
from kiteline_core.ids import SEQUENCE_BITS, KeyframeId, SubmapId, submap_of_keyframe


@dataclass(slots=True, eq=False)
class MapMerge:
    """A merge of the map `map_id` into the map `into`.

    moved: S_w_m (4,4) of each submap of the merged map before the merge.
    """

    map_id: SubmapId
    into: SubmapId
    moved: dict[SubmapId, F64]

    def forget(self, submaps: Collection[SubmapId]) -> None:
        """Submaps are deleted, or no part of the merged map any more."""
        self.moved = {submap: S_w_m for submap, S_w_m in self.moved.items() if submap not in submaps}


@dataclass(frozen=True, slots=True)
class MergerState:
    """State of a `MapMerger` that outlives the process; pending jobs are due again."""

    loops: int = 0
    undone: int = 0
    last_return: Mapping[SubmapId, int] = field(default_factory=dict)
    uncertain_at: Mapping[SubmapId, int] = field(default_factory=dict)
    bundled_sizes: Mapping[SubmapId, int] = field(default_factory=dict)
    graphs_due: tuple[SubmapId, ...] = ()
    bundles_due: tuple[SubmapId, ...] = ()
    requery: tuple[KeyframeId, ...] = ()
    edges: tuple[LoopEdge, ...] = ()
    unfused: Mapping[SubmapId, tuple[LoopMatch, ...]] = field(default_factory=dict)
    merges: tuple[MapMerge, ...] = ()
    detector: DetectorState = field(default_factory=DetectorState)


def edges_out_of(submaps: Collection[SubmapId], edges: Iterable[LoopEdge]) -> list[SubmapPair]:
    """The submaps of edges that lead out of some submaps: the one inside, then the other one."""
    ends = [(submap_of_keyframe(edge.new), submap_of_keyframe(edge.old)) for edge in edges]
    return [(a, b) if a in submaps else (b, a) for a, b in ends if (a in submaps) != (b in submaps)]


def resting_on(merge: MapMerge, later: Iterable[MapMerge], edges: Sequence[LoopEdge]) -> MapMerge | None:
    """The first of later merges that has edges to submaps of the merged map alone: its map lies where that one lay."""
    for other in later:
        pairs = edges_out_of(other.moved, edges)
        if pairs and all(a in merge.moved or b in merge.moved for a, b in pairs):
            return other
    return None


def fused_across(sparse_map: SparseMap, submaps: Collection[SubmapId]) -> I32:
    """Slots (n,) of landmarks that are fused with others, one of the two in some submaps and the other not."""
    table, n = sparse_map.keypoints, sparse_map.slots
    inside = np.isin(sparse_map.keyframes.id[table.row[:n]] >> SEQUENCE_BITS, sorted(submaps))
    root = table.root[:n]
    across = (table.kind[:n] == LANDMARK) & (root >= 0) & (inside != inside[np.maximum(root, 0)])
    return np.flatnonzero(across).astype(np.int32)


@dataclass(frozen=True, slots=True)
class MergeResult:
    """Changes of whole maps that the mapper has to apply.

    moved: ids of maps in which all keyframes may have moved. rescaled: factors by which units of submaps grew in their
    map. scale_sigma: relative deviations of lengths, by map id, where accelerations told them. split: all submaps of
    maps that were one. requeried: keyframes for which loop closures were searched again; local bundles are due around
    them. bent: rows of keyframes that a bundle of a part of a large map moved.
    """

    moved: frozenset[SubmapId] = frozenset()
    rescaled: Mapping[SubmapId, float] = field(default_factory=dict)
    scale_sigma: Mapping[SubmapId, float] = field(default_factory=dict)
    split: frozenset[SubmapId] = frozenset()
    requeried: tuple[KeyframeId, ...] = ()
    bent: frozenset[int] = frozenset()

    def __add__(self, later: "MergeResult") -> "MergeResult":
        factors = {submap: self.rescaled.get(submap, 1.0) * factor for submap, factor in later.rescaled.items()}
        return MergeResult(
            self.moved | later.moved, {**self.rescaled, **factors}, {**self.scale_sigma, **later.scale_sigma},
            self.split | later.split, self.requeried + later.requeried, self.bent | later.bent,
        )  # fmt: skip


NOTHING = MergeResult()
