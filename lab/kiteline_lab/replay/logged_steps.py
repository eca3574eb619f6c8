"""The steps of a log, and the agent or base that ran them."""

import json
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.onboard import OnboardAgent, onboard_agent
from kiteline_agent.runtime import flight_log
from kiteline_agent.runtime.options import AgentOptions, coded_channel_for
from kiteline_agent.step import Identity, StepInput
from kiteline_codec.channel import RecordChannel
from kiteline_core import config as configuration
from kiteline_core.frame import EncodedImage
from kiteline_core.ids import AgentId
from kiteline_hw.links.kinds import link_traits
from kiteline_hw.logs.mcap_log import DEPTH, LEFT, RIG, RIGHT, LogMessage, LogReader, read_frame
from kiteline_hw.logs.mcap_repair import BEGINS, REPAIRED
from kiteline_hw.logs.rig_json import rig_from_json
from kiteline_hw.logs.spill_file import SpillFile
from kiteline_hw.ports import SourceError
from kiteline_hw.system.vocabulary import shipped_vocabulary


@dataclass(slots=True)
class Step:
    """One logged step. head: its /step record. messages: those that belong to it, by topic, in order."""

    number: int
    head: Mapping[str, Any]
    messages: dict[str, list[LogMessage]] = field(default_factory=dict)

    def of(self, topic: str) -> list[LogMessage]:
        """The messages of a topic."""
        return self.messages.get(topic, [])

    def blobs(self, topic: str) -> tuple[bytes, ...]:
        """The opaque bytes of a topic."""
        return tuple(message.blob() for message in self.of(topic))

    def one_of(self, topic: str) -> LogMessage:
        """The only message of a topic. Raises SourceError if there are none or several."""
        found = self.of(topic)
        if len(found) != 1:
            raise SourceError(f"step {self.number} of the log has {len(found)} messages of {topic}, its head says one")
        return found[0]


def steps(log: LogReader) -> Iterator[Step]:
    """The steps of a log, in order; the last one of a log that was cut is left out, since it may be incomplete."""
    step: Step | None = None
    number = 0
    for message in log.messages():
        if message.topic == flight_log.STEP:
            if step is not None:
                yield step
            step = Step(number, message.json())
            number += 1
        elif step is not None:
            step.messages.setdefault(message.topic, []).append(message)
    if step is not None and log.cut is None and REPAIRED not in log.metadata:
        yield step


def check_replayable(log: LogReader, role: str) -> None:
    """Raise SourceError unless this is the log of an agent or a base ("role") whose packets are in it."""
    if log.metadata.get("role") != role:
        raise SourceError("no log of an agent or a base: a recording is flown with `kiteline fly`, not replayed")
    if log.metadata.get("channel") == "PlainChannel":
        raise SourceError("this is a monolith's log: its agent and base exchanged no packets, so they are not in it")
    if begins := log.metadata.get(BEGINS):
        raise SourceError(
            f"this log was cut at its beginning (it begins {begins}): a replay needs all steps before; `kiteline fly` "
            "flies its frames anew"
        )
    if part := log.metadata.get("part"):
        raise SourceError(
            f"part {part} of a log: a replay begins with its first part, the name without _{part}, if that "
            "was not deleted; `kiteline fly` flies the frames of any part anew"
        )


def agent_of_log(log: LogReader) -> OnboardAgent:
    """An agent like the one that wrote the log. Raises SourceError."""
    check_replayable(log, "agent")
    rig_message = next(log.messages((RIG,)), None)
    if rig_message is None:
        raise SourceError("this log holds no calibration on /rig: it was cut at its beginning, or is no agent's")
    rig, imu = rig_from_json(rig_message.json())
    known = AgentOptions.__dataclass_fields__
    logged = {name: value for name, value in json.loads(log.metadata["spec"]).items() if name in known}
    options = AgentOptions(**{"source": "", **logged, "folder": ""})
    channel: RecordChannel = NoBaseChannel()
    if log.metadata.get("channel") == "CodedChannel":
        spill = SpillFile(Path(tempfile.gettempdir())) if options.log_name else None
        channel = coded_channel_for(options, link_traits(options.link), spill)
    config = configuration.of_log(AgentConfig(), log.metadata["config"])
    return onboard_agent(
        rig, imu, config, Identity(AgentId(options.agent), options.boot, options.submap), channel, shipped_vocabulary()
    )


def agent_input(step: Step) -> StepInput:
    """What entered a step of an agent. Raises SourceError."""
    frame = None
    if step.head["frame_ns"] is not None:
        images: list[EncodedImage] = [m.image() for topic in (LEFT, RIGHT, DEPTH) for m in step.of(topic)]
        if not images:
            raise SourceError(
                f"step {step.number} of the log has no images: it was flown with every = 0 or more than 1 in "
                "[agent.log]; only a log with all images can be replayed"
            )
        frame = read_frame(images, step.head["frame_ns"], has_depth=bool(step.of(DEPTH)))
    imu = step.one_of(flight_log.IMU).imu() if step.head["imu"] else None
    odometry = step.one_of(flight_log.ODOMETER).odometry() if step.head.get("odometer") else None
    packets, predict_ns = step.blobs(flight_log.PACKETS_IN), step.head.get("predict_ns")
    return StepInput(frame, imu, packets, step.head["cpu_ns"], odometry, predict_ns)
