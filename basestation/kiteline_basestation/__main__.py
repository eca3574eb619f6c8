"""The base station as a process: the mapper, its log, its links and its files, put together.

`Ground` drives the station step by step and serves every kind of flight: lock-step in this process (lab), lock-step
behind a barrier (`fly_lockstep`), and live on real clocks (`fly_live`).
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import time
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import cv2
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

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.flight_log import write_step
from kiteline_basestation.jobs import Job, JobDone, run_job
from kiteline_basestation.station import Station

_COLLECT_S = 120.0  # s that an agent may take for one tick of a lock-step flight before it counts as gone
_DRAIN_TICK_NS = 50_000_000  # ns of flight time between two ticks after the last frame: acknowledgements go at once
_DRAIN_NS = 30_000_000_000  # ns of flight time after which a link that is still not quiet is given up


@dataclass(frozen=True, slots=True)
class BaseSpec:
    """All that the base's flight is told. Plain values, so that it travels as JSON."""

    folder: str  # for the log, the map and the grid
    agents: tuple[int, ...] = ()
    session: int = 1
    link: str = "none"  # LINK, or lockstep:ENDPOINT
    config: str = ""  # a TOML file
    down_bytes_s: int = 0  # B/s that the link to each agent takes; 0: any number
    loss: float = 0.0  # probability that a packet is lost
    disorder: float = 0.0  # probability that it is doubled, and that it is late
    seed: int = 0
    kill_at_s: float = -1.0  # end like a crash at this flight time
    store: str = ""
    web: str = ""


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


class Ground:
    """The base in flight: one channel and one modelled link to each agent."""

    def __init__(self, spec: BaseSpec, channels: Mapping[int, RecordChannel]) -> None:
        cv2.setNumThreads(1)
        self.spec = spec
        self.channels = {AgentId(agent): channel for agent, channel in sorted(channels.items())}
        self.config = base_config(spec.config)
        self.station = Station(self.config, self.channels)
        self.jobs = LockstepJobs()
        self.phase = Phase.FLY
        self.now_ns = -1
        self.rss_mib = 0.0
        self.drained_ns = 0
        self.digest_equal = False
        self._last_frame_ns = 0
        self._folder = Path(spec.folder)
        self._folder.mkdir(parents=True, exist_ok=True)
        self.log = LogWriter(self._folder / spec.log_name, _log_metadata(spec, self.config))
        model = LinkModelConfig(loss=spec.loss, duplicate=spec.disorder, reorder=spec.disorder)
        self._wires = {agent: LinkModel(model, spec.seed * 64 + 32 + agent) for agent in self.channels}

    def turn(self, ups: Mapping[int, Up]) -> dict[int, Down]:
        """One tick of a lock-step flight: every agent's message in, the next tick and the packets for it out.

        The first call brings greetings only: nothing is stepped, the first tick is set.
        """
        if self.now_ns >= 0:
            self.step({agent: up.packets for agent, up in ups.items()}, self.now_ns)
        frames = [up.next_ns for up in ups.values() if up.next_ns != NO_MORE_FRAMES_NS]
        if frames:
            self.now_ns = min(frames)
        else:
            self._drain(ups)
        packets = {agent: tuple(self._wires[AgentId(agent)].deliver(self.now_ns)) for agent in ups}
        return {agent: Down(self.now_ns, self.phase, packets[agent]) for agent in ups}

    def _drain(self, ups: Mapping[int, Up]) -> None:
        if self.phase is Phase.FLY:
            self.phase = Phase.DRAIN
            self._last_frame_ns = self.now_ns
        ends = [settled(channel) for agent, channel in self.channels.items() if agent in ups]
        ends += [(up.quiet, up.digest_equal) for up in ups.values()]
        self.digest_equal = bool(ends) and all(equal for _, equal in ends)
        self.drained_ns = self.now_ns - self._last_frame_ns
        if not ups or (self.jobs.idle and all(quiet and equal for quiet, equal in ends)) or self.drained_ns >= _DRAIN_NS:
            self.phase = Phase.END
        self.now_ns += _DRAIN_TICK_NS

    def step(self, packets: Mapping[int, Sequence[bytes]], now_ns: int) -> None:
        """One step of the station; what it sends waits on the wires."""
        done = self.jobs.due(now_ns)
        arrived = {AgentId(agent): tuple(packets[agent]) for agent in sorted(packets)}
        output = self.station.step(arrived, done, now_ns)
        write_step(self.log, arrived, done, output, now_ns, now_ns + self.spec.start_ns)
        for agent, out in output.packets.items():
            for packet in out:
                self._wires[agent].send(packet, now_ns)
        self.jobs.add(output.jobs, now_ns)
