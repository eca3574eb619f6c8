"""Maps that are deleted or forgotten leave their memory to the next ones, and nothing else."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.intake.intake import Intake
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import JobDone
from kiteline_basestation.management import Command
from kiteline_basestation.map.sparse_map import SparseMap
from kiteline_basestation.mapper import Mapper, MapperInput
from kiteline_basestation.station import Station
from kiteline_basestation.store.integrity import contradictions
from kiteline_codec.channel import CodedChannel, coded_channel
from kiteline_codec.schema import KEYFRAME_KINDS, CameraIntrinsics, CulledLandmarks, SubmapPlacement
from kiteline_codec.sync.resumption import agent_session
from kiteline_core.ids import AgentId, submap_of_keyframe
from tests.basestation.feeding import STEP_NS, WITHOUT_GRID, feed
from tests.entries import entries_of

MakeFlight = Callable[..., Any]


def test_deleted_maps_leave_their_memory_to_the_next_ones(make_flight: MakeFlight, words: Any) -> None:
    stays = make_flight(keyframes=12, agent=1, seed=5)
    mapper, alone = Mapper(WITHOUT_GRID, words), Mapper(WITHOUT_GRID, words)
    feed(alone, [stays])
    feed(mapper, [stays])
    sizes = []
    for number in range(4):
        flight = make_flight(keyframes=12, submap=number, seed=20 + number)
        feed(mapper, [flight])
        sizes.append((mapper.map.height, mapper.map.slots, mapper.map.nbytes()))
        command = Command(number, "delete", f'{{"map": "0.1.{number}"}}')
        for n in range(2):
            output = mapper.step(MapperInput((), (), (command,) if n == 0 else ()), (10**6 + number * 10 + n) * STEP_NS)
            assert all(answer.ok for answer in output.answers)
        assert contradictions(mapper) == []
        assert len(mapper.map) == 12 and mapper.idle
    assert {height for height, _, _ in sizes} == {24}
    assert max(slots for _, slots, _ in sizes) < 1.05 * sizes[0][1]  # flights are not all of one size
    for keyframe in stays.keyframes:
        assert np.array_equal(mapper.map.pose(keyframe), alone.map.pose(keyframe))
    assert mapper.map.count_live() == alone.map.count_live() == len(mapper.map.live_landmarks())


def test_an_agent_has_no_place_in_a_map_that_is_deleted(make_flight: MakeFlight, words: Any) -> None:
    """It was out of reach, and went on in the map by its placement until its next start."""
    flight, stays = make_flight(keyframes=10), make_flight(keyframes=10, agent=1, seed=5)
    ends = {f.agent: coded_channel(agent_session(1, 1), 0, "wifi") for f in (flight, stays)}
    station = Station(WITHOUT_GRID, lambda agent: coded_channel(1, 0, "wifi", peer=agent), words)
    down: dict[AgentId, tuple[bytes, ...]] = {}
    done: tuple[JobDone, ...] = ()
    placed: set[int] = set()
    for n in range(90):
        packets = {}
        for f in (flight, stays):
            if n == 0:
                ends[f.agent].put(CameraIntrinsics(f.agent, f.camera))
            records = ends[f.agent].receive(down.get(f.agent, ()), n * STEP_NS)
            placed |= {r.submap for r in records if isinstance(r, SubmapPlacement)}
            placed -= {key.id for key in ends[f.agent].take_removed() if key.kind == SubmapPlacement.KIND}
            for record in f.records[n] if n < len(f.records) else ():
                ends[f.agent].put(record)
            packets[f.agent] = ends[f.agent].poll(n * STEP_NS)
        orders = [Command(1, "delete", '{"map": "0.1.0"}')] if n == 60 else []
        if orders:
            assert placed == {submap_of_keyframe(flight.keyframes[0])}
        output = station.step(packets, done, n * STEP_NS, orders)
        assert all(answer.ok for answer in output.answers)
        done, down = tuple(run_job(job) for job in output.jobs), dict(output.packets)
    assert placed == set()
    channel = station.channels[flight.agent]
    assert isinstance(channel, CodedChannel)
    assert not any(key.kind == SubmapPlacement.KIND for key in channel.own_values())


def test_flights_that_come_and_are_deleted_leave_nothing_behind(
    make_flight: MakeFlight, words: Any, lively_room: Any
) -> None:  # fmt: skip
    station = Station(BaseConfig(), lambda agent: coded_channel(1, 0, "wifi", peer=agent), words)
    done: tuple[JobDone, ...] = ()
    counts = []
    now_ns = 0
    for boot in range(1, 6):
        looks = np.random.default_rng(boot).integers(0, 256, lively_room.descriptors.shape, np.uint8)
        scene = replace(lively_room, descriptors=looks)
        flight = make_flight(keyframes=10, boot=boot, submap=boot, turns=0.2, scene=scene)
        end, down = coded_channel(agent_session(boot, boot), 0, "wifi"), list[bytes]()
        end.put(CameraIntrinsics(flight.agent, flight.camera))
        for n in range(70):
            end.receive(down, now_ns)
            for record in flight.records[n] if n < len(flight.records) else ():
                end.put(record)
            delete = Command(n, "delete", f'{{"map": "0.{boot - 1}.{boot - 1}"}}')
            orders = [delete] if n == 40 and boot > 1 else []
            output = station.step({flight.agent: end.poll(now_ns)}, done, now_ns, orders)
            assert all(answer.ok for answer in output.answers)
            done = tuple(run_job(job) for job in output.jobs)
            down = list(dict(output.packets).get(flight.agent, ()))
            now_ns += STEP_NS
        counts.append(entries_of(station))
    before, after = counts[2], counts[4]  # one flight in two is placed: it comes when there is no other map
    grown = {name: after[name] - before[name] for name in after if after[name] > before[name]}
    assert {name for name in grown if not name.endswith(_MAY_GROW)} == set()


def test_what_was_written_of_a_deleted_map_is_removed_once_the_agent_has_it(
    make_flight: MakeFlight, words: Any, lively_room: Any
) -> None:  # fmt: skip
    station = Station(BaseConfig(), lambda agent: coded_channel(1, 0, "wifi", peer=agent), words)
    flight = make_flight(keyframes=8, boot=1, submap=1, turns=0.2, scene=lively_room)
    end, down, done = coded_channel(agent_session(1, 1), 0, "wifi"), list[bytes](), tuple[JobDone, ...]()
    end.put(CameraIntrinsics(flight.agent, flight.camera))
    held, culled = list[int](), False
    channel = station.join(flight.agent)
    assert isinstance(channel, CodedChannel)
    for n in range(60):
        records = end.receive(down if n < 30 or n >= 40 else [], n * STEP_NS)  # the link is down for a while
        culled |= any(isinstance(r, CulledLandmarks) and r.keyframe_too for r in records)
        for record in flight.records[n] if n < len(flight.records) else ():
            end.put(record)
        orders = [Command(n, "delete", '{"map": "0.1.1"}')] if n == 30 else []
        up = end.poll(n * STEP_NS) if n < 30 or n >= 40 else []
        output = station.step({flight.agent: up}, done, n * STEP_NS, orders)
        done = tuple(run_job(job) for job in output.jobs)
        down = list(dict(output.packets).get(flight.agent, ()))
        held.append(sum(key.kind in KEYFRAME_KINDS for key in channel.endpoint.own_values()))
    assert held[29] > 10 and min(held[30:40]) >= held[29]  # the agent does not know yet
    assert culled and held[-1] == 0
    assert not any(key.kind in KEYFRAME_KINDS for key in end.endpoint.peer_values())
    assert channel.endpoint.stats.mismatches == end.endpoint.stats.mismatches == 0


# Ids of what was deleted, which are ignored for ever, and times, of which the newest are kept.
_MAY_GROW = (".deleted", ".grid_ns")


def test_nothing_is_left_of_a_forgotten_submap_whose_keyframes_did_not_all_come(make_flight: MakeFlight) -> None:
    flight, sparse_map = make_flight(keyframes=12), SparseMap()
    intake = Intake(BaseConfig().intake, sparse_map)
    never = flight.keyframes[5]
    for records in flight.records:
        intake.take(flight.agent, tuple(r for r in records if getattr(r, "keyframe", None) != never), 0)
    sparse_map.up[never] = np.array([0.0, -1.0, 0.0]), 0.01
    assert sparse_map._waiting and sparse_map.children_of(never)
    sparse_map.forget([submap_of_keyframe(never)])
    assert len(sparse_map) == 0
    assert not (sparse_map._waiting or sparse_map.up or any(sparse_map._children.values()))
