"""The link of an agent or a base that works alone."""

from kiteline_hw.links.ends import LinkOptions, OneLinkHub
from kiteline_hw.ports import LinkHub


class NoLink:
    """A ByteLink without a peer."""

    def send(self, packet: bytes) -> bool:
        """Drop the packet; returns False."""
        return False

    def receive(self) -> list[bytes]:
        """No packets."""
        return []

    def close(self) -> None:
        """Do nothing."""


def open_agent_end(address: str, options: LinkOptions) -> NoLink:
    """The agent's end."""
    return NoLink()


def open_base_end(address: str, options: LinkOptions) -> LinkHub:
    """The base's end."""
    return OneLinkHub(None, options.agent)
