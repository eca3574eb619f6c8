"""Fly scenarios in this process: an agent alone, or agents that come and go with a base over a link."""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.step import Identity, StepInput
from kiteline_basestation.config import BaseConfig
from kiteline_basestation.runtime.worker import LockstepJobs
from kiteline_basestation.station import Station
from kiteline_bench.harness.recording import Item, Recording, items_of
from kiteline_bench.harness.result import AgentRun
from kiteline_codec.channel import RecordChannel, coded_channel
from kiteline_codec.sync.resumption import agent_session
from kiteline_core.frame import ImuBatch, ImuCalibration, joined
from kiteline_core.geometry.cameras import CameraRig
from kiteline_core.ids import AgentId
from kiteline_hw.sources.open import open_source
from kiteline_hw.system.vocabulary import shipped_vocabulary

TICK_NS = 50_000_000  # of flights with a base
_QUIET_S = 5.0  # without a job, after which a base is done: it adjusts a merged map after seconds


class FlyingAgent:
    """An agent that is given items one by one; `run` holds what came of them."""

    def __init__(
        self,
        rig: CameraRig,
        imu: ImuCalibration | None,
        config: AgentConfig | None = None,
        *,
        channel: RecordChannel | None = None,
        identity: Identity | None = None,
        vocabulary: bool = True,
    ) -> None:
        """vocabulary: whether old places are recognised; without it only the reference keyframe is found again."""
        self.box = Agent(
            rig, imu, config or AgentConfig(), identity or Identity(AgentId(0), 0), channel or NoBaseChannel(),
            shipped_vocabulary() if vocabulary else None,
        )  # fmt: skip
        self.run = AgentRun()
        self._skipped: list[ImuBatch] = []

    def step(
        self, item: Item, packets: Sequence[bytes] = (), now_ns: int | None = None, cpu_ns: int = 0
    ) -> tuple[bytes, ...]:
        """Fly one frame; returns the packets for the base. cpu_ns: CPU time of the last step, for the governor."""
        imu = joined([*self._skipped, *([] if item.imu is None else [item.imu])])
        self._skipped = []
        given = StepInput(item.frame, imu, tuple(packets), cpu_ns, item.odometry)
        begin_ns = time.process_time_ns()
        output = self.box.step(given, item.frame.t_ns if now_ns is None else now_ns)
        run = self.run
        run.cpu_ns.append(time.process_time_ns() - begin_ns)
        run.t_ns.append(item.frame.t_ns)
        run.estimates.append(output.estimate)
        run.truth.append(item.T_w_b)
        run.events.append(output.events)
        run.cached_keyframes = max(run.cached_keyframes, len(self.box.map_cache))
        run.metric.append(self.box.metric)
        run.metric_submap = int(self.box.submap) if self.box.metric else None
        return output.packets

    def drop(self, item: Item) -> None:
        """Pass over a frame; its inertial samples go to the next one."""
        if item.imu is not None:
            self._skipped.append(item.imu)
        self.run.t_ns.append(item.frame.t_ns)
        self.run.estimates.append(None)
        self.run.truth.append(item.T_w_b)
        self.run.cpu_ns.append(0)
        self.run.events.append(())
        self.run.metric.append(self.box.metric)


def fly_alone(recording: Recording, config: AgentConfig | None = None, *, vocabulary: bool = True) -> AgentRun:
    """Fly an agent without a base."""
    agent = FlyingAgent(recording.rig, recording.imu, config, vocabulary=vocabulary)
    for item in recording.items:
        agent.step(item)
    return agent.run


# with a base


@dataclass(slots=True)
class RecordingRun:
    """The flight of one agent along a recording, and agent and base at its end."""

    agent: AgentRun
    box: Agent
    station: Station


def fly_recording(
    recording: Recording,
    agent: AgentConfig | None = None,
    base: BaseConfig | None = None,
    bytes_s: tuple[int, int] = (0, 0),
    profile: str = "wifi",
    each: Callable[[FlyingAgent], None] | None = None,
    channels: Callable[[RecordChannel], RecordChannel] | None = None,
) -> RecordingRun:
    """Fly an agent with a base, in lock-step; packets arrive with the next frame. bytes_s: budget up and down.

    each: is called with the agent after each of its steps. channels: wraps the two ends of the link.
    """
    wrapped = channels or (lambda channel: channel)
    station = Station(
        base or BaseConfig(), lambda _: wrapped(coded_channel(1, bytes_s[1], profile)), shipped_vocabulary()
    )
    jobs, number = LockstepJobs(), AgentId(0)
    channel = wrapped(coded_channel(1, bytes_s[0], profile))
    flying = FlyingAgent(recording.rig, recording.imu, agent, channel=channel, identity=Identity(number, 0))
    first_ns = recording.items[0].frame.t_ns
    down: tuple[bytes, ...] = ()
    for item in recording.items:
        now_ns = item.frame.t_ns - first_ns
        up = flying.step(item, down, now_ns)
        if each is not None:
            each(flying)
        flying.run.placed.append(bool(flying.run.found[-1].submap in station.mapper.placements))
        flying.run.bytes_down += sum(map(len, down))
        flying.run.bytes_up += sum(map(len, up))
        output = station.step({number: list(up)}, jobs.done(now_ns), now_ns)
        jobs.add(output.jobs, now_ns)
        down = dict(output.packets).get(number, ())
    return RecordingRun(flying.run, flying.box, station)


@dataclass(frozen=True, slots=True)
class Part:
    """Frames of a recording, from one time to another in s after its first. dark: nothing is to be seen in them."""

    from_s: float
    to_s: float
    dark: bool = False


@dataclass(frozen=True, slots=True)
class Scenario:
    """One start of one agent. parts: what it sees, in order; with more than one it has no IMU.

    outages: times of the whole flight, in s, between which its link is down. mono: left camera alone, no IMU.
    imu: False leaves out the inertial samples.
    """

    source: str
    agent: int = 0
    boot: int = 0
    begin_s: float = 0.0
    parts: tuple[Part, ...] = (Part(0.0, 1e9),)
    outages: tuple[tuple[float, float], ...] = ()
    mono: bool = False
    imu: bool = True

    @property
    def has_imu(self) -> bool:
        """True if the agent gets the recording's inertial samples."""
        return self.imu and len(self.parts) == 1 and not self.mono

    def items(self) -> Iterator[Item]:
        """The items of all parts, decoded one by one; several parts get stamps in steps of a tick."""
        t_ns = 0
        for part in self.parts:
            source = open_source(self.source, mono=self.mono, imu=self.has_imu)
            assert source.ground_truth is not None
            begin_ns = int(source.ground_truth.t_ns[0])
            for item in items_of(source):
                at_s = (item.frame.t_ns - begin_ns) * 1e-9
                if at_s >= part.to_s:
                    break
                if at_s >= part.from_s:
                    frame = item.frame if len(self.parts) == 1 else replace(item.frame, t_ns=t_ns)
                    if part.dark:
                        dark = np.full_like(frame.left, 20)
                        frame = replace(frame, left=dark, right=None if frame.right is None else dark)
                    yield replace(item, frame=frame)
                    t_ns += TICK_NS
            source.close()


@dataclass(slots=True)
class JointRun:
    """The flights of all scenarios, in their order, and the base at the end."""

    scenarios: Sequence[Scenario]
    agents: list[AgentRun]
    station: Station


def fly_with_base(
    scenarios: Sequence[Scenario],
    agent: AgentConfig | None = None,
    base: BaseConfig | None = None,
    bytes_s: tuple[int, int] = (0, 0),
    profile: str = "wifi",
    at_end: Callable[[JointRun], None] | None = None,
) -> JointRun:
    """Fly in lock-step until the last scenario is over; packets arrive one tick later. bytes_s: budget up and down.

    at_end: called when the last frame came. With it the base then goes on until it has begun no job for _QUIET_S.
    """
    station = Station(base or BaseConfig(), lambda _: coded_channel(1, bytes_s[1], profile), shipped_vocabulary())
    jobs = LockstepJobs()
    starts = [_Start(scenario, agent, bytes_s[0], profile) for scenario in scenarios]
    now_ns = 0
    up: dict[AgentId, list[bytes]] = {}
    down: dict[AgentId, tuple[bytes, ...]] = {}
    while any(start.next is not None for start in starts):
        for start in starts:
            if start.next is not None and start.begin_ns <= now_ns:
                up.setdefault(start.agent, []).extend(start.tick(down.pop(start.agent, ()), now_ns))
                run = start.flying.run
                run.placed.append(run.found[-1].submap in station.mapper.placements)
        output = station.step(up, jobs.done(now_ns), now_ns)
        jobs.add(output.jobs, now_ns)
        up, down = {}, dict(output.packets)
        now_ns += TICK_NS
    station.step({}, jobs.done(now_ns), now_ns)
    flown = JointRun(scenarios, [start.flying.run for start in starts], station)
    if at_end is not None:
        at_end(flown)
        busy_ns = now_ns
        while now_ns - busy_ns < _QUIET_S * 1e9:
            now_ns += TICK_NS
            output = station.step({}, jobs.done(now_ns), now_ns)
            jobs.add(output.jobs, now_ns)
            busy_ns = busy_ns if jobs.idle else now_ns
    return flown


class _Start:
    """One scenario under way. next: the item to fly, None at the end."""

    def __init__(self, scenario: Scenario, config: AgentConfig | None, bytes_s: int, profile: str) -> None:
        self.agent = AgentId(scenario.agent)
        self.begin_ns = round(scenario.begin_s * 1e9)
        self._outages = scenario.outages
        self._items = scenario.items()
        self.next = next(self._items, None)
        source = open_source(scenario.source, mono=scenario.mono, imu=scenario.has_imu)
        identity = Identity(self.agent, scenario.boot)
        channel = coded_channel(agent_session(scenario.boot + 1, scenario.boot), bytes_s, profile)
        self.flying = FlyingAgent(source.rig, source.imu, config, channel=channel, identity=identity)
        source.close()

    def tick(self, packets: Sequence[bytes], now_ns: int) -> Iterable[bytes]:
        """Fly one frame; returns the packets that reach the base."""
        assert self.next is not None
        item, self.next = self.next, next(self._items, None)
        up = not any(a <= now_ns * 1e-9 < b for a, b in self._outages)
        received = packets if up else ()
        sent = self.flying.step(item, received, now_ns)
        self.flying.run.bytes_down += sum(map(len, received))
        self.flying.run.bytes_up += sum(map(len, sent)) if up else 0
        return sent if up else ()
