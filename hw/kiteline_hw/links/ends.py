"""What the ends of all links share: the options they are opened with, and the hub of a link to a single agent."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from kiteline_hw.ports import ByteLink, Framer, link_messages


@dataclass(frozen=True, slots=True)
class LinkOptions:
    """How one end of a link is opened.

    agent: number of the agent at this end or, for a base on a serial line, at the other end. framer: makes the framing
    of a byte stream (serial). required: a port that cannot be opened is an error; else the link waits for it. logins:
    users and passwords (zenoh): that of an agent, for bases that ask for one; those without which a base takes no
    connection.
    """

    agent: int = 0
    framer: Callable[[], Framer] | None = None
    required: bool = True
    logins: Mapping[str, str] = field(default_factory=dict)


class OneLinkHub:
    """A LinkHub whose link leads to one agent (cable, radio) or to none."""

    def __init__(self, link: ByteLink | None, agent: int) -> None:
        self._links = {} if link is None else {agent: link}

    def links(self) -> Mapping[int, ByteLink]:
        """The link by agent number."""
        return self._links

    def alive(self) -> frozenset[int]:
        """The agent at the other end: a silent one cannot be distinguished from one that is away."""
        return frozenset(self._links)

    def take_messages(self) -> list[str]:
        """What is to be told of the link since the last call."""
        return [message for link in self._links.values() for message in link_messages(link)]

    def close(self) -> None:
        """Close the link."""
        for link in self._links.values():
            link.close()
