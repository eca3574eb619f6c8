"""Seals packets: only holders of an agent's key can write them, and replayed ones are refused. See SPEC.md, "Seals".

On IP links packets are encrypted (ChaCha20-Poly1305, RFC 8439); on thin links they are readable but carry a keyed
BLAKE2s tag of 8 bytes (RFC 7693). The nonce is (direction, agent, boot, counter). Each writer counts its boots and
never uses one again. An encrypted packet also names 8 bytes that its writer drew at its start; its key is derived with
them, so that no nonce meets a key twice, not even where a boot comes again, as on a cloned card.
"""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from hashlib import blake2b, blake2s
from typing import TYPE_CHECKING

from kiteline_codec.coding.packing import Reader, WireError, Writer
from kiteline_codec.transport.link_traits import LinkTraits
from kiteline_codec.transport.sequence_window import SequenceWindow

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

KEY_BYTES = 32
EARLIER_BOOT = "earlier boot"
WINDOW_PACKETS = 1024  # a packet further behind the newest one is refused; no link reorders so much
_MAX_AGENT = (1 << 8) - 1
_SHORT_AGENTS = 63  # agents below fit the first byte of a packet; in others' it is 63, and a byte follows
_MAX_BOOT = (1 << 48) - 1
_MAX_COUNTER = (1 << 40) - 1
SALT_BYTES = {0: 8, 1: 0}  # by suite: a tag needs none
_MOST_HEAD_BYTES = 2 + 7 + 6 + 8  # of a packet before its content


class Suite(IntEnum):
    """How packets are sealed."""

    ENCRYPTED = 0  # 16 bytes of tag
    TAGGED = 1  # 8 bytes of tag, content readable


class Direction(IntEnum):
    """Who wrote a packet."""

    UP = 0  # the agent
    DOWN = 1  # the base


_TAG_BYTES = {Suite.ENCRYPTED: 16, Suite.TAGGED: 8}


def seal_bytes(suite: Suite, agent: int = 0) -> int:
    """Bytes that sealing adds to an agent's packets at most, below 2^42 as a boot and 2^28 packets."""
    return 1 + (agent >= _SHORT_AGENTS) + 6 + 4 + SALT_BYTES[suite] + _TAG_BYTES[suite]


def _head(suite: Suite, direction: Direction, agent: int) -> bytes:
    """What a packet begins with."""
    short = min(agent, _SHORT_AGENTS)
    return bytes((suite << 7 | direction << 6 | short,)) + (b"" if agent < _SHORT_AGENTS else bytes((agent,)))


def _read_head(source: Reader) -> tuple[Suite, Direction, int]:
    """The reverse of `_head`. Raises WireError."""
    first = source.u8()
    agent = first & _SHORT_AGENTS
    if agent == _SHORT_AGENTS:
        agent = source.u8()
        if agent < _SHORT_AGENTS:
            raise WireError(f"agent {agent} in two bytes, expected one")
    return Suite(first >> 7), Direction(first >> 6 & 1), agent


def read_head(sealed: bytes) -> tuple[Suite, Direction, int] | None:
    """Suite, direction and agent that a sealed packet names, unproved; None if it is too short for that."""
    try:
        return _read_head(Reader(sealed))
    except WireError:
        return None


def suite_for(link: LinkTraits) -> Suite:
    """The suite of a link: thin links have few bytes to spare."""
    return Suite.TAGGED if link.thin else Suite.ENCRYPTED


def fingerprint(key: bytes) -> str:
    """A short text that identifies a key and does not reveal it."""
    digest = blake2b(key, digest_size=8, person=b"kiteline-print").hexdigest()
    return "-".join(digest[i : i + 4] for i in range(0, 16, 4))


def _derived(key: bytes, suite: Suite, direction: Direction) -> bytes:
    """The key of one suite and direction, so that a packet of one use is not valid in another."""
    if len(key) != KEY_BYTES:
        raise ValueError(f"a key has {KEY_BYTES} bytes, found {len(key)}")
    return blake2b(bytes((suite, direction)), key=key, digest_size=32, person=b"kiteline-seal").digest()


def _nonce(first: int, boot: int, counter: int) -> bytes:
    return bytes((first,)) + boot.to_bytes(6, "big") + counter.to_bytes(5, "big")


def _salted(key: bytes, salt: bytes) -> bytes:
    """The key of one start of a writer."""
    return blake2b(salt, key=key, digest_size=32, person=b"kiteline-start").digest()


def _tag(key: bytes, data: bytes) -> bytes:
    return blake2s(data, key=key, digest_size=8, person=b"kiteline").digest()


def _cipher(key: bytes) -> ChaCha20Poly1305:
    """The cipher; its library, which takes 6 MiB, is loaded only when needed."""
    from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

    return ChaCha20Poly1305(key)


class Sealer:
    """Seals the packets of one start of one writer."""

    def __init__(
        self, key: bytes, agent: int, boot: int, direction: Direction, suite: Suite,
        draw: Callable[[int], bytes] = secrets.token_bytes,
    ) -> None:  # fmt: skip
        """boot: number of this start of the writer, never used again. draw: random bytes. Raises ValueError."""
        if not (0 <= agent <= _MAX_AGENT and 0 <= boot <= _MAX_BOOT):
            raise ValueError(f"agent {agent} is 0..{_MAX_AGENT} and boot {boot} is 0..{_MAX_BOOT}")
        self._first = _head(suite, direction, agent)
        self._boot = boot
        self._suite = suite
        self._key = _derived(key, suite, direction)
        self._salt = draw(SALT_BYTES[suite])
        if self._salt:
            self._key = _salted(self._key, self._salt)
        self._counter = 0

    def raise_to(self, boot: int) -> None:
        """Go on under a higher boot, which the receiver asked for; a lower one is ignored."""
        if self._boot < boot <= _MAX_BOOT:
            self._boot, self._counter = boot, 0

    def seal(self, packet: bytes) -> bytes:
        """The sealed packet. Raises OverflowError after 2^40 packets."""
        self._counter += 1
        if self._counter > _MAX_COUNTER:
            raise OverflowError("no nonces left in this boot")
        head = Writer()
        head.raw(self._first)
        head.varint(self._boot)
        head.varint(self._counter)
        data = head.bytes() + self._salt
        if self._suite == Suite.TAGGED:
            return data + packet + _tag(self._key, data + packet)
        nonce = _nonce(self._first[0], self._boot, self._counter)
        return data + _cipher(self._key).encrypt(nonce, packet, data)


@dataclass(slots=True)
class SealCounters:
    """Packets received. Only `opened` ones were passed on."""

    opened: int = 0
    truncated: int = 0  # too short, or no sealed packet at all
    unknown: int = 0  # of an agent without a key here, or of the wrong direction
    forged: int = 0  # the seal is wrong
    replayed: int = 0  # received before, or too old to tell
    by_agent: dict[int, int] = field(default_factory=dict)  # refused packets that named an agent

    @property
    def refused(self) -> int:
        """Packets that were ignored."""
        return self.truncated + self.unknown + self.forged + self.replayed


@dataclass(slots=True)
class _Writer:
    """What was received of one writer. packets: of its newest boot; None: no packet of `boot` or below is accepted."""

    boot: int
    packets: SequenceWindow | None = None

    def is_new(self, boot: int, counter: int) -> bool:
        if boot != self.boot:
            return boot > self.boot
        return self.packets is not None and self.packets.is_new(counter)

    def mark(self, boot: int, counter: int) -> None:
        if self.packets is None or boot != self.boot:
            self.boot, self.packets = boot, SequenceWindow(WINDOW_PACKETS - 1)
        self.packets.mark(counter)


class Opener:
    """Opens packets of any number of writers in one direction. Packets that are not genuine and new are counted."""

    def __init__(self, keys: Mapping[int, bytes], direction: Direction, boots: Mapping[int, int] | None = None) -> None:
        """keys: by agent. boots: by agent, from an earlier start of this process; packets of lower ones are refused."""
        self.counters = SealCounters()
        self.refusal = ""  # why the last packet that was refused was: a name of a counter, or EARLIER_BOOT
        self._direction = direction
        self._keys = {(a, s): _derived(key, s, direction) for a, key in keys.items() for s in Suite}
        self._writers = {a: _Writer((boots or {}).get(a, 0) - 1) for a in keys}
        self._salted: dict[int, tuple[bytes, bytes]] = {}  # the salt that was heard last of each agent, and its key
        self._tagged: set[int] = set()  # agents whose newest packet was tagged

    @property
    def boots(self) -> dict[int, int]:
        """The newest boot received, by agent."""
        return {a: w.boot for a, w in self._writers.items() if w.packets is not None}

    def is_familiar(self, agent: int, sealed: bytes) -> bool:
        """True if a packet names the salt of the start of its writer that was heard last: no stranger who does not
        listen can guess it. Tagged packets have none: they are familiar of agents that send them, over links that are
        too slow to flood. Cheap.
        """
        if sealed[:1] >= b"\x80":
            return agent in self._tagged
        heard = self._salted.get(agent)
        return heard is not None and heard[0] in sealed[:_MOST_HEAD_BYTES]

    def open(self, sealed: bytes) -> tuple[int, bytes] | None:
        """The agent and the packet, or None. Never raises."""
        source = Reader(sealed)
        try:
            suite, direction, agent = _read_head(source)
            boot, counter = source.varint(_MAX_BOOT), source.varint(_MAX_COUNTER)
            salt = source.raw(SALT_BYTES[suite])
        except WireError:
            self.counters.truncated += 1
            self.refusal = "truncated"
            return None
        body_at = len(sealed) - source.left
        if source.left < _TAG_BYTES[suite]:
            self._refuse("truncated", agent)
            return None
        key = self._keys.get((agent, suite))
        if key is None or direction != self._direction:
            self._refuse("unknown", agent)
            return None
        writer = self._writers[agent]
        if not writer.is_new(boot, counter):
            self._refuse("replayed", agent)
            if boot < writer.boot or writer.packets is None:
                self.refusal = EARLIER_BOOT
            return None
        heard = self._salted.get(agent)
        if salt:
            key = heard[1] if heard is not None and heard[0] == salt else _salted(key, salt)
        packet = self._opened(key, suite, sealed[:body_at], sealed[body_at:], _nonce(sealed[0], boot, counter))
        if packet is None:
            self._refuse("forged", agent)
            return None
        if salt:
            self._salted[agent] = salt, key
            self._tagged.discard(agent)
        else:
            self._tagged.add(agent)
        writer.mark(boot, counter)
        self.counters.opened += 1
        return agent, packet

    @staticmethod
    def _opened(key: bytes, suite: Suite, head: bytes, body: bytes, nonce: bytes) -> bytes | None:
        """The packet, None if the seal is wrong."""
        if suite == Suite.TAGGED:
            packet = body[: -_TAG_BYTES[suite]]
            sound = hmac.compare_digest(_tag(key, head + packet), body[-_TAG_BYTES[suite] :])
            return packet if sound else None
        from cryptography.exceptions import InvalidTag

        try:
            return _cipher(key).decrypt(nonce, body, head)
        except InvalidTag:
            return None

    def set_key(self, agent: int, key: bytes | None) -> None:
        """Open an agent's packets with another key from now on, and none under the one before. None: it has no key."""
        self._salted.pop(agent, None)
        self._tagged.discard(agent)
        for suite in Suite:
            self._keys.pop((agent, suite), None)
            if key is not None:
                self._keys[agent, suite] = _derived(key, suite, self._direction)
        self._writers[agent] = _Writer(-1)

    def _refuse(self, why: str, agent: int) -> None:
        self.refusal = why
        setattr(self.counters, why, getattr(self.counters, why) + 1)
        by = self.counters.by_agent
        by[agent] = by.get(agent, 0) + 1
