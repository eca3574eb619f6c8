"""A live flight: real clocks, a real link, and a flight controller if there is one."""

import os
import threading
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple, TypeVar

from kiteline_agent.onboard import OnboardAgent
from kiteline_agent.runtime.agent_runtime import PROGRESS_FRAMES, AgentRuntime, channel_with_spill, opened
from kiteline_agent.runtime.controller import (
    OBSTACLES_HZ,
    UnsentPoses,
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
from kiteline_agent.step import StepInput, StepOutput
from kiteline_codec.channel import settled
from kiteline_codec.sync.resumption import agent_session, order_of
from kiteline_codec.transport.framing import StreamFramer
from kiteline_codec.transport.seal import Direction, Opener, Sealer, suite_for
from kiteline_codec.transport.seal_watch import SealWatch
from kiteline_core.frame import ImuBatch, OdometryBatch
from kiteline_hw.links.ends import LinkOptions
from kiteline_hw.links.kinds import link_traits
from kiteline_hw.links.open import open_link
from kiteline_hw.links.sealed_link import SealedLink
from kiteline_hw.logs.log_budget import newest_start
from kiteline_hw.ports import ByteLink, ControllerLink, LinkError, link_messages
from kiteline_hw.system import kernel_cache, process
from kiteline_hw.system.clock import MonotonicClock
from kiteline_hw.system.cpu import CpuQuota
from kiteline_hw.system.key_store import login_of, read_keys
from kiteline_hw.system.long_work import StoppedError, long_work, starting
from kiteline_hw.system.start_numbers import Start, StartNumbers

_Batch = TypeVar("_Batch", ImuBatch, OdometryBatch)
_CATCH_UP_NS = 50_000_000  # ns between two steps while late frames are read and dropped, more slowly than they come
_IDLE_TICK_S = 0.05  # s between two steps while no frame is due: keeps acknowledgements and heartbeats moving
_DRAIN_S = 10.0  # s that a live flight waits at its end for the link to become quiet
_DRAIN_TOLD_S = 1.5  # s of that wait after which the user is told of it: over a fast link it is over by then
_FIRST_WORD_NS = 3_000_000_000  # ns after which it is said that no base answers: connections take less
_SILENCE_NS = 10_000_000_000  # ns of silence after which it is said of one that did: a link that comes back takes less
_QUIET_S = 1.0  # s that the link has to stay quiet: the base may still be working on the last keyframe


def fly_live(
    options: AgentOptions, parent: process.Parent | None, stop: process.StopSignal, numbers: StartNumbers | None = None
) -> None:
    """Fly on real clocks: frames of a camera as they come, others paced by their stamps; late ones are dropped.

    numbers: of this agent's starts; one is taken when all else is at hand. None: the options hold them.
    """
    with suppress(StoppedError), process.without_waiting_for_terminal(), ExitStack() as stack:
        with long_work(stop, "opening the source"):  # that of a recording without an index is read from end to end
            source = opened(options)
        stack.callback(source.close)
        source = with_controller_imu(options, source)
        # made before kernels and numbers are: a limit that cannot be set is told at once
        quota = stack.enter_context(CpuQuota(options.cpu_percent)) if options.cpu_percent > 0.0 else None
        if not kernel_cache.filled():
            with starting():
                kernel_cache.fill(WARMING, stop, parent)
        if stop:
            return
        key = _key_of(options)
        if numbers is not None:
            # above those of the logs: if the kept number was lost, the newest log would else count as the oldest
            least = 1 + newest_start(Path(options.folder), LOG_STEM) if options.log_name else 1
            start = numbers.next(least)
            options = _numbered(options, start)
            if start.kept:
                process.print_lines([f"the number of this start is drawn, as it cannot be kept: {start.kept}"])
        with starting(), long_work(stop, "compiling kernels"):  # those that could not be kept
            runtime = AgentRuntime(options, source, channel_with_spill(options), whole_process=True)
        if parent is None:  # once the files are closed
            stack.callback(lambda: process.print_lines(runtime.log_notes()))
        stack.callback(runtime.close)
        clock = MonotonicClock()
        controller = controller_link(options, source, clock, stack)
        logins = {} if key is None else login_of(options.agent, key)
        end = (None if controller is None else controller.tunnel_link()) or open_link(
            options.link, "agent", LinkOptions(options.agent, StreamFramer, required=False, logins=logins)
        )
        stack.callback(end.close)
        base = _BaseEnd(options, end, key, numbers)
        if quota is not None:
            quota.add(os.getpid())
        if parent is not None:
            parent.send_event("ready", frames=source.frame_count)
        process.notify("READY=1")
        if parent is None:
            process.print_lines([f"flying {source.name}, {_link_text(options)}", *options.told])
        flight = _LiveFlight(runtime, base, controller, clock, parent, stop)
        flight.fly()
        if parent is None:
            process.print_lines([f"over: {summary(runtime.counts)}", *runtime.take_notices()])
        flight.drain()
        if parent is not None:
            parent.send_event("result", report=runtime.report())


class _Due(NamedTuple):
    """What a step of a live flight is given, without packets.

    captured_ns: of the frame on the clock of the process, or the time of the step.
    """

    captured_ns: int
    given: StepInput


class _LiveFlight:
    """The loop of a live flight: waits for frames and poses that are due, steps the agent, sends packets."""

    def __init__(
        self, runtime: AgentRuntime, base: "_BaseEnd", controller: ControllerLink | None, clock: MonotonicClock,
        parent: process.Parent | None, stop: process.StopSignal,
    ) -> None:  # fmt: skip
        self._runtime, self._base, self._controller = runtime, base, controller
        self._clock, self._parent, self._stop = clock, parent, stop
        self._status = StatusMessages()
        self._unsent = UnsentPoses()
        options = runtime.options
        self._begin_ns = begin_ns = clock.now_ns()
        runtime.begin_at(begin_ns)
        if controller is not None:
            controller.take_imu(begin_ns)  # drop what was measured before the flight
        own_hz = 0.0 if controller is None else pose_rate_hz(options)
        obstacles_hz = OBSTACLES_HZ if controller is not None and options.obstacles else 0.0
        # Poses have a rate of their own, or are those of the frames: predictions may be for obstacles alone.
        self._predicts_poses = own_hz > 0.0
        self._predictions, self._obstacles = (
            PoseSchedule(own_hz or obstacles_hz, begin_ns), PoseSchedule(obstacles_hz, begin_ns)
        )  # fmt: skip
        self._newest_ns: int | None = None  # flight time of the newest frame, while those before it are dropped
        self._shift_ns = runtime.options.start_ns - begin_ns  # from the clock to the stamps of frames

    def fly(self) -> None:
        """Step until the source or the process ends."""
        runtime, controller = self._runtime, self._controller
        while not self._stop and not runtime.over:
            told = self._wait()
            if self._stop:
                break
            now_ns = self._clock.now_ns()
            if self._parent is None:
                told += runtime.take_notices()
                process.print_lines(f"{(now_ns - self._begin_ns) / 1e9:8.1f} s  {line}" for line in told)
            due = self._due(now_ns)
            if due is None:
                break
            push = None
            if controller is not None and self._predicts_poses == (due.given.frame is None):
                push = partial(_push, controller, runtime.agent, due.captured_ns, runtime.options.boot, self._clock)
            sent = runtime.step(replace(due.given, packets=tuple(self._base.receive())), now_ns, push)
            self._base.send(sent, runtime.session)
            if controller is not None:
                push_obstacles(controller, runtime.agent, runtime.output, self._obstacles, now_ns)
            process.notify("WATCHDOG=1")
            process.print_lines(self._base.lines(now_ns))
            self._report(now_ns)

    def drain(self) -> None:
        """After the last frame: step until both sides hold the same values, or _DRAIN_S have passed."""
        runtime = self._runtime
        runtime.end_of_frames()
        if self._parent is not None:
            self._parent.send_event("frames_over")
        now_ns = quiet_ns = self._clock.now_ns()
        end_ns, told_ns = now_ns + round(_DRAIN_S * 1e9), now_ns + round(_DRAIN_TOLD_S * 1e9)
        told = self._parent is not None
        while not self._stop and now_ns < end_ns and now_ns - quiet_ns < _QUIET_S * 1e9:
            self._stop.wait(_IDLE_TICK_S / 2)
            now_ns = self._clock.now_ns()
            self._base.send(runtime.step(StepInput(packets=tuple(self._base.receive())), now_ns), runtime.session)
            if not all(settled(runtime.channel)):
                quiet_ns = now_ns
                if not told and now_ns > told_ns:
                    told = True
                    process.print_lines([f"waiting, {_DRAIN_S:g} s at most, until the base has it all; Ctrl-C ends it"])
            process.notify("WATCHDOG=1")
        if self._parent is None and now_ns >= end_ns:
            add = (
                "`kiteline base --store DIR --import LOG` adds it" if runtime.options.log_name else "it was not logged"
            )
            process.print_lines([f"not all has reached the base: {add}"])

    def _wait(self) -> list[str]:
        """Wait for the next frame, the next pose, or one idle tick. Returns messages of the camera."""
        runtime, now_ns = self._runtime, self._clock.now_ns()
        until_ns = now_ns + round(_IDLE_TICK_S * 1e9)
        if self._predictions.next_ns is not None:
            until_ns = min(until_ns, self._predictions.next_ns)
        if runtime.camera is not None:
            return runtime.await_frame(until_ns)
        if runtime.next_ns is not None:
            until_ns = min(until_ns, self._begin_ns + runtime.next_ns)
        if until_ns > now_ns:
            self._stop.wait((until_ns - now_ns) / 1e9)
        return []

    def _due(self, now_ns: int) -> _Due | None:
        """What is due: a frame, a pose between frames, or nothing but packets; None at the end of the source."""
        runtime, controller = self._runtime, self._controller
        if runtime.next_ns is not None and now_ns >= self._begin_ns + runtime.next_ns:
            if self._newest_ns is None:
                self._newest_ns = now_ns - self._begin_ns
            until_ns = now_ns + _CATCH_UP_NS
            if not runtime.drop_stale(self._newest_ns, lambda: self._clock.now_ns() < until_ns):
                return _Due(now_ns, StepInput())
            self._newest_ns = None
            if runtime.over:
                return None
            captured_ns = self._begin_ns + runtime.next_ns
            frame, imu, odometry = runtime.reader.take()
            if controller is not None:
                odometry = _measured(controller.take_odometry(captured_ns), odometry, self._shift_ns)
                imu = _measured(controller.take_imu(captured_ns), imu, self._shift_ns)  # late samples: next frame
            return _Due(captured_ns, StepInput(frame, imu, odometry=odometry))
        if controller is None or not self._predictions.take_due(now_ns):
            return _Due(now_ns, StepInput())
        predict_ns = now_ns + self._shift_ns
        own = controller.take_imu(now_ns) if runtime.options.imu_of else None
        imu = _measured(own, runtime.reader.take_imu(predict_ns), self._shift_ns)
        return _Due(now_ns, StepInput(imu=imu, predict_ns=predict_ns))

    def _report(self, now_ns: int) -> None:
        """Tell the terminal, or the parent, how the flight goes."""
        runtime, controller = self._runtime, self._controller
        if self._parent is None:
            found = [] if controller is None else [f.line for f in controller.take_findings()]
            if runtime.output:
                if controller is not None:
                    found += self._unsent.lines(runtime.output.estimate, in_metres=runtime.agent.in_metres)
                lines = self._status.lines(runtime.output, runtime.counts, now_ns - self._begin_ns, found)
                process.print_lines(lines)
        elif runtime.counts.frames % PROGRESS_FRAMES == 0:
            self._parent.send_event("progress", frames=runtime.counts.frames, tracked=runtime.counts.tracked)


class _BaseEnd:
    """The agent's end of the link to the base: seals, the session that the base may raise, messages to the user."""

    def __init__(self, options: AgentOptions, end: ByteLink, key: bytes | None, numbers: StartNumbers | None) -> None:
        """end: the link without seals. key: None: packets are not sealed. numbers: see `_SessionFollower`."""
        self._end, self._agent = end, options.agent
        session = agent_session(options.order, options.boot)
        sealer = opener = None
        if key is not None:
            sealer = Sealer(key, options.agent, session, Direction.UP, suite_for(link_traits(options.link)))
            opener = Opener({options.agent: key}, Direction.DOWN)
        self._watch = SealWatch(Direction.UP, opener)
        self._link = SealedLink(end, options.agent, sealer, self._watch)
        self._follower = _SessionFollower(session, sealer, numbers)
        self._doubled_told = False
        self._reach = None if options.link == "none" else _BaseReach(options.link)
        self._heard = False  # since the last call of `lines`

    def receive(self) -> list[bytes]:
        """Packets that have arrived since the last call."""
        packets = self._link.receive()
        self._heard |= bool(packets)
        return packets

    def send(self, packets: Sequence[bytes], session: int) -> None:
        """Send packets of a session."""
        self._follower.follow(session)
        for packet in packets:
            self._link.send(packet)

    def lines(self, now_ns: int) -> list[str]:
        """Messages about the link and seals, and about another agent with this number, each once."""
        lines = [*link_messages(self._end), *self._watch.lines()]
        if self._reach is not None:
            lines += self._reach.lines(now_ns, heard=self._heard or bool(lines))
            self._heard = False
        if not self._doubled_told and getattr(self._end, "doubled", False):
            self._doubled_told = True
            lines.append(f"another agent has number {self._agent} too: give each its own --agent N")
        return lines


class _BaseReach:
    """Tells that no base answers, and that one does again: an agent flies on without a word from it."""

    def __init__(self, link: str) -> None:
        self._link = link
        self._heard_ns: int | None = None  # last; of a flight that begins, its begin
        self._silence_ns = _FIRST_WORD_NS
        self._silent = False

    def lines(self, now_ns: int, *, heard: bool) -> list[str]:
        """What has changed. heard: whether anything came from the base since the last call."""
        if heard or self._heard_ns is None:
            self._heard_ns = now_ns
        if heard:
            self._silence_ns = _SILENCE_NS
            self._silent, was_silent = False, self._silent
            return ["the base answers"] if was_silent else []
        if self._silent or now_ns - self._heard_ns < self._silence_ns:
            return []
        self._silent = True
        line = (
            f"no base answers at {self._link}, the flight goes on without: is one running there, does the network "
            "reach it, and is this agent paired with it? One started with --paired-only tells strangers nothing"
        )
        return [line]


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
        told = (
            "the base knows a later start of this agent: was its state folder lost or copied, or do two agents have "
            "its number (--agent N, its own for each)?"
        )
        process.print_lines([told])
