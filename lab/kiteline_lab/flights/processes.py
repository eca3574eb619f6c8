"""Fly a plan as child processes: one for each agent and one for the base, over a link."""

import contextlib
import socket
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

from kiteline_agent.runtime.options import AgentOptions
from kiteline_basestation.runtime.options import BaseOptions
from kiteline_hw.durable_files import next_number
from kiteline_hw.links.kinds import is_link, link_forms
from kiteline_hw.ports import LinkError
from kiteline_hw.system import kernel_cache, process
from kiteline_lab.flights.children import ChildProcesses, Event, ended_by
from kiteline_lab.flights.outcome import FlightOutcome, poses_from_json
from kiteline_lab.flights.plan import FlightPlan
from kiteline_lab.flights.progress import Progress

_NO_EVENT_S = 300.0  # s without an event of any child after which the flight is given up
_AGENT_END_S = 30.0  # s that the last child may take to end after the others


def free_endpoint() -> str:
    """A Zenoh endpoint on a free loopback port."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{s.getsockname()[1]}"


def link_ends(link: str, *, realtime: bool) -> tuple[str, str]:
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


def fly_processes(plan: FlightPlan, link: str, *, realtime: bool) -> FlightOutcome:
    """Fly as one process an agent and one for the base. Raises LinkError when the base cannot begin."""
    assert plan.base is not None
    up, down = link_ends(link, realtime=realtime)
    base = replace(plan.base, link=down)
    agents = [replace(spec, link=up) for spec in plan.agents]
    with contextlib.ExitStack() as stack:
        children = stack.enter_context(ChildProcesses())
        progress = stack.enter_context(Progress("flying", plan.frames, "frames")) if not plan.quiet else None
        supervisor = _Supervisor(children, base, agents, progress, plan.base_kills)
        supervisor.start_base()
        supervisor.run()
        return supervisor.outcome


class _Supervisor:
    """Handles the events of the child processes until all have ended."""

    def __init__(
        self,
        children: ChildProcesses,
        base: BaseOptions,
        agents: Sequence[AgentOptions],
        progress: Progress | None,
        kills: Sequence[tuple[float, float]],
    ) -> None:
        self._kills = list(kills)
        self.outcome = FlightOutcome([None] * len(agents))
        self._children = children
        self._base = base
        self._agents = agents
        self._progress = progress
        self._frames = [0] * len(agents)
        self._bases = 0
        self._awaited = False  # an agent waits for the next base
        self._kill_wanted = False  # the base that flies now is to be killed
        self._flying = {f"agent{spec.agent}" for spec in agents}
        self._base_up = True
        self._compiling_s: int | None = None  # s for which children compile kernels, as the user knows
        self._live = not base.link.startswith("lockstep:")
        self._over: set[str] = set()  # live agents that have flown their last frame
        self._errors: dict[str, str] = {}

    def run(self) -> None:
        """Run until every child has ended, or none reports anything any more."""
        if not self._live:  # agents wait for the base at the barrier
            self._start_agents()
        while self._flying or self._base_up:
            event = self._children.next_event(self._longest_silence_s())
            if event is None:
                self.outcome.note(
                    f"{', '.join(self._children.running())}: silent for too long; the flight was given up"
                )
                self.outcome.failed = True
                return
            self._take(event)

    def _longest_silence_s(self) -> float:
        """Seconds without an event after which nothing more is expected: before the first frame kernels may compile."""
        if not self._flying:
            return _AGENT_END_S
        return _NO_EVENT_S if any(self._frames) else kernel_cache.COMPILE_S

    def _start_agents(self) -> None:
        for spec in self._agents:
            self._children.start(f"agent{spec.agent}", "kiteline_agent", asdict(spec), Path(spec.folder))

    def _take(self, event: Event) -> None:
        agent = int(event.child.removeprefix("agent")) if event.child.startswith("agent") else None
        match event.kind:
            case "ready" if agent is None and self._live:
                self._start_agents()
            case "compiling":
                self._tell_of_compilation(event.values.get("seconds", 0))
            case "progress" if agent is not None:
                self._show(agent, event.values["frames"])
            case "result" if agent is not None:
                self.outcome.agents[agent] = event.values["report"]
                self._show(agent, event.values["report"]["frames"])
            case "result":
                self.outcome.base = event.values["report"]
                self.outcome.drained = poses_from_json(event.values["keyframes"])
            case "flown":
                self.outcome.at_last_frame = poses_from_json(event.values["keyframes"])
            case "error":
                self._errors[event.child] = event.values["text"]
            case "base_lost":
                self.outcome.note(f"the base ended in mid-flight; {event.child} went on alone")
            case "agents_lost":
                for number in event.values["agents"]:
                    self.outcome.note(f"agent {number} ended in mid-flight; the base kept its map")
            case "restored":
                self.outcome.restored.append(dict(event.values))
            case "awaiting_base":
                self._start_next_base()
            case "frames_over":  # live: the base cannot tell which frame is the last
                self._over.add(event.child)
                if self._over >= self._flying:
                    self._children.send_line(self._base_name, "frames_over")
            case "exit":
                self._ended(event, agent)

    def _show(self, agent: int, frames: int) -> None:
        self._frames[agent] = frames
        if self._progress is not None:
            self._progress.update(sum(self._frames))

    def _tell_of_compilation(self, seconds: int) -> None:
        """Say why nothing flies yet; of several children that compile, one tells how long."""
        if self._compiling_s is not None and seconds <= self._compiling_s:
            return
        self._compiling_s = seconds
        if self._progress is not None:
            line = kernel_cache.COMPILING if seconds == 0 else kernel_cache.still_compiling(seconds)
            process.print_lines([line])

    def _ended(self, event: Event, agent: int | None) -> None:
        code = event.values["code"]
        if agent is None:
            if event.child != self._base_name:
                return  # an earlier base
            self._base_up = False
            wanted = self._kill_wanted
            if self._awaited and code != 0:
                self._start_next_base()
        else:
            self._flying.discard(event.child)
            if self._live and not self._flying:
                self._children.terminate(self._base_name)
            kill_at_s = self._agents[agent].kill_at_s
            wanted = kill_at_s is not None
            if wanted:
                self.outcome.note(f"agent {agent} was ended at {kill_at_s:g} s of flight, as asked")
        if code == 0 or wanted:
            return
        why = self._errors.get(event.child) or self._children.processes[event.child].stderr_tail()
        self.outcome.note(f"{event.child} {ended_by(code)}" + (f": {why}" if why else ""))
        self.outcome.failed = True
        if not any(self._frames):  # it never started: what the others wait for will not come
            raise LinkError(self.outcome.notes[-1])

    @property
    def _base_name(self) -> str:
        return "base" if self._bases <= 1 else f"base-{self._bases}"

    def _start_next_base(self) -> None:
        self._awaited = self._base_up  # its exit event is still to come
        if self._base_up:
            return
        self.start_base()
        at_s = self._agents[0].await_base_at_s
        self.outcome.note(f"a new base began {'where one ended' if at_s is None else f'at {at_s:g} s of flight'}")

    def start_base(self) -> None:
        """Start the first base, or the next one after one that ended."""
        self._bases += 1
        self._base_up = True
        spec = self._base
        if self._bases > 1:
            session = self._base.session + self._bases - 1
            if spec.store:
                session = next_number(Path(spec.store) / "session")
            spec = replace(spec, kill_at_s=None, session=session, log_name=f"log-{self._bases}.mcap")
        if self._kills:
            at_s, delay_s = self._kills.pop(0)
            spec = replace(spec, kill_at_s=at_s, kill_delay_s=delay_s)
        self._kill_wanted = spec.kill_at_s is not None
        self._children.start(self._base_name, "kiteline_basestation", asdict(spec), Path(spec.folder))
