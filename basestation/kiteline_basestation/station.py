"""The mapper with one channel to each agent: packets in, packets out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.exchange.map_cache_planner import MapCachePlanner
from kiteline_basestation.jobs import Job, JobDone
from kiteline_basestation.management import Answer, Command
from kiteline_basestation.mapper import Mapper, MapperInput
from kiteline_codec.channel import CodedChannel, RecordChannel
from kiteline_codec.schema import Key, Record, WireError, messages
from kiteline_core.ids import AgentId
from kiteline_core.places.place_index import Vocabulary


@dataclass(frozen=True, slots=True)
class Import:
    """Values of an agent that came by another way than the link: out of its log."""

    agent: AgentId
    codes: tuple[tuple[Key, bytes], ...]


@dataclass(frozen=True, slots=True)
class StationOutput:
    """Packets for each agent, in order of agent id, the work to be done elsewhere, and answers to commands."""

    packets: tuple[tuple[AgentId, tuple[bytes, ...]], ...]
    jobs: tuple[Job, ...]
    answers: tuple[Answer, ...] = ()


class Station:
    """The base as a state machine over packets. `open_channel` makes our end of the channel to an agent."""

    def __init__(
        self, config: BaseConfig, open_channel: Callable[[AgentId], RecordChannel], words: Vocabulary | None = None
    ) -> None:  # fmt: skip
        self.mapper = Mapper(config, words)
        self.supply = MapCachePlanner(config.supply, config.loops, self.mapper.map)
        self.channels: dict[AgentId, RecordChannel] = {}
        self.touched: dict[tuple[AgentId, bool, Key], bytes | None] | None = None  # see `note_changes`
        self.unreadable = 0  # imported values whose code was no valid record
        self._open_channel = open_channel

    def join(self, agent: AgentId) -> RecordChannel:
        """The channel to an agent; opened on first use."""
        if agent not in self.channels:
            self.channels[agent] = self._open_channel(agent)
        return self.channels[agent]

    def note_changes(self) -> None:
        """From here on note in `touched` which values change: (agent, whether it is ours, key); with its code where no
        channel holds it.
        """
        self.touched = {}

    def step(
        self,
        packets: Mapping[AgentId, Sequence[bytes]],
        done: Sequence[JobDone],
        now_ns: int,
        orders: Sequence[Import | Command] = (),
    ) -> StationOutput:
        """Take in packets, finished jobs and orders; every agent that ever joined is served, in order of id."""
        for agent in sorted(packets):
            self.join(agent)
        arrivals = [
            (agent, tuple(channel.receive(packets.get(agent, ()), now_ns)))
            for agent, channel in sorted(self.channels.items())
        ]
        for agent, records in arrivals:
            self._note(agent, False, records)
        arrivals += [(order.agent, self._imported(order)) for order in orders if isinstance(order, Import)]
        commands = tuple(order for order in orders if isinstance(order, Command))
        output = self.mapper.step(MapperInput(tuple(arrivals), tuple(done), commands), now_ns)
        for agent, records in output.publish:
            channel = self.join(agent)
            for record in records:
                self.mapper.adopt(channel.put(record))  # from here on we compute with what the agent will hold
            self._note(agent, True, records)
        for agent, key in output.withdrawn:
            self.join(agent).remove(key)
            if self.touched is not None:
                self.touched[agent, True, key] = None
        for agent, channel in sorted(self.channels.items()):
            self.supply.serve(agent, self.mapper.live(agent), channel, now_ns)
        sent = tuple((agent, tuple(channel.poll(now_ns))) for agent, channel in sorted(self.channels.items()))
        return StationOutput(sent, output.jobs, output.answers)

    def _note(self, agent: AgentId, ours: bool, records: Sequence[Record]) -> None:
        if self.touched is not None:
            for record in records:
                self.touched[agent, ours, messages.key(record)] = None

    def _imported(self, order: Import) -> tuple[Record, ...]:
        """The records that are not here yet."""
        channel = self.join(order.agent)
        records = []
        for key, code in order.codes:
            if isinstance(channel, CodedChannel) and channel.endpoint.peer_value(key) == code:
                continue
            try:
                records.append(messages.decode(key, code))
            except WireError:
                self.unreadable += 1
                continue
            if self.touched is not None:
                self.touched[order.agent, False, key] = code
        return tuple(records)
