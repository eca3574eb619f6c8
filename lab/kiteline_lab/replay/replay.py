"""`kiteline replay LOG`: run an agent or a base again from its log, and compare what comes out."""

from __future__ import annotations

import argparse
import json
import tempfile
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.runtime import flight_log as agent_log
from kiteline_agent.runtime.frame_counts import FrameCounts, live_line, odometry_line
from kiteline_agent.runtime.options import AgentOptions
from kiteline_agent.runtime.warm import warm as agent_warm
from kiteline_agent.step import Identity, StepInput
from kiteline_basestation.config import BaseConfig
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import Job
from kiteline_basestation.runtime import flight_log as base_log
from kiteline_basestation.runtime.base_runtime import load_vocabulary
from kiteline_basestation.runtime.options import BaseOptions
from kiteline_basestation.runtime.warm import warm as base_warm
from kiteline_basestation.station import Station
from kiteline_basestation.store.restore import restore
from kiteline_basestation.store.saved_map import unpack
from kiteline_codec.channel import RecordChannel, coded_channel
from kiteline_codec.transport.seal import seal_bytes, suite_for
from kiteline_core import config as configuration
from kiteline_core.frame import EncodedImage, ImuBatch, OdometryBatch
from kiteline_core.ids import AgentId
from kiteline_hw.logs.mcap_log import DEPTH, LEFT, RIG, RIGHT, LogMessage, LogReader, read_frame
from kiteline_hw.logs.mcap_repair import REPAIRED
from kiteline_hw.logs.rig_json import rig_from_json
from kiteline_hw.logs.spill_file import SpillFile
from kiteline_hw.ports import SourceError
from kiteline_hw.system.vocabulary import shipped_vocabulary
from kiteline_lab.flights.progress import Progress


@dataclass(slots=True)
class Step:
    """One logged step: its /step record, and the messages that belong to it by topic, in order."""

    number: int
    head: Mapping[str, Any]
    messages: dict[str, list[LogMessage]] = field(default_factory=dict)

    def of(self, topic: str) -> list[LogMessage]:
        """The messages of a topic."""
        return self.messages.get(topic, [])

    def blobs(self, topic: str) -> tuple[bytes, ...]:
        """The opaque bytes of a topic."""
        return tuple(message.blob() for message in self.of(topic))


@dataclass(slots=True)
class Replayed:
    """What a replay came to. difference: the first one in words, None when there was none."""

    steps: int = 0
    difference: str | None = None
    tally: FrameCounts = field(default_factory=FrameCounts)
    live: list[str] = field(default_factory=list)
    odometry: list[str] = field(default_factory=list)

    def differs(self, step: Step, what: str) -> None:
        """Note the first difference."""
        if self.difference is None:
            self.difference = f"step {step.number} at {step.head['now_ns'] / 1e9:.3f} s: {what}"


def steps(log: LogReader) -> Iterator[Step]:
    """The steps of a log, in order; what a cut has left of the last one is passed over when it is not whole."""
    step: Step | None = None
    number = 0
    for message in log.messages():
        if message.topic == agent_log.STEP:
            if step is not None:
                yield step
            step = Step(number, message.json())
            number += 1
        elif step is not None:
            step.messages.setdefault(message.topic, []).append(message)
    if step is not None and log.cut is None and REPAIRED not in log.metadata:
        yield step


def replay_agent(log: LogReader, progress: Progress | None = None, stop_at_first: bool = True) -> Replayed:
    """Fly an agent again. Raises SourceError for a log that cannot be replayed."""
    spec = spec_of_log(log)
    rig_message = next(log.messages((RIG,)), None)
    if rig_message is None:
        raise SourceError("this log holds no calibration on /rig: it was cut at its beginning, or is no agent's")
    rig, imu = rig_from_json(rig_message.json())
    config = configuration.apply(AgentConfig(), tomllib.loads(log.metadata["config"]))
    kind = log.metadata.get("channel", "")
    if kind == "PlainChannel":
        raise SourceError("this is a monolith's log: what its base handed over was no packet, and is not in it")
    channel: RecordChannel = NoBaseChannel()
    if kind == "CodedChannel":
        spill = SpillFile(Path(tempfile.gettempdir())) if spec["log_name"] else None
        channel = channel_of_log(spec, spec["boot"] + 1, spec["up_bytes_s"], spill, bounded=True)
    agent = Agent(rig, imu, config, Identity(AgentId(spec["agent"]), spec["boot"]), channel, shipped_vocabulary())
    out = Replayed()
    for step in steps(log):
        frame = batch = None
        if step.head["frame_ns"] is not None:
            images: list[EncodedImage] = [m.image() for topic in (LEFT, RIGHT, DEPTH) for m in step.of(topic)]
            frame = read_frame(images, step.head["frame_ns"], bool(step.of(DEPTH)))
        if step.head["imu"]:
            batch = _imu(step)
        driven = _odometry(step) if step.head.get("odometer") else None
        given = StepInput(frame, batch, step.blobs(agent_log.PACKETS_IN), step.head["cpu_ns"], driven)
        output = agent.step(given, step.head["now_ns"])
        logged = [m.json() for m in step.of(agent_log.ESTIMATE)]
        made = [] if output.estimate is None else [agent_log.estimate_to_json(output.estimate)]
        for a, b in zip(logged, made):
            wrong = [name for name in a.keys() | b.keys() if a.get(name) != b.get(name)]
            if wrong:
                out.differs(step, f"the estimate has another {', '.join(sorted(wrong))}")
        if len(logged) != len(made):
            out.differs(step, f"{len(made)} estimates, {len(logged)} in the log")
        _compare_packets(out, step, agent_log.PACKETS_OUT, output.packets)
        if frame is not None:
            out.tally.count(output.estimate)
            if output.estimate is not None:
                out.live.append(live_line(output.estimate))
                out.odometry.append(odometry_line(output.estimate))
        out.steps += 1
        if progress is not None:
            progress.update(out.steps)
        if out.difference is not None and stop_at_first:
            break
    return out


def _imu(step: Step) -> ImuBatch:
    batches = step.of(agent_log.IMU)
    if len(batches) != 1:
        raise SourceError(f"step {step.number} of the log has {len(batches)} inertial batches, its head says one")
    return batches[0].imu()


def _odometry(step: Step) -> OdometryBatch:
    batches = step.of(agent_log.ODOMETER)
    if len(batches) != 1:
        raise SourceError(f"step {step.number} of the log has {len(batches)} batches of odometry, its head says one")
    return batches[0].odometry()


def channel_of_log(
    spec: dict[str, Any], session: int, budget_bytes: int, spill: SpillFile | None = None, bounded: bool = False
) -> RecordChannel:
    """One end of the codec as it was in flight."""
    link = spec.get("link", "")
    sealed = seal_bytes(suite_for(link + ":")) if spec.get("key") else 0
    return coded_channel(session, budget_bytes, spec.get("profile", ""), sealed, link, spill, bounded)


def replay_base(log: LogReader, progress: Progress | None = None, stop_at_first: bool = True) -> Replayed:
    """Run a base again. Raises SourceError for a log that cannot be replayed."""
    spec = spec_of_log(log)
    config = configuration.apply(BaseConfig(), tomllib.loads(log.metadata["config"]))
    if log.metadata.get("channel") == "PlainChannel":
        raise SourceError("this is a monolith's log: what its agents handed over was no packet, and is not in it")
    station = Station(
        config, lambda agent: channel_of_log(spec, spec["session"], spec["down_bytes_s"]), load_vocabulary()
    )
    jobs: dict[int, Job] = {}
    out = Replayed()
    for kept in log.messages((base_log.RESTORED,)):
        restore(station, unpack(kept.blob()), kept.t_ns - spec["start_ns"])
    for step in steps(log):
        packets = {AgentId(int(a)): step.blobs(base_log.packets_in(int(a))) for a in step.head["agents"]}
        done = []
        for number, logged in zip(step.head["done"], step.of(base_log.JOB)):
            result = run_job(jobs.pop(number))
            if base_log.fingerprint(result) != logged.json()["result"]:
                out.differs(step, f"job {number} has another result")
            done.append(result)
        orders = base_log.read_orders([*step.of(base_log.IMPORT), *step.of(base_log.COMMAND)])
        output = station.step(packets, done, step.head["now_ns"], orders)
        jobs.update({job.id: job for job in output.jobs})
        if [[job.id, job.kind] for job in output.jobs] != step.head["jobs"]:
            out.differs(step, "other jobs")
        told = [{"id": a.id, "ok": a.ok, "text": a.text} for a in output.answers]
        if told != [message.json() for message in step.of(base_log.ANSWER)]:
            out.differs(step, "other answers")
        for agent, sent in output.packets:
            _compare_packets(out, step, base_log.packets_out(agent), sent)
        out.steps += 1
        if progress is not None:
            progress.update(out.steps)
        if out.difference is not None and stop_at_first:
            break
    return out


def _compare_packets(out: Replayed, step: Step, topic: str, made: tuple[bytes, ...]) -> None:
    logged = step.blobs(topic)
    if logged != made:
        first = next((i for i, (a, b) in enumerate(zip(logged, made)) if a != b), min(len(logged), len(made)))
        out.differs(step, f"{topic}: {len(made)} packets, {len(logged)} in the log, the first that differs is {first}")


def spec_of_log(log: LogReader) -> dict[str, Any]:
    known: dict[str, Any] = {}
    if log.metadata.get("role") == "agent":
        fields = AgentOptions.__dataclass_fields__
        known = {name: fields[name].default for name in ("up_bytes_s", "log_name")}
    elif log.metadata.get("role") == "base":
        known = {"down_bytes_s": BaseOptions.__dataclass_fields__["down_bytes_s"].default}
    else:
        raise SourceError("no log of an agent or a base: a recording is flown with `kiteline fly`, not replayed")
    return {**known, **json.loads(log.metadata["spec"])}


def main(argv: list[str]) -> int:
    """Run `kiteline replay`; 1 when --verify found a difference."""
    p = argparse.ArgumentParser(
        prog="kiteline replay",
        description="Run an agent or a base again from its log: the same inputs go through the same steps.",
    )
    p.add_argument("log", metavar="LOG", type=Path, help="agentN/log.mcap or base/log.mcap of a flight")
    p.add_argument(
        "--verify", action="store_true", help="compare all packets and estimates bit for bit; exit 1 where one differs"
    )
    p.add_argument(
        "--cpu", metavar="PERCENT", type=float, default=0.0, help="fly the log's frames anew with so much of one core"
    )
    p.add_argument(
        "--virtual", action="store_true", help="with --cpu: the modelled core, also where the kernel could limit us"
    )
    p.add_argument("--out", metavar="DIR", type=Path, help="leave trajectories here")
    a = p.parse_args(argv)
    if a.cpu:
        from kiteline_lab.replay.replay_cpu import refly

        return refly(a.log, a.cpu, a.out, a.virtual)
    cv2.setNumThreads(1)
    agent_warm()
    base_warm()
    with LogReader(a.log) as log, Progress("replaying", log.topics.get(agent_log.STEP), "steps") as progress:
        is_agent = log.metadata.get("role") == "agent"
        done = (replay_agent if is_agent else replay_base)(log, progress, stop_at_first=a.verify)
        cut = log.cut or log.metadata.get(REPAIRED)
    if a.out is not None and is_agent:
        a.out.mkdir(parents=True, exist_ok=True)
        (a.out / "live.tum").write_text("".join(done.live))
        (a.out / "odometry.tum").write_text("".join(done.odometry))
    if cut is not None:
        print(f"the log was {cut}; what stands before was replayed")
    if done.difference is not None:
        print(f"differs: {done.difference}")
        return 1 if a.verify else 0
    print(
        f"{done.steps} steps" + (f", {done.tally.frames} frames" if is_agent else "") + ": every output as in the log"
    )
    return 0
