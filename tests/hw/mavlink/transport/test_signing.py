"""Signed messages: who is believed, and stamps that never go back."""

import errno
import struct
import threading
import time
from pathlib import Path

import pytest

from kiteline_hw import durable_files
from kiteline_hw.mavlink.codec import MavlinkCodec
from kiteline_hw.mavlink.messages import Heartbeat, RadioStatus, TimeSync
from kiteline_hw.mavlink.transport import signing
from kiteline_hw.mavlink.transport.signing import Signing, StampFile, read_key
from kiteline_hw.ports import LinkError

KEY, WALL_S = bytes(range(32)), 1_800_000_000.0


def signed(folder: Path, key: bytes = KEY, *, wall_s: float = WALL_S, system: int = 1) -> MavlinkCodec:
    stamps = StampFile(folder / "stamp", lambda: wall_s)
    return MavlinkCodec(system, 1, Signing(key, stamps, lambda: wall_s))


def stamp_of(frame: bytes) -> int:
    return int(struct.unpack("<Q", frame[-12:-6] + b"\0\0")[0])


def test_both_ends_of_one_key_understand_each_other(tmp_path: Path) -> None:
    a, b = signed(tmp_path / "a"), signed(tmp_path / "b")
    for i in range(3):
        frame = a.encode(TimeSync(0, i))
        assert frame[2] == 1 and len(frame) == 12 + 13 + len(frame[10:-15])
        assert b.receive(frame) == [TimeSync(0, i, 1, 1)]


def test_unsigned_wrong_and_repeated_messages_are_refused_but_radios_are_heard(tmp_path: Path) -> None:
    a, b, other = signed(tmp_path / "a"), signed(tmp_path / "b"), signed(tmp_path / "c", bytes(32))
    good = a.encode(Heartbeat(2, 3))
    assert len(b.receive(good)) == 1
    for frame in (MavlinkCodec(1, 1).encode(Heartbeat(2, 3)), other.encode(Heartbeat(2, 3)), good):
        assert b.receive(frame) == []
    assert b.refused == 3
    assert b.receive(MavlinkCodec(51, 68).encode(RadioStatus(80))) == [RadioStatus(80)]


def test_a_forged_stamp_of_the_future_locks_nobody_out(tmp_path: Path) -> None:
    a, b = signed(tmp_path / "a"), signed(tmp_path / "b")
    forger = signed(tmp_path / "c", bytes(32), wall_s=WALL_S + 1e7)
    assert b.receive(forger.encode(Heartbeat(2, 3))) == []
    assert len(b.receive(a.encode(Heartbeat(2, 3)))) == 1


def test_a_computer_without_a_clock_goes_on_with_later_stamps(tmp_path: Path) -> None:
    first = signed(tmp_path, wall_s=WALL_S)
    before = stamp_of([first.encode(TimeSync(0, i)) for i in range(50)][-1])
    after = stamp_of(signed(tmp_path, wall_s=0.0).encode(TimeSync(0, 1)))  # 1970 after a loss of power
    assert after > before
    again = stamp_of(signed(tmp_path, wall_s=0.0).encode(TimeSync(0, 1)))
    assert again > after


def test_a_long_flight_keeps_the_stored_stamp_ahead(tmp_path: Path) -> None:
    now_s = WALL_S
    stamps = StampFile(tmp_path / "stamp", lambda: now_s, beside=lambda work: work())
    codec = MavlinkCodec(1, 1, Signing(KEY, stamps, lambda: now_s))
    for _ in range(100):
        now_s += 7.0
        stamp = stamp_of(codec.encode(TimeSync(0, 1)))
        assert int((tmp_path / "stamp").read_text(encoding="ascii")) > stamp


def test_messages_never_wait_for_a_card_that_stalls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No message waits, no second write begins beside the first, and the user is told before stamps may go back."""
    now_s, asked, free = WALL_S, [], threading.Event()

    def stalls(path: Path, content: bytes) -> None:
        asked.append(now_s - WALL_S)
        if not free.wait(20.0):
            raise AssertionError("the message waited for the disk")
        durable_files.write_atomically(path, content)

    stamps = StampFile(tmp_path / "stamp", lambda: now_s)
    codec = MavlinkCodec(1, 1, Signing(KEY, stamps, lambda: now_s))
    monkeypatch.setattr(signing, "write_atomically", stalls)
    for _ in range(590):
        now_s += 0.1
        codec.encode(TimeSync(0, 1))
    assert not free.is_set() and not stamps.fault and len(asked) == 1 and asked[0] > 29.0  # it is ahead by a minute
    for _ in range(100):
        now_s += 0.1
        codec.encode(TimeSync(0, 1))
    assert "does not answer" in stamps.fault and len(asked) == 1
    free.set()
    deadline = time.monotonic() + 10.0
    while stamps.fault and time.monotonic() < deadline:
        time.sleep(0.01)
    for _ in range(100):
        now_s += 0.1
        stamp = stamp_of(codec.encode(TimeSync(0, 1)))
    while len(asked) < 2 and time.monotonic() < deadline:
        time.sleep(0.01)
    while int((tmp_path / "stamp").read_text(encoding="ascii")) <= stamp and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not stamps.fault and int((tmp_path / "stamp").read_text(encoding="ascii")) > stamp


def test_a_full_card_is_asked_every_few_seconds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now_s, asked = WALL_S, []

    def is_full(path: Path, content: bytes) -> None:
        asked.append(now_s - WALL_S)
        raise OSError(errno.ENOSPC, "No space left on device")

    stamps = StampFile(tmp_path / "stamp", lambda: now_s, beside=lambda work: work())
    codec = MavlinkCodec(1, 1, Signing(KEY, stamps, lambda: now_s))
    monkeypatch.setattr(signing, "write_atomically", is_full)
    for _ in range(600):
        now_s += 0.1
        codec.encode(TimeSync(0, 1))
    assert "No space left" in stamps.fault
    assert 4 <= len(asked) <= 7 and asked[0] > 29.0  # the stored stamp is ahead by a minute


def test_a_disk_that_cannot_be_written_stops_no_start(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    stamps = StampFile(tmp_path / "file" / "stamp", lambda: WALL_S)
    assert "cannot keep the stamp" in stamps.fault
    assert stamp_of(MavlinkCodec(1, 1, Signing(KEY, stamps, lambda: WALL_S)).encode(TimeSync(0, 1))) >= stamps.first


def test_keys(tmp_path: Path) -> None:
    path = tmp_path / "key"
    path.write_text(KEY.hex() + "\n", encoding="utf-8")
    assert read_key(path) == KEY
    path.write_text("correct horse", encoding="utf-8")  # as ground stations do: SHA-256 of the pass phrase
    assert read_key(path).hex().startswith("4104d36f")
    path.write_text(" \n", encoding="utf-8")
    with pytest.raises(LinkError, match="64 hexadecimal digits"):
        read_key(path)
    with pytest.raises(LinkError, match="cannot read the key"):
        read_key(tmp_path / "none")
