"""The base's steps in its log: inputs, then outputs. Pure: the caller passes the log.

Each step begins with a /step record. Only the fingerprint of a job's result is logged: a replay runs the job again and
passes the result at the same step.
"""

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, fields, is_dataclass
from typing import Any, Protocol

import numpy as np

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.job_kinds import run_job
from kiteline_basestation.jobs import Job, JobDone, set_aside
from kiteline_basestation.management import Command
from kiteline_basestation.runtime.options import BaseOptions, coded_channels
from kiteline_basestation.station import Import, Station, StationOutput
from kiteline_basestation.store.saved_map import SavedMap, SavedValues, pack, unpack
from kiteline_codec.transport.link_traits import LinkTraits
from kiteline_core import config as configuration
from kiteline_core.ids import AgentId
from kiteline_core.places.place_index import Vocabulary

STEP, JOB, RESTORED, IMPORT, COMMAND, ANSWER = "/step", "/job", "/restored", "/import", "/command", "/answer"


def metadata_of(spec: BaseOptions, config: BaseConfig, *, plain_channels: bool) -> dict[str, str]:
    """Metadata of a log that a replay needs."""
    unlogged = (
        "folder",
        "config",
        "store",
        "imports",
        "web",
        "maps",
        "quiet",
        "log_mib",
        "log_optional",
        "paired_only",
        "workers",
    )
    plain = {key: value for key, value in asdict(spec).items() if key not in unlogged}
    plain["link"] = spec.link.partition(":")[0]  # the kind decides how packets are made, the address does not
    channel = "PlainChannel" if plain_channels else "CodedChannel"
    return {"role": "base", "channel": channel, "spec": json.dumps(plain), "config": configuration.describe(config)}


def station_of(
    metadata: Mapping[str, str], words: Vocabulary | None, link_traits: Callable[[str], LinkTraits]
) -> Station:
    """A station as the one of a base's log was. link_traits: of a kind of link."""
    config = configuration.of_log(BaseConfig(), metadata["config"])
    logged = {k: v for k, v in json.loads(metadata["spec"]).items() if k in BaseOptions.__dataclass_fields__}
    spec = configuration.from_json(BaseOptions, json.dumps({"folder": "", **logged}))
    return Station(config, coded_channels(spec, link_traits(spec.link)), words)


class StepLog(Protocol):
    """What writes a log, such as kiteline_hw LogWriter."""

    def blob(self, topic: str, t_ns: int, data: bytes) -> None: ...
    def json(self, topic: str, t_ns: int, value: object) -> None: ...


class StepMessage(Protocol):
    """A message of a log, such as kiteline_hw LogMessage."""

    @property
    def topic(self) -> str: ...
    def blob(self) -> bytes: ...
    def json(self) -> Any: ...


def packets_in(agent: int) -> str:
    """Topic of the packets from an agent."""
    return f"/agent{agent}/packets/in"


def packets_out(agent: int) -> str:
    """Topic of the packets to an agent."""
    return f"/agent{agent}/packets/out"


def write_step(
    log: StepLog,
    packets: Mapping[AgentId, Sequence[bytes]],
    done: Sequence[JobDone],
    output: StationOutput,
    now_ns: int,
    log_ns: int,
    orders: Sequence[Import | Command] = (),
) -> None:
    """Write one step. now_ns: the step's time. log_ns: the log's time stamp."""
    log.json(
        STEP,
        log_ns,
        {
            "now_ns": now_ns,
            "agents": {str(agent): len(packets[agent]) for agent in sorted(packets)},
            "done": [job.id for job in done],
            "jobs": [[job.id, job.kind] for job in output.jobs],
            "sent": {str(agent): len(out) for agent, out in output.packets},
        },
    )
    for agent in sorted(packets):
        for packet in packets[agent]:
            log.blob(packets_in(agent), log_ns, packet)
    for order in orders:
        if isinstance(order, Import):
            log.blob(IMPORT, log_ns, pack(SavedMap({order.agent: SavedValues(dict(order.codes), {})})))
        else:
            log.json(COMMAND, log_ns, {"id": order.id, "verb": order.verb, "text": order.text})
    for job in done:
        failed = {"failed": job.failed} if job.failed else {}
        log.json(JOB, log_ns, {"id": job.id, "cost_ops": job.cost_ops, "result": fingerprint(job), **failed})
    for answer in output.answers:
        log.json(ANSWER, log_ns, {"id": answer.id, "ok": answer.ok, "text": answer.text})
    for agent, out in output.packets:
        for packet in out:
            log.blob(packets_out(agent), log_ns, packet)


def read_orders(messages: Iterable[StepMessage]) -> tuple[Import | Command, ...]:
    """Imports and commands of one step, in order. Raises WireError."""
    out: list[Import | Command] = []
    for message in messages:
        if message.topic == IMPORT:
            agents = unpack(message.blob()).agents
            out += [Import(agent, tuple(codes.received.items())) for agent, codes in agents.items()]
        elif message.topic == COMMAND:
            out.append(Command(**message.json()))
    return tuple(out)


def done_again(job: Job, logged: StepMessage) -> JobDone:
    """The job as it ended in the log: done again, or set aside."""
    failed = logged.json().get("failed")
    return set_aside(job, str(failed)) if failed else run_job(job)


def fingerprint(done: JobDone) -> str:
    """A digest of a job's result, equal for results that are equal bit for bit."""
    digest = hashlib.blake2b(digest_size=16)
    _feed(digest, done.result)
    return digest.hexdigest()


def _feed(digest: hashlib.blake2b, value: object) -> None:
    """Feed type, shape and content of every field, in order; names may change between versions."""
    if is_dataclass(value):
        for field in fields(value):
            _feed(digest, getattr(value, field.name))
    elif isinstance(value, np.ndarray):
        digest.update(f"{value.dtype.str}{value.shape}".encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    else:
        digest.update(repr(value).encode())
