"""A submap whose ids of keyframes are used up is continued in another one: neither tracker nor base lose anything."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from kiteline_agent.keyframes import reference
from kiteline_agent.mapping.submaps import Submaps
from kiteline_bench.harness.recording import Item, Recording
from kiteline_bench.harness.run import RecordingRun, fly_recording
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.ids import MAX_KEYFRAMES
from tests.agent.room_flight import RoomFlight
from tests.basestation.feeding import WITHOUT_GRID

SECONDS = 3.0
FULL_AT = 2


def fly(flight: RoomFlight) -> RecordingRun:
    """Fly the first seconds with a base, without an IMU."""
    short = flight.first(SECONDS)
    items = [Item(frame, T_w_b=T_w_b) for frame, T_w_b in zip(short.frames, short.truth, strict=True)]
    return fly_recording(Recording(short.rig, None, tuple(items)), base=WITHOUT_GRID)


def test_a_full_submap_is_continued_and_the_base_merges_the_two(
    room_flight: RoomFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reference, "FULL_AT", FULL_AT)
    run = fly(room_flight)
    found, sparse_map = run.agent.found, run.station.mapper.map
    assert run.agent.lost == 0 and len(found) == len(run.agent.estimates)
    submaps = list(dict.fromkeys(e.submap for e in found))
    assert len(submaps) >= 3
    assert max(k & MAX_KEYFRAMES - 1 for k in sparse_map.rows) <= FULL_AT + 2  # one is returned to
    true = np.array(run.agent.truth)
    assert largest_error_m([e.T_o_b for e in found], true) < 0.02
    assert all(e.T_w_b is not None for e in found[3:]), "live poses go on in the world"
    assert [sparse_map.map_id(s) for s in sorted(sparse_map.submaps)] == [submaps[0]] * len(submaps)
    stamps, T_c_b = sparse_map.keyframes.t_ns, se3.inverse(run.box.map.camera.T_b_c)
    held = sorted(k for k in sparse_map.rows if sparse_map.world_pose(k) is not None)
    frames = [run.agent.t_ns.index(int(stamps[sparse_map.rows[k]])) for k in held]
    assert len(held) == len(sparse_map.rows) - run.station.mapper.counts.keyframes_culled
    assert largest_error_m([sparse_map.world_pose(k) @ T_c_b for k in held], true[frames]) < 0.02


def largest_error_m(found: Sequence[Any], true: F64) -> float:
    """The largest error of positions of the body, with the first poses as one."""
    T_true_found = true[0] @ se3.inverse(found[0])
    return max(float(np.linalg.norm((T_true_found @ T - T_w_b)[:3, 3])) for T, T_w_b in zip(found, true, strict=True))


def test_without_ids_of_submaps_the_last_one_goes_on(room_flight: RoomFlight, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reference, "FULL_AT", FULL_AT)
    monkeypatch.setattr(Submaps, "room", False)
    run = fly(room_flight)
    assert run.agent.lost == 0 and len({e.submap for e in run.agent.found}) == 1
