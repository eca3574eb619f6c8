"""Records are taken from the agent whose they are, and from no other."""

from dataclasses import replace

import numpy as np
import pytest

from kiteline_basestation.config import BaseConfig, IntakeConfig
from kiteline_basestation.intake.intake import Intake
from kiteline_basestation.map import sparse_map as sparse_map_module
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_codec.schema import (
    RECORD_TYPES,
    CameraIntrinsics,
    GravityAlignment,
    InertialSteps,
    KeyframeHeader,
    LivePose,
    Observations,
    Record,
    StereoAlignment,
    SubmapScale,
    SubmapTie,
)
from kiteline_core.geometry.cameras import RectifiedCamera
from kiteline_core.ids import NO_KEYFRAME, AgentId, keyframe_id, point_id, submap_id

ONE, OTHER = AgentId(1), AgentId(2)
SUBMAP, LATER = submap_id(ONE, 3, 0), submap_id(ONE, 3, 1)
FIRST, SECOND = keyframe_id(SUBMAP, 0), keyframe_id(LATER, 1)
CAMERA = RectifiedCamera(640, 480, 400.0, 400.0, 320.0, 240.0, 0.1, True, np.eye(4))
STEP = [np.zeros((1, 3))] * 4
NOTHING = np.zeros(0)
RECORDS: list[Record] = [
    CameraIntrinsics(ONE, CAMERA),
    StereoAlignment(ONE, np.zeros(5), False, np.full(5, 0.3), 0.1),
    LivePose(ONE, 10**9, FIRST, np.eye(4), 80),
    KeyframeHeader(FIRST, 10**9, NO_KEYFRAME, np.eye(4), 5),
    Observations(FIRST, 0, NOTHING.astype(np.uint16), np.zeros((0, 2), np.float32), NOTHING.astype(np.float32),
                 NOTHING.astype(np.uint8), NOTHING.astype(np.int64)),
    GravityAlignment(SUBMAP, np.eye(4)),
    SubmapScale(SUBMAP, 1.0),
    SubmapTie(LATER, FIRST, np.eye(4), 0.1, 0.01),
    InertialSteps(SECOND, FIRST, 2e-3, np.full(1, 0.2), *STEP),
]  # fmt: skip


def new_intake() -> Intake:
    return Intake(BaseConfig().intake, SparseMap())


def holds_nothing(intake: Intake) -> bool:
    held = (intake.live, intake.last_pose, intake.tracked_ns, intake.gravity, intake.loss_ties)
    known = intake._map
    tables = (
        known.rows,
        known.cameras,
        known.rows_px,
        known.disparity_offset_px,
        known.inertial_steps,
        known.metres_per_unit,
        intake._pending,
    )
    return not any(held) and not any(tables)


@pytest.mark.parametrize("record", RECORDS, ids=lambda r: type(r).__name__)
def test_a_record_of_another_agent_is_refused(record: Record) -> None:
    intake = new_intake()
    intake.take(OTHER, (record,), 0)
    assert intake.refused == 1
    assert holds_nothing(intake)
    intake.take(ONE, (record,), 0)
    assert intake.refused == 1
    assert not holds_nothing(intake)


def test_what_a_record_names_beside_its_own_submap_is_checked_too() -> None:
    foreign = keyframe_id(submap_id(OTHER, 3, 0), 0)
    intake = new_intake()
    wrong = (
        LivePose(ONE, 10**9, foreign, np.eye(4), 80),
        SubmapTie(LATER, foreign, np.eye(4), 0.1, 0.01),
        replace(KeyframeHeader(SECOND, 10**9, NO_KEYFRAME, np.eye(4), 5), parent=foreign),
    )
    intake.take(ONE, wrong, 0)
    assert intake.refused == len(wrong)
    assert holds_nothing(intake)


def test_every_kind_of_an_agent_names_its_owner() -> None:
    """A new kind is checked by its key, whatever it holds."""
    kinds = {t for t in RECORD_TYPES.values() if t.written_by_agent()}
    assert {type(r) for r in RECORDS} <= kinds
    assert all(t.ID.name in ("AGENT", "SUBMAP", "KEYFRAME", "PASSING_KEYFRAME") for t in kinds)


def test_every_record_of_agents_has_a_handler() -> None:
    written = {kind for kind in RECORD_TYPES.values() if kind.__module__.startswith("kiteline_codec.schema.agent.")}
    assert len(written) > 5
    assert new_intake()._handlers.keys() == written


def test_what_waits_for_keyframes_that_never_come_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """An agent may name new ones in each version of its observations, and a new submap in each live pose."""
    monkeypatch.setattr(sparse_map_module, "_MOST_WAITED_FOR", 500)
    sparse_map = SparseMap()
    intake = Intake(IntakeConfig(max_pending=100), sparse_map)
    own = submap_id(1, 0, 0)
    keyframe = keyframe_id(own, 9)
    intake.take(AgentId(1), (KeyframeHeader(keyframe, 1, NO_KEYFRAME, np.eye(4), 50),), 0)
    index = np.arange(50, dtype=np.uint16)
    floats, bytes_ = np.ones(50, np.float32), np.zeros(50, np.uint8)
    for version in range(40):
        names = np.array([point_id(keyframe_id(own, 100 + 50 * version + i), 0) for i in range(50)], np.int64)
        uv = np.ones((50, 2), np.float32)
        intake.take(AgentId(1), (Observations(keyframe, 0, index, uv, floats, bytes_, names),), 0)
        intake.take(AgentId(1), (Observations(keyframe, 0, index, uv, floats, bytes_, names),), 0)
    assert sum(map(len, sparse_map._waiting.values())) <= 500
    for number in range(300):
        pose = LivePose(AgentId(1), number, keyframe_id(submap_id(1, 1 + number, 0), 0), np.eye(4), 90)
        intake.take(AgentId(1), (pose,), 0)
    assert len(intake.last_pose) <= 100 and intake.refused == 200
