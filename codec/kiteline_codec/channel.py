"""Records between one agent and the base: with the codec between them, or handed over as they are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from kiteline_codec import messages
from kiteline_codec.schema import Key, Record, WireError
from kiteline_codec.sync import Endpoint, SyncConfig, SyncStats


class RecordChannel(Protocol):
    """One end of a shared set of records. Each record has one writer; a later record of the same key replaces it."""

    def put(self, record: Record) -> Record:
        """Share a record. Returns it as the other side will hold it: compute on with that."""
        ...

    def remove(self, key: Key) -> None:
        """Take back a record that was put; unknown keys are ignored."""
        ...

    def receive(self, packets: Sequence[bytes], now_ns: int) -> list[Record]:
        """Take in packets. Returns the records that are new or changed, in the order in which they became so."""
        ...

    def take_removed(self) -> list[Key]:
        """The keys that the other side took back since the last call."""
        ...

    def poll(self, now_ns: int) -> list[bytes]:
        """The packets to send now."""
        ...


class PlainChannel:
    """One of two joined ends in one process: records pass as they are, at the next `receive`. Made by `plain_pair`."""

    def __init__(self) -> None:
        self._arrived: list[Record] = []
        self._removed: list[Key] = []
        self._partner: PlainChannel = self

    def put(self, record: Record) -> Record:
        """Hand a record over."""
        self._partner._arrived.append(record)
        return record

    def remove(self, key: Key) -> None:
        """Take back a record."""
        self._partner._arrived = [r for r in self._partner._arrived if messages.key(r) != key]
        self._partner._removed.append(key)

    def receive(self, packets: Sequence[bytes], now_ns: int) -> list[Record]:
        """What the partner put since the last call; there are no packets."""
        arrived, self._arrived = self._arrived, []
        return arrived

    def take_removed(self) -> list[Key]:
        """What the partner removed since the last call."""
        removed, self._removed = self._removed, []
        return removed

    def poll(self, now_ns: int) -> list[bytes]:
        """Nothing: no packets are needed."""
        return []

    @staticmethod
    def _join(a: PlainChannel, b: PlainChannel) -> None:
        a._partner, b._partner = b, a


def plain_pair() -> tuple[PlainChannel, PlainChannel]:
    """Two ends that are joined: what one puts, the other receives."""
    a, b = PlainChannel(), PlainChannel()
    PlainChannel._join(a, b)
    return a, b


class CodedChannel:
    """Records through the codec and an endpoint, over any link that carries packets."""

    def __init__(self, config: SyncConfig, session: int) -> None:
        self.endpoint = Endpoint(config, session)
        self.undecodable = 0  # values whose code was no valid record: the other side speaks another schema
        self._removed: list[Key] = []

    @property
    def stats(self) -> SyncStats:
        """The endpoint's numbers."""
        return self.endpoint.stats

    def put(self, record: Record) -> Record:
        """Code and share a record. Raises ValueError when it cannot be coded."""
        key = messages.key(record)
        code = messages.encode(record)
        self.endpoint.put(key, code)
        return messages.decode(key, code)

    def remove(self, key: Key) -> None:
        """Take back a record."""
        self.endpoint.remove(key)

    def receive(self, packets: Sequence[bytes], now_ns: int) -> list[Record]:
        """Take in packets from the link. Values that cannot be decoded are counted and left out."""
        records = []
        for packet in packets:
            for update in self.endpoint.receive(packet, now_ns):
                if update.code is None:
                    self._removed.append(update.key)
                    continue
                try:
                    records.append(messages.decode(update.key, update.code))
                except WireError:
                    self.undecodable += 1
        return records

    def take_removed(self) -> list[Key]:
        """The keys that the other side took back since the last call."""
        removed, self._removed = self._removed, []
        return removed

    def poll(self, now_ns: int) -> list[bytes]:
        """All packets that may be sent now."""
        packets = []
        while (packet := self.endpoint.poll(now_ns)) is not None:
            packets.append(packet)
        return packets
