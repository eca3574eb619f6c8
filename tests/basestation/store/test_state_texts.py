"""The mapper's state as texts: it comes back as it was, and only changed parts are written."""

import json
from dataclasses import replace

import numpy as np
import pytest

from kiteline_basestation.intake.intake import IntakeState
from kiteline_basestation.intake.placements import PlacementState
from kiteline_basestation.mapper_state import MapperState, MapState
from kiteline_basestation.merging.loop_detector import DetectorState
from kiteline_basestation.merging.loop_edges import LoopEdge, LoopMatch
from kiteline_basestation.merging.merges import MapMerge, MergerState
from kiteline_basestation.store import state_texts
from kiteline_basestation.store.state_texts import StateWriter, state_of, texts_of
from kiteline_codec.schema import LivePose
from kiteline_core.geometry import se3, sim3
from kiteline_core.ids import AgentId, KeyframeId, SubmapId

T = se3.exp(np.array([0.3, -0.2, 0.1, 0.4, 0.1, -0.7]))
S = sim3.of(1.7, T)
A, B = SubmapId(4096), SubmapId(67112960)


def full_state() -> MapperState:
    """A state in which every kind of field is set."""
    edge = LoopEdge(KeyframeId(70), KeyframeId(5), T, 41, 3.25, 1.1)
    match = LoopMatch(KeyframeId(71), KeyframeId(6), T, 40, 2.5, 1.0, np.array([3, 9]), np.array([4, 2**50]))
    merger = MergerState(
        loops=2, last_return={A: 30}, graphs_due=(A,), requery=(KeyframeId(9),), edges=(edge, edge),
        unfused={B: (match,)}, merges=(MapMerge(B, A, {B: S}), MapMerge(A, B, {A: T})),
        detector=DetectorState({(A, B): (match, match)}, {(A, B): 1}, (B, A), ((frozenset({A}), frozenset({B})),)),
    )  # fmt: skip
    return MapperState(
        names={A: 'hall "7"'}, unbundled={A: (KeyframeId(1), KeyframeId(2))},
        map=MapState(
            {B: A}, {B: S}, {AgentId(1): np.array([0.1, 0, 0, 0, 0])}, frozenset({AgentId(1)}), {AgentId(1): 0.07},
            {KeyframeId(7): np.array([0.2, 0, 0, 0, 0])},
        ),
        intake=IntakeState({A: LivePose(AgentId(0), 5, KeyframeId(2), T, 80)}, {A: 5}, (KeyframeId(3),), (B,)),
        placements=PlacementState({B: S, A: T}, {A: T}, frozenset({B})), merger=merger,
    )  # fmt: skip


def test_a_state_comes_back_to_the_last_bit() -> None:
    texts = texts_of(full_state())
    again = state_of(texts)
    assert texts_of(again) == texts
    assert list(again.placements.S_w_m) == [B, A]  # the first submap of all stays the first
    assert np.array_equal(again.placements.S_w_m[B], S)
    assert [list(merge.moved) for merge in again.merger.merges] == [[B], [A]]
    assert again.merger.detector.matches[A, B][1].old_landmarks.tolist() == [4, 2**50]
    assert texts_of(state_of({})) == texts_of(MapperState())


def test_a_state_of_an_earlier_version_can_be_read() -> None:
    texts = texts_of(full_state())
    before = json.loads(texts["mapper.map"])
    assert before.pop("disparity_sigma_px") == [[1, 0.07]]
    assert len(before.pop("measured_with_px")) == 1
    again = state_of({**texts, "mapper.map": json.dumps(before)})
    assert again.map.disparity_sigma_px == {}
    assert again.map.measured_with_px == {}
    assert again.map.disparity_calibrated == {AgentId(1)}
    merge = json.loads(texts["mapper.merger.merges/000000"]) | {"fused": [[1, 2], [3, 4]]}
    again = state_of({**texts, "mapper.merger.merges/000000": json.dumps(merge)})
    assert list(again.merger.merges[0].moved) == [B]
    del before["root_submaps"]  # always there
    with pytest.raises(KeyError):
        state_of({**texts, "mapper.map": json.dumps(before)})


def test_only_changed_parts_are_written() -> None:
    writer, state = StateWriter(), full_state()
    assert set(writer.changes(state)) == set(texts_of(state))
    assert writer.changes(state) == {}
    copied = replace(state.merger, merges=tuple(replace(m) for m in state.merger.merges))
    assert writer.changes(replace(state, merger=copied)) == {}
    more = replace(state.merger.merges[0], moved={B: T})
    changed = replace(copied, edges=copied.edges[:1], merges=(more, *copied.merges[1:]))
    expected = {"mapper.merger.merges/000000", "mapper.merger.edges/000001"}
    assert set(writer.changes(replace(state, merger=changed))) == expected
    assert writer.changes(replace(state, merger=changed)) == {}


def test_parts_that_stay_are_not_named_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Names of all scans and edges at each write took as long as the map was large."""
    writer, state = StateWriter(), full_state()
    writer.changes(state)
    named: list[object] = []
    monkeypatch.setattr(state_texts, "_key_text", lambda key: named.append(key) or f"/{key}")
    pose = LivePose(AgentId(0), 6, KeyframeId(2), T, 80)
    moved = replace(state, intake=replace(state.intake, last_pose={A: pose}))
    assert list(writer.changes(moved)) == [f"mapper.intake.last_pose/{A}"]
    assert named == [A]
    assert writer.changes(replace(moved, intake=replace(state.intake, last_pose={}))) == {
        f"mapper.intake.last_pose/{A}": None
    }


@pytest.mark.parametrize(
    ("name", "path", "value"),
    [
        ("mapper.merger.edges/000000", ("T_old_new", 1, 0), 2.0),
        ("mapper.merger.edges/000000", ("inliers",), "many"),
        ("mapper.placements", ("S_w_m", 0, 1, 1, 0), float("nan")),
        ("mapper.intake.last_pose/4096", ("T_k_c", 1, 15), 0.0),
        ("mapper.merger", ("loops",), None),
    ],
)
def test_values_of_another_type_are_refused(name: str, path: tuple[str | int, ...], value: object) -> None:
    texts = texts_of(full_state())
    changed = json.loads(texts[name])
    inner = changed
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    with pytest.raises((TypeError, ValueError)):
        state_of({**texts, name: json.dumps(changed)})
