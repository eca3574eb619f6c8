"""The station: the mapper with one channel to each agent. Packets enter, packets leave."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.exchange.correction_batches import CorrectionBatches
from kiteline_basestation.exchange.deleted_values import DeletedValues
from kiteline_basestation.exchange.map_cache_planner import MapCachePlanner
from kiteline_basestation.exchange.tile_planner import TilePlanner
from kiteline_basestation.jobs import Job, JobDone
from kiteline_basestation.management import Answer, Command
from kiteline_basestation.mapper import Mapper, MapperInput
from kiteline_codec.channel import CodedChannel, RecordChannel
from kiteline_codec.schema import PASSING_KINDS, Key, KeyframeHeader, LivePose, Record, WireError, messages
from kiteline_codec.schema.owners import KEYFRAME_BYTES, submap_of
from kiteline_core.ids import NO_KEYFRAME, AgentId, KeyframeId, SubmapId
from kiteline_core.places.place_index import Vocabulary


@dataclass(frozen=True, slots=True)
class Import:
    """Values of an agent that were read from its log instead of received."""

    agent: AgentId
    codes: tuple[tuple[Key, bytes], ...]


@dataclass(frozen=True, slots=True)
class StationOutput:
    """Packets for each agent, in order of agent id, jobs to be run, and answers to commands."""

    packets: tuple[tuple[AgentId, tuple[bytes, ...]], ...]
    jobs: tuple[Job, ...]
    answers: tuple[Answer, ...] = ()


class Station:
    """The base as a state machine over packets. `open_channel` makes the base's end of the channel to an agent."""

    def __init__(
        self, config: BaseConfig, open_channel: Callable[[AgentId], RecordChannel], vocabulary: Vocabulary | None = None
    ) -> None:  # fmt: skip
        self.mapper = Mapper(config, vocabulary)
        self.map_cache_planner = MapCachePlanner(config.map_cache, config.loops, self.mapper.map)
        self.tile_planner = TilePlanner(
            config.tiles, self.mapper.map, self.mapper.grid_updates, self.mapper.placements
        )  # fmt: skip
        self.channels: dict[AgentId, RecordChannel] = {}
        self._batches: dict[AgentId, CorrectionBatches] = {}  # of corrections, by agent
        self._deleted_values: dict[AgentId, DeletedValues] = {}
        self._publish = config.publish
        self.changed: dict[tuple[AgentId, bool, Key], bytes | None] | None = None  # see `track_changes`
        self.received = 0  # records of agents in the last step
        self.published = 0  # records for agents in the last step
        self._open_channel = open_channel

    def join(self, agent: AgentId) -> RecordChannel:
        """The channel to an agent; opened on first use."""
        if agent not in self.channels:
            self.channels[agent] = channel = self._open_channel(agent)
            self._batches[agent] = CorrectionBatches(agent, self._publish)
            if isinstance(channel, CodedChannel):
                self._batches[agent].shares = channel.shares
                channel.endpoint.received.earlier.is_gone = lambda key: submap_of(key) in self.mapper.deleted
                channel.endpoint.received.claims.is_of_use = self._is_of_use
            self._deleted_values[agent] = DeletedValues()
        return self.channels[agent]

    def _is_of_use(self, key: Key, code: bytes, also: Collection[Key]) -> bool:
        """True for a header whose parent has a pose, and for what belongs to a keyframe that is known.

        also: keys of values that will be in the map, too.
        """
        header_of = partial(Key, KeyframeHeader.KIND)
        if key.kind != KeyframeHeader.KIND:
            return KeyframeId(key.id) in self.mapper.map or header_of(key.id) in also
        record = messages.decode(key, code)
        assert isinstance(record, KeyframeHeader)
        parent = record.parent
        return parent == NO_KEYFRAME or header_of(parent) in also or self.mapper.map.pose(parent) is not None

    def track_changes(self) -> None:
        """From now on collect in `changed` which values change: (agent, True if the base wrote it, key).

        The code is None where a channel holds it.
        """
        self.changed = {}

    def step(
        self,
        packets: Mapping[AgentId, Sequence[bytes]],
        done: Sequence[JobDone],
        now_ns: int,
        orders: Sequence[Import | Command] = (),
    ) -> StationOutput:
        """Take in packets, finished jobs and orders; serve every agent that ever joined, in order of id."""
        for agent in sorted(packets):
            self.join(agent)
        arrivals = [
            (agent, tuple(channel.receive(packets.get(agent, ()), now_ns)))
            for agent, channel in sorted(self.channels.items())
        ]
        for agent, channel in sorted(self.channels.items()):
            channel.take_removed()  # the map keeps what it was given; else the keys would pile up
            if isinstance(channel, CodedChannel):
                released = self._batches[agent].follow_session(channel.endpoint.peer_session)
                self._put(agent, [] if released is None else [released])
        self.received = sum(len(records) for _, records in arrivals)
        for agent, records in arrivals:
            self._track(agent, False, records)
        imports = tuple((order.agent, self._imported(order)) for order in orders if isinstance(order, Import))
        commands = tuple(order for order in orders if isinstance(order, Command))
        limits = tuple(
            (agent, room) for agent, end in sorted(self.channels.items())
            if (room := self._room_bytes(agent, end, now_ns)) is not None
        )  # fmt: skip
        given = MapperInput(tuple(arrivals), tuple(done), commands, limits, imports)
        output = self.mapper.step(given, now_ns)
        for agent, keyframes in self.mapper.take_confirmed().items():
            if isinstance(end := self.channels.get(agent), CodedChannel):
                end.endpoint.received.claims.earned += KEYFRAME_BYTES * keyframes
        self.published = len(output.urgent) + sum(len(records) for _, records in output.publish)
        for agent, placement in output.urgent:
            self.join(agent)
            overtaken = self._batches[agent].without(messages.key(placement))
            self._put(agent, [placement] if overtaken is None else [placement, overtaken])
        published = dict(output.publish)
        for agent in sorted(published.keys() | {a for a, batches in self._batches.items() if batches.is_open}):
            self.join(agent)
            numbered, unfinished = self._batches[agent].numbered, agent in output.unfinished
            self._put(agent, numbered(published.get(agent, ()), now_ns, unfinished=unfinished))
        for agent, key in (*output.withdrawn, *self._placements_that_ended()):
            self.join(agent).remove(key)
            if self.changed is not None:
                self.changed[agent, True, key] = None
            replaced = self._batches[agent].without(key)
            self._put(agent, [] if replaced is None else [replaced])
        for agent, channel in sorted(self.channels.items()):
            if self.mapper.silent_s(agent, now_ns) < self._publish.batch_wait_s:  # to others nothing would arrive
                self.map_cache_planner.update(agent, self.mapper.live(agent), channel, now_ns)
                self.tile_planner.update(agent, self.mapper.live(agent), channel, now_ns)
            if self.mapper.deleted and isinstance(channel, CodedChannel):
                self._deleted_values[agent].remove_some(channel, self.mapper.deleted)
        sent = tuple((agent, tuple(channel.poll(now_ns))) for agent, channel in sorted(self.channels.items()))
        return StationOutput(sent, output.jobs, output.answers)

    def _put(self, agent: AgentId, records: Sequence[Record]) -> None:
        for record in records:
            self.mapper.adopt(self.channels[agent].put(record))  # the base computes on with what the agent will hold
        self._track(agent, True, records)

    def _placements_that_ended(self) -> list[tuple[AgentId, Key]]:
        """Placements that agents hold of earlier starts of this base, of submaps without a place in the world now."""
        return [
            (agent, key)
            for agent, channel in sorted(self.channels.items())
            if isinstance(channel, CodedChannel)
            for key in channel.endpoint.standing
            if self.mapper.has_no_place(SubmapId(key.id))
        ]

    def restore(self, agent: AgentId, own: Sequence[Record], now_ns: int) -> None:
        """Share again the values that an earlier process had written for an agent."""
        channel = self.join(agent)
        for record in own:
            self._batches[agent].restore(record)
        self.mapper.restore(agent, (), tuple(channel.put(record) for record in own), now_ns)
        if (released := self._batches[agent].release()) is not None:
            self._put(agent, [released])

    def _track(self, agent: AgentId, own: bool, records: Sequence[Record]) -> None:
        if self.changed is not None:
            for record in records:
                if record.KIND not in PASSING_KINDS:
                    self.changed[agent, own, messages.key(record)] = None

    def _room_bytes(self, agent: AgentId, channel: RecordChannel, now_ns: int) -> int | None:
        """Bytes of corrections that may be shared with an agent now; None without a limit."""
        gap_s = self._publish.batch_gap_s if self.mapper.map.measures_distances(agent) else 0.0
        return self._batches[agent].room_bytes(channel, now_ns, gap_s)

    def _imported(self, order: Import) -> tuple[Record, ...]:
        """The records of an import that are not here yet."""
        channel = self.join(order.agent)
        records = []
        for key, code in order.codes:
            if isinstance(channel, CodedChannel) and channel.endpoint.peer_value(key) == code:
                continue
            try:
                records.append(messages.decode(key, code))
            except WireError:
                continue
            if key.kind == LivePose.KIND and self.mapper.live(order.agent) is not None:
                records.pop()  # of an earlier flight
                continue
            if self.changed is not None and key.kind not in PASSING_KINDS:
                self.changed[order.agent, False, key] = code
        return tuple(records)
