"""A link, or a hub of links, whose packets are sealed, or watched where they are not; the functions are handed in."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

from kiteline_hw.ports import ByteLink, LinkHub


class PacketSealer(Protocol):
    """Seals outgoing packets."""

    def seal(self, packet: bytes) -> bytes: ...


class PacketDoor(Protocol):
    """Takes incoming packets of an agent's link: agent number and content, or None for a packet that is refused; and an
    answer to be sent back, or None.
    """

    def take(self, agent: int, packet: bytes) -> tuple[tuple[int, bytes] | None, bytes | None]: ...


class SealedLink:
    """A ByteLink to or from one agent. Packets that name another agent are dropped and counted."""

    def __init__(self, link: ByteLink, agent: int, sealer: PacketSealer | None, door: PacketDoor) -> None:
        """sealer: None where packets are not sealed."""
        self._link, self._agent, self._sealer, self._door = link, agent, sealer, door
        self.misdirected = 0

    def send(self, packet: bytes) -> bool:
        """Seal and send one packet; False if the link refuses it."""
        return self._link.send(packet if self._sealer is None else self._sealer.seal(packet))

    def receive(self) -> list[bytes]:
        """The packets that have arrived and opened without fault."""
        packets = []
        for arrived in self._link.receive():
            opened, answer = self._door.take(self._agent, arrived)
            if answer is not None:
                self._link.send(answer)
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
    """A LinkHub that seals per agent. Agents for which `sealer` returns None are left out, and told so."""

    def __init__(self, hub: LinkHub, sealer: Callable[[int], PacketSealer | None], door: PacketDoor) -> None:
        self._hub, self._sealer, self._door = hub, sealer, door
        self._links: dict[int, SealedLink] = {}

    def links(self) -> Mapping[int, ByteLink]:
        """The links of all agents with a key, by agent number."""
        for agent, link in self._hub.links().items():
            if agent not in self._links:
                sealer = self._sealer(agent)
                if sealer is not None:
                    self._links[agent] = SealedLink(link, agent, sealer, self._door)
                else:
                    SealedLink(link, agent, None, self._door).receive()
        return self._links

    def renew(self, agent: int) -> None:
        """Ask for a new sealer of an agent, whose key has changed."""
        self._links.pop(agent, None)

    def alive(self) -> frozenset[int]:
        """The agents with a key that are reachable now."""
        return self._hub.alive() & frozenset(self.links())

    def close(self) -> None:
        """Close all links."""
        self._hub.close()


class WatchedHub:
    """A LinkHub without seals, whose packets pass a door."""

    def __init__(self, hub: LinkHub, door: PacketDoor) -> None:
        self._hub, self._door = hub, door
        self._links: dict[int, SealedLink] = {}

    def links(self) -> Mapping[int, ByteLink]:
        """The links of all agents, by agent number."""
        for agent, link in self._hub.links().items():
            if agent not in self._links:
                self._links[agent] = SealedLink(link, agent, None, self._door)
        return self._links

    def alive(self) -> frozenset[int]:
        """The agents that are reachable now."""
        return self._hub.alive()

    def close(self) -> None:
        """Close all links."""
        self._hub.close()
