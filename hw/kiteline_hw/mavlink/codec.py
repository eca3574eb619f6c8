"""Encodes and parses MAVLink 2 frames over pymavlink's generated parser."""

from __future__ import annotations

from typing import Any

from pymavlink.dialects.v20 import common

from kiteline_hw.mavlink import messages
from kiteline_hw.mavlink.messages import COMPONENT_VIO, MavlinkMessage
from kiteline_hw.mavlink.watch.messages import MESSAGES as STATUS_MESSAGES

_MARKERS = (0xFD, 0xFE)  # first byte of a frame of MAVLink 2 and 1
_SIGNED = 1  # bit of a frame's incompatibility flags
_MIN_FRAME_BYTES = 8  # the length that pymavlink expects before it has read a header
_MAX_PARSED_BYTES = 4096  # parsed bytes that pymavlink's buffer may hold before it is trimmed


class MavlinkCodec:
    """Converts bytes to messages and back, for one sender and one stream. Holds sequence number and parser state."""

    def __init__(self, system: int = 1, component: int = COMPONENT_VIO) -> None:
        self._mav: Any = common.MAVLink(None, srcSystem=system, srcComponent=component)
        self._mav.robust_parsing = True
        self._kinds = {name: kind for kind in (*messages.MESSAGES, *STATUS_MESSAGES) for name in kind.NAMES}
        self.bad = 0  # pieces that were no valid message
        self.unknown = 0  # valid frames of messages that are not in the table
        self.signed = 0  # signed frames, whoever signed them
        self.refused = 0  # frames whose signature is missing or is not by our key

    def encode(self, message: MavlinkMessage) -> bytes:
        """The frame of a message."""
        generated = getattr(common, f"MAVLink_{message.NAMES[0].lower()}_message")
        data = bytes(generated(*message.values()).pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        return data

    def receive(self, data: bytes, *, datagram: bool = False) -> list[MavlinkMessage]:
        """Add bytes, in pieces of any size; the messages that they complete. Never raises.

        datagram: the bytes are a whole datagram, so no message continues in the next one.
        """
        if datagram:
            self._drop_buffer()
        self._mav.buf.extend(data)
        received = []
        while (frame := self._next_frame()) is not None:
            message = self._convert(frame)
            if message is not None:
                received.append(message)
        if self._mav.buf_index > _MAX_PARSED_BYTES:
            self._mav.buf = self._mav.buf[self._mav.buf_index :]
            self._mav.buf_index = 0
        return received

    def _next_frame(self) -> Any:
        """The next frame in the buffer, or None.

        Bytes that began like a frame and were none are searched for frames within: pymavlink alone would drop up to 280
        good bytes after one stray marker.
        """
        while True:
            try:
                frame = self._mav.parse_char(b"")
            except Exception:  # generated decoders document no exceptions for malformed bytes
                self.bad += 1
                self._drop_buffer()
                return None
            if frame is None:
                return None
            kind = frame.get_type()
            rest = self._mav.buf[self._mav.buf_index :]
            doubtful = kind.startswith("UNKNOWN") and len(rest) > 0 and rest[0] not in _MARKERS  # checksum unknown
            if not (doubtful or (kind == "BAD_DATA" and len(frame.data) > 1 and frame.data[0] in _MARKERS)):
                return frame
            self.bad += 1
            self._mav.buf = bytearray(frame.data[1:]) + rest
            self._mav.buf_index = 0
            self._mav.expected_length = _MIN_FRAME_BYTES

    def _drop_buffer(self) -> None:
        self._mav.buf = bytearray()
        self._mav.buf_index = 0
        self._mav.expected_length = _MIN_FRAME_BYTES

    def _convert(self, frame: Any) -> MavlinkMessage | None:
        name = frame.get_type()
        if name == "BAD_DATA":
            self.bad += 1
            self.refused += "signature" in str(frame.reason)
            return None
        self.signed += bool(frame.get_header().incompat_flags & _SIGNED)
        kind = self._kinds.get(name)
        if kind is not None:
            return kind.parse(frame)
        self.unknown += 1
        return None
