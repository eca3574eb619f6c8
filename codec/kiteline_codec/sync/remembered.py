"""What a side still knows of earlier sessions of its peer, told in a few bytes a value, so that it is not sent again.

A side that began anew, or whose peer did, shares under KIND which codes it remembers, newest ids first. The peer then
sends in place of such a code its checksum alone. See SPEC.md, "Remembered codes".
"""

from __future__ import annotations

from collections.abc import Mapping
from struct import pack
from zlib import crc32

from kiteline_codec.coding.packing import Reader, Writer
from kiteline_codec.schema import AGENT_KINDS, KEYFRAME_KINDS, Key, WireError
from kiteline_codec.transport.packet import MAX_KIND
from kiteline_core.ids import BOOT_BITS, SEQUENCE_BITS, SUBMAP_BITS

KIND = MAX_KIND  # of the values that tell; no record has it
FORM_BYTES = 4
_LEAST_BYTES = 16  # shorter codes are not worth a word
_PART_VALUES = 60  # told in one value: it fits a packet of a thin link in a few pieces
_MAX_PARTS = 1 << 16
_HASH = 0xFFFFFF
_SEEN = KEYFRAME_KINDS & AGENT_KINDS


def told(values: Mapping[Key, bytes], session: int) -> dict[Key, bytes]:
    """The values that tell a session of the peer what is remembered. Of its keyframes only those of its own boot: an
    agent's session is its boot, counted from 1, and what it saw in earlier ones it does not hold.
    """
    worth = [key for key, code in values.items() if len(code) >= _LEAST_BYTES and key.kind != KIND]
    worth = [key for key in worth if key.kind not in _SEEN or _boot(key.id) + 1 == session]
    worth.sort(key=lambda key: (-key.id, key.kind, key.part))
    out: dict[Key, bytes] = {}
    for part, begin in enumerate(range(0, min(len(worth), _MAX_PARTS * _PART_VALUES), _PART_VALUES)):
        writer, last_id = Writer(), 0
        for key in worth[begin : begin + _PART_VALUES]:
            writer.signed(key.id - last_id)
            last_id = key.id
            writer.u8(key.kind)
            writer.varint(key.part)
            writer.raw((crc32(values[key]) & _HASH).to_bytes(3, "little"))
        out[Key(KIND, 0, part)] = writer.bytes()
    return out


def _boot(keyframe: int) -> int:
    return keyframe >> SEQUENCE_BITS + SUBMAP_BITS & (1 << BOOT_BITS) - 1


def heard(code: bytes) -> dict[Key, int]:
    """What the peer remembers: a short checksum by key. Raises WireError."""
    source, last_id = Reader(code), 0
    out: dict[Key, int] = {}
    while source.left:
        last_id += source.signed(1 << 62)
        key = Key(source.u8(), last_id, source.varint(0xFFFF))
        if not 0 <= last_id < 1 << 62 or key.kind >= KIND:
            raise WireError(f"{key} cannot be remembered")
        out[key] = int.from_bytes(source.raw(3), "little")
    return out


def form_of(key: Key, code: bytes, remembered: Mapping[Key, int]) -> bytes | None:
    """In place of a code that the peer remembers, its checksum; else None."""
    if not remembered or key not in remembered:
        return None
    checksum = crc32(code)
    return pack("<I", checksum) if remembered[key] == checksum & _HASH else None


def code_of(form: bytes, code: bytes | None) -> bytes:
    """The remembered code that a form means. Raises WireError where another one, or none, is remembered."""
    if code is None or pack("<I", crc32(code)) != form:
        raise WireError("a form of a remembered code, which is not remembered here")
    return code
