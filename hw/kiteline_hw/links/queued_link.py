"""The bounded queues of a link, between a step loop that never waits and a device thread that may."""

import threading
from collections import deque
from dataclasses import dataclass

from kiteline_hw.system.closing import Closing

OUTBOX_PACKETS = 256  # packets; one second of the fastest profile: the sender builds older ones anew
INBOX_PACKETS = 4096  # packets
INBOX_BYTES = 1 << 20  # memory for them: a second of a fast Wi-Fi; the loop takes them every 5 to 50 ms
PACKET_BYTES = 64  # memory of a packet beside its bytes, roughly
MOST_PACKET_BYTES = (1 << 16) + 64  # of a packet with its seal


@dataclass(slots=True)
class LinkCounters:
    """What a link carried and lost. Loss is no error, but it is counted."""

    sent_packets: int = 0
    failed_packets: int = 0  # accepted by send(), then lost in the device
    received_packets: int = 0
    overrun_packets: int = 0  # the oldest of a full inbox, and those that are no packets by their length
    reconnects: int = 0
    callback_errors: int = 0


class QueuedLink(Closing):
    """Base class of a ByteLink with an outbox and an inbox.

    `wake` is notified when the outbox has a packet; several links of one sender thread may share it. `send` and
    `receive` are for the loop, the other methods for the device thread.
    """

    def __init__(self, wake: threading.Condition | None = None) -> None:
        self._counters = LinkCounters()
        self._wake = wake or threading.Condition()
        self._outbox: deque[bytes] = deque()
        self._inbox: deque[bytes] = deque()
        self._inbox_bytes = 0
        self._inbox_lock = threading.Lock()
        self.inbox_limit = INBOX_BYTES  # bytes

    @property
    def counters(self) -> LinkCounters:
        """What was carried and lost so far."""
        return self._counters

    @property
    def connected(self) -> bool:
        """True if a peer is known to be there."""
        raise NotImplementedError

    def send(self, packet: bytes) -> bool:
        """Queue one packet; False if no peer is there or the outbox is full. Never blocks."""
        with self._wake:
            if not self.connected or len(self._outbox) >= OUTBOX_PACKETS:
                return False
            self._outbox.append(packet)
            self._wake.notify()
        return True

    def receive(self) -> list[bytes]:
        """All packets that came in since the last call. Never blocks."""
        with self._inbox_lock:
            packets = list(self._inbox)
            self._inbox.clear()
            self._inbox_bytes = 0
        return packets

    def pending(self) -> bool:
        """True if a packet waits in the outbox."""
        return bool(self._outbox)

    def next_packet(self) -> bytes | None:
        """Remove the oldest packet from the outbox, or None. `wake` may be held."""
        return self._outbox.popleft() if self._outbox else None

    def clear_outbox(self) -> None:
        """Drop all packets that wait, because their receiver is gone."""
        with self._wake:
            self._counters.failed_packets += len(self._outbox)
            self._outbox.clear()

    def count_sent(self, packet: bytes) -> None:
        """Count a packet that was handed to the device."""
        self._counters.sent_packets += 1

    def deliver(self, packet: bytes) -> None:
        """Put a packet that came in into the inbox; the oldest ones make room if it is full."""
        with self._inbox_lock:
            if len(packet) > MOST_PACKET_BYTES:
                self._counters.overrun_packets += 1
                return
            while self._inbox and (
                len(self._inbox) >= INBOX_PACKETS
                or self._inbox_bytes + len(packet) + PACKET_BYTES > self.inbox_limit
            ):  # fmt: skip
                self._inbox_bytes -= len(self._inbox.popleft()) + PACKET_BYTES
                self._counters.overrun_packets += 1
            self._inbox.append(packet)
            self._inbox_bytes += len(packet) + PACKET_BYTES
            self._counters.received_packets += 1
