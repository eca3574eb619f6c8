"""Log and trajectories of a flight. Pure: the files are handed in."""

import json
from dataclasses import asdict
from typing import Protocol

from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.runtime.flight_log import StepLog, write_step
from kiteline_agent.runtime.frame_counts import live_line, odometry_line
from kiteline_agent.runtime.options import AgentOptions
from kiteline_agent.step import StepInput, StepOutput
from kiteline_codec.channel import CodedChannel, RecordChannel
from kiteline_codec.schema import record_log
from kiteline_core import config as configuration
from kiteline_core.ids import AgentId

_LINK_NS = 1_000_000_000  # ns between two link reports in the log


class Lines(Protocol):
    """A file of text lines that never raises; kiteline_hw.logs.whole_file.LineFile is one."""

    def write(self, line: str, /) -> object: ...


class FlightRecord:
    """Writes each step, the records that it shared, and the poses."""

    def __init__(
        self, log: StepLog, live: Lines, odometry: Lines, agent: int, channel: RecordChannel, every: int = 1
    ) -> None:
        """live, odometry: files of TUM lines. every: the images of one frame in so many are written, 0: none."""
        self._every = every
        self._frames = 0
        self._log = log
        self._live = live
        self._odometry = odometry
        self._agent = AgentId(agent)
        self._channel = channel
        self._link_due_ns = 0
        if isinstance(channel, CodedChannel | NoBaseChannel):
            channel.noting = True

    def step(self, step_input: StepInput, output: StepOutput, now_ns: int, log_ns: int) -> None:
        """Write a step. now_ns: the time that was handed to it. log_ns: the time under which it is logged."""
        with_images = self._every > 0 and self._frames % self._every == 0
        self._frames += step_input.frame is not None
        write_step(self._log, step_input, output, now_ns, log_ns, with_images)
        self._shared(log_ns)
        if isinstance(self._channel, CodedChannel) and now_ns >= self._link_due_ns:
            self._link_due_ns = now_ns + _LINK_NS
            self._log.json("/link", log_ns, self._channel.report())

    def _shared(self, log_ns: int) -> None:
        """Write the shared records, for a base that imports the log after the flight."""
        if isinstance(self._channel, CodedChannel | NoBaseChannel):
            for key, code in self._channel.take_noted().items():
                self._log.blob(record_log.TOPIC, log_ns, record_log.write_record(self._agent, key, code))

    def text(self, line: str, log_ns: int) -> None:
        """Write a message to the user, for viewers."""
        self._log.text("/log", log_ns, "info", line)

    def pose(self, output: StepOutput) -> None:
        """Write the poses of a frame."""
        self._live.write(live_line(output.estimate))
        self._odometry.write(odometry_line(output.estimate or output.predicted))


def metadata(options: AgentOptions, source: str, config: AgentConfig, channel: RecordChannel) -> dict[str, str]:
    """Metadata at the head of a log. source: its name."""
    unlogged = ("folder", "config", "rig", "log_mib", "log_optional")
    plain = {key: value for key, value in asdict(options).items() if key not in unlogged}
    plain["link"] = options.link.partition(":")[
        0
    ]  # the kind of link decides how packets are made, its address does not
    return {
        "role": "agent",
        "channel": type(channel).__name__,
        "source": source,
        "spec": json.dumps(plain),
        "config": configuration.describe(config),
    }
