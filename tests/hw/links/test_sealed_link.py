"""Sealed links, and the key file."""

from pathlib import Path

import pytest

from kiteline_codec.transport.seal import Direction, Opener, Sealer, Suite
from kiteline_codec.transport.seal_watch import SealWatch
from kiteline_hw.links.ends import OneLinkHub
from kiteline_hw.links.sealed_link import SealedHub, SealedLineHub, SealedLink
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
    for number in (1, 2):
        new_key(path, number)
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
    assert hub.links() and hub.alive() == frozenset()  # anyone can announce a number
    assert hub.links()[1].receive() == [b"up"]
    assert hub.links()[1].send(b"down")
    up.inbox = list(down.sent)
    assert agent.receive() == [b"down"]
    assert hub.alive() == {1}


def test_packets_of_a_flood_are_not_opened(tmp_path: Path) -> None:
    """Each cost as much as a sound one."""
    key, forged = bytes(32), bytes([1]) * 32
    opener, wire = Opener({1: key}, Direction.UP), Wire()
    link = SealedLink(wire, 1, None, SealWatch(Direction.DOWN, opener))
    agent = Sealer(key, 1, 4, Direction.UP, Suite.ENCRYPTED)
    stranger = Sealer(forged, 1, 5, Direction.UP, Suite.ENCRYPTED)
    wire.inbox = [agent.seal(b"first")]
    assert link.receive() == [b"first"]
    for _ in range(3):
        wire.inbox = [stranger.seal(bytes(100)) for _ in range(500)] + [agent.seal(b"sound")]
        assert link.receive() == [b"sound"]
    assert opener.counters.forged <= 3 * 10 and link.unopened > 1400
    # an agent that starts again is heard within some turns
    again = Sealer(key, 1, 6, Direction.UP, Suite.ENCRYPTED)
    wire.inbox = [stranger.seal(bytes(100)), again.seal(b"again"), *(stranger.seal(bytes(100)) for _ in range(100))]
    assert link.receive() == [b"again"]
    wire.inbox = [*(stranger.seal(bytes(100)) for _ in range(100)), again.seal(b"more")]
    assert link.receive() == [b"more"]


@pytest.mark.parametrize("first", [Suite.TAGGED << 7 | 1, 0xFF], ids=["of the agent", "of nobody"])
def test_a_flood_of_tagged_packets_is_not_opened_either(first: int) -> None:
    """Their first byte alone made them familiar."""
    opener, wire = Opener({1: bytes(32)}, Direction.UP), Wire()
    link = SealedLink(wire, 1, None, SealWatch(Direction.DOWN, opener))
    agent = Sealer(bytes(32), 1, 4, Direction.UP, Suite.ENCRYPTED)
    wire.inbox = [agent.seal(b"first")]
    assert link.receive() == [b"first"]
    wire.inbox = [*(bytes((first, 5, n)) + bytes(1000) for n in range(100)), agent.seal(b"sound")]
    assert link.receive() == [b"sound"]
    assert opener.counters.refused <= 10 and link.unopened >= 90


def test_tagged_packets_of_an_agent_that_was_heard_all_open() -> None:
    opener, wire = Opener({1: bytes(32)}, Direction.UP), Wire()
    link = SealedLink(wire, 1, None, SealWatch(Direction.DOWN, opener))
    agent = Sealer(bytes(32), 1, 4, Direction.UP, Suite.TAGGED)
    wire.inbox = [agent.seal(b"first")]
    assert link.receive() == [b"first"]
    wire.inbox = [agent.seal(bytes((n,))) for n in range(50)]
    assert link.receive() == [bytes((n,)) for n in range(50)]


def test_the_agent_of_a_line_is_the_one_that_sound_packets_name(tmp_path: Path) -> None:
    path = tmp_path / "keys"
    for agent in (2, 3):
        new_key(path, agent)
    keys, line = read_keys(path), Wire()
    made: list[int] = []

    def sealer(agent: int) -> Sealer:
        made.append(agent)
        return Sealer(keys[agent], agent, 9, Direction.DOWN, Suite.TAGGED)

    hub = SealedLineHub(OneLinkHub(line, 0), sealer, SealWatch(Direction.DOWN, Opener(keys, Direction.UP)))
    assert hub.links() == {} and hub.alive() == frozenset()
    ups = {agent: Sealer(keys[agent], agent, 4, Direction.UP, Suite.TAGGED) for agent in keys}
    line.inbox = [b"noise", ups[3].seal(b"one"), ups[3].seal(b"two")]
    assert hub.alive() == {3}
    assert hub.links()[3].receive() == [b"one", b"two"] and hub.links()[3].receive() == []
    line.sent.clear()
    assert hub.links()[3].send(b"down")
    assert Opener(keys, Direction.DOWN).open(line.sent[0]) == (3, b"down")
    line.inbox = [ups[2].seal(b"another drone")]
    assert list(hub.links()) == [2] and hub.links()[2].receive() == [b"another drone"]
    line.inbox = [ups[3].seal(b"again")]
    assert list(hub.links()) == [3] and made == [3, 2]  # a sealer goes on counting
    hub.renew(3)
    assert hub.links() == {}


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


@pytest.mark.parametrize("line", ["5", "5 xyz", "256 " + "00" * 32, "5 " + "00" * 31, "5 " + "00" * 32 + " more"])
def test_a_malformed_line_is_named(tmp_path: Path, line: str) -> None:
    path = tmp_path / "keys"
    path.write_text(f"# keys\n{line}\n")
    path.chmod(0o600)
    with pytest.raises(LinkError, match="line 2"):
        read_keys(path)


def test_a_missing_key_file_names_the_command(tmp_path: Path) -> None:
    with pytest.raises(LinkError, match=r"kiteline keys --file \S+ pair N"):
        read_keys(tmp_path / "none")
    with pytest.raises(LinkError, match="0 to 255"):
        new_key(tmp_path / "keys", 256)
