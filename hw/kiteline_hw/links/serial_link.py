"""Packets over a serial port or a transparent radio. How packets are framed is handed in (ports.Framer)."""

from __future__ import annotations

import threading
from types import TracebackType
from typing import Self

from kiteline_hw.links.packet_lane import LinkCounters, PacketLane
from kiteline_hw.ports import Framer
from kiteline_hw.system.serial_port import SerialPort


class SerialLink:
    """A ByteLink over DEVICE. Survives hang-ups: the port is opened again with back-off, and what could not be sent
    meanwhile is refused. Raises LinkError when `required` and the port cannot be opened now.
    """

    def __init__(self, device: str, baud: int, framer: Framer, *, required: bool = True) -> None:
        self._lane = PacketLane(threading.Condition())
        self._framer = framer
        self._port = SerialPort(device, baud, self._on_data, self._next_out, required=required)

    def _on_data(self, data: bytes) -> None:
        for packet in self._framer.feed(data):
            self._lane.deliver(packet)

    def _next_out(self) -> bytes:
        packet = self._lane.next_out()
        if packet is None:
            return b""
        frame = self._framer.encode(packet)
        self._lane.count_sent(packet)
        return frame

    @property
    def counters(self) -> LinkCounters:
        """What passed and what was lost. Packets counted as sent have left the outbox, not necessarily the cable."""
        counters = self._lane.counters
        counters.reconnects = self._port.opened
        counters.callback_errors = self._port.callback_errors
        return counters

    @property
    def connected(self) -> bool:
        """Whether the port is open. A radio without a peer looks just so."""
        return self._port.connected

    def send(self, packet: bytes) -> bool:
        """Queue one packet; False when the port is away or the outbox is full. Never blocks."""
        if not self._port.connected:
            self._lane.counters.refused_packets += 1
            return False
        taken = self._lane.offer(packet)
        self._port.wake()
        return taken

    def receive(self) -> list[bytes]:
        """All packets that came in since the last call. Never blocks."""
        return self._lane.take()

    def close(self) -> None:
        """Close the port within a second. May be called twice."""
        self._port.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
