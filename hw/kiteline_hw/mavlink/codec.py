"""Encodes and parses MAVLink 2 frames over pymavlink's generated parser."""

from typing import Any

from pymavlink.dialects.v20 import common

from kiteline_hw.mavlink import messages
from kiteline_hw.mavlink.messages import COMPONENT_VIO, MavlinkMessage
from kiteline_hw.mavlink.sample_frames import is_sample_frame, parse_sample_frame
from kiteline_hw.mavlink.transport.signing import Signing, SigningMavlink
from kiteline_hw.mavlink.watch.messages import MESSAGES as STATUS_MESSAGES

_MARKERS = (0xFD, 0xFE)  # first byte of a frame of MAVLink 2 and 1
_SIGNED = 1  # bit of a frame's incompatibility flags
_MIN_FRAME_BYTES = 8  # the length that pymavlink expects before it has read a header
_MAX_PARSED_BYTES = 4096  # parsed bytes that pymavlink's buffer may hold before it is trimmed


class MavlinkCodec:
    """Converts bytes to messages and back, for one sender and one stream. Holds sequence number and parser state.

    only_system: messages about a vehicle are taken of this system alone; None: of all.
    """

    def __init__(self, system: int = 1, component: int = COMPONENT_VIO, signing: Signing | None = None) -> None:
        self._mav: Any = SigningMavlink(None, srcSystem=system, srcComponent=component)
        self._signing = signing
        if signing is not None:
            signing.set_up(self._mav)
        self.only_system: int | None = None
        self.other_systems = 0  # messages of other systems
        self._mav.robust_parsing = True
        self._kinds = {name: kind for kind in (*messages.MESSAGES, *STATUS_MESSAGES) for name in kind.NAMES}
        self.bad = 0  # pieces that were no valid message
        self.unknown = 0  # valid frames of messages that are not in the table
        self.signed = 0  # signed frames, whoever signed them

    @property
    def system(self) -> int:
        """The system id in the messages that are sent."""
        return int(self._mav.srcSystem)

    @system.setter
    def system(self, system: int) -> None:
        self._mav.srcSystem = system

    @property
    def has_key(self) -> bool:
        """True if messages are signed, and unsigned ones refused."""
        return self._signing is not None

    @property
    def refused(self) -> int:
        """Messages without a valid signature, where one is demanded."""
        return int(self._mav.signing.reject_count)

    def encode(self, message: MavlinkMessage) -> bytes:
        """The frame of a message."""
        if self._signing is not None:
            self._signing.before_signing(self._mav)
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
        if self.holds_sample_alone(data) and (parsed := parse_sample_frame(data)) is not None:
            system, sample = parsed
            if self.only_system not in (None, system):
                self.other_systems += 1
                return []
            return [] if sample is None else [sample]
        self._mav.buf.extend(data)
        received: list[MavlinkMessage] = []
        while (frame := self._next_frame()) is not None:
            message = self._convert(frame)
            if message is not None:
                received.append(message)
        if self._mav.buf_index > _MAX_PARSED_BYTES:
            self._mav.buf = self._mav.buf[self._mav.buf_index :]
            self._mav.buf_index = 0
        return received

    def holds_sample_alone(self, data: bytes) -> bool:
        """True if the bytes look like one inertial sample, and `receive` would parse them without what came before."""
        return is_sample_frame(data) and self._signing is None and self._mav.buf_index == len(self._mav.buf)

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
            if kind == "BAD_DATA" and frame.reason == "Invalid signature":
                continue
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
            return None
        self.signed += bool(frame.get_header().incompat_flags & _SIGNED)
        kind = self._kinds.get(name)
        if kind is not None:
            if self.only_system not in (None, frame.get_srcSystem()) and not kind.FROM_ANY_SYSTEM:
                self.other_systems += 1
                return None
            return kind.parse(frame)
        self.unknown += 1
        return None
