"""The mapper with one channel to each agent: packets in, packets out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.jobs import Job, JobDone
from kiteline_basestation.mapper import Mapper, MapperInput
from kiteline_basestation.supply import Supply
from kiteline_codec.channel import RecordChannel
from kiteline_core.ids import AgentId
from kiteline_core.place_index import Vocabulary


@dataclass(frozen=True, slots=True)
class StationOutput:
    """Packets for each agent, in order of agent id, and the work to be done elsewhere."""

    packets: tuple[tuple[AgentId, tuple[bytes, ...]], ...]
    jobs: tuple[Job, ...]


class Station:
    """The base as a state machine over packets. `open_channel` makes our end of the channel to an agent."""

    def __init__(
        self, config: BaseConfig, open_channel: Callable[[AgentId], RecordChannel], words: Vocabulary | None = None
    ) -> None:  # fmt: skip
        self.mapper = Mapper(config, words)
        self.supply = Supply(config.supply, config.loops, self.mapper.map)
        self.channels: dict[AgentId, RecordChannel] = {}
        self._open_channel = open_channel

    def join(self, agent: AgentId) -> RecordChannel:
        """The channel to an agent; opened on first use."""
        if agent not in self.channels:
            self.channels[agent] = self._open_channel(agent)
        return self.channels[agent]

    def step(
        self, packets: Mapping[AgentId, Sequence[bytes]], done: Sequence[JobDone], now_ns: int
    ) -> StationOutput:  # fmt: skip
        """Take in packets and finished jobs; every agent that ever joined is served, in order of id."""
        for agent in sorted(packets):
            self.join(agent)
        arrivals = tuple(
            (agent, tuple(channel.receive(packets.get(agent, ()), now_ns)))
            for agent, channel in sorted(self.channels.items())
        )
        output = self.mapper.step(MapperInput(arrivals, tuple(done)), now_ns)
        for agent, records in output.publish:
            channel = self.join(agent)
            for record in records:
                self.mapper.adopt(channel.put(record))  # from here on we compute with what the agent will hold
        for agent, channel in sorted(self.channels.items()):
            self.supply.serve(agent, self.mapper.live(agent), channel, now_ns)
        return StationOutput(
            tuple((agent, tuple(channel.poll(now_ns))) for agent, channel in sorted(self.channels.items())), output.jobs
        )
