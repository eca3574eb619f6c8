"""Fly a plan in lock-step in this process."""

import contextlib
from collections.abc import Mapping
from pathlib import Path

from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.runtime.agent_runtime import AgentRuntime
from kiteline_agent.runtime.warm import WARMING as AGENT_WARMING
from kiteline_basestation.runtime.base_runtime import BaseRuntime
from kiteline_basestation.runtime.options import coded_channels
from kiteline_basestation.runtime.warm import WARMING as BASE_WARMING
from kiteline_codec.channel import RecordChannel, coded_channel, plain_pair
from kiteline_codec.sync.resumption import agent_session
from kiteline_hw.links.kinds import link_traits
from kiteline_hw.lockstep.messages import Down, Phase
from kiteline_hw.lockstep.shared_core import SharedCore
from kiteline_hw.logs.spill_file import SpillFile
from kiteline_hw.system import kernel_cache
from kiteline_lab.flights.outcome import FlightOutcome, poses_from_json
from kiteline_lab.flights.plan import FlightPlan
from kiteline_lab.flights.progress import Progress


def fly_in_process(plan: FlightPlan, mode: str) -> FlightOutcome:
    """Fly in lock-step in this process. mode: tracker, local or monolith.

    A limit on the CPU covers all of it: agents, and the base's steps and jobs, share one modelled core.
    """
    ours: dict[int, RecordChannel] = {}
    theirs: dict[int, RecordChannel] = {}
    for spec in plan.agents:
        if mode == "monolith":
            ours[spec.agent], theirs[spec.agent] = plain_pair()
        elif mode == "local":
            ours[spec.agent] = coded_channel(
                agent_session(spec.order, spec.boot),
                spec.up_bytes_s,
                spec.profile,
                spill=SpillFile(Path(spec.folder)),
                bounded=True,
            )
        else:
            ours[spec.agent] = NoBaseChannel()
    percent = plan.agents[0].cpu_percent
    core = SharedCore(percent) if percent > 0.0 and plan.base is not None else None
    if not plan.quiet:
        kernel_cache.fill(AGENT_WARMING if plan.base is None else (*AGENT_WARMING, *BASE_WARMING))
    with contextlib.ExitStack() as stack:
        agents = {}
        for spec, source in zip(plan.agents, plan.sources, strict=True):
            of_core = None if core is None else core.process()
            agents[spec.agent] = AgentRuntime(spec, source, ours[spec.agent], whole_process=False, core=of_core)
            stack.callback(agents[spec.agent].close)
        progress = stack.enter_context(Progress("flying", plan.frames, "frames")) if not plan.quiet else None
        outcome = FlightOutcome([None] * len(plan.agents))
        if plan.base is None:
            _fly_alone(agents, progress)
        else:
            open_channel = theirs.__getitem__ if theirs else coded_channels(plan.base, link_traits(plan.base.link))
            base = BaseRuntime(plan.base, open_channel, plain=bool(theirs), core=core)
            stack.callback(base.close)
            _fly_joined(agents, base, progress)
            outcome.base = base.report()
            assert base.at_last_frame is not None
            outcome.at_last_frame = poses_from_json(base.at_last_frame.keyframes)
            outcome.drained = poses_from_json(base.summary().keyframes)
        outcome.agents = [agents[spec.agent].report() for spec in plan.agents]
    return outcome


def _fly_alone(agents: Mapping[int, AgentRuntime], progress: Progress | None) -> None:
    for agent in agents.values():
        while agent.next_ns is not None:
            agent.tick(Down(agent.next_ns, Phase.FLY, ()))
            _show(agents, progress)


def _fly_joined(agents: Mapping[int, AgentRuntime], base: BaseRuntime, progress: Progress | None) -> None:
    ups = {number: agent.first_message() for number, agent in agents.items()}
    while True:
        downs = base.tick(ups)
        if base.phase is Phase.END:
            return
        ups = {number: agent.tick(downs[number]) for number, agent in agents.items()}
        _show(agents, progress)


def _show(agents: Mapping[int, AgentRuntime], progress: Progress | None) -> None:
    if progress is not None:
        progress.update(sum(agent.counts.frames for agent in agents.values()))
