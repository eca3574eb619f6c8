"""Opens the links that users name: zenoh:ENDPOINT, serial:DEVICE:BAUD, mavlink:URL, none."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, overload

from kiteline_hw.ports import ByteLink, Framer, LinkError, LinkHub
from kiteline_hw.system.serial_port import parse_serial

LINK_FORMS = "zenoh:tcp/HOST:PORT, serial:DEVICE:BAUD, mavlink:udp:HOST:PORT or none"


@dataclass(frozen=True, slots=True)
class Framing:
    """A Framer put together from two functions: `encode` frames a packet, `feed` finds packets in a stream's bytes."""

    encode: Callable[[bytes], bytes]
    feed: Callable[[bytes], list[bytes]]


class NoLink:
    """The link of an agent that flies alone."""

    def send(self, packet: bytes) -> bool:
        """Nobody is there: False."""
        del packet
        return False

    def receive(self) -> list[bytes]:
        """Nothing."""
        return []

    def close(self) -> None:
        """Nothing to do."""


class OneLinkHub:
    """A base whose link leads to one agent (a cable, a radio) or to none."""

    def __init__(self, link: ByteLink | None, agent: int) -> None:
        self._links = {} if link is None else {agent: link}

    def links(self) -> Mapping[int, ByteLink]:
        """The link by agent number."""
        return self._links

    def alive(self) -> frozenset[int]:
        """The agent at the other end, who cannot be told from a silent one."""
        return frozenset(self._links)

    def close(self) -> None:
        """Close the link."""
        for link in self._links.values():
            link.close()


def split_link(spec: str) -> tuple[str, str]:
    """Kind and address of a link's name. Raises LinkError for a kind that does not exist."""
    kind, _, address = spec.partition(":")
    if kind == "none" and not address:
        return kind, ""
    if kind not in ("zenoh", "serial", "mavlink") or not address:
        raise LinkError(f"unknown link {spec!r}: expected {LINK_FORMS}")
    return kind, address


@overload
def open_link(
    spec: str,
    role: Literal["agent"],
    agent: int = ...,
    *,
    group: str = ...,
    framer: Callable[[], Framer] | None = ...,
    required: bool = ...,
) -> ByteLink: ...
@overload
def open_link(
    spec: str,
    role: Literal["base"],
    agent: int = ...,
    *,
    group: str = ...,
    framer: Callable[[], Framer] | None = ...,
    required: bool = ...,
) -> LinkHub: ...
def open_link(
    spec: str,
    role: Literal["agent", "base"],
    agent: int = 0,
    *,
    group: str = "default",
    framer: Callable[[], Framer] | None = None,
    required: bool = True,
) -> ByteLink | LinkHub:
    """Open one end of a link. An agent gets a ByteLink, a base a LinkHub. Raises LinkError.

    agent: the agent's number; for a base the number of the one agent at the other end of a serial line.
    group: flights with other group names on the same network do not see each other (zenoh).
    framer: makes the framing of a byte stream (serial).
    required: whether a serial port that cannot be opened is an error, or is waited for.
    """
    kind, address = split_link(spec)
    if kind == "none":
        return NoLink() if role == "agent" else OneLinkHub(None, agent)
    if kind == "zenoh":
        from kiteline_hw.links.zenoh_link import ZenohHub, ZenohLink

        return ZenohLink(address, agent, group=group) if role == "agent" else ZenohHub(address, group=group)
    if kind == "mavlink":
        from kiteline_hw.mavlink.tunnel import AGENT_END, BASE_END
        from kiteline_hw.mavlink.tunnel_link import MavlinkTunnelLink

        tunnel = MavlinkTunnelLink(address, AGENT_END if role == "agent" else BASE_END, required=required)
        return tunnel if role == "agent" else OneLinkHub(tunnel, agent)
    if framer is None:
        raise LinkError(f"link {spec!r}: a serial line needs framing and none was handed in")
    from kiteline_hw.links.serial_link import SerialLink

    device, baud = parse_serial(address)
    link = SerialLink(device, baud, framer(), required=required)
    return link if role == "agent" else OneLinkHub(link, agent)
