"""Flow control of a tunnel by what arrives: each end reports it, and the other sets its rate by that. Pure."""

import struct
from collections import deque

# Chunks received so far, when the last one came in ms of the receiver's clock, its two bytes of head, who reports.
_REPORT = struct.Struct("<HIBBB")
_LOGGED = 512  # chunks that are remembered as sent
_LEAST = 6  # chunks by which a share of losses is judged
_LOST, _SOME_LOST = 0.35, 0.15  # share of chunks: a link that is overrun; one that begins to be
_QUEUED_MS, _SOME_QUEUED_MS = 700, 400  # ms of delay on the way beyond the least seen: the same
_DRIFT = 1e-4  # between the two clocks, at most
_RESTART_MS = 60_000  # ms by which a delay jumps when the other end's clock begins anew
_SILENT_NS = 4_000_000_000  # ns without a report after which the link counts as overrun
_FALL, _SLOW_FALL, _RISE = 0.8, 0.95, 1.05  # change of the rate with each report


class Arrivals:
    """Counts the chunks that arrive."""

    def __init__(self) -> None:
        self._count, self._head, self._t_ns = 0, (0, 0), 0

    def add(self, number: int, part: int, now_ns: int) -> None:
        """Add a chunk with the two bytes of its head."""
        self._count, self._head, self._t_ns = (self._count + 1) % 65536, (number, part), now_ns

    def report(self, *, is_base: bool) -> bytes:
        """The report to the sender. is_base: it comes from a base."""
        return _REPORT.pack(self._count, self._t_ns // 1_000_000 % 2**32, *self._head, is_base)


def is_of_base(report: bytes) -> bool | None:
    """Whether a report comes from a base; None if it is no report."""
    return bool(report[_REPORT.size - 1]) if len(report) >= _REPORT.size else None


class Departures:
    """Remembers the chunks that were sent, and judges the link by reports. Factors apply to the rate."""

    def __init__(self) -> None:
        self._log: deque[tuple[tuple[int, int], int, int]] = deque(maxlen=_LOGGED)  # head, chunks sent with it, time
        self._sent = 0
        self._judged: tuple[int, int] | None = None  # chunks sent and received at the last judgement
        self._least_ms: float | None = None  # least delay, by two clocks
        self._heard_ms = 0  # of the last report
        self._reported_ns: int | None = None

    def add(self, number: int, part: int, now_ns: int) -> None:
        """Add a chunk that is sent now."""
        self._sent += 1
        self._log.append(((number, part), self._sent, now_ns))

    def factor(self, report: bytes, now_ns: int) -> float:
        """The change of the rate by a report; 1 if it covers too little."""
        if len(report) < _REPORT.size:
            return 1.0
        count, arrived_ms, *head, _ = _REPORT.unpack(report[: _REPORT.size])
        self._reported_ns = now_ns
        chunk = next((entry for entry in reversed(self._log) if entry[0] == tuple(head)), None)
        if chunk is None or count == 0:
            return 1.0
        _, sent, sent_ns = chunk
        queued_ms = self._queued_ms(arrived_ms - sent_ns // 1_000_000, now_ns // 1_000_000)
        if self._judged is None or sent < self._judged[0]:
            self._judged = sent, count
            return 1.0
        n = sent - self._judged[0]
        lost = 0.0
        if n >= _LEAST:
            arrived = (count - self._judged[1]) % 65536
            lost = 0.0 if arrived > n else 1.0 - arrived / n  # more than sent: the other end was restarted
            self._judged = sent, count
        if lost > _LOST or queued_ms > _QUEUED_MS:
            return _FALL
        if lost > _SOME_LOST or queued_ms > _SOME_QUEUED_MS:
            return _SLOW_FALL
        return _RISE

    def _queued_ms(self, delay_ms: int, now_ms: int) -> float:
        """By how much a delay on the way is longer than the least. The way of the report itself does not count."""
        delay_ms %= 2**32
        least, since_ms = self._least_ms, now_ms - self._heard_ms
        self._heard_ms = now_ms
        if least is None or abs(delay_ms - least) > _RESTART_MS:
            least = float(delay_ms)
        self._least_ms = min(float(delay_ms), least + _DRIFT * since_ms)
        return delay_ms - self._least_ms

    def factor_of_silence(self, now_ns: int) -> float:
        """The change of the rate if reports stopped coming while chunks are sent."""
        if self._reported_ns is None or now_ns - self._reported_ns < _SILENT_NS or not self._log:
            return 1.0
        return _FALL if self._log[-1][2] > self._reported_ns else 1.0
