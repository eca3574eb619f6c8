"""Flights in this process whose agents come and go, lose their sight or their link, and see what they are shown.

What `fly` cannot play: an agent that starts late or again, frames shown a second time, a link that is down for a while.
Lock-step at the pace of the frames; the codec lies between, packets arrive one tick later.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.step import Estimate, Identity, StepInput
from kiteline_basestation.config import BaseConfig
from kiteline_basestation.runtime.worker import LockstepJobs
from kiteline_basestation.station import Station
from kiteline_codec.channel import CodedChannel, coded_channel
from kiteline_core.frame import Frame, ImuBatch
from kiteline_core.ids import AgentId
from kiteline_hw.sources.open import open_source
from kiteline_hw.system.vocabulary import shipped_vocabulary
from kiteline_lab.evaluation import metrics

F64 = NDArray[np.float64]

TICK_NS = 50_000_000


@dataclass(frozen=True, slots=True)
class Part:
    """Frames from one time of a recording to another, in s after its first. dark: nothing is to be seen in them."""

    from_s: float
    to_s: float
    dark: bool = False


@dataclass(frozen=True, slots=True)
class Sortie:
    """One start of one agent. parts: what it sees, one after another; with more than one it has no IMU. deaf: times of
    the whole flight, in s, between which its link is down. mono: with one eye, and without IMU.
    """

    source: str
    agent: int = 0
    boot: int = 0
    begin_s: float = 0.0
    parts: tuple[Part, ...] = (Part(0.0, 1e9),)
    deaf: tuple[tuple[float, float], ...] = ()
    mono: bool = False


@dataclass(slots=True)
class Flown:
    """What came of one sortie. truth: T_w_b (4,4) of each frame. events: by frame."""

    estimates: list[Estimate] = field(default_factory=list)
    truth: list[F64] = field(default_factory=list)
    events: list[tuple[str, ...]] = field(default_factory=list)
    bytes_up: int = 0
    bytes_down: int = 0
    placed: list[bool] = field(default_factory=list)  # whether the base had placed the frame's submap by then
    copies: int = 0  # most that the agent held at once
    cpu_ms: list[float] = field(default_factory=list)  # of each frame's step

    def said(self, word: str) -> list[int]:
        """Frames in which an event begins with a word."""
        return [k for k, events in enumerate(self.events) if any(e.startswith(word) for e in events)]


@dataclass(slots=True)
class Flight:
    """All sorties, and the base as it was left."""

    sorties: list[Flown]
    station: Station


def fly(
    sorties: Sequence[Sortie],
    agent: AgentConfig | None = None,
    base: BaseConfig | None = None,
    bytes_s: tuple[int, int] = (0, 0),
    profile: str = "wifi",
    each_tick: Callable[[int, Station], None] | None = None,
) -> Flight:
    """Fly until the last sortie is over. bytes_s: budget up and down. each_tick: called with the time and the base."""
    words = shipped_vocabulary()
    station = Station(base or BaseConfig(), lambda _: coded_channel(1, bytes_s[1], profile), words)
    jobs = LockstepJobs()
    crews = [_Crew(sortie, agent or AgentConfig(), bytes_s[0], profile) for sortie in sorties]
    now_ns = 0
    up: dict[AgentId, list[bytes]] = {}
    down: dict[AgentId, tuple[bytes, ...]] = {}
    while any(not crew.over for crew in crews):
        for crew in crews:
            if not crew.over and crew.begin_ns <= now_ns:
                up.setdefault(crew.agent, []).extend(crew.tick(down.pop(crew.agent, ()), now_ns))
                if not crew.over:
                    crew.flown.placed.append(crew.flown.estimates[-1].submap in station.mapper.placements)
        output = station.step(up, jobs.done(now_ns), now_ns)
        jobs.add(output.jobs, now_ns)
        up, down = {}, dict(output.packets)
        if each_tick is not None:
            each_tick(now_ns, station)
        now_ns += TICK_NS
    return Flight([crew.flown for crew in crews], station)


class _Crew:
    """One agent with its frames."""

    def __init__(self, sortie: Sortie, config: AgentConfig, bytes_s: int, profile: str) -> None:
        self.agent = AgentId(sortie.agent)
        self.begin_ns = round(sortie.begin_s * 1e9)
        self.over = False
        self.flown = Flown()
        self._deaf = sortie.deaf
        self._frames = _frames(sortie)
        self._next = next(self._frames, None)
        source = open_source(sortie.source, mono=sortie.mono, imu=_has_imu(sortie))
        self._channel: CodedChannel = coded_channel(sortie.boot + 1, bytes_s, profile)
        identity = Identity(self.agent, sortie.boot)
        self._box = Agent(source.rig, source.imu, config, identity, self._channel, shipped_vocabulary())
        source.close()

    def tick(self, packets: Sequence[bytes], now_ns: int) -> tuple[bytes, ...]:
        """One frame; what leaves for the base."""
        if self._next is None:
            self.over = True
            return ()
        frame, imu, truth = self._next
        self._next = next(self._frames, None)
        deaf = any(a <= now_ns * 1e-9 < b for a, b in self._deaf)
        received = () if deaf else tuple(packets)
        begin_ns = time.process_time_ns()
        output = self._box.step(StepInput(frame, imu, received), now_ns)
        out = self.flown
        out.cpu_ms.append((time.process_time_ns() - begin_ns) / 1e6)
        assert output.estimate is not None
        out.estimates.append(output.estimate)
        out.truth.append(truth)
        out.events.append(output.events)
        out.bytes_down += sum(map(len, received))
        out.copies = max(out.copies, len(self._box.window))
        if deaf:
            return ()
        out.bytes_up += sum(map(len, output.packets))
        return output.packets


def _has_imu(sortie: Sortie) -> bool:
    return len(sortie.parts) == 1 and not sortie.mono


def _frames(sortie: Sortie) -> Iterator[tuple[Frame, ImuBatch | None, F64]]:
    """The frames of all parts, with stamps that go on."""
    alone = len(sortie.parts) == 1
    t_ns = 0
    for part in sortie.parts:
        source = open_source(sortie.source, mono=sortie.mono, imu=_has_imu(sortie))
        assert source.ground_truth is not None
        begin_ns = int(source.ground_truth.t_ns[0])
        pending: ImuBatch | None = None
        for item in source:
            if isinstance(item, ImuBatch):
                pending = item
                continue
            if not isinstance(item, Frame):
                continue
            at_s = (item.t_ns - begin_ns) * 1e-9
            if at_s >= part.to_s:
                break
            if at_s >= part.from_s:
                _, true = metrics.truth_at(np.array([item.t_ns]), source.ground_truth)
                frame = item if alone else replace(item, t_ns=t_ns)
                if part.dark:
                    dark = np.full_like(item.left, 20)
                    frame = replace(frame, left=dark, right=None if item.right is None else dark)
                yield replace(frame, encoded=()), pending, true[0]
                t_ns += TICK_NS
            pending = None
        source.close()
