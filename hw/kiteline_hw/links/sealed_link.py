"""A link, or a hub of links, whose packets are sealed, or watched where they are not; the functions are handed in."""

from collections.abc import Callable, Mapping
from typing import Protocol

from kiteline_hw.ports import ByteLink, LinkHub

_STRANGERS = 8  # packets that are tried in one turn of the loop: an agent that starts sends one in some turns


class PacketSealer(Protocol):
    """Seals outgoing packets."""

    def seal(self, packet: bytes) -> bytes: ...


class PacketChecker(Protocol):
    """Takes incoming packets of an agent's link: agent number and content, or None for a packet that is refused; and an
    answer to be sent back, or None.
    """

    def take(self, agent: int | None, packet: bytes) -> tuple[tuple[int, bytes] | None, bytes | None]:
        """agent: None where the packet alone says whose it is."""
        ...

    def is_familiar(self, agent: int, packet: bytes) -> bool:
        """True if a packet looks, at a glance, like those of an agent that was heard."""
        ...


class SealedLink:
    """A ByteLink to or from one agent. Packets that name another agent are dropped, and so are those of
    strangers beyond the first few: to open one costs as much as a sound packet.
    """

    def __init__(self, link: ByteLink, agent: int, sealer: PacketSealer | None, checker: PacketChecker) -> None:
        """sealer: None where packets are not sealed."""
        self._link, self._agent, self._sealer, self._checker = link, agent, sealer, checker
        self.unopened = 0
        self.heard = False  # whether a packet of the agent has opened

    def send(self, packet: bytes) -> bool:
        """Seal and send one packet; False if the link refuses it."""
        return self._link.send(packet if self._sealer is None else self._sealer.seal(packet))

    def receive(self) -> list[bytes]:
        """The packets that have arrived and opened without fault."""
        packets, strangers = [], 0
        for arrived in self._link.receive():
            if not self._checker.is_familiar(self._agent, arrived):
                strangers += 1
                if strangers > _STRANGERS:
                    self.unopened += 1
                    continue
            opened, answer = self._checker.take(self._agent, arrived)
            if answer is not None:
                self._link.send(answer)
            if opened is None or opened[0] != self._agent:
                continue
            self.heard = True
            packets.append(opened[1])
        return packets

    def close(self) -> None:
        """Close the link."""
        self._link.close()


class SealedHub:
    """A LinkHub that seals per agent. Agents for which `sealer` returns None are left out, and told so."""

    def __init__(self, hub: LinkHub, sealer: Callable[[int], PacketSealer | None], checker: PacketChecker) -> None:
        self._hub, self._sealer, self._checker = hub, sealer, checker
        self._links: dict[int, SealedLink] = {}

    def links(self) -> Mapping[int, ByteLink]:
        """The links of all agents with a key, by agent number."""
        for agent, link in self._hub.links().items():
            if agent not in self._links:
                sealer = self._sealer(agent)
                if sealer is not None:
                    self._links[agent] = SealedLink(link, agent, sealer, self._checker)
                else:
                    SealedLink(link, agent, None, self._checker).receive()
        return self._links

    def renew(self, agent: int) -> None:
        """Ask for a new sealer of an agent, whose key has changed."""
        self._links.pop(agent, None)

    def alive(self) -> frozenset[int]:
        """The agents that are reachable now and were heard: anyone can announce a number."""
        return self._hub.alive() & frozenset(agent for agent, link in self._links.items() if link.heard)

    def close(self) -> None:
        """Close all links."""
        self._hub.close()


class _LineEnd:
    """The ByteLink to an agent at the other end of a line, whose packets the hub opens."""

    def __init__(self, line: ByteLink, sealer: PacketSealer) -> None:
        self._line, self._sealer = line, sealer
        self.arrived: list[bytes] = []

    def send(self, packet: bytes) -> bool:
        """Seal and send one packet; False if the line refuses it."""
        return self._line.send(self._sealer.seal(packet))

    def receive(self) -> list[bytes]:
        """The packets that have arrived and opened without fault."""
        packets, self.arrived = self.arrived, []
        return packets

    def close(self) -> None:
        """The hub closes the line."""


class SealedLineHub:
    """A LinkHub of a cable, a radio or a tunnel, that seals. Its agent is the one that sound packets name last."""

    def __init__(self, hub: LinkHub, sealer: Callable[[int], PacketSealer | None], checker: PacketChecker) -> None:
        self._hub, self._sealer, self._checker = hub, sealer, checker
        self._ends: dict[int, _LineEnd] = {}
        self._agent: int | None = None

    def links(self) -> Mapping[int, ByteLink]:
        """The link of the agent, once it was heard."""
        for line in self._hub.links().values():
            for arrived in line.receive():
                opened, answer = self._checker.take(None, arrived)
                if answer is not None:
                    line.send(answer)
                if opened is not None:
                    self._take(line, *opened)
        return {} if self._agent is None else {self._agent: self._ends[self._agent]}

    def _take(self, line: ByteLink, agent: int, packet: bytes) -> None:
        if agent not in self._ends:
            sealer = self._sealer(agent)
            if sealer is None:
                return
            self._ends[agent] = _LineEnd(line, sealer)
        self._agent = agent
        self._ends[agent].arrived.append(packet)

    def renew(self, agent: int) -> None:
        """Ask for a new sealer of an agent, whose key has changed."""
        self._ends.pop(agent, None)
        if self._agent == agent:
            self._agent = None

    def alive(self) -> frozenset[int]:
        """The agent, if it was heard and the line may lead to it."""
        return frozenset(self.links()) if self._hub.alive() else frozenset()

    def close(self) -> None:
        """Close the line."""
        self._hub.close()


class WatchedHub:
    """A LinkHub without seals, whose packets are checked."""

    def __init__(self, hub: LinkHub, checker: PacketChecker) -> None:
        self._hub, self._checker = hub, checker
        self._links: dict[int, SealedLink] = {}

    def links(self) -> Mapping[int, ByteLink]:
        """The links of all agents, by agent number."""
        for agent, link in self._hub.links().items():
            if agent not in self._links:
                self._links[agent] = SealedLink(link, agent, None, self._checker)
        return self._links

    def alive(self) -> frozenset[int]:
        """The agents that are reachable now."""
        return self._hub.alive()

    def close(self) -> None:
        """Close all links."""
        self._hub.close()
