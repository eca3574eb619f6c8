"""A digest of a changing set of values, updated in constant time.

Each (key, version, code) is hashed with BLAKE2b; the digest is the sum of the hashes modulo 2^128, whatever their
order (M. Bellare, D. Micciancio, "A new paradigm for collision-free hashing", 1997). It detects defects, not attacks.
"""

from hashlib import blake2b

from kiteline_codec.coding.packing import Writer
from kiteline_codec.schema import Key
from kiteline_codec.transport.packet import DIGEST_BYTES

MODULUS = 1 << 8 * DIGEST_BYTES


def hash_value(key: Key, version: int, code: bytes) -> int:
    """The 128-bit hash of one value: BLAKE2b over the varints kind, id, part, version, then the code."""
    head = Writer()
    head.varint(key.kind)
    head.varint(key.id)
    head.varint(key.part)
    head.varint(version)
    return int.from_bytes(blake2b(head.bytes() + code, digest_size=DIGEST_BYTES).digest(), "little")


class Digest:
    """The sum of the hashes of a set of values."""

    __slots__ = ("_sum",)

    def __init__(self) -> None:
        self._sum = 0

    def add(self, hashes: int) -> None:
        """Add values whose hashes have this sum."""
        self._sum = (self._sum + hashes) % MODULUS

    def discard(self, hashes: int) -> None:
        """Remove values whose hashes have this sum."""
        self._sum = (self._sum - hashes) % MODULUS

    def bytes(self) -> bytes:
        """The digest, 16 bytes."""
        return self._sum.to_bytes(DIGEST_BYTES, "little")
