"""A link, or a hub of links, whose packets are sealed; the sealing functions are handed in."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

from kiteline_hw.ports import ByteLink, LinkHub


class PacketSealer(Protocol):
    """Seals outgoing packets."""

    def seal(self, packet: bytes) -> bytes: ...


class PacketOpener(Protocol):
    """Opens incoming packets: agent number and content, or None for a forged, damaged or repeated packet."""

    def open(self, sealed: bytes) -> tuple[int, bytes] | None: ...


class SealedLink:
    """A ByteLink to or from one agent. Packets that name another agent are dropped and counted."""

    def __init__(self, link: ByteLink, agent: int, sealer: PacketSealer, opener: PacketOpener) -> None:
        self._link, self._agent, self._sealer, self._opener = link, agent, sealer, opener
        self.misdirected = 0

    def send(self, packet: bytes) -> bool:
        """Seal and send one packet; False if the link refuses it."""
        return self._link.send(self._sealer.seal(packet))

    def receive(self) -> list[bytes]:
        """The packets that have arrived and opened without fault."""
        packets = []
        for sealed in self._link.receive():
            opened = self._opener.open(sealed)
            if opened is None:
                continue
            if opened[0] != self._agent:
                self.misdirected += 1
                continue
            packets.append(opened[1])
        return packets

    def close(self) -> None:
        """Close the link."""
        self._link.close()


class SealedHub:
    """A LinkHub that seals per agent. Agents for which `sealer` returns None are left out."""

    def __init__(self, hub: LinkHub, sealer: Callable[[int], PacketSealer | None], opener: PacketOpener) -> None:
        self._hub, self._sealer, self._opener = hub, sealer, opener
        self._links: dict[int, SealedLink] = {}

    def links(self) -> Mapping[int, ByteLink]:
        """The links of all agents with a key, by agent number."""
        for agent, link in self._hub.links().items():
            if agent not in self._links:
                sealer = self._sealer(agent)
                if sealer is not None:
                    self._links[agent] = SealedLink(link, agent, sealer, self._opener)
        return self._links

    def alive(self) -> frozenset[int]:
        """The agents with a key that are reachable now."""
        return self._hub.alive() & frozenset(self.links())

    def close(self) -> None:
        """Close all links."""
        self._hub.close()
