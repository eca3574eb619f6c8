"""The status page's snapshot of a station that has flown."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.grid.placed_map import placed_map
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import JobDone
from kiteline_basestation.station import Station
from kiteline_basestation.web import snapshot
from kiteline_basestation.web.messages import status
from kiteline_basestation.web.snapshot import empty_snapshot, take_snapshot
from kiteline_codec.channel import CodedChannel
from kiteline_codec.sync.config import SyncConfig
from kiteline_core.ids import AgentId

S = 1_000_000_000


def test_a_fresh_base_has_nothing_to_show() -> None:
    shown = status(empty_snapshot(5 * S))
    assert (shown["agents"], shown["up_s"]) == ([], 0.0)
    assert [n["value"] for n in shown["totals"]] == [0] * len(shown["totals"])
    station = Station(BaseConfig(), lambda _: CodedChannel(SyncConfig(), 1))
    assert status(take_snapshot(station, 5 * S, 5 * S)) == shown


def test_overview_follows_a_flight(make_flight: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> None:
    flight = make_flight(keyframes=6, points=300)
    agent = CodedChannel(SyncConfig(), 1)
    station = Station(BaseConfig(), lambda _: CodedChannel(SyncConfig(), 1))
    for record in flight.all_records():
        agent.put(record)
    done: tuple[JobDone, ...] = ()
    for tick in range(40):
        now_ns = (tick + 1) * S // 10
        out = station.step({AgentId(0): agent.poll(now_ns)}, done, now_ns)
        done = tuple(run_job(job) for job in out.jobs)
        for _, packets in out.packets:
            agent.receive(packets, now_ns)
    station.mapper.jobs_failed = 2
    now = take_snapshot(station, 4 * S, 0)
    shown = status(now)
    (only,) = shown["agents"]
    counts = {n["label"]: n["value"] for n in only["counts"]}
    totals = {n["label"]: n["value"] for n in shown["totals"]}
    assert only["agent"] == 0 and counts["Keyframes"] == 6 and counts["Submaps"] == 1
    assert only["bytes_up"] > 10_000 and only["bytes_down"] > 0
    assert totals["Landmarks"] == counts["Landmarks"] > 100 and totals["Failed jobs"] == 2
    assert now.agents[0].path.shape == (6, 3)
    mapper = station.mapper
    everything = placed_map(mapper.map, mapper.placements)
    np.testing.assert_array_equal(now.points, everything.points)
    np.testing.assert_array_equal(now.labels, mapper.labels(mapper.map.find_landmarks(everything.landmark_ids)))
    monkeypatch.setattr(snapshot, "LOOKED_AT", 300)  # as of a map of 20,000 keyframes, which has 7,000,000 keypoints
    looked: list[int] = []
    for name in ("is_live", "positions", "observations"):
        whole = getattr(mapper.map, name)
        monkeypatch.setattr(mapper.map, name, lambda s, whole=whole: (looked.append(len(s)), whole(s))[1])
    monkeypatch.setattr(mapper.map, "live_landmarks", None)
    some = take_snapshot(station, 4 * S, 0).points
    assert 5 < len(some) < max(looked) <= 300
    assert {*map(tuple, some.tolist())} <= {*map(tuple, everything.points.tolist())}
    radius = np.linalg.norm(now.agents[0].path - now.agents[0].path.mean(axis=0), axis=1)
    np.testing.assert_allclose(radius, 1.2, atol=0.1)
