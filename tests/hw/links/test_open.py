"""Links opened by name."""

import socket
import time

import pytest

from kiteline_hw.links.ends import LinkOptions
from kiteline_hw.links.open import open_link
from kiteline_hw.ports import LinkError
from kiteline_hw.sim.links.serial_pair import SerialPair


class Lines:
    """The simplest framing: a line a packet."""

    def __init__(self) -> None:
        self._buffer = b""

    def encode(self, packet: bytes) -> bytes:
        return packet + b"\n"

    def feed(self, data: bytes) -> list[bytes]:
        *packets, self._buffer = (self._buffer + data).split(b"\n")
        return packets


def pass_one(base_spec: str, agent_spec: str) -> None:
    hub = open_link(base_spec, "base", LinkOptions(3, Lines))
    agent = open_link(agent_spec, "agent", LinkOptions(3, Lines))
    try:
        end_s = time.monotonic() + 8.0
        received: list[bytes] = []
        while not received and time.monotonic() < end_s:
            agent.send(b"hello")
            time.sleep(0.01)
            received = hub.links()[3].receive() if 3 in hub.links() else []
        assert received[0] == b"hello"
        assert hub.alive() == {3}
    finally:
        agent.close()
        hub.close()


def test_zenoh() -> None:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        spec = f"zenoh:tcp/127.0.0.1:{s.getsockname()[1]}"
    pass_one(spec, spec)


def test_serial() -> None:
    with SerialPair() as pair:
        pass_one(f"serial:{pair.a}:57600", f"serial:{pair.b}:57600")


def test_none() -> None:
    link, hub = open_link("none", "agent"), open_link("none", "base")
    assert not link.send(b"x") and link.receive() == []
    assert not hub.links() and not hub.alive()
    link.close()
    hub.close()


@pytest.mark.parametrize("role", ["agent", "base"])
@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("", "expected zenoh:tcp/HOST:PORT, serial:DEVICE:BAUD, mavlink"),
        ("zenoh:", "unknown link"),
        ("none:x", "unknown link"),
        ("carrier-pigeon:7", "unknown link 'carrier-pigeon:7'"),
        ("mavlink:pigeon:1", "expected udp:HOST:PORT"),
        ("zenoh:tcp/127.0.0.1", "has no port: write tcp/127.0.0.1:7447"),
        ("zenoh:router/tcp/[::1]?rel=1", r"has no port: write router/tcp/\[::1\]:7447\?rel=1"),
        ("serial:/dev/ttyNONE", "expected DEVICE:BAUD"),
        ("serial:/dev/ttyNONE:57600", "cannot open serial port /dev/ttyNONE"),
    ],
)
def test_bad_names(spec: str, words: str, role: str) -> None:
    with pytest.raises(LinkError, match=words):
        open_link(spec, role, LinkOptions(framer=Lines))  # type: ignore[call-overload]


def test_serial_without_framing() -> None:
    with pytest.raises(LinkError, match="needs framing"):
        open_link("serial:/dev/ttyNONE:57600", "agent")
