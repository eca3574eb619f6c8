"""Sealed links, and the key file."""

from __future__ import annotations

from pathlib import Path

import pytest

from kiteline_codec.transport.seal import Direction, Opener, Sealer, Suite
from kiteline_codec.transport.seal_watch import SealWatch
from kiteline_hw.links.ends import OneLinkHub
from kiteline_hw.links.sealed_link import SealedHub, SealedLink
from kiteline_hw.ports import LinkError
from kiteline_hw.system.key_store import new_key, read_keys


class Wire:
    """A ByteLink that gives back what was put into `inbox`."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []
        self.inbox: list[bytes] = []

    def send(self, packet: bytes) -> bool:
        self.sent.append(packet)
        return True

    def receive(self) -> list[bytes]:
        packets, self.inbox = self.inbox, []
        return packets

    def close(self) -> None:
        self.sent = []


def test_sealed_packets_both_ways(tmp_path: Path) -> None:
    path = tmp_path / "keys"
    for agent in (1, 2):
        new_key(path, agent)
    keys = read_keys(path)
    down, up = Wire(), Wire()
    hub = SealedHub(
        OneLinkHub(down, 1),
        lambda a: Sealer(keys[a], a, 9, Direction.DOWN, Suite.TAGGED),
        SealWatch(Direction.DOWN, Opener(keys, Direction.UP)),
    )
    agent = SealedLink(
        up, 1, Sealer(keys[1], 1, 4, Direction.UP, Suite.TAGGED),
        SealWatch(Direction.UP, Opener({1: keys[1]}, Direction.DOWN)),
    )  # fmt: skip
    assert agent.send(b"up")
    other = Sealer(keys[2], 2, 4, Direction.UP, Suite.TAGGED)
    down.inbox = [*up.sent, up.sent[0], other.seal(b"not on this link"), b"noise"]
    assert hub.links()[1].receive() == [b"up"]
    assert hub.links()[1].send(b"down")
    up.inbox = list(down.sent)
    assert agent.receive() == [b"down"]
    assert hub.alive() == {1}


def test_an_agent_without_a_key_is_left_out(tmp_path: Path) -> None:
    hub = SealedHub(OneLinkHub(Wire(), 7), lambda a: None, SealWatch(Direction.DOWN, Opener({}, Direction.UP)))
    assert hub.links() == {}
    hub.close()


def test_the_key_file_is_readable_by_its_owner_only(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "keys"
    first = new_key(path, 5)
    assert path.stat().st_mode & 0o777 == 0o600
    assert new_key(path, 6) != first
    with pytest.raises(LinkError, match="has a key"):
        new_key(path, 5)
    assert new_key(path, 5, replace=True) != first
    assert set(read_keys(path)) == {5, 6}
    path.chmod(0o640)
    with pytest.raises(LinkError, match="chmod 600"):
        read_keys(path)


@pytest.mark.parametrize("line", ["5", "5 xyz", "64 " + "00" * 32, "5 " + "00" * 31, "5 " + "00" * 32 + " more"])
def test_a_malformed_line_is_named(tmp_path: Path, line: str) -> None:
    path = tmp_path / "keys"
    path.write_text(f"# keys\n{line}\n")
    path.chmod(0o600)
    with pytest.raises(LinkError, match="line 2"):
        read_keys(path)


def test_a_missing_key_file_names_the_command(tmp_path: Path) -> None:
    with pytest.raises(LinkError, match=r"kiteline keys --file \S+ pair N"):
        read_keys(tmp_path / "none")
    with pytest.raises(LinkError, match="0 to 63"):
        new_key(tmp_path / "keys", 64)
