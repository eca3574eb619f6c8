"""A digest of a set of values that is kept up to date in constant time a change.

Each (key, version, code) is hashed on its own with BLAKE2b; the digest is the sum of the hashes modulo 2^128, which
does not depend on their order, so nothing needs to be sorted or hashed again (M. Bellare, D. Micciancio, "A new
paradigm for collision-free hashing", 1997). It guards against defects, not against an attacker who holds the key.
"""

from __future__ import annotations

from hashlib import blake2b

from kiteline_codec.coding.packing import Writer
from kiteline_codec.schema import Key

DIGEST_BYTES = 16
MODULUS = 1 << 8 * DIGEST_BYTES


def hash_value(key: Key, version: int, code: bytes) -> int:
    """The 128-bit hash of one value: BLAKE2b over the varints kind, id, part, version, then the code."""
    out = Writer()
    for number in (key.kind, key.id, key.part, version):
        out.varint(number)
    out.raw(code)
    return int.from_bytes(blake2b(out.bytes(), digest_size=DIGEST_BYTES).digest(), "little")


class Digest:
    """The digest of a changing set."""

    __slots__ = ("_sum",)

    def __init__(self) -> None:
        self._sum = 0

    def add(self, key: Key, version: int, code: bytes) -> None:
        """A value joins the set."""
        self._sum = (self._sum + hash_value(key, version, code)) % MODULUS

    def discard(self, key: Key, version: int, code: bytes) -> None:
        """A value that is in the set leaves it."""
        self._sum = (self._sum - hash_value(key, version, code)) % MODULUS

    def join(self, hashes: int) -> None:
        """Values whose hashes have this sum join the set."""
        self._sum = (self._sum + hashes) % MODULUS

    def leave(self, hashes: int) -> None:
        """Values whose hashes have this sum leave the set."""
        self._sum = (self._sum - hashes) % MODULUS

    def bytes(self) -> bytes:
        """The digest, 16 bytes."""
        return self._sum.to_bytes(DIGEST_BYTES, "little")
