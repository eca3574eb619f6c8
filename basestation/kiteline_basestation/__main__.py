"""The base station as a process: the mapper, its log, its links and its files, put together.

`Ground` drives the station step by step and serves every kind of flight: lock-step in this process (lab), lock-step
behind a barrier (`fly_lockstep`), and live on real clocks (`fly_live`).
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import time
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import cv2

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.flight_log import write_step
from kiteline_basestation.jobs import Job, JobDone, run_job
from kiteline_basestation.outputs import counts, keyframe_poses, map_files
from kiteline_basestation.station import Station, StationOutput
from kiteline_basestation.warm import warm
from kiteline_codec import warm as codec_warm
from kiteline_codec.channel import CodedChannel, RecordChannel
from kiteline_codec.sync import SyncConfig
from kiteline_core import config as configuration
from kiteline_core.ids import AgentId
from kiteline_hw import process
from kiteline_hw.cpu import rss_mib
from kiteline_hw.lockstep_messages import NO_MORE_FRAMES_NS, Down, Phase, Up
from kiteline_hw.mcap_log import LogWriter
from kiteline_hw.ports import LinkError
from kiteline_hw.sim.link_model import LinkModel, LinkModelConfig
from kiteline_hw.zenoh_lockstep import LockstepServer

_COLLECT_S = 120.0  # s that an agent may take for one tick of a lock-step flight before it counts as gone
_DRAIN_TICK_NS = 50_000_000  # ns of flight time between two ticks after the last frame: acknowledgements go at once
_DRAIN_NS = 30_000_000_000  # ns of flight time after which a link that is still not quiet is given up
_MEMORY_STEPS = 10  # steps between two looks at the memory


@dataclass(frozen=True, slots=True)
class BaseSpec:
    """All that the base's flight is told. Plain values, so that it travels as JSON."""

    folder: str  # for the log, the map and the grid
    log_name: str = "log.mcap"
    agents: tuple[int, ...] = ()
    session: int = 1  # higher than that of any base before it
    link: str = "none"  # LINK, or lockstep:ENDPOINT
    config: str = ""  # a TOML file
    start_ns: int = 0  # the stamp that is flight time 0, so that the log stands in the time of the first source
    down_bytes_s: int = 0  # B/s that the link to each agent takes; 0: any number
    loss: float = 0.0  # probability that a packet is lost
    disorder: float = 0.0  # probability that it is doubled, and that it is late
    seed: int = 0
    kill_at_s: float = -1.0  # end like a crash at this flight time
    store: str = ""
    web: str = ""


def from_json(text: str) -> BaseSpec:
    """A spec from its JSON; unknown keys are an error."""
    values: dict[str, Any] = json.loads(text)
    known = {f.name for f in fields(BaseSpec)}
    if unknown := set(values) - known:
        raise ValueError(f"unknown key in spec: {sorted(unknown)}")
    values["agents"] = tuple(values.get("agents", ()))
    return BaseSpec(**values)


def base_config(path: str) -> BaseConfig:
    """The configuration, with the [base] table of a TOML file in place of the defaults. Raises ConfigError."""
    if not path:
        return BaseConfig()
    try:
        table = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise configuration.ConfigError(f"{path}: {error}") from error
    if unknown := set(table) - {"agent", "base"}:
        raise configuration.ConfigError(f"{path}: unknown table {sorted(unknown)}; known are: agent, base")
    section = table.get("base", {})
    if not isinstance(section, dict):
        raise configuration.ConfigError(f"{path}: [base] is a section")
    return configuration.apply(BaseConfig(), section, "base")


def settled(channel: RecordChannel) -> tuple[bool, bool]:
    """Whether a channel is quiet, and whether both sides were seen to hold the same."""
    if isinstance(channel, CodedChannel):
        return channel.endpoint.quiet, channel.endpoint.digest_equal
    return True, True


class LockstepJobs:
    """One worker in flight time: a job begins when the worker is free and is done after its modelled cost."""

    def __init__(self) -> None:
        self.cpu_ms: dict[str, list[float]] = {}
        self._waiting: list[tuple[int, JobDone]] = []
        self._free_ns = 0

    def add(self, jobs: Sequence[Job], now_ns: int) -> None:
        """Run jobs now; their results are handed out later."""
        for job in jobs:
            begin_ns = time.process_time_ns()
            done = run_job(job)
            self.cpu_ms.setdefault(job.kind, []).append((time.process_time_ns() - begin_ns) / 1e6)
            self._free_ns = max(now_ns, self._free_ns) + done.cost_ops
            self._waiting.append((self._free_ns, done))

    def due(self, now_ns: int) -> tuple[JobDone, ...]:
        """What is done by now, in order."""
        done = tuple(result for end_ns, result in self._waiting if end_ns <= now_ns)
        self._waiting = self._waiting[len(done) :]
        return done

    @property
    def idle(self) -> bool:
        """Nothing is running."""
        return not self._waiting


@dataclass(slots=True)
class Flown:
    """The base at one moment: its counts, and where its keyframes are (T_w_k as 16 numbers by keyframe id)."""

    counts: dict[str, int]
    keyframes: dict[str, list[float]]


class Ground:
    """The base in flight: a station, and to each agent a modelled link. open_channel: our end of the codec."""

    def __init__(self, spec: BaseSpec, open_channel: Callable[[AgentId], RecordChannel]) -> None:
        cv2.setNumThreads(1)
        self.spec = spec
        self.config = base_config(spec.config)
        codec_warm.warm()
        warm(self.config)
        self.station = Station(self.config, open_channel)
        self.jobs = LockstepJobs()
        self.phase = Phase.FLY
        self.now_ns = -1
        self.rss_mib = 0.0
        self.step_ms: list[float] = []
        self.drained_ns = 0
        self.digest_equal = False
        self.flown: Flown | None = None  # the base when the last frame had come
        self.agents_lost: set[int] = set()
        self._last_frame_ns = 0
        self._folder = Path(spec.folder)
        self._folder.mkdir(parents=True, exist_ok=True)
        self.log = LogWriter(self._folder / spec.log_name, _log_metadata(spec, self.config))
        model = LinkModelConfig(loss=spec.loss, duplicate=spec.disorder, reorder=spec.disorder)
        self._wires = {agent: LinkModel(model, spec.seed * 64 + 32 + agent) for agent in spec.agents}

    def turn(self, ups: Mapping[int, Up]) -> dict[int, Down]:
        """One tick of a lock-step flight: every agent's message in, the next tick and the packets for it out.

        The first call brings greetings only: nothing is stepped, the first tick is set.
        """
        if self.now_ns >= 0:
            packets = {agent: up.packets for agent, up in ups.items()}
            output = self.step(packets, self.jobs.due(self.now_ns), self.now_ns)
            self.jobs.add(output.jobs, self.now_ns)
        frames = [up.next_ns for up in ups.values() if up.next_ns != NO_MORE_FRAMES_NS]
        if frames:
            self.now_ns = min(frames)
        else:
            self._drain(ups)
        arrived = {agent: tuple(self._wires[agent].deliver(self.now_ns)) for agent in sorted(ups)}
        return {agent: Down(self.now_ns, self.phase, packets) for agent, packets in arrived.items()}

    def _drain(self, ups: Mapping[int, Up]) -> None:
        if self.phase is Phase.FLY:
            self.phase = Phase.DRAIN
            self._last_frame_ns = self.now_ns
            self.frames_are_over()
        ends = [settled(channel) for agent, channel in self.station.channels.items() if agent in ups]
        ends += [(up.quiet, up.digest_equal) for up in ups.values()]
        self.digest_equal = bool(ends) and all(equal for _, equal in ends)
        self.drained_ns = self.now_ns - self._last_frame_ns
        still = self.digest_equal and all(quiet for quiet, _ in ends) and self.station.mapper.idle and self.jobs.idle
        if not ups or still or self.drained_ns >= _DRAIN_NS:
            self.phase = Phase.END
        self.now_ns += _DRAIN_TICK_NS

    def frames_are_over(self) -> None:
        """What follows is draining: the map is written, and kept in mind, as it stands now."""
        if self.flown is None:
            self.flown = self.snapshot()
            for name, content in map_files(self.station.mapper).items():
                (self._folder / name).write_bytes(content)

    def snapshot(self) -> Flown:
        """The base as it stands."""
        poses = keyframe_poses(self.station.mapper)
        return Flown(counts(self.station.mapper), {str(k): pose.ravel().tolist() for k, pose in poses.items()})

    def step(self, packets: Mapping[int, Sequence[bytes]], done: Sequence[JobDone], now_ns: int) -> StationOutput:
        """One step of the station, logged; in lock-step what it sends waits on the modelled wires."""
        begin_ns = time.process_time_ns()
        arrived = {AgentId(agent): tuple(packets[agent]) for agent in sorted(packets)}
        output = self.station.step(arrived, done, now_ns)
        write_step(self.log, arrived, done, output, now_ns, now_ns + self.spec.start_ns)
        for agent, out in output.packets:
            wire = self._wires.get(agent)
            if wire is not None:
                for packet in out:
                    wire.send(packet, now_ns)
        self.step_ms.append((time.process_time_ns() - begin_ns) / 1e6)
        if len(self.step_ms) % _MEMORY_STEPS == 1:
            self.rss_mib = max(self.rss_mib, rss_mib())
        return output

    def report(self) -> dict[str, Any]:
        """The base's part of report.json, with raw samples in place of statistics."""
        self.frames_are_over()
        assert self.flown is not None
        return {
            **self.flown.counts,
            "digest_equal": self.digest_equal,
            "agents_lost": sorted(self.agents_lost),
            "drain": {"flight_ms": self.drained_ns // 1_000_000, **counts(self.station.mapper)},
            "timing": {
                "bundle_ms": self.jobs.cpu_ms.get("bundle", []),
                "grid_ms": self.jobs.cpu_ms.get("grid", []),
                "step_ms": self.step_ms,
                "rss_mib": round(max(self.rss_mib, rss_mib()), 1),
            },
        }

    def close(self) -> None:
        """Finish the log."""
        self.log.close()


def _log_metadata(spec: BaseSpec, config: BaseConfig) -> dict[str, str]:
    unlogged = ("folder", "config", "link", "store", "web")
    plain = {key: value for key, value in asdict(spec).items() if key not in unlogged}
    return {"role": "base", "spec": json.dumps(plain), "config": configuration.describe(config)}


def coded_channels(spec: BaseSpec) -> Callable[[AgentId], RecordChannel]:
    """Opens our end of the codec to an agent."""
    return lambda agent: CodedChannel(SyncConfig(budget_bytes=spec.down_bytes_s), spec.session)


def fly_lockstep(spec: BaseSpec, parent: process.Parent, stop: process.StopSignal) -> None:
    """Keep the barrier: step once all agents have handed in their messages. An agent that ends is left out."""
    ground = Ground(spec, coded_channels(spec))
    server = LockstepServer(spec.link.removeprefix("lockstep:"))
    try:
        parent.tell("ready")
        here = set(spec.agents)
        while ground.phase is not Phase.END and not stop:
            ups = _collect(server, here, ground, parent)
            if 0 <= spec.kill_at_s * 1e9 <= ground.now_ns:
                os.kill(os.getpid(), signal.SIGKILL)
            over = ground.flown is not None
            for agent, down in ground.turn(ups).items():
                with contextlib.suppress(LinkError):  # an agent that has ended is found missing at the next tick
                    server.answer(agent, down.encode())
            if ground.flown is not None and not over:
                parent.tell("flown", keyframes=ground.flown.keyframes)
        report = ground.report()
        parent.tell("result", report=report, keyframes=ground.snapshot().keyframes)
    finally:
        server.close()
        ground.close()


def _collect(server: LockstepServer, here: set[int], ground: Ground, parent: process.Parent) -> dict[int, Up]:
    """The messages of all agents that are still here; those that ended are taken out of `here`."""
    while here:
        try:
            return {agent: Up.decode(message) for agent, message in server.collect(here, _COLLECT_S).items()}
        except LinkError as error:
            gone = server.lost() & here or here
            here -= gone
            ground.agents_lost |= gone
            parent.tell("agents_lost", agents=sorted(gone), text=str(error))
    return {}


def main(argv: Sequence[str] | None = None) -> int:
    """`kiteline base`, and a child of `kiteline fly` (with --spec); the exit status."""
    a = parser().parse_args(argv)
    stop = process.StopSignal()
    if a.spec:
        return run_child(from_json(a.spec), stop)
    return 0


def run_child(spec: BaseSpec, stop: process.StopSignal) -> int:
    """Fly as a child process; an error that a user can mend ends in one line."""
    parent = process.Parent()
    try:
        fly_lockstep(spec, parent, stop)
    except (LinkError, ValueError) as error:
        parent.tell("error", text=str(error))
        return 2
    return 0


def parser() -> argparse.ArgumentParser:
    """The arguments of `kiteline base`."""
    p = argparse.ArgumentParser(prog="kiteline base", description="The base station.")
    p.add_argument("--spec", metavar="JSON", default="", help=argparse.SUPPRESS)
    return p


if __name__ == "__main__":
    raise SystemExit(main())
