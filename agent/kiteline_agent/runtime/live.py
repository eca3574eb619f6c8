"""A live flight: real clocks, a real link, and a flight controller if there is one."""

from __future__ import annotations

import os
import threading
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TypeVar

from kiteline_agent.onboard import OnboardAgent
from kiteline_agent.runtime.agent_runtime import PROGRESS_FRAMES, AgentRuntime, channel_with_spill, opened
from kiteline_agent.runtime.controller import (
    OBSTACLES_HZ,
    controller_link,
    pose_rate_hz,
    pose_sample,
    push_obstacles,
    with_controller_imu,
)
from kiteline_agent.runtime.options import LOG_STEM, AgentOptions
from kiteline_agent.runtime.pose_schedule import PoseSchedule
from kiteline_agent.runtime.terminal import StatusMessages, summary
from kiteline_agent.runtime.warm import WARMING
from kiteline_agent.step import StepOutput
from kiteline_codec.channel import settled
from kiteline_codec.sync.resumption import agent_session, order_of
from kiteline_codec.transport.framing import StreamFramer
from kiteline_codec.transport.seal import Direction, Opener, Sealer, suite_for
from kiteline_codec.transport.seal_watch import SealWatch
from kiteline_core.frame import ImuBatch, OdometryBatch
from kiteline_hw.links.kinds import link_traits
from kiteline_hw.links.open import open_link
from kiteline_hw.links.sealed_link import SealedLink
from kiteline_hw.ports import ByteLink, ControllerLink, LinkError
from kiteline_hw.system import kernel_cache, process
from kiteline_hw.system.clock import MonotonicClock
from kiteline_hw.system.cpu import CpuQuota
from kiteline_hw.system.key_store import login_of, read_keys
from kiteline_hw.system.long_work import starting
from kiteline_hw.system.start_numbers import Start, StartNumbers

_Batch = TypeVar("_Batch", ImuBatch, OdometryBatch)
_IDLE_TICK_S = 0.05  # s between two steps while no frame is due: keeps acknowledgements and heartbeats moving
_DRAIN_S = 10.0  # s that a live flight waits at its end for the link to become quiet
_QUIET_S = 1.0  # s that the link has to stay quiet: the base may still be working on the last keyframe


def fly_live(
    options: AgentOptions, parent: process.Parent | None, stop: process.StopSignal, numbers: StartNumbers | None = None
) -> None:
    """Fly on real clocks: frames of a camera as they come, others paced by their stamps; late ones are dropped.

    numbers: of this agent's starts; one is taken when all else is at hand. None: the options hold them.
    """
    source = opened(options)
    with ExitStack() as stack:
        stack.callback(source.close)
        source = with_controller_imu(options, source)
        if not kernel_cache.filled():
            with starting():
                kernel_cache.fill(WARMING, stop, parent)
        if stop:
            return
        key = _key_of(options)
        if numbers is not None:
            start = numbers.next()
            options = _numbered(options, start)
            if start.kept:
                process.print_lines([f"the number of this start is drawn, as it cannot be kept: {start.kept}"])
        with starting():  # it compiles what could not be kept
            runtime = AgentRuntime(options, source, channel_with_spill(options), whole_process=True)
        stack.callback(runtime.close)
        clock = MonotonicClock()
        controller = controller_link(options, source, clock, stack)
        shared = None if controller is None else controller.tunnel_link()
        link = shared or open_link(
            options.link, "agent", options.agent, framer=StreamFramer, required=False,
            logins=None if key is None else login_of(options.agent, key),
        )  # fmt: skip
        stack.callback(link.close)
        sealer: Sealer | None = None
        session = agent_session(options.order, options.boot)
        if key is not None:
            sealer = Sealer(key, options.agent, session, Direction.UP, suite_for(link_traits(options.link)))
        watch = SealWatch(Direction.UP, None if key is None else Opener({options.agent: key}, Direction.DOWN))
        end, doubled = link, False
        link = SealedLink(link, options.agent, sealer, watch)
        follower = _SessionFollower(session, sealer, numbers)
        if options.cpu_percent > 0.0:
            stack.enter_context(CpuQuota(options.cpu_percent)).add(os.getpid())
        if parent is not None:
            parent.send_event("ready", frames=source.frame_count)
        process.notify("READY=1")
        status = StatusMessages()
        if parent is None:
            process.print_lines([f"flying {source.name}, {_link_text(options)}", *options.told])
        begin_ns = clock.now_ns()
        runtime.begin_at(begin_ns)
        if controller is not None:
            controller.take_imu(begin_ns)  # drop what was measured before the flight
        own_hz = 0.0 if controller is None else pose_rate_hz(options)
        obstacles_hz = OBSTACLES_HZ if controller is not None and options.obstacles else 0.0
        predictions, around = PoseSchedule(own_hz or obstacles_hz, begin_ns), PoseSchedule(obstacles_hz, begin_ns)
        shift_ns = runtime.options.start_ns - begin_ns
        while not stop and not runtime.over:
            told = _wait(runtime, begin_ns, predictions.next_ns, clock, stop)
            if stop:
                break
            now_ns = captured_ns = clock.now_ns()
            if parent is None:
                told += runtime.take_notices()
                process.print_lines(f"{(now_ns - begin_ns) / 1e9:8.1f} s  {line}" for line in told)
            frame = imu = odometry = predict_ns = None
            if runtime.next_ns is not None and now_ns >= begin_ns + runtime.next_ns:
                if not runtime.drop_stale(now_ns - begin_ns):
                    break
                captured_ns = begin_ns + runtime.next_ns
                frame, imu, odometry = runtime.reader.take()
                if controller is not None:
                    odometry = _measured(controller.take_odometry(captured_ns), odometry, shift_ns)
                    imu = _measured(controller.take_imu(captured_ns), imu, shift_ns)  # late samples: next frame
            elif controller is not None and predictions.take_due(now_ns):
                predict_ns = now_ns + shift_ns
                imu = runtime.reader.take_imu(predict_ns)
                imu = _measured(controller.take_imu(now_ns) if options.imu_of else None, imu, shift_ns)
            push = None
            # Poses have a rate of their own, or are those of the frames: predictions may be for obstacles alone.
            if controller is not None and (own_hz > 0.0) == (frame is None):
                push = partial(_push, controller, runtime.agent, captured_ns, options.boot, clock)
            sent = runtime.step(frame, imu, link.receive(), now_ns, odometry, predict_ns, push)
            follower.follow(runtime.session)
            for packet in sent:
                link.send(packet)
            if controller is not None:
                push_obstacles(controller, runtime.agent, runtime.output, around, now_ns)
            process.notify("WATCHDOG=1")
            process.print_lines(watch.lines())
            if not doubled and getattr(end, "doubled", False):
                doubled = True
                process.print_lines([f"another agent has number {options.agent} too: give each its own --agent N"])
            if parent is None:
                found = [] if controller is None else [f.line for f in controller.take_findings()]
                process.print_lines(
                    status.lines(runtime.output, runtime.counts, now_ns - begin_ns, found) if runtime.output else ()
                )
            elif runtime.counts.frames % PROGRESS_FRAMES == 0:
                parent.send_event("progress", frames=runtime.counts.frames, tracked=runtime.counts.tracked)
        if parent is None:
            process.print_lines([f"over: {summary(runtime.counts)}", *runtime.take_notices(), *runtime.log_notes()])
        _drain_live(runtime, link, clock, parent, stop, follower)
        if parent is not None:
            parent.send_event("result", report=runtime.report())


def _measured(by_controller: _Batch | None, by_source: _Batch | None, shift_ns: int) -> _Batch | None:
    """The flight controller's samples, else those of the source. shift_ns: from the clock to the stamps of frames."""
    if by_controller is None:
        return by_source
    return replace(by_controller, t_ns=by_controller.t_ns + shift_ns)


def _push(
    controller: ControllerLink,
    agent: OnboardAgent,
    captured_ns: int,
    boot: int,
    clock: MonotonicClock,
    output: StepOutput,
) -> None:
    """Send the pose of a step to the flight controller, if there is one."""
    pose = pose_sample(agent, output, captured_ns, boot)
    if pose is not None:
        controller.push(pose, clock.now_ns())


def _wait(
    runtime: AgentRuntime, begin_ns: int, pose_ns: int | None, clock: MonotonicClock, stop: process.StopSignal
) -> list[str]:
    """Wait for the next frame, the next pose, or one idle tick; what a camera has to tell. pose_ns: None: no poses."""
    now_ns = clock.now_ns()
    until_ns = now_ns + round(_IDLE_TICK_S * 1e9)
    until_ns = until_ns if pose_ns is None else min(until_ns, pose_ns)
    if runtime.camera is not None:
        return runtime.await_frame(until_ns)
    if runtime.next_ns is not None:
        until_ns = min(until_ns, begin_ns + runtime.next_ns)
    if until_ns > now_ns:
        stop.wait((until_ns - now_ns) / 1e9)
    return []


def _link_text(options: AgentOptions) -> str:
    return "without a link" if options.link == "none" else f"the base at {options.link}"


def _numbered(options: AgentOptions, start: Start) -> AgentOptions:
    """The options with the numbers of this start."""
    name = options.log_name and f"{LOG_STEM}{start.order:05d}.mcap"
    return replace(options, boot=start.boot, submap=start.submap, order=start.order, log_name=name)


def _key_of(options: AgentOptions) -> bytes | None:
    """The agent's key; None if packets are not sealed. Raises LinkError without a key for this agent."""
    if not options.key:
        return None
    keys = read_keys(Path(options.key))
    if options.agent not in keys:
        raise LinkError(
            f"{options.key} has no key for agent {options.agent}: run `kiteline keys pair {options.agent}` at the "
            f"base, and here the command that it shows, with --file {options.key}"
        )
    return keys[options.agent]


class _SessionFollower:
    """Goes on in a session above that of an earlier start, which the base knows and this one did not: seal, keep, tell.

    numbers: where the order is kept; None: nowhere.
    """

    def __init__(self, session: int, sealer: Sealer | None, numbers: StartNumbers | None) -> None:
        self._session, self._sealer, self._numbers = session, sealer, numbers

    def follow(self, session: int) -> None:
        """Take over the channel's session, if it rose."""
        if session <= self._session:
            return
        self._session, order = session, order_of(session)
        if self._sealer is not None:
            self._sealer.raise_to(session)
        if self._numbers is not None:  # beside the flight, which cannot wait for a disk
            threading.Thread(target=self._numbers.raise_to, args=(order,), name="start-number", daemon=True).start()
        process.print_lines(["the base knows a later start of this agent: state lost, or two agents with one number?"])


def _drain_live(
    runtime: AgentRuntime,
    link: ByteLink,
    clock: MonotonicClock,
    parent: process.Parent | None,
    stop: process.StopSignal,
    follower: _SessionFollower,
) -> None:
    """After the last frame: step until both sides hold the same values, or _DRAIN_S have passed."""
    runtime.end_of_frames()
    if parent is not None:
        parent.send_event("frames_over")
    now_ns = quiet_ns = clock.now_ns()
    end_ns = now_ns + round(_DRAIN_S * 1e9)
    while not stop and now_ns < end_ns and now_ns - quiet_ns < _QUIET_S * 1e9:
        stop.wait(_IDLE_TICK_S / 2)
        now_ns = clock.now_ns()
        sent = runtime.step(None, None, link.receive(), now_ns)
        follower.follow(runtime.session)
        for packet in sent:
            link.send(packet)
        if not all(settled(runtime.channel)):
            quiet_ns = now_ns
        process.notify("WATCHDOG=1")
