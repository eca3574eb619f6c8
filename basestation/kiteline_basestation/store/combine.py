"""Combines two saved maps. Where the second lies in the first is unknown: loop closures find it."""

from dataclasses import replace

from kiteline_basestation.intake.placements import PlacementState
from kiteline_basestation.mapper_state import MapperState
from kiteline_basestation.merging.loop_detector import DetectorState
from kiteline_basestation.merging.map_merger import MergerState
from kiteline_basestation.store.saved_map import SavedMap, SavedValues
from kiteline_basestation.store.state_texts import state_of, texts_of
from kiteline_codec.schema import GridTile, Key, KeyframeHeader, SubmapPlacement, WireError
from kiteline_core.ids import KeyframeId


def combine(first: SavedMap, second: SavedMap) -> SavedMap:
    """Both maps, in the world of the first. Of keyframes in both, the first map's values are taken.

    Raises WireError if the maps hold different keyframes under the same ids.
    """
    if first.empty:
        return replace(second, faults=first.faults + second.faults)
    agents, faults = dict(first.agents), first.faults + second.faults
    new: list[KeyframeId] = []
    for agent, values in sorted(second.agents.items()):
        here = agents.get(agent, SavedValues({}, {}))
        headers = {key for key in values.received if key.kind == KeyframeHeader.KIND}
        for key in headers:
            if here.received.get(key, values.received[key]) != values.received[key]:
                raise WireError(
                    f"both maps hold keyframe {key.id} of agent {agent}, and not the same: another agent with this "
                    "number? Give each its own --agent, and keep its state folder, where its starts are counted"
                )
        new += sorted(KeyframeId(key.id) for key in headers if key not in here.received)
        known = {key.id for key in headers if key in here.received}
        own = {key: code for key, code in values.own.items() if _is_taken(key, known)}
        agents[agent] = SavedValues({**values.received, **here.received}, {**own, **here.own})
    if not second.texts:
        return SavedMap(agents, first.texts, faults)
    ours, theirs = state_of(first.texts), state_of(second.texts)
    if not first.texts:  # the second map's state, but nothing of it is placed
        ours = replace(theirs, placements=PlacementState({}, theirs.placements.unmerged), merger=MergerState())
    return SavedMap(agents, texts_of(_combined(ours, theirs, new)), faults)


def _is_taken(key: Key, known: set[int]) -> bool:
    """True if a value of the second map is taken: no placement or tile, and of no keyframe in both maps."""
    return key.kind not in (SubmapPlacement.KIND, GridTile.KIND) and key.id not in known


def _combined(ours: MapperState, theirs: MapperState, new: list[KeyframeId]) -> MapperState:
    """Our state, with the submaps, calibrations, loop edges and merges of the other map."""
    a, b = ours.map, theirs.map
    sparse_map = replace(
        a,
        root_submaps={**b.root_submaps, **a.root_submaps},
        submap_poses={**b.submap_poses, **a.submap_poses},
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
    m, n = ours.merger, theirs.merger
    merger = replace(
        m,
        loops=m.loops + n.loops,
        requery=tuple(sorted({*m.requery, *new})),
        edges=m.edges + n.edges,
        merges=m.merges + n.merges,
        detector=_combined_detector(m.detector, n.detector),
    )
    scans = {**theirs.made_scans, **ours.made_scans}
    names = {**theirs.names, **ours.names}
    return replace(ours, names=names, map=sparse_map, intake=intake, merger=merger, made_scans=scans)


def _combined_detector(a: DetectorState, b: DetectorState) -> DetectorState:
    return replace(
        a,
        matches={**b.matches, **a.matches},
        first_seen=tuple(dict.fromkeys([*a.first_seen, *b.first_seen])),
        kept_apart=a.kept_apart + tuple(pair for pair in b.kept_apart if pair not in a.kept_apart),
    )
