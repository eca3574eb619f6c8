"""The messages of a lock-step flight: one from each side per tick."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

from kiteline_hw.ports import LinkError

_NO_FRAME_NS = -1  # on the wire, after the last frame

_UP = struct.Struct("<qBI")  # next frame's flight time, flags, packets
_DOWN = struct.Struct("<qBI")  # flight time of this tick, phase, packets
_LENGTH = struct.Struct("<I")


class Phase(IntEnum):
    """The phase of the flight."""

    FLY = 0
    DRAIN = 1  # no frames left: remaining packets are exchanged
    END = 2  # the last message: close


@dataclass(frozen=True, slots=True)
class Up:
    """An agent's message. next_ns: flight time of its next frame, None after its last.

    quiet, digest_equal: state of its sync endpoint.
    """

    next_ns: int | None
    quiet: bool
    digest_equal: bool
    packets: tuple[bytes, ...]

    def encode(self) -> bytes:
        """The encoded message."""
        flags = self.quiet | self.digest_equal << 1
        next_ns = _NO_FRAME_NS if self.next_ns is None else self.next_ns
        return _UP.pack(next_ns, flags, len(self.packets)) + _join(self.packets)

    @classmethod
    def decode(cls, message: bytes) -> "Up":
        """Decode a message. Raises LinkError on any other bytes."""
        next_ns, flags, packets = _split(_UP, message)
        return cls(None if next_ns == _NO_FRAME_NS else next_ns, bool(flags & 1), bool(flags & 2), packets)


@dataclass(frozen=True, slots=True)
class Down:
    """The base's message. now_ns: flight time of the tick that begins."""

    now_ns: int
    phase: Phase
    packets: tuple[bytes, ...]

    def encode(self) -> bytes:
        """The encoded message."""
        return _DOWN.pack(self.now_ns, self.phase, len(self.packets)) + _join(self.packets)

    @classmethod
    def decode(cls, message: bytes) -> "Down":
        """Decode a message. Raises LinkError on any other bytes."""
        now_ns, phase, packets = _split(_DOWN, message)
        try:
            return cls(now_ns, Phase(phase), packets)
        except ValueError as error:
            raise LinkError(f"lock-step message of an unknown phase {phase}") from error


def _join(packets: Sequence[bytes]) -> bytes:
    return b"".join(_LENGTH.pack(len(packet)) + packet for packet in packets)


def _split(header: struct.Struct, message: bytes) -> tuple[int, int, tuple[bytes, ...]]:
    try:
        time_ns, flags, count = header.unpack_from(message)
        packets = []
        at = header.size
        for _ in range(count):
            (length,) = _LENGTH.unpack_from(message, at)
            at += _LENGTH.size
            packets.append(message[at : at + length])
            at += length
    except struct.error as error:
        raise LinkError(f"lock-step message of {len(message)} bytes is cut short") from error
    if at != len(message):
        raise LinkError(f"lock-step message of {len(message)} bytes, expected {at}: are both sides of one version?")
    return int(time_ns), int(flags), tuple(packets)
