"""The base's batches of corrections: one after another, sized by the link, nothing lost, nothing overtaken."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kiteline_agent.exchange.correction_batches import ReceivedBatches as Holder
from kiteline_basestation.config import BaseConfig, PublishConfig
from kiteline_basestation.exchange.correction_batches import MEMBERS, CorrectionBatches
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import JobDone
from kiteline_basestation.station import Station
from kiteline_codec.channel import CodedChannel, PlainChannel, coded_channel
from kiteline_codec.schema import (
    CameraIntrinsics,
    CorrectionBatch,
    CulledLandmarks,
    Key,
    KeyframePose,
    Record,
    RefinedLandmarks,
    messages,
)
from kiteline_codec.sync.config import SyncConfig
from kiteline_codec.sync.resumption import agent_session
from kiteline_core.ids import AgentId, KeyframeId
from kiteline_hw.sim.links.link_model import LinkModel, LinkModelConfig
from tests.basestation.feeding import WITHOUT_GRID, keyframes_in

AGENT = AgentId(0)
SECOND_NS = 1_000_000_000
STEP_NS = 100_000_000


class Link(PlainChannel):
    """A channel of which the test says what has arrived."""

    def __init__(self) -> None:
        super().__init__()
        self.missing: set[Key] = set()
        self.rate: int | None = None
        self.asked = 0

    def arrived(self, key: Key) -> bool:
        self.asked += 1
        return key not in self.missing

    def rate_bytes_s(self) -> int | None:
        return self.rate


def pose(keyframe: int) -> KeyframePose:
    return KeyframePose(KeyframeId(keyframe), np.eye(4))


def numbers(records: list[Record]) -> list[int]:
    out = [r.batch for r in records if isinstance(r, MEMBERS)]
    return out + [r.number for r in records if isinstance(r, CorrectionBatch)]


def test_the_next_batch_waits_until_the_last_value_of_this_one_has_arrived() -> None:
    link, batches = Link(), CorrectionBatches(AGENT, PublishConfig())
    first = batches.numbered([pose(1), pose(2)], 0)
    assert numbers(first) == [1, 1, 1]
    link.missing = {messages.key(first[1])}
    assert batches.room_bytes(link, SECOND_NS) == 0
    link.missing = {messages.key(first[2])}  # the record of the batch itself
    assert batches.room_bytes(link, SECOND_NS) == 0
    link.missing.clear()
    assert batches.room_bytes(link, SECOND_NS) is None
    assert numbers(batches.numbered([pose(2)], SECOND_NS)) == [2, 2]


def test_the_next_batch_is_not_made_at_once_on_a_fast_link() -> None:
    link, batches = Link(), CorrectionBatches(AGENT, PublishConfig())
    assert batches.room_bytes(link, SECOND_NS, 0.5) is None
    batches.numbered([pose(1)], SECOND_NS)
    assert batches.room_bytes(link, SECOND_NS + SECOND_NS // 2 - 1, 0.5) == 0
    assert batches.room_bytes(link, SECOND_NS + SECOND_NS // 2, 0.5) is None
    assert batches.room_bytes(link, SECOND_NS, 0.0) is None


@pytest.mark.parametrize("late", [0, 250, 499])
def test_a_step_looks_for_one_missing_value_of_a_batch_not_for_all(late: int) -> None:
    """Of a large map, a batch holds hundreds of values, and steps are many while it is on its way."""
    link, batches = Link(), CorrectionBatches(AGENT, PublishConfig())
    records = batches.numbered([pose(k) for k in range(500)], 0)
    link.missing = {messages.key(records[late])}
    for _ in range(100):
        assert batches.room_bytes(link, SECOND_NS) == 0
    assert link.asked < 1000
    link.missing = {messages.key(records[7])}
    assert batches.room_bytes(link, SECOND_NS) == 0
    link.missing.clear()
    assert batches.room_bytes(link, SECOND_NS) is None


def test_what_moves_nothing_has_no_number() -> None:
    batches = CorrectionBatches(AGENT, PublishConfig())
    culled = CulledLandmarks(KeyframeId(1), np.zeros(0, np.uint16), 0)
    assert batches.numbered([culled], 0) == [culled]
    assert len(batches.numbered([culled, pose(1)], 0)) == 3


def test_an_agent_that_does_not_listen_is_not_waited_for() -> None:
    config = PublishConfig()
    link, batches = Link(), CorrectionBatches(AGENT, config)
    first = batches.numbered([pose(1)], 0)
    link.missing = {messages.key(record) for record in first}
    late_ns = round(config.batch_wait_s * 1e9)
    assert batches.room_bytes(link, late_ns - 1) == 0
    assert batches.room_bytes(link, late_ns) is None
    joined = batches.numbered([pose(2)], late_ns)
    assert numbers(joined) == [1, 1]
    assert joined[-1] == CorrectionBatch.of(AGENT, 1, [])  # whoever comes back waits for none of them
    link.missing.clear()
    assert batches.room_bytes(link, late_ns + 1) is None
    assert numbers(batches.numbered([pose(3)], late_ns + 1)) == [2, 2]


def test_a_withdrawn_value_is_not_waited_for_by_the_agent() -> None:
    batches = CorrectionBatches(AGENT, PublishConfig())
    first = batches.numbered([pose(1), pose(2)], 0)
    assert batches.without(Key(KeyframePose.KIND, 9)) is None
    assert batches.without(messages.key(first[0])) == CorrectionBatch.of(AGENT, 1, [])


def test_an_agent_that_starts_anew_waits_for_nothing_of_its_earlier_starts(
    make_flight: Callable[..., Any], words: Any
) -> None:
    """The base keeps that to itself, but counted it: no batch that moved old keyframes, too, was ever whole."""
    flights = [
        make_flight(keyframes=14, turns=0.4, boot=1),
        make_flight(keyframes=14, turns=0.4, start=0.1, variant=1, boot=2),
    ]
    station = Station(WITHOUT_GRID, lambda agent: coded_channel(1, peer=agent), words)
    done: tuple[JobDone, ...] = ()
    now_ns, applied = 0, set[KeyframeId]()
    for boot, flight in enumerate(flights, 1):
        agent, holder, down = coded_channel(agent_session(boot, boot)), Holder(), ()
        agent.put(CameraIntrinsics(AGENT, flight.camera))
        for n in range(len(flight.records) + 40):
            now_ns += STEP_NS
            records = holder.take(agent.receive(down, now_ns), agent.take_removed())
            applied |= {record.keyframe for record in records if isinstance(record, KeyframePose)}
            for record in flight.records[n] if n < len(flight.records) else ():
                agent.put(record)
            output = station.step({AGENT: agent.poll(now_ns)}, done, now_ns)
            done, down = tuple(run_job(job) for job in output.jobs), dict(output.packets)[AGENT]
    assert station.mapper.summary()["merges"] == 1
    assert len(holder) == 0 and set(flights[1].keyframes[1:]) <= applied


def test_a_batch_is_let_go_whose_values_are_sent_no_more_to_a_new_start() -> None:
    batches = CorrectionBatches(AGENT, PublishConfig())
    assert batches.follow_session(5) is None
    batches.numbered([pose(1), pose(2)], 0)
    batches.shares = lambda key: key.id != 1
    assert batches.follow_session(5) is None
    assert batches.follow_session(6) == CorrectionBatch.of(AGENT, 1, [])
    assert batches.follow_session(7) is None
    assert numbers(batches.numbered([pose(1), pose(2)], 0)) == [0, 2, 2]


def test_numbers_go_on_after_a_restart() -> None:
    before, after, link = CorrectionBatches(AGENT, PublishConfig()), CorrectionBatches(AGENT, PublishConfig()), Link()
    before.numbered([pose(1)], 0)
    records = before.numbered([pose(1), pose(2)], 0)
    for record in [replace_batch(pose(7), 1), *records]:
        after.restore(record)
    link.missing = {messages.key(records[0])}
    assert after.room_bytes(link, 1) == 0  # the restored batch has to arrive first
    link.missing = {messages.key(pose(7))}  # of an older one
    assert after.room_bytes(link, 1) is None
    assert numbers(after.numbered([pose(3)], 0)) == [3, 3]


def test_a_batch_over_several_steps_is_whole_with_its_last_ones() -> None:
    link, batches, holder = Link(), CorrectionBatches(AGENT, PublishConfig()), Holder()
    first = batches.numbered([pose(1), pose(2)], 0, unfinished=True)
    assert numbers(first) == [1, 1] and batches.is_open and not holder.take(first, [])
    link.missing = {messages.key(first[0])}
    assert batches.room_bytes(link, STEP_NS) == 0
    second = batches.numbered([pose(3), pose(1)], STEP_NS, unfinished=True)
    assert numbers(second) == [1, 1] and not holder.take(second, [])
    assert batches.numbered([], STEP_NS, unfinished=True) == []
    last = batches.numbered([], STEP_NS)  # what was left turned out to be void
    assert numbers(last) == [1] and not batches.is_open
    assert keyframes_in(holder.take(last, [])) == [1, 2, 3]
    link.missing.clear()
    assert batches.room_bytes(link, STEP_NS) is None
    assert numbers(batches.numbered([pose(4)], STEP_NS)) == [2, 2]


def test_a_batch_that_a_restart_cut_off_is_not_waited_for() -> None:
    before, after, holder = (
        CorrectionBatches(AGENT, PublishConfig()),
        CorrectionBatches(AGENT, PublishConfig()),
        Holder(),
    )
    whole, part = before.numbered([pose(1)], 0), before.numbered([pose(1), pose(2)], 0, unfinished=True)
    holder.take([*whole, *part], [])
    for record in [*whole, *part]:
        after.restore(record)
    released = after.release()
    assert released == CorrectionBatch.of(AGENT, 2, []) and after.release() is None
    assert len(holder.take([released], [])) == 2
    for record in before.numbered([], 0):
        after.restore(record)
    assert after.release() is None


def test_values_that_a_crash_left_out_of_the_store_hold_up_no_batch() -> None:
    before, after, holder = (
        CorrectionBatches(AGENT, PublishConfig()),
        CorrectionBatches(AGENT, PublishConfig()),
        Holder(),
    )
    saved = before.numbered([pose(1)], 0)
    holder.take(saved, [])
    assert not holder.take(before.numbered([pose(2), pose(3)], 0, unfinished=True), [])  # not in the store
    for record in saved:
        after.restore(record)
    assert after.release() is None
    assert keyframes_in(holder.take(after.numbered([pose(3), pose(4)], 0), [])) == [2, 3, 4]
    assert len(holder) == 0


def replace_batch(record: KeyframePose, batch: int) -> KeyframePose:
    return KeyframePose(record.keyframe, record.T_m_k, batch)


def test_a_thin_link_gets_batches_of_its_size() -> None:
    link, batches = Link(), CorrectionBatches(AGENT, PublishConfig())
    link.rate = 500
    assert batches.room_bytes(link, 0) == round(500 * PublishConfig().batch_s)


@pytest.mark.parametrize(("budget_bytes", "loss"), [(None, 0.0), (None, 0.3), (800, 0.0), (800, 0.2)])
def test_every_batch_is_applied_as_it_was_made(
    make_flight: Callable[..., Any], budget_bytes: int | None, loss: float
) -> None:
    """Over any link: the agent applies the batches that the base made, whole and one after another, and ends equal."""
    flight = make_flight(keyframes=12, turns=0.4)
    config = SyncConfig(packet_bytes=220, overhead_bytes=7, budget_bytes=budget_bytes)
    base_end, agent_end = CodedChannel(config, 1), CodedChannel(SyncConfig(), 1)
    station, holder = Station(BaseConfig(), lambda agent: base_end), Holder()
    up, down = (LinkModel(LinkModelConfig(loss=loss, delay_ns=30_000_000, duplicate=loss / 2), seed) for seed in (1, 2))
    made: dict[int, dict[Key, bytes]] = {}
    held: dict[Key, bytes] = {}
    order: list[int] = []
    put = base_end.put

    def noted(record: Record) -> Record:
        if isinstance(record, MEMBERS):
            made.setdefault(record.batch, {})[messages.key(record)] = messages.encode(record)
        return put(record)

    base_end.put = noted  # type: ignore[method-assign]
    agent_end.put(CameraIntrinsics(flight.agent, flight.camera))
    done: list[Any] = []
    for n in range(len(flight.records) + 600):
        now_ns = n * STEP_NS
        heard = agent_end.receive(down.deliver(now_ns), now_ns)
        ready = [r for r in holder.take(heard, agent_end.take_removed()) if isinstance(r, MEMBERS)]
        for number in sorted({r.batch for r in ready} - {0}):
            part = {messages.key(r): messages.encode(r) for r in ready if r.batch == number}
            assert part == made[number]
            order.append(number)
        held.update((messages.key(r), messages.encode(r)) for r in ready)
        for record in flight.records[n] if n < len(flight.records) else ():
            agent_end.put(record)
        for packet in agent_end.poll(now_ns):
            up.send(packet, now_ns)
        output = station.step({flight.agent: up.deliver(now_ns)}, done, now_ns)
        done = [run_job(job) for job in output.jobs]
        for packet in dict(output.packets).get(flight.agent, ()):
            down.send(packet, now_ns)
        if n > len(flight.records) and station.mapper.idle and base_end.endpoint.digest_equal and not len(holder):
            break
    assert station.mapper.idle
    assert base_end.endpoint.digest_equal
    assert not len(holder)
    assert order == list(range(1, len(made) + 1))
    newest = {key: code for number in sorted(made) for key, code in made[number].items()}
    assert held == newest
    assert sum(key.kind == KeyframePose.KIND for key in held) == 11
    assert any(key.kind == RefinedLandmarks.KIND for key in held)


def test_values_of_two_bundles_are_not_applied_in_one_batch(make_flight: Callable[..., Any]) -> None:
    """A large batch is sent over several steps of a thin link, and a bundle moves the map again meanwhile."""
    flight = make_flight(keyframes=12, turns=0.4)
    base_end, agent_end = (
        CodedChannel(SyncConfig(packet_bytes=220, budget_bytes=1500), 1),
        CodedChannel(SyncConfig(), 1),
    )
    config = replace(WITHOUT_GRID, publish=replace(PublishConfig(), step_values=4))
    station, holder = Station(config, lambda agent: base_end), Holder()
    moved = flight.keyframes[1:]  # the first one has no pose but its submap's
    agent_end.put(CameraIntrinsics(flight.agent, flight.camera))
    x_m: dict[KeyframeId, float] = {}  # at the agent
    before_m, first = dict[KeyframeId, float](), 0
    shifts: list[set[float]] = []  # of the agent's keyframes against `before_m`, as they change
    done: list[Any] = []
    for n in range(600):
        now_ns = n * STEP_NS
        for record in flight.records[n] if n < len(flight.records) else ():
            agent_end.put(record)
        output = station.step({flight.agent: agent_end.poll(now_ns)}, done, now_ns)
        done = [run_job(job) for job in output.jobs]
        heard = agent_end.receive(dict(output.packets).get(flight.agent, ()), now_ns)
        ready = [r for r in holder.take(heard, ()) if isinstance(r, KeyframePose)]
        x_m.update((r.keyframe, float(r.T_m_k[0, 3])) for r in ready)
        settled = station.mapper.idle and base_end.endpoint.digest_equal and not len(holder)
        if not before_m and not (settled and n > len(flight.records)):
            continue
        if before_m and ready:
            shifts.append({round(x_m[k] - before_m[k]) for k in moved})
        if shifts and settled:
            break
        if not before_m:
            before_m, first = dict(x_m), n
        if n in (first, first + 2):  # two bundles, the second one while the batch of the first is being sent
            for keyframe in moved:
                T_m_k = station.mapper.map.pose(keyframe).copy()
                T_m_k[0, 3] += 1.0
                station.mapper.map.set_pose(keyframe, T_m_k)
                station.mapper._publisher.mark_changed(KeyframePose.KIND, keyframe)
    assert shifts == [{1}, {2}]
    for keyframe in moved:
        assert station.mapper.map.pose(keyframe)[0, 3] == x_m[keyframe]
