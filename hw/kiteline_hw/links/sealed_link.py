"""A link, or a hub of links, whose packets are sealed on their way. How is handed in."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

from kiteline_hw.ports import ByteLink, LinkHub


class Seals(Protocol):
    """Seals what goes out."""

    def seal(self, packet: bytes) -> bytes: ...


class Opens(Protocol):
    """Opens what comes in; None for what is not sound and new."""

    def open(self, sealed: bytes) -> tuple[int, bytes] | None: ...


class SealedLink:
    """A ByteLink to or from one agent. A packet that names another agent is not handed on."""

    def __init__(self, link: ByteLink, agent: int, sealer: Seals, opener: Opens) -> None:
        self._link, self._agent, self._sealer, self._opener = link, agent, sealer, opener
        self.misdirected = 0

    def send(self, packet: bytes) -> bool:
        """Seal and hand over one packet."""
        return self._link.send(self._sealer.seal(packet))

    def receive(self) -> list[bytes]:
        """The sound and new packets that have arrived."""
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
    """A LinkHub with a seal for each agent. Agents for whom `sealer` has none are not there."""

    def __init__(self, hub: LinkHub, sealer: Callable[[int], Seals | None], opener: Opens) -> None:
        self._hub, self._sealer, self._opener = hub, sealer, opener
        self._links: dict[int, SealedLink] = {}

    def links(self) -> Mapping[int, ByteLink]:
        """The links of all agents with a key, by number."""
        for agent, link in self._hub.links().items():
            if agent not in self._links:
                sealer = self._sealer(agent)
                if sealer is not None:
                    self._links[agent] = SealedLink(link, agent, sealer, self._opener)
        return self._links

    def alive(self) -> frozenset[int]:
        """Those of them that are reachable now."""
        return self._hub.alive() & frozenset(self.links())

    def close(self) -> None:
        """Close all links."""
        self._hub.close()
