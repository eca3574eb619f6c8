"""All that a base knows beyond the values shared with the agents, as it outlives the process.

Keyframes, submaps and landmarks are named by their ids, because slots are numbered anew in each process.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from kiteline_basestation.grid.image_scans import MadeScan
from kiteline_basestation.intake.intake import IntakeState
from kiteline_basestation.intake.placements import PlacementState
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.merging.merges import MergerState
from kiteline_core.arrays import F64
from kiteline_core.geometry.disparity_offset import TERMS
from kiteline_core.ids import AgentId, KeyframeId, SubmapId


@dataclass(slots=True)
class MapperCounts:
    """What was done so far."""

    keyframes: int = 0
    found: int = 0  # new landmarks that were fused with older ones
    triangulated: int = 0  # landmarks that got their first depth at the base
    culled: int = 0
    keyframes_culled: int = 0
    bundles: int = 0
    grids: int = 0


@dataclass(frozen=True, slots=True)
class MapState:
    """How submaps lie in their maps, and the disparity calibrations. See the attributes of `MapView`."""

    root_submaps: Mapping[SubmapId, SubmapId] = field(default_factory=dict)
    submap_poses: Mapping[SubmapId, F64] = field(default_factory=dict)
    disparity_offset_px: Mapping[AgentId, F64] = field(default_factory=dict)
    disparity_calibrated: frozenset[AgentId] = frozenset()
    disparity_sigma_px: Mapping[AgentId, float] = field(default_factory=dict)
    measured_with_px: Mapping[KeyframeId, F64] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class MapperState:
    """State of a `Mapper`. names: of maps. unbundled: keyframes that wait for a local bundle, by submap. made_scans: of
    images, by keyframe and part.
    """

    counts: MapperCounts = field(default_factory=MapperCounts)
    names: Mapping[SubmapId, str] = field(default_factory=dict)
    unbundled: Mapping[SubmapId, tuple[KeyframeId, ...]] = field(default_factory=dict)
    map: MapState = field(default_factory=MapState)
    intake: IntakeState = field(default_factory=IntakeState)
    placements: PlacementState = field(default_factory=PlacementState)
    merger: MergerState = field(default_factory=MergerState)
    made_scans: Mapping[tuple[int, int], MadeScan] = field(default_factory=dict)


def map_state(sparse_map: SparseMap) -> MapState:
    """State of a map to be saved."""
    return MapState(
        dict(sorted(sparse_map.root_submaps.items())), dict(sorted(sparse_map.submap_poses.items())),
        dict(sorted(sparse_map.disparity_offset_px.items())), frozenset(sparse_map.disparity_calibrated),
        dict(sorted(sparse_map.disparity_sigma_px.items())), dict(sorted(sparse_map.measured_with_px.items())),
    )  # fmt: skip


def restore_map(sparse_map: SparseMap, state: MapState) -> None:
    """Continue from a saved state, in a map whose keyframes are all there.

    Raises ValueError for what is no disparity offset.
    """
    for offset in (*state.disparity_offset_px.values(), *state.measured_with_px.values()):
        if offset.shape != (TERMS,) or not np.isfinite(offset).all():
            raise ValueError(f"a disparity offset is {offset.tolist()}: expected {TERMS} numbers")
    sparse_map.root_submaps.update(state.root_submaps)
    for submap, S_w_m in state.submap_poses.items():
        sparse_map.move_submap(submap, S_w_m)
    sparse_map.disparity_offset_px.update(state.disparity_offset_px)
    sparse_map.disparity_calibrated.update(state.disparity_calibrated)
    sparse_map.disparity_sigma_px.update(state.disparity_sigma_px)
    sparse_map.measured_with_px = dict(state.measured_with_px)
    told = sparse_map.onboard_sigma_px  # on board: what the agent found itself stays the prior
    sparse_map.known_offset_px.update({a: px for a, px in state.disparity_offset_px.items() if a not in told})
