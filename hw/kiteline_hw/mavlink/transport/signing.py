"""Signatures of MAVLink 2 messages, with a stamp that never goes back, even on a computer without a clock."""

import contextlib
import hashlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import common

from kiteline_hw.durable_files import in_thread, write_atomically
from kiteline_hw.ports import LinkError

_EPOCH_S = 1420070400  # s: 1 January 2015, at which stamps begin
_TICKS = 100_000  # stamps count 10 us
_AHEAD = 60 * _TICKS  # by which the stored stamp is ahead of those in use
_AGAIN = 5 * _TICKS  # from one attempt to store it to the next
_RADIO_STATUS = 109  # telemetry radios cannot sign
_EXPECTED = "expected a file with 64 hexadecimal digits, or the pass phrase set in the ground station"


def read_key(path: Path) -> bytes:
    """The key (32 bytes) of a file: 64 hexadecimal digits, or a pass phrase, whose SHA-256 it is. Raises LinkError."""
    try:
        text = path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "no text"
        raise LinkError(f"{path}: cannot read the key of MAVLink's signatures ({why}); {_EXPECTED}") from error
    if not text:
        raise LinkError(f"{path}: no key; {_EXPECTED}")
    with contextlib.suppress(ValueError):
        if len(text) == 64:
            return bytes.fromhex(text)
    return hashlib.sha256(text.encode()).digest()


class StampFile:
    """Keeps on disk a stamp later than all that were used, so that stamps increase even over a loss of power.

    first: the stamp to begin with. fault: why it cannot be kept, "" if it is. In flight the disk is written beside the
    messages: a card that stalls must not hold up the poses.
    """

    def __init__(
        self,
        path: Path,
        wall_s: Callable[[], float] = time.time,
        beside: Callable[[Callable[[], None]], None] = in_thread,
    ) -> None:
        """beside: does a piece of work without waiting for it."""
        self._path, self._beside = path, beside
        stored = 0
        with contextlib.suppress(OSError, ValueError):
            stored = int(path.read_text(encoding="ascii"))
        self.first = max(stored, round((wall_s() - _EPOCH_S) * _TICKS), 1)
        self._reserved = self._asked = self.first  # on disk; when it was written last, or tried
        self._writing = False
        self.fault = ""
        self._store(self.first)

    def reserve(self, stamp: int) -> None:
        """Have a stamp ahead of `stamp` stored, unless the stored one is ahead of it already or was just tried."""
        if stamp < self._reserved - _AHEAD // 2 or stamp < self._asked + _AGAIN:
            return
        self._asked = stamp
        if self._writing:  # two writes would share a file
            if stamp > self._reserved:
                self.fault = self._fault("the disk does not answer")
            return
        self._writing = True
        self._beside(lambda: self._store(stamp))

    def _store(self, stamp: int) -> None:
        """Store a stamp ahead of this one."""
        try:
            write_atomically(self._path, str(stamp + _AHEAD).encode())
        except OSError as error:
            self.fault = self._fault(error.strerror or str(error))
        else:
            self._reserved, self.fault = stamp + _AHEAD, ""
        finally:
            self._writing = False

    def _fault(self, reason: str) -> str:
        return f"{self._path}: cannot keep the stamp of MAVLink's signatures ({reason})"


class SigningMavlink(common.MAVLink):  # type: ignore[misc]  # pymavlink's classes are untyped
    """pymavlink's parser, which verifies a signature before it takes over the stamp: a forged stamp has no effect."""

    def check_signature(self, msgbuf: bytearray, srcSystem: int, srcComponent: int) -> bool:
        key: Any = self.signing.secret_key
        right: bool = hashlib.sha256(key + bytes(msgbuf[:-6])).digest()[:6] == bytes(msgbuf[-6:])
        return right and bool(super().check_signature(msgbuf, srcSystem, srcComponent))


class Signing:
    """A key with its stamps. Unsigned messages are refused, but for those of radios."""

    def __init__(self, key: bytes, stamps: StampFile, wall_s: Callable[[], float] = time.time) -> None:
        self._key, self._stamps, self._wall_s = key, stamps, wall_s

    def set_up(self, mav: Any) -> None:
        """Sign and verify with a parser from now on."""
        mav.signing.secret_key = self._key
        mav.signing.sign_outgoing = True
        mav.signing.timestamp = self._stamps.first
        mav.signing.allow_unsigned_callback = lambda _, message: message == _RADIO_STATUS

    def before_signing(self, mav: Any) -> None:
        """Move the stamp on with the clock before a message is signed."""
        mav.signing.timestamp = max(mav.signing.timestamp, round((self._wall_s() - _EPOCH_S) * _TICKS))
        self._stamps.reserve(mav.signing.timestamp)
