"""The status page's snapshot of a station that has flown."""

import json
import socket
import urllib.request
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.grid.placed_map import placed_map
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import JobDone
from kiteline_basestation.management import Command
from kiteline_basestation.station import Station
from kiteline_basestation.web import snapshot
from kiteline_basestation.web.messages import status
from kiteline_basestation.web.snapshot import empty_snapshot, take_snapshot
from kiteline_basestation.web.status_page import StatusPage, open_page
from kiteline_codec.channel import CodedChannel
from kiteline_codec.sync.config import SyncConfig
from kiteline_core.geometry import se3
from kiteline_core.ids import AgentId
from kiteline_hw.ports import LinkError

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


def station_with(*flights: Any) -> Station:
    """A station that has received all records of one agent's flights."""
    agent = CodedChannel(SyncConfig(), 1)
    station = Station(BaseConfig(), lambda _: CodedChannel(SyncConfig(), 1))
    for flight in flights:
        for record in flight.all_records():
            agent.put(record)
    for tick in range(40):
        now_ns = (tick + 1) * S // 10
        for _, packets in station.step({AgentId(0): agent.poll(now_ns)}, (), now_ns).packets:
            agent.receive(packets, now_ns)
    return station


def test_no_line_leads_from_one_submap_to_the_next(make_flight: Callable[..., Any]) -> None:
    station = station_with(make_flight(keyframes=4, turns=0.1), make_flight(keyframes=3, turns=0.1, boot=2, seed=3))
    mapper = station.mapper
    mapper.placements.update({submap: np.eye(4) for submap in mapper.map.submaps})
    path = take_snapshot(station, 5 * S, 0).agents[0].path
    assert np.flatnonzero(np.isnan(path).all(axis=1)).tolist() == [4] and path.shape == (8, 3)


@pytest.mark.parametrize("stereo", [True, False])
def test_a_map_without_a_scale_says_so(make_flight: Callable[..., Any], stereo: bool) -> None:
    now = take_snapshot(station_with(make_flight(keyframes=4, turns=0.1, stereo=stereo)), 5 * S, 0)
    assert now.own_unit == now.agents[0].own_unit == (not stereo)


def test_the_page_tells_what_is_wrong_with_the_base() -> None:
    station = Station(BaseConfig(), lambda _: CodedChannel(SyncConfig(), 1))
    page = StatusPage("127.0.0.1:0", 0)
    try:
        page.update(station, S, lambda: ["store maps: not written: the disk is full"])
        with urllib.request.urlopen(f"{page.url}status.json", timeout=5) as answer:
            assert json.load(answer)["troubles"] == ["store maps: not written: the disk is full"]
    finally:
        page.close()


def test_a_port_that_is_taken_is_told_with_the_mend() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        where = f"127.0.0.1:{other.getsockname()[1]}"
        with pytest.raises(LinkError, match=f"--web {where}: cannot listen there .*another program's.*Choose another"):
            open_page(where, 0)


def test_points_are_taken_again_when_maps_move_or_go(make_flight: Callable[..., Any]) -> None:
    """The page showed the landmarks of a deleted map, and those of a merged one at its old place."""
    station = station_with(make_flight(keyframes=30, turns=0.5))
    mapper = station.mapper
    (submap,) = mapper.map.submaps
    now = take_snapshot(station, 5 * S, 0)
    assert take_snapshot(station, 6 * S, 0, now).points is now.points
    mapper.placements[submap] = se3.from_rt(np.eye(3), np.array([100.0, 0.0, 0.0])) @ mapper.placements[submap]
    moved = take_snapshot(station, 6 * S, 0, now)
    np.testing.assert_allclose(moved.points[:, 0], now.points[:, 0] + 100.0)
    assert (moved.map_revision, moved.layout) != (now.map_revision, now.layout)
    station.step({}, (), 7 * S, [Command(1, "delete", '{"map": "0.1.0"}')])
    gone = take_snapshot(station, 7 * S, 0, moved)
    assert len(gone.points) == 0 and (gone.map_revision, gone.layout) != (moved.map_revision, moved.layout)
