"""What the codec must know about a link."""

from typing import Protocol


class LinkTraits(Protocol):
    """Traits of a kind of link; `kiteline_hw.links.kinds.LinkTraits` is one."""

    @property
    def overhead_bytes(self) -> int | None:
        """Cost of a packet on the wire beyond its own bytes; None: as the profile says."""
        ...

    @property
    def profile(self) -> str:
        """The profile if none is given: wifi, radio, or "" to choose by budget and throughput."""
        ...

    @property
    def thin(self) -> bool:
        """True if packets are sealed with short tags and not encrypted."""
        ...
