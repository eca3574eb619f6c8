"""A batch of corrections."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

from kiteline_codec.coding.packing import Reader, WireError, Writer
from kiteline_codec.schema.batches import MAX_BATCH, MAX_MEMBERS, checksum_of_keys
from kiteline_codec.schema.record import IdOf, Key, Priority, Record, register
from kiteline_core.ids import AgentId


@register
@dataclass(frozen=True, slots=True)
class CorrectionBatch(Record):
    """What belongs to the newest batch of corrections for an agent, which applies them together.

    members: how many values carry this number; 0: values up to this number wait for no other ones. keys: checksum of
    their keys (`checksum_of_keys`), 0 without members.
    """

    KIND = 26
    ID = IdOf.AGENT
    PRIORITY = Priority.CORRECTION

    agent: AgentId
    number: int
    members: int
    keys: int

    @classmethod
    def of(cls, agent: AgentId, number: int, keys: Sequence[Key]) -> Self:
        """The batch of the values with these keys."""
        return cls(agent, number, len(keys), checksum_of_keys(list(keys)) if keys else 0)

    def write(self, out: Writer) -> None:
        """Append number, members and, if there are any, the checksum of their keys."""
        if not (0 < self.number <= MAX_BATCH and 0 <= self.members <= MAX_MEMBERS):
            raise ValueError(f"batch {self.number} of {self.members}: expected 1..{MAX_BATCH} of 0..{MAX_MEMBERS}")
        out.varint(self.number)
        out.varint(self.members)
        if self.members:
            out.raw(self.keys.to_bytes(4, "little"))

    @classmethod
    def read(cls, source: Reader, key: Key) -> Self:
        """The record of a key and a code."""
        number, members = source.varint(MAX_BATCH), source.varint(MAX_MEMBERS)
        if not number:
            raise WireError("the number of a batch is above 0")
        return cls(AgentId(key.id), number, members, int.from_bytes(source.raw(4), "little") if members else 0)
