"""The table of LINK kinds: the parser, the help texts, the error messages and the codec's settings come from it.

It imports nothing heavy, because `kiteline --help` prints it. The module of a row has
`open_agent_end(address, options) -> ByteLink` and `open_base_end(address, options) -> LinkHub`; where an address may
have a wrong form, also `check_address(address)`, which raises LinkError.
"""

from dataclasses import dataclass

# Addresses of a flight controller: of `mavlink:` links and of `--mavlink`.
MAVLINK_FORMS = (
    "udp:HOST:PORT (send to), udpin:HOST:PORT (listen), tcp:HOST:PORT, serial:DEVICE:BAUD; ?system=N after it "
    "names the own system id"
)


@dataclass(frozen=True, slots=True)
class LinkTraits:
    """What the codec has to know about a link.

    overhead_bytes: added to each packet on the wire; None: as the transmission profile says. profile: used unless the
    user names one; "": chosen by the measured throughput. thin: few bytes to spare, so packets are sealed with short
    tags and not encrypted.
    """

    overhead_bytes: int | None = None
    profile: str = ""
    thin: bool = False


@dataclass(frozen=True, slots=True)
class LinkKind:
    """One kind of link, written SCHEME:ADDRESS. address: its form, "" if there is none."""

    scheme: str
    address: str
    about: str
    module: str
    traits: LinkTraits = LinkTraits()

    @property
    def form(self) -> str:
        """SCHEME:ADDRESS, as users write it."""
        return f"{self.scheme}:{self.address}" if self.address else self.scheme


LINKS: tuple[LinkKind, ...] = (
    LinkKind("zenoh", "tcp/HOST:PORT", "IP network, any number of agents (a base listens on 0.0.0.0:PORT)",
             "kiteline_hw.links.zenoh_link", LinkTraits(28)),  # IPv4 and UDP
    LinkKind("serial", "DEVICE:BAUD", "cable or transparent radio",
             "kiteline_hw.links.serial_link", LinkTraits(7, "radio", thin=True)),  # COBS, two zeros and a CRC-32
    LinkKind("mavlink", "udp:HOST:PORT", "tunnel through a flight controller's telemetry",
             "kiteline_hw.mavlink.tunnel.tunnel_link", LinkTraits(76, "radio", thin=True)),  # four TUNNEL messages
    LinkKind("none", "", "no base", "kiteline_hw.links.no_link"),
)  # fmt: skip


def link_forms() -> str:
    """All forms of LINK in one line, for help texts and errors."""
    *forms, last = [kind.form for kind in LINKS]
    return f"{', '.join(forms)} or {last}"


def link_table() -> str:
    """The forms of LINK with their meanings, one a line."""
    return "\n".join(f"  {kind.form:21}  {kind.about}" for kind in LINKS)


def is_link(spec: str) -> bool:
    """True if `spec` has the scheme of a link with an address."""
    return any(kind.scheme == spec.partition(":")[0] for kind in LINKS if kind.address)


def link_traits(spec: str) -> LinkTraits:
    """Traits of a LINK; the default ones for a link that is not in the table (the barrier of a lock-step flight)."""
    scheme = spec.partition(":")[0]
    return next((kind.traits for kind in LINKS if kind.scheme == scheme), LinkTraits())
