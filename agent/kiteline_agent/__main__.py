"""The onboard half as a process: a source, the agent, its log and its link, put together.

`Onboard` drives one agent step by step and serves every kind of flight: lock-step in this process (lab), lock-step
behind a barrier (`fly_lockstep`), and live on real clocks (`fly_live`).
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import time
import tomllib
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, TextIO

import cv2

from kiteline_agent.agent import Agent, Identity, StepInput, StepOutput
from kiteline_agent.alone import AloneChannel
from kiteline_agent.camera import Camera
from kiteline_agent.config import AgentConfig
from kiteline_agent.flight_log import write_step
from kiteline_agent.tally import Tally, live_line, odometry_line
from kiteline_agent.warm import warm
from kiteline_codec import warm as codec_warm
from kiteline_codec.channel import CodedChannel, RecordChannel
from kiteline_codec.sync import SyncConfig
from kiteline_core import config as configuration
from kiteline_core.frame import Frame, ImuBatch
from kiteline_core.ids import AgentId
from kiteline_hw import process
from kiteline_hw.cpu import rss_mib
from kiteline_hw.lockstep_messages import NO_MORE_FRAMES_NS, Down, Phase, Up
from kiteline_hw.mcap_log import LogWriter
from kiteline_hw.ports import FrameSource, LinkError, SourceError
from kiteline_hw.sim.link_model import LinkModel, LinkModelConfig
from kiteline_hw.sources import open_source
from kiteline_hw.zenoh_lockstep import LockstepClient

_ANSWER_S = 120.0  # s that the base may take for one tick of a lock-step flight before it counts as gone
_IDLE_TICK_S = 0.05  # s between two steps while no frame is due: keeps acknowledgements and heartbeats moving
_DRAIN_S = 5.0  # s that a live flight waits at its end for the link to become quiet
_PROGRESS_FRAMES = 10  # frames between two words to the parent; also between two looks at the memory


@dataclass(frozen=True, slots=True)
class AgentSpec:
    """All that one agent's flight is told. Plain values, so that it travels as JSON."""

    source: str
    folder: str  # for the log and the trajectories
    log_name: str = "log.mcap"
    agent: int = 0
    boot: int = 0
    link: str = "none"  # LINK, or lockstep:ENDPOINT
    mono: bool = False
    imu: bool = True
    config: str = ""  # a TOML file
    start_ns: int = 0  # the stamp that is flight time 0
    seconds: float = 0.0  # s of flight time to fly; 0: all
    up_bytes_s: int = 0  # B/s that the link takes; 0: any number
    loss: float = 0.0  # probability that a packet is lost
    disorder: float = 0.0  # probability that it is doubled, and that it is late
    seed: int = 0
    cpu_percent: float = 0.0  # of one core; 0: all of it
    mavlink: str = ""
    kill_at_s: float = -1.0  # end like a crash at this flight time
    await_base_at_s: float = -1.0  # look for a base again at this flight time


def from_json(text: str) -> AgentSpec:
    """A spec from its JSON; unknown keys are an error."""
    values: dict[str, Any] = json.loads(text)
    known = {f.name for f in fields(AgentSpec)}
    if unknown := set(values) - known:
        raise ValueError(f"unknown key in spec: {sorted(unknown)}")
    return AgentSpec(**values)


def agent_config(path: str) -> AgentConfig:
    """The configuration, with the [agent] table of a TOML file in place of the defaults. Raises ConfigError."""
    if not path:
        return AgentConfig()
    try:
        table = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise configuration.ConfigError(f"{path}: {error}") from error
    unknown = set(table) - {"agent", "base"}
    if unknown:
        raise configuration.ConfigError(f"{path}: unknown table {sorted(unknown)}; known are: agent, base")
    section = table.get("agent", {})
    if not isinstance(section, dict):
        raise configuration.ConfigError(f"{path}: [agent] is a section")
    return configuration.apply(AgentConfig(), section, "agent")


def settled(channel: RecordChannel) -> tuple[bool, bool]:
    """Whether a channel is quiet, and whether both sides were seen to hold the same."""
    if isinstance(channel, CodedChannel):
        return channel.endpoint.quiet, channel.endpoint.digest_equal
    return True, True


class Onboard:
    """One agent in flight.

    whole_process: the agent is alone in this process, so that all CPU time between two frames, decoding taken off, is
    its own; otherwise only the time inside its steps is.
    """

    def __init__(self, spec: AgentSpec, source: FrameSource, channel: RecordChannel, whole_process: bool) -> None:
        cv2.setNumThreads(1)
        self.spec = spec
        self.source = source
        self.channel = channel
        self.tally = Tally()
        self.flown: dict[str, int | float] | None = None  # the tally when the last frame had been flown
        self.cpu_ms: list[float] = []
        self.rss_mib = 0.0
        config = agent_config(spec.config)
        begin_ns = time.process_time_ns()
        codec_warm.warm()
        warm(source.rig, config)
        self.warm_ms = (time.process_time_ns() - begin_ns) / 1e6
        until_ns = spec.start_ns + round(spec.seconds * 1e9) if spec.seconds > 0 else None
        self.camera = Camera(source, until_ns, time.process_time_ns)
        self.agent = Agent(source.rig, source.imu, config, Identity(AgentId(spec.agent), spec.boot), channel)
        folder = Path(spec.folder)
        folder.mkdir(parents=True, exist_ok=True)
        self._files = ExitStack()
        self._log_shift_ns = spec.start_ns  # log time minus the time handed to the agent: logs stand in source time
        self.log = self._files.enter_context(LogWriter(folder / spec.log_name, _log_metadata(spec, source, config)))
        self.log.rig(self._log_shift_ns, source.rig, source.imu)
        self._live = self._open(folder / "live.tum")
        self._odometry = self._open(folder / "odometry.tum")
        disorder = LinkModelConfig(loss=spec.loss, duplicate=spec.disorder, reorder=spec.disorder)
        self._wire = LinkModel(disorder, spec.seed)
        self._overhead_bytes = channel.endpoint.config.overhead_bytes if isinstance(channel, CodedChannel) else 0
        self._whole = whole_process
        self._mark_ns = time.process_time_ns()
        self._decode_mark_ns = self.camera.decode_ns
        self._spent_ns = 0
        self._told_cpu_ns = 0

    def _open(self, path: Path) -> TextIO:
        return self._files.enter_context(path.open("w", buffering=1))

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
        frame = imu = None
        if self.next_ns is not None and self.next_ns <= down.now_ns:
            frame, imu = self.camera.take()
        sent = self.step(frame, imu, down.packets, down.now_ns)
        quiet, equal = settled(self.channel)
        return Up(self._next_or_end(), quiet, equal, tuple(sent))

    def frames_are_over(self) -> None:
        """What follows is draining: it is reported apart."""
        if self.flown is None:
            self.flown = self.tally.as_report()

    def _next_or_end(self) -> int:
        next_ns = self.next_ns
        return NO_MORE_FRAMES_NS if next_ns is None else next_ns

    def step(self, frame: Frame | None, imu: ImuBatch | None, packets: Sequence[bytes], now_ns: int) -> list[bytes]:
        """One step of the agent, logged and counted; the packets that leave for the wire."""
        begin_ns = time.process_time_ns()
        step_input = StepInput(frame, imu, tuple(packets), self._told_cpu_ns)
        output = self.agent.step(step_input, now_ns)
        write_step(self.log, step_input, output, now_ns, now_ns + self._log_shift_ns)
        if frame is not None:
            self._record(output)
        for packet in output.packets:
            self._wire.send(packet, now_ns)
        sent = self._wire.deliver(now_ns)
        self.tally.bytes_up += sum(map(len, output.packets)) + len(output.packets) * self._overhead_bytes
        self.tally.bytes_down += sum(map(len, packets)) + len(packets) * self._overhead_bytes
        self._account(begin_ns, frame is not None)
        return sent

    def _record(self, output: StepOutput) -> None:
        self.tally.count(output.estimate)
        if output.estimate is not None:
            self._live.write(live_line(output.estimate))
            self._odometry.write(odometry_line(output.estimate))

    def _account(self, begin_ns: int, with_frame: bool) -> None:
        end_ns = time.process_time_ns()
        self._spent_ns += end_ns - (self._mark_ns if self._whole else begin_ns)
        if self._whole:
            self._spent_ns -= self.camera.decode_ns - self._decode_mark_ns
        self._mark_ns, self._decode_mark_ns = end_ns, self.camera.decode_ns
        if not with_frame:
            return
        self.cpu_ms.append(self._spent_ns / 1e6)
        self._spent_ns = 0
        if len(self.cpu_ms) % _PROGRESS_FRAMES == 1:
            self.rss_mib = max(self.rss_mib, rss_mib())

    def report(self) -> dict[str, Any]:
        """The agent's part of report.json, with raw samples in place of statistics."""
        self.frames_are_over()
        assert self.flown is not None
        total = self.tally.as_report()
        skipped = self.source.report.skipped
        return {
            "source": self.source.name,
            **self.flown,
            "skipped": dict(sorted(skipped.items())),
            "notes": list(self.source.report.notes),
            "drain": {key: total[key] - self.flown[key] for key in ("bytes_up", "bytes_down")},
            "timing": {
                "cpu_ms_per_frame": self.cpu_ms,
                "decode_ms": self.camera.decode_ms,
                "warm_ms": round(self.warm_ms, 1),
                "rss_mib": round(self.rss_mib, 1),
            },
        }

    def close(self) -> None:
        """Finish the files."""
        self._files.close()


def _log_metadata(spec: AgentSpec, source: FrameSource, config: AgentConfig) -> dict[str, str]:
    plain = {key: value for key, value in asdict(spec).items() if key not in ("folder", "config", "link")}
    return {
        "role": "agent",
        "source": source.name,
        "spec": json.dumps(plain),
        "config": configuration.describe(config),
    }


def channel_for(spec: AgentSpec) -> RecordChannel:
    """The agent's end of the codec, or nothing where no base is meant to be. A session is the boot, counted from 1."""
    if spec.link == "none":
        return AloneChannel()
    return CodedChannel(SyncConfig(budget_bytes=spec.up_bytes_s), spec.boot + 1)


def fly_lockstep(spec: AgentSpec, parent: process.Parent, stop: process.StopSignal) -> None:
    """Fly behind the base's barrier; where the base ends, go on alone."""
    source = open_source(spec.source, mono=spec.mono, imu=spec.imu)
    onboard = Onboard(spec, source, channel_for(spec), whole_process=True)
    parent.tell("ready", frames=source.frame_count)
    line = Barrier(spec.link.removeprefix("lockstep:"), spec.agent, parent)
    try:
        up, now_ns, phase = onboard.hello(), -1, Phase.FLY
        while phase is not Phase.END and not stop:
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
                parent.tell("progress", frames=onboard.tally.frames, tracked=onboard.tally.tracked)
            if 0 <= spec.await_base_at_s * 1e9 <= now_ns and line.lost:
                parent.tell("awaiting_base")
                line.meet_again()
                up = onboard.hello()
        parent.tell("result", report={**onboard.report(), "base_lost": line.times_lost})
    finally:
        line.close()
        onboard.close()
        source.close()


class Barrier:
    """The agent's side of the barrier, that turns a base which has ended into silence."""

    def __init__(self, endpoint: str, agent: int, parent: process.Parent) -> None:
        self._endpoint, self._agent, self._parent = endpoint, agent, parent
        self._client: LockstepClient | None = LockstepClient(endpoint, agent)
        self.times_lost = 0

    @property
    def lost(self) -> bool:
        """There was a base, and there is none now."""
        return self._client is None

    def exchange(self, up: Up) -> Down | None:
        """The base's answer; None when there is no base."""
        if self._client is None:
            return None
        try:
            return Down.decode(self._client.exchange(up.encode(), _ANSWER_S))
        except LinkError as error:
            self.times_lost += 1
            self._parent.tell("base_lost", text=str(error))
            self.close()
            return None

    def meet_again(self) -> None:
        """Look for a base where the last one was. Raises LinkError when none comes."""
        self._client = LockstepClient(self._endpoint, self._agent)

    def close(self) -> None:
        """Leave the barrier."""
        if self._client is not None:
            self._client.close()
            self._client = None


def main(argv: Sequence[str] | None = None) -> int:
    """`kiteline agent`, and a child of `kiteline fly` (with --spec); the exit status."""
    a = parser().parse_args(argv)
    stop = process.StopSignal()
    if a.spec:
        spec = from_json(a.spec)
        return run_child(spec, stop)
    return 0


def run_child(spec: AgentSpec, stop: process.StopSignal) -> int:
    """Fly as a child process; an error that a user can mend ends in one line."""
    parent = process.Parent()
    try:
        fly_lockstep(spec, parent, stop)
    except (SourceError, LinkError, ValueError) as error:
        parent.tell("error", text=str(error))
        return 2
    return 0


def parser() -> argparse.ArgumentParser:
    """The arguments of `kiteline agent`."""
    p = argparse.ArgumentParser(prog="kiteline agent", description="The onboard half.")
    p.add_argument("--spec", metavar="JSON", default="", help=argparse.SUPPRESS)
    return p


if __name__ == "__main__":
    raise SystemExit(main())
