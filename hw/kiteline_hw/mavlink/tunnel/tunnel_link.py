"""The tunnel through a flight controller as a ByteLink, over UDP, TCP or a serial port."""

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace

from kiteline_hw.links.ends import LinkOptions
from kiteline_hw.mavlink.transport.connection import Adopt, MavlinkConnection
from kiteline_hw.mavlink.transport.url import parse_mavlink_url
from kiteline_hw.mavlink.tunnel.tunnel_end import AGENT_END, BASE_END, TunnelConfig, TunnelEnd
from kiteline_hw.ports import ByteLink, LinkHub
from kiteline_hw.system.closing import Closing

_TICK_S = 0.01  # s between two checks of the send rate
_INBOX_PACKETS = 1024
_ALIVE_NS = 10_000_000_000  # ns after the last message in which an agent counts as reachable


class TunnelQueue:
    """Sends and receives packets by one end of a tunnel. lock: held while the end is used."""

    def __init__(self, end: TunnelEnd, lock: threading.Lock) -> None:
        self._end = end
        self._lock = lock
        self._inbox: deque[bytes] = deque(maxlen=_INBOX_PACKETS)

    def send(self, packet: bytes) -> bool:
        """Queue one packet; False if too much is queued already. Never blocks."""
        with self._lock:
            return self._end.send(packet)

    def receive(self) -> list[bytes]:
        """All packets that came in since the last call."""
        with self._lock:
            packets = list(self._inbox)
            self._inbox.clear()
        return packets


class MavlinkTunnelLink(TunnelQueue, Closing):
    """A ByteLink. url: see MAVLINK_FORMS; its system id, if it has one, is ours. Raises LinkError."""

    def __init__(
        self, url: str, config: TunnelConfig, *, required: bool = True, clock: Callable[[], int] = time.monotonic_ns
    ) -> None:  # fmt: skip
        self._clock = clock
        address = parse_mavlink_url(url)
        if address.system is not None:
            config = replace(config, system=address.system, learns_system=False)
        super().__init__(TunnelEnd(config), threading.Lock())
        self._connection = MavlinkConnection(
            address, "mavlink-tunnel", self._on_data, self._on_tick, _TICK_S, 0, required=required
        )
        self._connection.start()

    @property
    def rate_bytes_s(self) -> float:
        """The send rate that the radio allows at present, MAVLink's framing included."""
        return self._end.rate_bytes_s

    @property
    def heard(self) -> bool:
        """True once anything came from the other end."""
        return self._end.heard

    @property
    def alive(self) -> bool:
        """True if anything came from the other end lately."""
        return self._end.heard_within(_ALIVE_NS, self._clock())

    def take_messages(self) -> list[str]:
        """See MavlinkConnection."""
        return self._connection.take_messages()

    def _on_data(self, data: bytes, datagram: bool, adopt: Adopt | None) -> None:
        with self._lock:
            messages = self._end.codec.receive(data, datagram=datagram)
            if adopt is not None and messages:
                adopt()
            now_ns = self._clock()
            taken = [self._end.take(message, now_ns) for message in messages]
            self._inbox.extend(packet for packet in taken if packet is not None)

    def _on_tick(self) -> None:
        with self._lock:
            messages = self._end.poll(self._clock())
        for message in messages:
            self._connection.send(message)

    def close(self) -> None:
        """Stop, within a second. May be called twice."""
        self._connection.close()


class TunnelHub:
    """A LinkHub with one agent at the other end, known from its first packet on."""

    def __init__(self, link: MavlinkTunnelLink, agent: int) -> None:
        self._link, self._agent = link, agent

    def links(self) -> Mapping[int, ByteLink]:
        """The link by agent number; none before the agent was heard."""
        return {self._agent: self._link} if self._link.heard else {}

    def alive(self) -> frozenset[int]:
        """The agent, if anything of it came in the last ten seconds."""
        return frozenset((self._agent,) if self._link.alive else ())

    def take_messages(self) -> list[str]:
        """What is to be told of the link since the last call."""
        return self._link.take_messages()

    def close(self) -> None:
        """Close the link."""
        self._link.close()


def check_address(address: str) -> None:
    """Raise LinkError for anything but the address of a flight controller."""
    parse_mavlink_url(address)


def open_agent_end(address: str, options: LinkOptions) -> MavlinkTunnelLink:
    """Open the agent's end. Raises LinkError."""
    return MavlinkTunnelLink(address, AGENT_END, required=options.required)


def open_base_end(address: str, options: LinkOptions) -> LinkHub:
    """Open the base's end, with one agent at the other. Raises LinkError."""
    return TunnelHub(MavlinkTunnelLink(address, BASE_END, required=options.required), options.agent)
