"""The onboard half as a process: a source, the agent, its log and its link, put together.

`Onboard` drives one agent step by step and serves every kind of flight: lock-step in this process (lab), lock-step
behind a barrier (`fly_lockstep`), and live on real clocks (`fly_live`).
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.governor.cost_model import cost_ns
from kiteline_agent.governor.cpu_account import CpuAccount
from kiteline_agent.governor.virtual_cpu import VirtualCpu
from kiteline_agent.runtime.flight_record import FlightRecord, metadata
from kiteline_agent.runtime.frame_counts import FrameCounts
from kiteline_agent.runtime.frame_reader import FrameReader
from kiteline_agent.runtime.options import (
    AgentOptions,
    agent_config,
    channel_for,
    options_of,
    parser,
)
from kiteline_agent.runtime.terminal import StatusMessages, summary
from kiteline_agent.runtime.warm import warm
from kiteline_agent.step import Identity, StepInput, StepOutput
from kiteline_codec import warm as codec_warm
from kiteline_codec.channel import CodedChannel, RecordChannel, settled
from kiteline_codec.transport.framing import StreamFramer
from kiteline_codec.transport.seal import Direction, Opener, Sealer, suite_for
from kiteline_core import config as configuration
from kiteline_core.frame import Frame, ImuBatch, OdometryBatch
from kiteline_core.ids import AgentId
from kiteline_hw.links.kinds import MAVLINK_FORMS, link_forms
from kiteline_hw.links.open import open_link
from kiteline_hw.links.sealed_link import SealedLink
from kiteline_hw.lockstep.agent_end import AgentBarrier
from kiteline_hw.lockstep.messages import NO_MORE_FRAMES_NS, Down, Phase, Up
from kiteline_hw.logs.mcap_log import LogWriter
from kiteline_hw.logs.spill_file import SpillFile
from kiteline_hw.ports import ByteLink, ControllerLink, FrameSource, LinkError, PoseSample, SourceError
from kiteline_hw.sim.links.link_model import LinkModel, LinkModelConfig
from kiteline_hw.sources.kinds import source_forms
from kiteline_hw.sources.open import open_source
from kiteline_hw.sources.overrides import with_other_imu
from kiteline_hw.system import kernel_cache, process
from kiteline_hw.system.clock import MonotonicClock
from kiteline_hw.system.cpu import CpuQuota
from kiteline_hw.system.key_store import read_keys
from kiteline_hw.system.memory import release_memory, rss_mib
from kiteline_hw.system.vocabulary import shipped_vocabulary

_IDLE_TICK_S = 0.05  # s between two steps while no frame is due: keeps acknowledgements and heartbeats moving
_DRAIN_S = 10.0  # s that a live flight waits at its end for the link to become quiet
_QUIET_S = 1.0  # s that it has to stay so: the base may still be working on the last keyframe
_PROGRESS_FRAMES = 10  # frames between two words to the parent; also between two looks at the memory


class Onboard:
    """One agent in flight.

    whole_process: the agent is alone in this process, so that all CPU time between two frames, decoding taken off, is
    its own; otherwise only the time inside its steps is.
    """

    def __init__(self, spec: AgentOptions, source: FrameSource, channel: RecordChannel, whole_process: bool) -> None:
        cv2.setNumThreads(1)
        self.spec = spec
        self.source = source
        self.channel = channel
        self.tally = FrameCounts()
        self.flown: dict[str, int | float] | None = None  # the tally when the last frame had been flown
        self.rss_mib = 0.0
        config = agent_config(spec.config, spec.cpu_percent)
        if whole_process:
            kernel_cache.fill("kiteline_agent.runtime.warm")
        begin_ns = time.process_time_ns()
        codec_warm.warm()
        warm(source.rig, config)
        if whole_process:
            release_memory()
        self.warm_s = (time.process_time_ns() - begin_ns) / 1e9
        until_ns = spec.start_ns + round(spec.seconds * 1e9) if spec.seconds > 0 else None
        self.camera = FrameReader(source, until_ns, time.process_time_ns)
        self._files = ExitStack()
        self._log_shift_ns = spec.start_ns  # log time minus the time handed to the agent: logs stand in source time
        self._record = self._open_record(config) if spec.log_name else None
        self.agent = Agent(
            source.rig, source.imu, config, Identity(AgentId(spec.agent), spec.boot), channel, shipped_vocabulary()
        )
        disorder = LinkModelConfig(
            loss=spec.loss, duplicate=spec.disorder, reorder=spec.disorder, delay_ns=round(spec.delay_s * 1e9)
        )  # fmt: skip
        self._wire = LinkModel(disorder, spec.seed)
        self._overhead_bytes = channel.endpoint.config.overhead_bytes if isinstance(channel, CodedChannel) else 0
        self._account = CpuAccount(time.process_time_ns, self.camera, whole_process)
        self._told_cpu_ns = 0  # what the last frame cost: modelled in lock-step, measured in a live flight
        self._live_clock = False
        self._core = VirtualCpu(spec.cpu_percent)
        self.output: StepOutput | None = None  # of the last step

    def _open_record(self, config: AgentConfig) -> FlightRecord:
        spec, source = self.spec, self.source
        folder = Path(spec.folder)
        folder.mkdir(parents=True, exist_ok=True)
        about = metadata(spec, source.name, config, self.channel)
        log = self._files.enter_context(LogWriter(folder / spec.log_name, about))
        log.rig(self._log_shift_ns, source.rig, source.imu)
        log.flush()  # an agent that dies at once leaves a log that can be read
        live, odometry = (
            self._files.enter_context((folder / name).open("w", buffering=1)) for name in ("live.tum", "odometry.tum")
        )
        return FlightRecord(log, live, odometry, spec.agent, self.channel)

    @property
    def next_ns(self) -> int | None:
        """Flight time of the next frame; None after the last."""
        stamp = self.camera.next_ns
        return None if stamp is None else stamp - self.spec.start_ns

    def hello(self) -> Up:
        """The first word at the barrier."""
        return Up(self._next_or_end(), False, False, ())

    def turn(self, down: Down) -> Up:
        """One tick of a lock-step flight: the base's packets, then the frame that is due, if one is."""
        if down.phase is not Phase.FLY:
            self.frames_are_over()
        frame = imu = driven = None
        if self.next_ns is not None and self.next_ns <= down.now_ns:
            if self._core.newest_wins(self.next_ns, self.camera.period_ns):
                self.camera.drop()
                self.tally.dropped += 1
            else:
                frame, imu, driven = self.camera.take()
        sent = self.step(frame, imu, down.packets, down.now_ns, driven)
        quiet, equal = settled(self.channel)
        return Up(self._next_or_end(), quiet, equal, tuple(sent))

    def begin_at(self, begin_ns: int) -> None:
        """A live flight begins: `begin_ns` of its clock is flight time 0."""
        assert self.camera.next_ns is not None
        self._live_clock = True
        self.spec = replace(self.spec, start_ns=self.camera.next_ns)
        self._log_shift_ns = self.spec.start_ns - begin_ns

    def drop_stale(self, flight_ns: int) -> bool:
        """Pass over frames until the next one is the newest there is at a flight time; whether one is left."""
        while self.next_ns is not None and 0 < self.camera.period_ns <= flight_ns - self.next_ns:
            self.camera.drop()
            self.tally.dropped += 1
        return self.next_ns is not None

    def frames_are_over(self) -> None:
        """What follows is draining: it is reported apart."""
        if self.flown is None:
            self.flown = self.tally.as_report()

    def _next_or_end(self) -> int:
        next_ns = self.next_ns
        return NO_MORE_FRAMES_NS if next_ns is None else next_ns

    def step(
        self, frame: Frame | None, imu: ImuBatch | None, packets: Sequence[bytes], now_ns: int,
        driven: OdometryBatch | None = None,
    ) -> list[bytes]:  # fmt: skip
        """One step of the agent, logged and counted; the packets that leave for the wire."""
        self._account.begin()
        step_input = StepInput(frame, imu, tuple(packets), self._told_cpu_ns, driven)
        self.output = output = self.agent.step(step_input, now_ns)
        if self._record is not None:
            self._record.step(step_input, output, now_ns, now_ns + self._log_shift_ns)
        if frame is not None:
            self.tally.count(output.estimate)
            if output.estimate is not None and self._record is not None:
                self._record.pose(output.estimate)
            if not self._live_clock:
                ops = cost_ns(self.agent.work)
                self._core.spend(ops, now_ns)
                self._told_cpu_ns = ops
        for packet in output.packets:
            self._wire.send(packet, now_ns)
        sent = self._wire.deliver(now_ns)
        self.tally.bytes_up += sum(map(len, output.packets)) + len(output.packets) * self._overhead_bytes
        self.tally.bytes_down += sum(map(len, packets)) + len(packets) * self._overhead_bytes
        self._account.end(frame is not None)
        if frame is not None and self._live_clock:
            self._told_cpu_ns = self._account.last_ns
        if frame is not None and len(self._account.ms) % _PROGRESS_FRAMES == 1:
            self.rss_mib = max(self.rss_mib, rss_mib())
        return sent

    def report(self) -> dict[str, Any]:
        """The agent's part of report.json, with raw samples in place of statistics."""
        self.frames_are_over()
        assert self.flown is not None
        total = self.tally.as_report()
        skipped = self.source.report.skipped
        return {
            "source": self.source.name,
            **self.flown,
            "link": self.channel.report() if isinstance(self.channel, CodedChannel) else {},
            "skipped": dict(sorted(skipped.items())),
            "notes": list(self.source.report.notes),
            "scale": "metric" if self.agent.metric else "own",
            "time_offset": self.agent.time_offset_report(),
            "odometer": self.agent.odometer_report(),
            "drain": {key: total[key] - self.flown[key] for key in ("bytes_up", "bytes_down")},
            "timing": {
                "cpu_ms_per_frame": self._account.ms,
                "decode_ms": self.camera.decode_ms,
                "warm_up_s": round(self.warm_s, 3),
                "rss_mib": round(self.rss_mib, 1),
            },
        }

    def close(self) -> None:
        """Finish the files."""
        self._files.close()


def _spill(spec: AgentOptions) -> SpillFile | None:
    """Where shared values wait while the link is down: beside the log, where one is kept."""
    return SpillFile(Path(spec.folder)) if spec.log_name else None


def fly_lockstep(spec: AgentOptions, parent: process.Parent) -> None:
    """Fly behind the base's barrier; where the base ends, go on alone."""
    source = open_source(spec.source, mono=spec.mono, imu=spec.imu)
    onboard = Onboard(spec, source, channel_for(spec, _spill(spec)), whole_process=True)
    parent.send_event("ready", frames=source.frame_count)
    line = AgentBarrier(spec.link.removeprefix("lockstep:"), spec.agent, parent)
    try:
        up, now_ns, phase = onboard.hello(), -1, Phase.FLY
        while phase is not Phase.END:
            down = line.exchange(up)
            if down is None:
                if onboard.next_ns is None:
                    break
                down = Down(onboard.next_ns, Phase.FLY, ())
            now_ns, phase = down.now_ns, down.phase
            if 0 <= spec.kill_at_s * 1e9 <= now_ns:
                os.kill(os.getpid(), signal.SIGKILL)
            if phase is Phase.END:
                break
            up = onboard.turn(down)
            if onboard.tally.frames % _PROGRESS_FRAMES == 0:
                parent.send_event("progress", frames=onboard.tally.frames, tracked=onboard.tally.tracked)
            if line.lost and (spec.await_bases or 0 <= spec.await_base_at_s * 1e9 <= now_ns):
                parent.send_event("awaiting_base")
                line.reconnect()
                up = onboard.hello()
        parent.send_event("result", report={**onboard.report(), "base_lost": line.times_lost})
    finally:
        line.close()
        onboard.close()
        source.close()


def fly_live(spec: AgentOptions, parent: process.Parent | None, stop: process.StopSignal) -> None:
    """Fly on real clocks: frames are paced by their stamps, the newest wins, and the tracker waits for nobody."""
    source = open_source(spec.source, mono=spec.mono, imu=spec.imu)
    with ExitStack() as stack:
        stack.callback(source.close)
        source = _with_imu(spec, source)
        onboard = Onboard(spec, source, channel_for(spec, _spill(spec)), whole_process=True)
        stack.callback(onboard.close)
        link = open_link(spec.link, "agent", spec.agent, framer=StreamFramer, required=False)
        stack.callback(link.close)
        if spec.key:
            link = _sealed(spec, link)
        clock = MonotonicClock()
        sink = _pose_sink(spec, source, clock, stack)
        if spec.cpu_percent > 0.0:
            stack.enter_context(CpuQuota(spec.cpu_percent)).add(os.getpid())
        if parent is not None:
            parent.send_event("ready", frames=source.frame_count)
        process.notify("READY=1")
        narrator = StatusMessages()
        if parent is None:
            process.print_lines([f"flying {source.name}, {_link_words(spec)}"])
        begin_ns = clock.now_ns()
        onboard.begin_at(begin_ns)
        if sink is not None:
            sink.take_imu(begin_ns)  # what was felt before the flight
        shift_ns = onboard.spec.start_ns - begin_ns
        while not stop and onboard.next_ns is not None:
            wait_s = (begin_ns + onboard.next_ns - clock.now_ns()) / 1e9
            if wait_s > 0.0 and stop.wait(min(wait_s, _IDLE_TICK_S)):
                break
            now_ns = clock.now_ns()
            frame = imu = driven = None
            if now_ns >= begin_ns + onboard.next_ns:
                if not onboard.drop_stale(now_ns - begin_ns):
                    break
                captured_ns = begin_ns + onboard.next_ns
                frame, imu, driven = onboard.camera.take()
                told = None if sink is None else sink.take_odometry(captured_ns)
                driven = driven if told is None else replace(told, t_ns=told.t_ns + shift_ns)
                felt = None if sink is None else sink.take_imu(captured_ns)  # late ones come with the next frame
                imu = imu if felt is None else replace(felt, t_ns=felt.t_ns + shift_ns)
            for packet in onboard.step(frame, imu, link.receive(), now_ns, driven):
                link.send(packet)
            e = onboard.output.estimate if onboard.output is not None else None
            if sink is not None and e is not None and e.T_l_b is not None:
                quality = onboard.agent.odometry_quality(e)
                sink.push(PoseSample(captured_ns, e.T_l_b, e.tracked, quality, spec.boot, e.cov_l), clock.now_ns())
            process.notify("WATCHDOG=1")
            if parent is None:
                process.print_lines(
                    narrator.lines(onboard.output, onboard.tally, now_ns - begin_ns) if onboard.output else ()
                )
            elif onboard.tally.frames % _PROGRESS_FRAMES == 0:
                parent.send_event("progress", frames=onboard.tally.frames, tracked=onboard.tally.tracked)
        if parent is None:
            process.print_lines([f"over: {summary(onboard.tally)}"])
        _drain_live(onboard, link, clock, parent, stop)
        if parent is not None:
            parent.send_event("result", report=onboard.report())


def _link_words(spec: AgentOptions) -> str:
    return "without a link" if spec.link == "none" else f"the base at {spec.link}"


def _sealed(spec: AgentOptions, link: ByteLink) -> ByteLink:
    """The link with its packets sealed. Raises LinkError without a key for this agent."""
    keys = read_keys(Path(spec.key))
    if spec.agent not in keys:
        raise LinkError(f"{spec.key} has no key for agent {spec.agent}; `kiteline keys new {spec.agent}` makes one")
    key = {spec.agent: keys[spec.agent]}
    sealer = Sealer(key[spec.agent], spec.agent, spec.boot + 1, Direction.UP, suite_for(spec.link))
    return SealedLink(link, spec.agent, sealer, Opener(key, Direction.DOWN))


def _drain_live(
    onboard: Onboard, link: ByteLink, clock: MonotonicClock, parent: process.Parent | None, stop: process.StopSignal
) -> None:
    """After the last frame: until both sides were seen to hold the same, or patience ends."""
    onboard.frames_are_over()
    if parent is not None:
        parent.send_event("frames_over")
    now_ns = quiet_ns = clock.now_ns()
    end_ns = now_ns + round(_DRAIN_S * 1e9)
    while not stop and now_ns < end_ns and now_ns - quiet_ns < _QUIET_S * 1e9:
        stop.wait(_IDLE_TICK_S / 2)
        now_ns = clock.now_ns()
        for packet in onboard.step(None, None, link.receive(), now_ns):
            link.send(packet)
        if not all(settled(onboard.channel)):
            quiet_ns = now_ns
        process.notify("WATCHDOG=1")


def _pose_sink(
    spec: AgentOptions, source: FrameSource, clock: MonotonicClock, stack: ExitStack
) -> ControllerLink | None:
    """The flight controller that gets poses, if any. Raises LinkError."""
    if not spec.mavlink:
        if spec.odometry:
            raise LinkError("--odometry takes velocities from a flight controller: expected --mavlink URL beside it")
        return None
    from kiteline_hw.mavlink.connect import connect

    own = agent_config(spec.config).controller_imu
    return stack.enter_context(
        connect(
            spec.mavlink, source.rig, spec.axes, clock, odometry=spec.odometry,
            imu_rate_hz=own.noise.rate_hz if spec.imu_of else 0.0,
            body_is_controller=bool(spec.imu_of and own.T_f_c), report=source.report,
        )
    )  # fmt: skip


def _with_imu(spec: AgentOptions, source: FrameSource) -> FrameSource:
    """The source, with the flight controller's IMU in place of its own where that is asked for. Raises LinkError."""
    if not spec.imu_of:
        return source
    if spec.imu_of != "controller" or not spec.mavlink:
        raise LinkError("--imu controller takes a flight controller's samples: expected --mavlink URL beside it")
    if not spec.imu:
        raise LinkError("--imu controller and --no-imu: expected one of them")
    own = agent_config(spec.config).controller_imu
    if not own.T_f_c and not (source.rig.has_body and spec.axes):
        raise LinkError(
            f"--imu controller: nobody says where the camera of {source.name} sits in the vehicle: expected T_f_c, the "
            "camera in the flight controller's frame, in [agent.controller_imu] of --config (or --axes, for a source "
            "that knows its body)"
        )
    return with_other_imu(source, own.noise, own.camera())


def main(argv: Sequence[str] | None = None) -> int:
    """`kiteline agent`, and a child of `kiteline fly` (with --spec); the exit status."""
    p = parser(f"SOURCE is {source_forms()}. LINK is {link_forms()}. URL is {MAVLINK_FORMS}.")
    a = p.parse_args(argv)
    if a.spec:
        spec = configuration.from_json(AgentOptions, a.spec)
        expected = (SourceError, LinkError, ValueError)
        process.exit_now(process.run_child(spec.link, partial(fly_lockstep, spec), partial(fly_live, spec), expected))
    if not a.source:
        p.error("a SOURCE is required")
    folder = (Path(a.log) if a.log else process.state_folder()) / f"agent{a.agent}"
    spec = options_of(a, folder, process.next_number(folder / "boot"))
    fly_live(spec, None, process.StopSignal())
    process.exit_now(0)


if __name__ == "__main__":
    raise SystemExit(main())
