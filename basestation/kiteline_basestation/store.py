"""What a base keeps for its next start: the codes of both sides, by agent. Pure: bytes in, bytes out.

File: 8 bytes magic; then for each agent a header (agent, how many received, how many own) and its entries
(kind, id, part, length, code); at the end a BLAKE2b digest of all before it.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Mapping
from dataclasses import dataclass

from kiteline_basestation.station import Station
from kiteline_basestation.supply import is_copy
from kiteline_codec import messages
from kiteline_codec.schema import Key, WireError
from kiteline_core.ids import AgentId

_MAGIC = b"KLSTORE1"
_AGENT = struct.Struct("<BII")
_ENTRY = struct.Struct("<BqHI")
_DIGEST_BYTES = 16


@dataclass(frozen=True, slots=True)
class Codes:
    """The values shared with one agent. received: what it wrote. own: what the base wrote."""

    received: Mapping[Key, bytes]
    own: Mapping[Key, bytes]


def pack(agents: Mapping[AgentId, Codes]) -> bytes:
    """The file's content."""
    out = [_MAGIC]
    for agent in sorted(agents):
        codes = agents[agent]
        out.append(_AGENT.pack(agent, len(codes.received), len(codes.own)))
        for values in (codes.received, codes.own):
            for key in sorted(values):
                out.append(_ENTRY.pack(key.kind, key.id, key.part, len(values[key])))
                out.append(values[key])
    body = b"".join(out)
    return body + hashlib.blake2b(body, digest_size=_DIGEST_BYTES).digest()


def unpack(content: bytes) -> dict[AgentId, Codes]:
    """What `pack` was given. Raises WireError on anything else."""
    body, digest = content[:-_DIGEST_BYTES], content[-_DIGEST_BYTES:]
    if not body.startswith(_MAGIC) or hashlib.blake2b(body, digest_size=_DIGEST_BYTES).digest() != digest:
        raise WireError(f"store of {len(content)} bytes is damaged, or of another version")
    agents: dict[AgentId, Codes] = {}
    at = len(_MAGIC)
    while at < len(body):
        agent, received, own = _AGENT.unpack_from(body, at)
        at += _AGENT.size
        parts: tuple[dict[Key, bytes], dict[Key, bytes]] = ({}, {})
        for values, count in zip(parts, (received, own), strict=True):
            for _ in range(count):
                kind, number, part, length = _ENTRY.unpack_from(body, at)
                at += _ENTRY.size
                values[Key(kind, number, part)] = body[at : at + length]
                at += length
        agents[AgentId(agent)] = Codes(*parts)
    return agents


def restore(station: Station, kept: bytes, now_ns: int) -> None:
    """Put what an earlier base kept into a station that begins, and share with the agents again what is ours. What an
    agent still holds comes again and replaces what it told the earlier base. Raises WireError.
    """
    agents = unpack(kept)
    for agent, codes in agents.items():
        station.join(agent)
        received = tuple(messages.decode(key, codes.received[key]) for key in sorted(codes.received))
        station.mapper.restore(agent, received, (), now_ns)
    for agent, codes in agents.items():  # what is ours may tell of points of several agents
        channel = station.join(agent)
        lasting = [key for key in sorted(codes.own) if not is_copy(key)]  # what was lent is lent anew
        own = tuple(channel.put(messages.decode(key, codes.own[key])) for key in lasting)
        station.mapper.restore(agent, (), own, now_ns)
    station.mapper.rejoin()
