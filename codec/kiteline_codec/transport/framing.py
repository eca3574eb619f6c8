"""Packets on a raw byte stream, such as a serial cable: COBS between zero bytes, with a checksum.

Source: S. Cheshire, M. Baker, "Consistent overhead byte stuffing", 1999. A frame is COBS(packet, CRC-32 of packet
little endian) and a zero byte. After garbage a reader is synchronised again at the next zero.
"""

from zlib import crc32

from cobs import cobs

_CRC_BYTES = 4
_END = b"\0"


def frame(packet: bytes) -> bytes:
    """The bytes to write for a packet. The zero in front ends whatever noise came before."""
    return _END + bytes(cobs.encode(packet + crc32(packet).to_bytes(_CRC_BYTES, "little"))) + _END


def framed_bytes(packet_bytes: int) -> int:
    """The most bytes that `frame` makes of a packet of a length."""
    body = packet_bytes + _CRC_BYTES
    return body + body // 254 + 3


class Deframer:
    """Finds packets in a byte stream fed in pieces of any size. Memory is bounded by the longest packet allowed."""

    def __init__(self, max_packet_bytes: int = 1 << 16) -> None:
        self.damaged = 0  # frames that were no packet
        self._limit = framed_bytes(max_packet_bytes)
        self._pending = bytearray()
        self._overlong = False

    def feed(self, data: bytes) -> list[bytes]:
        """The packets that these bytes complete. Never raises: damaged frames are counted."""
        packets = []
        *complete, rest = bytes(data).split(_END)
        for piece in complete:
            self._append(piece)
            body = self._take()
            if body is not None:
                packets.append(body)
        self._append(rest)
        return packets

    def _append(self, piece: bytes) -> None:
        if self._overlong or len(self._pending) + len(piece) > self._limit:
            self._overlong = True
            self._pending.clear()
            return
        self._pending += piece

    def _take(self) -> bytes | None:
        coded, overlong = bytes(self._pending), self._overlong
        self._pending.clear()
        self._overlong = False
        if not coded and not overlong:
            return None  # two zeros in a row
        try:
            data = b"" if overlong else cobs.decode(coded)
        except cobs.DecodeError:
            data = b""
        body, checksum = data[:-_CRC_BYTES], data[-_CRC_BYTES:]
        if len(data) < _CRC_BYTES or crc32(body).to_bytes(_CRC_BYTES, "little") != checksum:
            self.damaged += 1
            return None
        return body


class StreamFramer(Deframer):
    """Both directions of one byte stream."""

    def encode(self, packet: bytes) -> bytes:
        """The bytes of one framed packet."""
        return frame(packet)
