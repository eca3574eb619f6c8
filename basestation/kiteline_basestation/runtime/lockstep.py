"""A lock-step flight as a child process: the base steps when all agents have sent their messages."""

import contextlib
import os
import signal
import threading

from kiteline_basestation.runtime.base_runtime import BaseRuntime, report_restored
from kiteline_basestation.runtime.options import BaseOptions, coded_channels
from kiteline_basestation.runtime.warm import WARMING
from kiteline_hw.links.kinds import link_traits
from kiteline_hw.lockstep.messages import Down, Phase, Up
from kiteline_hw.lockstep.zenoh_lockstep import LockstepServer
from kiteline_hw.ports import LinkError
from kiteline_hw.system import kernel_cache, process
from kiteline_hw.system.memory import return_large_arrays

_COLLECT_S = 120.0  # s that an agent may take for one tick before it counts as lost


def fly_lockstep(options: BaseOptions, parent: process.Parent) -> None:
    """Serve the barrier until the flight ends. An agent whose process ends is left out."""
    return_large_arrays()
    kernel_cache.fill(WARMING, parent=parent)
    base = BaseRuntime(options, coded_channels(options, link_traits(options.link)))
    report_restored(base.restore_maps(0), parent)
    server = LockstepServer(options.link.removeprefix("lockstep:"))
    try:
        parent.send_event("ready")
        agents = set(options.agents)
        kill_ns = None if options.kill_at_s is None else options.kill_at_s * 1e9
        while base.phase is not Phase.END:
            ups = _collect(server, agents, base, parent)
            if kill_ns is not None and base.now_ns is not None and kill_ns <= base.now_ns:
                kill_ns = None
                threading.Timer(options.kill_delay_s, os.kill, (os.getpid(), signal.SIGKILL)).start()
            frames_were_over = base.at_last_frame is not None
            _answer(server, base.tick(ups))
            if base.at_last_frame is not None and not frames_were_over:
                parent.send_event("flown", keyframes=base.at_last_frame.keyframes)
        parent.send_event("result", report=base.report(), keyframes=base.summary().keyframes)
    finally:
        server.close()
        base.close()


def _collect(server: LockstepServer, agents: set[int], base: BaseRuntime, parent: process.Parent) -> dict[int, Up]:
    """Messages of all `agents`; agents whose process ended are removed from that set."""
    while agents:
        try:
            return {agent: Up.decode(message) for agent, message in server.collect(agents, _COLLECT_S).items()}
        except LinkError as error:
            lost = server.lost() & agents or agents
            agents -= lost
            base.agents_lost |= lost
            parent.send_event("agents_lost", agents=sorted(lost), text=str(error))
    return {}


def _answer(server: LockstepServer, downs: dict[int, Down]) -> None:
    for agent, down in downs.items():
        with contextlib.suppress(LinkError):  # an agent that has ended is found missing at the next tick
            server.answer(agent, down.encode())
