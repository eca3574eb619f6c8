"""Addresses of flight controllers."""

from dataclasses import dataclass

from kiteline_hw.links.kinds import MAVLINK_FORMS
from kiteline_hw.ports import LinkError
from kiteline_hw.system.serial_port import parse_serial

_UDP = {"udp": "udpout", "udpout": "udpout", "udpin": "udpin", "tcp": "tcp"}


@dataclass(frozen=True, slots=True)
class MavlinkUrl:
    """Address of a flight controller.

    kind: "udpout", "udpin", "tcp" or "serial". port: of UDP or TCP, or baud rate. system: our MAVLink system id, which
    onboard is that of the vehicle; None: it is learnt.
    """

    kind: str
    address: str
    port: int
    system: int | None = None

    def same_port(self, other: "MavlinkUrl") -> bool:
        """True if both name the same serial device or socket."""
        if self.kind == other.kind == "serial":
            return self.address == other.address
        return (self.kind, self.address, self.port) == (other.kind, other.address, other.port)


def parse_mavlink_url(url: str) -> MavlinkUrl:
    """Parse udp:HOST:PORT, udpout:…, udpin:…, tcp:HOST:PORT, serial:DEVICE:BAUD, with ?system=N. Raises LinkError."""
    form = f"flight controller {url!r}: expected {MAVLINK_FORMS}"
    place, _, query = url.partition("?")
    system = None
    if query:
        key, _, value = query.partition("=")
        if key != "system" or not value.isdecimal() or not 0 < int(value) < 256:
            raise LinkError(f"{form}; after ?, system=1 to system=255")
        system = int(value)
    kind, _, rest = place.partition(":")
    if kind == "serial":
        return MavlinkUrl("serial", *parse_serial(rest), system)
    host, _, port = rest.removeprefix("//").rpartition(":")
    if kind not in _UDP or not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise LinkError(form)
    return MavlinkUrl(_UDP[kind], host, int(port), system)
