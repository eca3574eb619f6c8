"""Combines two saved maps. Where the second lies in the first is unknown: loop closures find it.

Both may hold the same submaps, as a store and a newer copy of it do, and may have merged them differently.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

from kiteline_basestation.intake.placements import PlacementState
from kiteline_basestation.mapper_state import MapperState, MapState
from kiteline_basestation.merging.loop_detector import DetectorState
from kiteline_basestation.merging.merges import MergerState
from kiteline_basestation.store.saved_map import SavedMap, SavedValues
from kiteline_basestation.store.state_texts import state_of, texts_of
from kiteline_codec.schema import KEYFRAME_KINDS, GridTile, Key, KeyframeHeader, SubmapPlacement, WireError
from kiteline_core.arrays import F64
from kiteline_core.ids import KeyframeId, SubmapId, submap_of_keyframe


@dataclass(frozen=True, slots=True)
class _Sources:
    """From which saved map submaps are taken. in_first, in_second: the submaps of each.

    as_in_first, as_in_second: submaps whose merges are taken from one map alone, because the maps differ in them.
    """

    in_first: set[SubmapId]
    in_second: set[SubmapId]
    as_in_first: set[SubmapId]
    as_in_second: set[SubmapId]

    def is_from_second(self, submap: SubmapId) -> bool:
        """True if the pose of a submap, and what the base found of its keyframes, are taken from the second map."""
        return submap in self.in_second and (submap not in self.in_first or submap in self.as_in_second)


def combine(first: SavedMap, second: SavedMap) -> SavedMap:
    """Both maps, in the world of the first. Of keyframes in both, the first map's values are taken.

    Where the two merged the same submaps differently, that is taken from the map with more merges of them, with all
    that it found of their keyframes. Raises WireError if the maps hold different keyframes under the same ids.
    """
    if first.empty:
        return replace(second, faults=first.faults + second.faults)
    for agent, values in sorted(second.agents.items()):
        here = first.agents.get(agent, SavedValues({}, {}))
        for key, code in values.received.items():
            if key.kind == KeyframeHeader.KIND and here.received.get(key, code) != code:
                raise WireError(
                    f"both maps hold keyframe {key.id} of agent {agent}, and not the same: another agent with this "
                    "number? Give each its own --agent, and keep its state folder, where its starts are counted"
                )
    ours, theirs = state_of(first.texts), state_of(second.texts)
    if not first.texts:  # the second map's state, but nothing of it is placed
        ours = replace(theirs, placements=PlacementState({}, theirs.placements.unmerged), merger=MergerState())
    ids, other_ids = _keyframes_of(first), _keyframes_of(second)
    sources = _sources(ours.map, theirs.map, _submaps_of(ids), _submaps_of(other_ids))
    replaced = {k for k in ids & other_ids if sources.is_from_second(submap_of_keyframe(k))}
    known = (ids & other_ids) - replaced
    agents = dict(first.agents)
    for agent, values in sorted(second.agents.items()):
        here = agents.get(agent, SavedValues({}, {}))
        own = {key: code for key, code in values.own.items() if _is_taken(key, known)}
        kept = {key: c for key, c in here.own.items() if key.kind not in KEYFRAME_KINDS or key.id not in replaced}
        agents[agent] = SavedValues({**values.received, **here.received}, {**own, **kept})
    faults = first.faults + second.faults
    if not second.texts:
        return SavedMap(agents, first.texts, faults)
    set_apart = {k for k in ids if (s := submap_of_keyframe(k)) in sources.as_in_second and s not in sources.in_second}
    requery = (other_ids - ids) | set_apart
    return SavedMap(agents, texts_of(_combined(ours, theirs, sources, requery)), faults)


def _keyframes_of(saved: SavedMap) -> set[KeyframeId]:
    received = (key for values in saved.agents.values() for key in values.received)
    return {KeyframeId(key.id) for key in received if key.kind == KeyframeHeader.KIND}


def _submaps_of(keyframes: Collection[KeyframeId]) -> set[SubmapId]:
    return {submap_of_keyframe(k) for k in keyframes}


def _sources(first: MapState, second: MapState, in_first: set[SubmapId], in_second: set[SubmapId]) -> _Sources:
    """Decide where the maps differ, and which of them is taken there: the one with more merges."""
    a, b = first.root_submaps, second.root_submaps
    groups: dict[SubmapId, set[SubmapId]] = {}  # by submap: all that either map joins to it, also by way of others
    for submap, root in [*a.items(), *b.items()]:
        group = groups.get(submap, {submap}) | groups.get(root, {root})
        groups.update(dict.fromkeys(group, group))
    as_in_first, as_in_second = set[SubmapId](), set[SubmapId]()
    for submap in in_first & in_second:
        if a.get(submap, submap) != b.get(submap, submap):
            group = groups[submap]
            (as_in_second if len(group & b.keys()) > len(group & a.keys()) else as_in_first).update(group)
    return _Sources(in_first, in_second, as_in_first, as_in_second)


def _is_taken(key: Key, known: Collection[int]) -> bool:
    """True if a value of the second map is taken: no placement or tile, and of no keyframe in both maps."""
    return key.kind not in (SubmapPlacement.KIND, GridTile.KIND) and key.id not in known


def _combined(
    ours: MapperState, theirs: MapperState, sources: _Sources, requery: Collection[KeyframeId]
) -> MapperState:  # fmt: skip
    """Our state, with the submaps, calibrations, loop edges and merges of the other map."""
    a, b = ours.map, theirs.map
    sparse_map = replace(
        a,
        root_submaps={
            **{s: root for s, root in b.root_submaps.items() if s not in sources.as_in_first},
            **{s: root for s, root in a.root_submaps.items() if s not in sources.as_in_second},
        },
        submap_poses=_poses(a.submap_poses, b.submap_poses, sources),
        disparity_offset_px={**b.disparity_offset_px, **a.disparity_offset_px},
        disparity_calibrated=a.disparity_calibrated | b.disparity_calibrated,
        disparity_sigma_px={**b.disparity_sigma_px, **a.disparity_sigma_px},
        measured_with_px={**b.measured_with_px, **a.measured_with_px},
    )
    intake = replace(
        ours.intake,
        last_pose={**theirs.intake.last_pose, **ours.intake.last_pose},
        tracked_ns={**theirs.intake.tracked_ns, **ours.intake.tracked_ns},
    )
    merger = _combined_merger(ours.merger, theirs.merger, sources, sparse_map.root_submaps, requery)
    scans = {**theirs.made_scans, **ours.made_scans}
    names = {**theirs.names, **ours.names}
    return replace(ours, names=names, map=sparse_map, intake=intake, merger=merger, made_scans=scans)


def _poses(a: Mapping[SubmapId, F64], b: Mapping[SubmapId, F64], sources: _Sources) -> dict[SubmapId, F64]:
    """Poses of submaps; one without a pose defines the frame of its map."""
    ours = {submap: S_w_m for submap, S_w_m in a.items() if not sources.is_from_second(submap)}
    return ours | {submap: S_w_m for submap, S_w_m in b.items() if sources.is_from_second(submap)}


def _combined_merger(
    a: MergerState, b: MergerState, sources: _Sources, roots: Mapping[SubmapId, SubmapId],
    requery: Collection[KeyframeId],
) -> MergerState:  # fmt: skip
    """Our state, with edges and merges that the other map alone has. Maps as in the other one are due for a bundle."""

    def map_ids(submaps: Collection[SubmapId]) -> tuple[SubmapId, ...]:
        return tuple(sorted({roots.get(submap, submap) for submap in submaps}))

    is_shared = not sources.in_second.isdisjoint(sources.in_first)
    merges = [m for m in a.merges if m.map_id not in sources.as_in_second]
    merged = {m.map_id for m in merges}
    merges += [m for m in b.merges if m.map_id not in sources.as_in_first and m.map_id not in merged]
    held = {(e.new, e.old) for e in a.edges}
    edges = [*a.edges, *(e for e in b.edges if (e.new, e.old) not in held)]
    return replace(
        a,
        loops=max(a.loops, b.loops) if is_shared else a.loops + b.loops,
        graphs_due=map_ids(a.graphs_due),
        bundles_due=map_ids([*a.bundles_due, *(s for s in sources.as_in_second if s in roots)]),  # which places them
        requery=tuple(sorted({*a.requery, *requery})),
        edges=tuple(e for e in edges if len(map_ids([submap_of_keyframe(e.new), submap_of_keyframe(e.old)])) == 1),
        unfused={s: matches for s, matches in a.unfused.items() if s not in roots},
        merges=tuple(merges),
        detector=_combined_detector(a.detector, b.detector),
    )


def _combined_detector(a: DetectorState, b: DetectorState) -> DetectorState:
    return replace(
        a,
        matches={**b.matches, **a.matches},
        first_seen=tuple(dict.fromkeys([*a.first_seen, *b.first_seen])),
        kept_apart=a.kept_apart + tuple(pair for pair in b.kept_apart if pair not in a.kept_apart),
    )
