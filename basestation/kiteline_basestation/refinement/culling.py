"""Culls landmarks that too few later keyframes observe, and redundant keyframes (ORB-SLAM2)."""

import numpy as np

from kiteline_basestation.exchange.publisher import Publisher
from kiteline_basestation.map.map_tables import CULLED, LANDMARK, REFINED_POSE
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.refinement.apply_bundle import cull_landmarks
from kiteline_basestation.refinement.landmark_matching import predict_projections
from kiteline_codec.schema import CulledLandmarks
from kiteline_core.ids import KeyframeId, submap_of_keyframe

_MIN_SHARED = 15  # landmarks that a keyframe shares with the new one, to be tested
_LANDMARK_AGE = 4  # keyframes after the first observation at which a landmark is tested
_MIN_FOUND = 0.25  # share of the keyframes with a landmark in view that observe it
_MIN_VISIBLE = 4  # keyframes with the landmark in view before it is tested
_KEYFRAME_AGE = 10  # later keyframes of its submap before a keyframe may be culled as redundant
_KEYFRAME_SHARE = 0.9  # share of its landmarks that other keyframes observe as well
_KEYFRAME_OTHERS = 3  # other keyframes that observe them, at a scale at most one octave coarser


def cull_weak_landmarks(sparse_map: SparseMap, keyframe: KeyframeId, publisher: Publisher) -> int:
    """Test the landmarks first observed _LANDMARK_AGE keyframes before this one. Returns how many were culled."""
    same = sparse_map.submaps[submap_of_keyframe(keyframe)]
    number = sparse_map.number_of(keyframe)
    if number < _LANDMARK_AGE:
        return 0
    anchor = same[number - _LANDMARK_AGE]
    table = sparse_map.keypoints
    slots = sparse_map.slots_of(anchor)
    own = (table.kind[slots] == LANDMARK) & (table.root[slots] == slots) & (table.flags[slots] & CULLED == 0)
    landmarks = slots[own]
    visible, first = np.zeros(len(slots), np.int32), int(sparse_map.keyframes.start[sparse_map.rows[anchor]])
    for later in same[number - _LANDMARK_AGE + 1 : number + 1]:
        if sparse_map.pose(later) is not None:
            visible[predict_projections(sparse_map, landmarks, later)[0] - first] += 1
    visible = visible[own]
    found = np.diff(sparse_map.observations(landmarks)[0]) - 1
    weak = (visible >= _MIN_VISIBLE) & (found < _MIN_FOUND * visible)
    cull_landmarks(sparse_map, landmarks[weak], publisher)
    return int(np.count_nonzero(weak))


def cull_redundant_keyframes(sparse_map: SparseMap, keyframe: KeyframeId, publisher: Publisher) -> list[KeyframeId]:
    """Cull covisible keyframes whose landmarks other keyframes observe as well. Returns them."""
    out: list[KeyframeId] = []
    for other in sparse_map.covisible_keyframes(keyframe, _MIN_SHARED):
        same = sparse_map.submaps[submap_of_keyframe(other)]
        at = sparse_map.number_of(other)
        if at == 0 or len(same) - at <= _KEYFRAME_AGE or not sparse_map.is_complete(other):
            continue
        if sparse_map.keyframes.pose_source[sparse_map.rows[other]] == REFINED_POSE and _redundant(sparse_map, other):
            sparse_map.cull_keyframe(other)
            publisher.mark_changed(CulledLandmarks.KIND, other)
            out.append(other)
    return out


def _redundant(sparse_map: SparseMap, keyframe: KeyframeId) -> bool:
    """True if enough other keyframes observe most of its landmarks, at a scale at most one octave coarser."""
    table, row = sparse_map.keypoints, sparse_map.rows[keyframe]
    mine = sparse_map.observations_of(keyframe)
    landmarks = table.root[mine]
    starts, slots = sparse_map.observations(landmarks)
    which = np.repeat(np.arange(len(landmarks)), np.diff(starts))
    finer = table.octave[slots].astype(np.int64) <= table.octave[mine[which]].astype(np.int64) + 1
    others = np.bincount(which[finer & (table.row[slots] != row)], minlength=len(landmarks))
    return float(np.mean(others >= _KEYFRAME_OTHERS)) >= _KEYFRAME_SHARE
