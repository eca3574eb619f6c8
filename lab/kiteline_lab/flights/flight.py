"""One flight: in this process (tracker, local, monolith) or as child processes (distributed), with the same outcome."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.runtime.agent_runtime import AgentRuntime
from kiteline_agent.runtime.options import AgentOptions
from kiteline_basestation.runtime.base_runtime import BaseRuntime
from kiteline_basestation.runtime.options import BaseOptions, coded_channels
from kiteline_codec.channel import RecordChannel, coded_channel, plain_pair
from kiteline_hw.links.kinds import is_link, link_forms, link_traits
from kiteline_hw.lockstep.messages import Down, Phase
from kiteline_hw.logs.spill_file import SpillFile
from kiteline_hw.ports import FrameSource, LinkError
from kiteline_hw.system import process
from kiteline_lab.flights.children import Crew, Event, ended_by
from kiteline_lab.flights.progress import Progress

F64 = NDArray[np.float64]

_SILENCE_S = 300.0  # s without a word from any child after which the flight is given up
_AGENT_END_S = 30.0  # s that the last child may take to end after the others


@dataclass(frozen=True, slots=True)
class Flight:
    """What is about to be flown. frames: how many in all, None unknown. quiet: without progress.

    deaths: when each base in turn is killed (flight time, and real time after it, in s); a new one follows each.
    """

    agents: Sequence[AgentOptions]
    base: BaseOptions | None
    frames: int | None
    quiet: bool = False
    deaths: Sequence[tuple[float, float]] = ()


@dataclass(slots=True)
class Outcome:
    """How it went. Reports hold raw samples in place of statistics; None: that process left none. flown, drained: T_w_k
    of the base's keyframes when the last frame came, and after the link was drained. notes: what a user must know.
    """

    agents: list[dict[str, Any] | None]
    base: dict[str, Any] | None = None
    flown: dict[int, F64] = field(default_factory=dict)
    drained: dict[int, F64] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    restored: list[dict[str, Any]] = field(default_factory=list)  # how each base that began with a store found it
    failed: bool = False


def poses_from_json(value: Mapping[str, Sequence[float]]) -> dict[int, F64]:
    """Keyframe poses as a base tells them."""
    return {int(k): np.array(pose, np.float64).reshape(4, 4) for k, pose in value.items()}


# In this process


def fly_here(flight: Flight, sources: Sequence[FrameSource], mode: str) -> Outcome:
    """Fly in lock-step in this process. mode: tracker, local or monolith."""
    ours: dict[int, RecordChannel] = {}
    theirs: dict[int, RecordChannel] = {}
    for spec in flight.agents:
        if mode == "monolith":
            ours[spec.agent], theirs[spec.agent] = plain_pair()
        elif mode == "local":
            ours[spec.agent] = coded_channel(
                spec.boot + 1, spec.up_bytes_s, spec.profile, spill=SpillFile(Path(spec.folder)), bounded=True
            )
        else:
            ours[spec.agent] = NoBaseChannel()
    with contextlib.ExitStack() as stack:
        onboards = {}
        for spec, source in zip(flight.agents, sources, strict=True):
            onboards[spec.agent] = AgentRuntime(spec, source, ours[spec.agent], whole_process=False)
            stack.callback(onboards[spec.agent].close)
        progress = stack.enter_context(Progress("flying", flight.frames, "frames")) if not flight.quiet else None
        outcome = Outcome([None] * len(flight.agents))
        if flight.base is None:
            _fly_alone(onboards, progress)
        else:
            open_channel = theirs.__getitem__ if theirs else coded_channels(flight.base, link_traits(flight.base.link))
            base = BaseRuntime(flight.base, open_channel, plain=bool(theirs))
            stack.callback(base.close)
            _fly_joined(onboards, base, progress)
            outcome.base = base.report()
            assert base.at_last_frame is not None
            outcome.flown = poses_from_json(base.at_last_frame.keyframes)
            outcome.drained = poses_from_json(base.summary().keyframes)
        outcome.agents = [onboards[spec.agent].report() for spec in flight.agents]
    return outcome


def _fly_alone(onboards: Mapping[int, AgentRuntime], progress: Progress | None) -> None:
    for onboard in onboards.values():
        while onboard.next_ns is not None:
            onboard.tick(Down(onboard.next_ns, Phase.FLY, ()))
            _show(onboards, progress)


def _fly_joined(onboards: Mapping[int, AgentRuntime], base: BaseRuntime, progress: Progress | None) -> None:
    ups = {agent: onboard.first_message() for agent, onboard in onboards.items()}
    while True:
        downs = base.tick(ups)
        if base.phase is Phase.END:
            return
        ups = {agent: onboard.tick(downs[agent]) for agent, onboard in onboards.items()}
        _show(onboards, progress)


def _show(onboards: Mapping[int, AgentRuntime], progress: Progress | None) -> None:
    if progress is not None:
        progress.update(sum(onboard.counts.frames for onboard in onboards.values()))


# As child processes


def free_endpoint() -> str:
    """A Zenoh endpoint on a free loopback port."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{s.getsockname()[1]}"


def link_ends(link: str, realtime: bool) -> tuple[str, str]:
    """LINK of the agents and of the base. Where the ends differ (always with `serial:` and `mavlink:`) both are named,
    the agent's first, with a comma between. Raises LinkError.
    """
    kind, _, address = link.partition(":")
    if is_link(link) and realtime and address.count(",") == 1:
        ends = address.split(",")
        return f"{kind}:{ends[0]}", f"{kind}:{ends[1]}"
    if link and kind != "zenoh":
        raise LinkError(
            f"--link {link}: fly joins its processes by zenoh:tcp/HOST:PORT, or with --realtime by {link_forms()}, "
            "with the addresses of both ends, the agent's end first and a comma between"
        )
    endpoint = address or free_endpoint()
    return (f"zenoh:{endpoint}",) * 2 if realtime else (f"lockstep:{endpoint}",) * 2


def fly_processes(flight: Flight, link: str, realtime: bool) -> Outcome:
    """Fly as one process an agent and one for the base. Raises LinkError when the base cannot begin."""
    assert flight.base is not None
    up, down = link_ends(link, realtime)
    base = replace(flight.base, link=down)
    agents = [replace(spec, link=up) for spec in flight.agents]
    with contextlib.ExitStack() as stack:
        crew = stack.enter_context(Crew())
        progress = stack.enter_context(Progress("flying", flight.frames, "frames")) if not flight.quiet else None
        supervisor = _Supervisor(crew, base, agents, progress, flight.deaths)
        supervisor.start_base()
        supervisor.run()
        return supervisor.outcome


class _Supervisor:
    """Listens to the children until all have ended, and notes what they say."""

    def __init__(
        self,
        crew: Crew,
        base: BaseOptions,
        agents: Sequence[AgentOptions],
        progress: Progress | None,
        deaths: Sequence[tuple[float, float]],
    ) -> None:
        self._deaths = list(deaths)
        self.outcome = Outcome([None] * len(agents))
        self._crew = crew
        self._base = base
        self._agents = agents
        self._progress = progress
        self._frames = [0] * len(agents)
        self._bases = 0
        self._awaited = False  # whether an agent looks for the next one already
        self._wanted = False  # whether the base that flies now is meant to die
        self._flying = {f"agent{spec.agent}" for spec in agents}
        self._base_up = True
        self._live = not base.link.startswith("lockstep:")
        self._over: set[str] = set()  # live agents that have flown their last frame
        self._errors: dict[str, str] = {}

    def run(self) -> None:
        """Until every child has ended, or none says anything any more."""
        if not self._live:  # agents wait for the base at the barrier
            self._start_agents()
        while self._flying or self._base_up:
            event = self._crew.next_event(_SILENCE_S if self._flying else _AGENT_END_S)
            if event is None:
                self._note(f"{', '.join(self._crew.running())}: silent for too long; the flight was given up")
                self.outcome.failed = True
                return
            self._take(event)

    def _start_agents(self) -> None:
        for spec in self._agents:
            self._crew.start(f"agent{spec.agent}", "kiteline_agent", asdict(spec), Path(spec.folder))

    def _take(self, event: Event) -> None:
        agent = int(event.child.removeprefix("agent")) if event.child.startswith("agent") else None
        match event.kind:
            case "ready" if agent is None and self._live:
                self._start_agents()
            case "progress" if agent is not None:
                self._show(agent, event.values["frames"])
            case "result" if agent is not None:
                self.outcome.agents[agent] = event.values["report"]
                self._show(agent, event.values["report"]["frames"])
            case "result":
                self.outcome.base = event.values["report"]
                self.outcome.drained = poses_from_json(event.values["keyframes"])
            case "flown":
                self.outcome.flown = poses_from_json(event.values["keyframes"])
            case "error":
                self._errors[event.child] = event.values["text"]
            case "base_lost":
                self._note(f"the base ended in mid-flight; {event.child} went on alone")
            case "agents_lost":
                for number in event.values["agents"]:
                    self._note(f"agent {number} ended in mid-flight; the base kept its map")
            case "restored":
                self.outcome.restored.append(dict(event.values))
            case "awaiting_base":
                self._restart_base()
            case "frames_over":  # live: the base cannot see for itself when the last frame has come
                self._over.add(event.child)
                if self._over >= self._flying:
                    self._crew.say(self._base_name, "frames_over")
            case "exit":
                self._ended(event, agent)

    def _show(self, agent: int, frames: int) -> None:
        self._frames[agent] = frames
        if self._progress is not None:
            self._progress.update(sum(self._frames))

    def _ended(self, event: Event, agent: int | None) -> None:
        code = event.values["code"]
        if agent is None:
            if event.child != self._base_name:
                return  # an earlier base
            self._base_up = False
            wanted = self._wanted
            if self._awaited and code != 0:
                self._restart_base()
        else:
            self._flying.discard(event.child)
            if self._live and not self._flying:
                self._crew.ask_to_end(self._base_name)
            wanted = self._agents[agent].kill_at_s >= 0
            if wanted:
                self._note(f"agent {agent} was ended at {self._agents[agent].kill_at_s:g} s of flight, as asked")
        if code == 0 or wanted:
            return
        why = self._errors.get(event.child) or self._crew.children[event.child].last_words()
        self._note(f"{event.child} {ended_by(code)}" + (f": {why}" if why else ""))
        self.outcome.failed = True
        if not any(self._frames):  # it never started: what the others wait for will not come
            raise LinkError(self.outcome.notes[-1])

    @property
    def _base_name(self) -> str:
        return "base" if self._bases <= 1 else f"base-{self._bases}"

    def _restart_base(self) -> None:
        self._awaited = self._base_up  # its end is still to be heard of
        if self._base_up:
            return
        self.start_base()
        when = f"at {self._agents[0].await_base_at_s:g} s of flight"
        self._note(f"a new base began {when if not self._agents[0].await_bases else 'where one ended'}")

    def start_base(self) -> None:
        """The first base, or the next one after one that died."""
        self._bases += 1
        self._base_up = True
        spec = self._base
        if self._bases > 1:
            session = self._base.session + self._bases - 1
            if spec.store:
                session = process.next_number(Path(spec.store) / "session")
            spec = replace(spec, kill_at_s=-1.0, session=session, log_name=f"log-{self._bases}.mcap")
        if self._deaths:
            at_s, delay_s = self._deaths.pop(0)
            spec = replace(spec, kill_at_s=at_s, kill_delay_s=delay_s)
        self._wanted = spec.kill_at_s >= 0
        self._crew.start(self._base_name, "kiteline_basestation", asdict(spec), Path(spec.folder))

    def _note(self, text: str) -> None:
        if text not in self.outcome.notes:
            self.outcome.notes.append(text)
