"""Signatures of MAVLink 2 messages, with a stamp that never goes back, even on a computer without a clock."""

import contextlib
import hashlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import common

from kiteline_hw.durable_files import write_atomically
from kiteline_hw.ports import LinkError

_EPOCH_S = 1420070400  # s: 1 January 2015, at which stamps begin
_TICKS = 100_000  # stamps count 10 us
_AHEAD = 60 * _TICKS  # by which the stored stamp is ahead of those in use
_RADIO_STATUS = 109  # telemetry radios cannot sign


def read_key(path: Path) -> bytes:
    """The key (32 bytes) of a file: 64 hexadecimal digits, or a pass phrase, whose SHA-256 it is. Raises LinkError."""
    try:
        text = path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise LinkError(f"{path}: cannot read the key of MAVLink's signatures ({error})") from error
    if not text:
        raise LinkError(f"{path}: no key: expected 64 hexadecimal digits, or the pass phrase set in the ground station")
    with contextlib.suppress(ValueError):
        if len(text) == 64:
            return bytes.fromhex(text)
    return hashlib.sha256(text.encode()).digest()


class StampFile:
    """Keeps on disk a stamp later than all that were used, so that stamps increase even over a loss of power."""

    def __init__(self, path: Path, wall_s: Callable[[], float] = time.time) -> None:
        self._path = path
        stored = 0
        with contextlib.suppress(OSError, ValueError):
            stored = int(path.read_text(encoding="ascii"))
        self.first = max(stored, round((wall_s() - _EPOCH_S) * _TICKS), 1)
        self._reserved = 0
        self.reserve(self.first)

    def reserve(self, stamp: int) -> None:
        """Store a stamp ahead of `stamp`, unless the stored one is ahead of it already. Raises LinkError."""
        if stamp < self._reserved - _AHEAD // 2:
            return
        try:
            write_atomically(self._path, str(stamp + _AHEAD).encode())
        except OSError as error:
            raise LinkError(f"{self._path}: cannot keep the stamp of MAVLink's signatures ({error})") from error
        self._reserved = stamp + _AHEAD


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
        with contextlib.suppress(LinkError):  # a full disk must not stop the poses
            self._stamps.reserve(mav.signing.timestamp)
