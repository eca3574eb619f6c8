"""One link's bounded queues: what every link puts between a step loop, which never waits, and a thread, which may."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass

OUTBOX_PACKETS = 256  # packets; a second of the fastest profile: what is older is better built anew by the sender
INBOX_PACKETS = 4096  # packets; 4 MB at most with usual packets, and a loop that sleeps longer has other worries


@dataclass(slots=True)
class LinkCounters:
    """What a link did. Loss is no error, but it is counted."""

    sent_packets: int = 0
    sent_bytes: int = 0
    refused_packets: int = 0  # full outbox or no peer: send() said False
    failed_packets: int = 0  # taken by send(), then lost in the device
    received_packets: int = 0
    received_bytes: int = 0
    overrun_packets: int = 0  # the oldest of a full inbox
    reconnects: int = 0
    callback_errors: int = 0


class PacketLane:
    """An outbox and an inbox. `wake` is notified when the outbox has work; several lanes may share it."""

    def __init__(self, wake: threading.Condition) -> None:
        self.counters = LinkCounters()
        self._wake = wake
        self._outbox: deque[bytes] = deque()
        self._inbox: deque[bytes] = deque()
        self._inbox_lock = threading.Lock()

    def offer(self, packet: bytes) -> bool:
        """Queue a packet to be sent; False when the outbox is full."""
        with self._wake:
            if len(self._outbox) >= OUTBOX_PACKETS:
                self.counters.refused_packets += 1
                return False
            self._outbox.append(packet)
            self._wake.notify()
        return True

    def pending(self) -> bool:
        """Whether a packet waits to be sent."""
        return bool(self._outbox)

    def next_out(self) -> bytes | None:
        """The oldest packet to be sent, or None. The sender thread's side; `wake` may be held."""
        return self._outbox.popleft() if self._outbox else None

    def drop_out(self) -> None:
        """Forget what was to be sent: the peer that it was meant for is gone."""
        with self._wake:
            self.counters.failed_packets += len(self._outbox)
            self._outbox.clear()

    def count_sent(self, packet: bytes) -> None:
        """One packet left for the wire."""
        self.counters.sent_packets += 1
        self.counters.sent_bytes += len(packet)

    def deliver(self, packet: bytes) -> None:
        """A packet came in. The receiver thread's side; the oldest makes room when the inbox is full."""
        with self._inbox_lock:
            if len(self._inbox) >= INBOX_PACKETS:
                self._inbox.popleft()
                self.counters.overrun_packets += 1
            self._inbox.append(packet)
            self.counters.received_packets += 1
            self.counters.received_bytes += len(packet)

    def take(self) -> list[bytes]:
        """All packets that came in since the last call."""
        with self._inbox_lock:
            packets = list(self._inbox)
            self._inbox.clear()
        return packets
