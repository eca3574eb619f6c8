"""A map at rest: the codes that both sides wrote, by agent, and the base's state as texts. Pure.

Packed for a base's log: 8 bytes magic; for each agent a header (agent, number of received and of own values) and the
values (kind, id, part, length, code); the texts (lengths of name and text, both); a BLAKE2b digest of all before it.
"""

import hashlib
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field

from kiteline_codec.schema import RECORD_TYPES, Key, WireError
from kiteline_core.errors import INPUT_FAULTS
from kiteline_core.ids import AgentId

_MAGIC = b"KLSTORE3"
_AGENTS = struct.Struct("<B")
_AGENT = struct.Struct("<BII")
_ENTRY = struct.Struct("<BqHI")
_TEXT = struct.Struct("<HI")
_DIGEST_BYTES = 16


@dataclass(frozen=True, slots=True)
class SavedValues:
    """The values shared with one agent. received: what it wrote. own: what the base wrote."""

    received: Mapping[Key, bytes]
    own: Mapping[Key, bytes]


@dataclass(frozen=True, slots=True)
class SavedMap:
    """A map at rest. texts: state of the mapper by name, see `state_texts`. faults: what was left out, in words."""

    agents: Mapping[AgentId, SavedValues] = field(default_factory=dict)
    texts: Mapping[str, str] = field(default_factory=dict)
    faults: tuple[str, ...] = ()

    @property
    def empty(self) -> bool:
        """True if there is no map."""
        return not any(codes.received or codes.own for codes in self.agents.values())


def value_name(key: Key) -> str:
    """The name of a value in messages."""
    record_type = RECORD_TYPES.get(key.kind)
    kind = f"kind {key.kind}" if record_type is None else record_type.__name__
    return f"{kind} {key.id}" + (f" part {key.part}" if key.part else "")


def pack(saved: SavedMap) -> bytes:
    """Pack a map into bytes."""
    out = [_MAGIC, _AGENTS.pack(len(saved.agents))]
    for agent in sorted(saved.agents):
        codes = saved.agents[agent]
        out.append(_AGENT.pack(agent, len(codes.received), len(codes.own)))
        for values in (codes.received, codes.own):
            for key in sorted(values):
                out.append(_ENTRY.pack(key.kind, key.id, key.part, len(values[key])))
                out.append(values[key])
    for name in sorted(saved.texts):
        pair = name.encode(), saved.texts[name].encode()
        out += [_TEXT.pack(len(pair[0]), len(pair[1])), *pair]
    body = b"".join(out)
    return body + hashlib.blake2b(body, digest_size=_DIGEST_BYTES).digest()


def unpack(content: bytes) -> SavedMap:
    """Unpack a map. Raises WireError on anything else."""
    body, digest = content[:-_DIGEST_BYTES], content[-_DIGEST_BYTES:]
    if not body.startswith(_MAGIC) or hashlib.blake2b(body, digest_size=_DIGEST_BYTES).digest() != digest:
        raise WireError(f"a saved map of {len(content)} bytes is damaged, or of another version")
    try:
        return _unpacked(body)
    except (ValueError, *INPUT_FAULTS) as error:
        raise WireError(f"a saved map of {len(content)} bytes is damaged ({error!r})") from error


def _unpacked(body: bytes) -> SavedMap:
    agents: dict[AgentId, SavedValues] = {}
    (count,) = _AGENTS.unpack_from(body, len(_MAGIC))
    at = len(_MAGIC) + _AGENTS.size
    for _ in range(count):
        agent, received, own = _AGENT.unpack_from(body, at)
        at += _AGENT.size
        parts: tuple[dict[Key, bytes], dict[Key, bytes]] = ({}, {})
        for values, entries in zip(parts, (received, own), strict=True):
            for _ in range(entries):
                kind, number, part, length = _ENTRY.unpack_from(body, at)
                at += _ENTRY.size
                values[Key(kind, number, part)] = body[at : at + length]
                at += length
        agents[AgentId(agent)] = SavedValues(*parts)
    texts: dict[str, str] = {}
    while at < len(body):
        name, text = _TEXT.unpack_from(body, at)
        at += _TEXT.size
        texts[body[at : at + name].decode()] = body[at + name : at + name + text].decode()
        at += name + text
    return SavedMap(agents, texts)
