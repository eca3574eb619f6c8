"""Shared values in an agent's log, from which a base imports what no link carried."""

import struct

from kiteline_codec.schema import Key, WireError
from kiteline_core.ids import AgentId

TOPIC = "/record"
_HEAD = struct.Struct("<BBqH")  # agent, kind, id, part


def write_record(agent: AgentId, key: Key, code: bytes) -> bytes:
    """The bytes of one value with its agent and key."""
    return _HEAD.pack(agent, key.kind, key.id, key.part) + code


def read_record(data: bytes) -> tuple[AgentId, Key, bytes]:
    """The inverse of `write_record`. Raises WireError."""
    if len(data) < _HEAD.size:
        raise WireError(f"a logged record of {len(data)} bytes, expected at least {_HEAD.size}")
    agent, kind, number, part = _HEAD.unpack_from(data)
    return AgentId(agent), Key(kind, number, part), data[_HEAD.size :]
