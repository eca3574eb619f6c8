"""Packets over a serial port or a transparent radio; the framing is handed in (ports.Framer)."""

import time
from collections.abc import Callable

from kiteline_hw.links.ends import LinkOptions, OneLinkHub
from kiteline_hw.links.queued_link import LinkCounters, QueuedLink
from kiteline_hw.ports import Framer, LinkError, LinkHub
from kiteline_hw.system.serial_port import SerialPort, parse_serial

_ALIVE_NS = 10_000_000_000  # ns after the last packet in which an agent counts as reachable: it sends one a second


class SerialLink(QueuedLink):
    """A ByteLink over a serial device, reopened with back-off after a hang-up; meanwhile packets are refused.

    Packets counted as sent have left the outbox, not necessarily the cable. Raises LinkError if `required` and the
    port cannot be opened now.
    """

    def __init__(
        self, device: str, baud: int, framer: Framer, *, required: bool = True,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:  # fmt: skip
        super().__init__()
        self._framer = framer
        self._clock = clock
        self._heard_ns: int | None = None  # when the last packet came
        self._port = SerialPort(device, baud, self._on_data, self._next_frame, required=required)

    @property
    def counters(self) -> LinkCounters:
        """What was carried and lost so far."""
        self._counters.reconnects = self._port.opened
        self._counters.callback_errors = self._port.callback_errors
        return self._counters

    @property
    def connected(self) -> bool:
        """True if the port is open; a radio without a peer looks the same."""
        return self._port.connected

    @property
    def alive(self) -> bool:
        """True if anything came from the other end lately."""
        return self._heard_ns is not None and self._clock() - self._heard_ns <= _ALIVE_NS

    def take_messages(self) -> list[str]:
        """See SerialPort."""
        return self._port.take_messages()

    def _on_data(self, data: bytes) -> None:
        for packet in self._framer.feed(data):
            self._heard_ns = self._clock()
            self.deliver(packet)

    def _next_frame(self) -> bytes:
        packet = self.next_packet()
        if packet is None:
            return b""
        frame = self._framer.encode(packet)
        self.count_sent(packet)
        return frame

    def send(self, packet: bytes) -> bool:
        """Queue one packet; False if the port is away or the outbox is full. Never blocks."""
        accepted = super().send(packet)
        self._port.wake()
        return accepted

    def close(self) -> None:
        """Close the port within a second. May be called twice."""
        self._port.close()


class SerialHub(OneLinkHub):
    """A LinkHub whose agent is reachable while packets of it come."""

    def __init__(self, link: SerialLink, agent: int) -> None:
        super().__init__(link, agent)
        self._link = link

    def alive(self) -> frozenset[int]:
        """The agent, if anything of it came in the last ten seconds."""
        return super().alive() if self._link.alive else frozenset()


def check_address(address: str) -> None:
    """Raise LinkError for anything but DEVICE:BAUD."""
    parse_serial(address)


def open_agent_end(address: str, options: LinkOptions) -> SerialLink:
    """Open DEVICE:BAUD. Raises LinkError."""
    if options.framer is None:
        raise LinkError(f"link serial:{address}: a serial line needs framing and none was handed in")
    return SerialLink(*parse_serial(address), options.framer(), required=options.required)


def open_base_end(address: str, options: LinkOptions) -> LinkHub:
    """Open DEVICE:BAUD, at whose other end is one agent. Raises LinkError."""
    return SerialHub(open_agent_end(address, options), options.agent)
