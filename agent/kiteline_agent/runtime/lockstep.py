"""A lock-step flight: each tick waits for the base at a barrier."""

import os
import signal

from kiteline_agent.runtime.agent_runtime import PROGRESS_FRAMES, AgentRuntime, channel_with_spill, opened
from kiteline_agent.runtime.options import AgentOptions
from kiteline_agent.runtime.warm import WARMING
from kiteline_hw.lockstep.agent_end import AgentBarrier
from kiteline_hw.lockstep.messages import Down, Phase
from kiteline_hw.system import kernel_cache, process


def fly_lockstep(options: AgentOptions, parent: process.Parent) -> None:
    """Fly in lock-step with the base; if the base ends, fly on alone."""
    source = opened(options)
    kernel_cache.fill(WARMING, parent=parent)
    runtime = AgentRuntime(options, source, channel_with_spill(options), whole_process=True)
    parent.send_event("ready", frames=source.frame_count)
    line = AgentBarrier(options.link.removeprefix("lockstep:"), options.agent, parent)
    try:
        up, now_ns, phase = runtime.first_message(), -1, Phase.FLY
        while phase is not Phase.END:
            down = line.exchange(up)
            if down is None:
                if runtime.next_ns is None:
                    break
                down = Down(runtime.next_ns, Phase.FLY, ())
            now_ns, phase = down.now_ns, down.phase
            if options.kill_at_s is not None and options.kill_at_s * 1e9 <= now_ns:
                os.kill(os.getpid(), signal.SIGKILL)
            if phase is Phase.END:
                break
            up = runtime.tick(down)
            if runtime.counts.frames % PROGRESS_FRAMES == 0:
                parent.send_event("progress", frames=runtime.counts.frames, tracked=runtime.counts.tracked)
            await_ns = None if options.await_base_at_s is None else options.await_base_at_s * 1e9
            if line.lost and (options.await_bases or (await_ns is not None and await_ns <= now_ns)):
                parent.send_event("awaiting_base")
                line.reconnect()
                up = runtime.first_message()
        parent.send_event("result", report={**runtime.report(), "base_lost": line.times_lost})
    finally:
        line.close()
        runtime.close()
        source.close()
