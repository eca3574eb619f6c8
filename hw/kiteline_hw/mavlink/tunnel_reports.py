"""Flow control of a tunnel by what arrives: each end reports it, and the other sets its rate by that. Pure."""

from __future__ import annotations

import struct
from collections import deque

_REPORT = struct.Struct("<HHBBB")  # chunks received so far, ms since the last one, its two bytes of head, who reports
_LOGGED = 512  # chunks that are remembered as sent
_LEAST = 6  # chunks by which a share of losses is judged
_LOST, _SOME_LOST = 0.35, 0.15  # share of chunks: a link that is overrun; one that begins to be
_QUEUED_NS, _SOME_QUEUED_NS = 1_500_000_000, 700_000_000  # ns beyond the least delay seen: the same
_SILENT_NS = 4_000_000_000  # ns without a report after which the link counts as overrun
_FALL, _SLOW_FALL, _RISE = 0.8, 0.95, 1.05  # change of the rate with each report


class Arrivals:
    """Counts the chunks that arrive."""

    def __init__(self) -> None:
        self._count, self._head, self._t_ns = 0, (0, 0), 0

    def add(self, number: int, part: int, now_ns: int) -> None:
        """Add a chunk with the two bytes of its head."""
        self._count, self._head, self._t_ns = (self._count + 1) % 65536, (number, part), now_ns

    def report(self, now_ns: int, *, is_base: bool) -> bytes:
        """The report to the sender. is_base: it comes from a base."""
        return _REPORT.pack(self._count, min((now_ns - self._t_ns) // 1_000_000, 65535), *self._head, is_base)


def is_of_base(report: bytes) -> bool | None:
    """Whether a report comes from a base; None if it is no report."""
    return bool(report[_REPORT.size - 1]) if len(report) >= _REPORT.size else None


class Departures:
    """Remembers the chunks that were sent, and judges the link by reports. Factors apply to the rate."""

    def __init__(self) -> None:
        self._log: deque[tuple[tuple[int, int], int, int]] = deque(maxlen=_LOGGED)  # head, chunks sent with it, time
        self._sent = 0
        self._judged: tuple[int, int] | None = None  # chunks sent and received at the last judgement
        self._least_ns: int | None = None  # least delay
        self._reported_ns: int | None = None

    def add(self, number: int, part: int, now_ns: int) -> None:
        """Add a chunk that is sent now."""
        self._sent += 1
        self._log.append(((number, part), self._sent, now_ns))

    def factor(self, report: bytes, now_ns: int) -> float:
        """The change of the rate by a report; 1 if it tells too little."""
        if len(report) < _REPORT.size:
            return 1.0
        count, age_ms, *head, _ = _REPORT.unpack(report[: _REPORT.size])
        self._reported_ns = now_ns
        chunk = next((entry for entry in reversed(self._log) if entry[0] == tuple(head)), None)
        if chunk is None or age_ms == 65535:
            return 1.0
        _, sent, sent_ns = chunk
        delay_ns = now_ns - sent_ns - age_ms * 1_000_000
        self._least_ns = delay_ns if self._least_ns is None else min(self._least_ns, delay_ns)
        queued_ns = delay_ns - self._least_ns
        if self._judged is None or sent < self._judged[0]:
            self._judged = sent, count
            return 1.0
        n = sent - self._judged[0]
        lost = 0.0
        if n >= _LEAST:
            arrived = (count - self._judged[1]) % 65536
            lost = 0.0 if arrived > n else 1.0 - arrived / n  # more than sent: the other end was restarted
            self._judged = sent, count
        if lost > _LOST or queued_ns > _QUEUED_NS:
            return _FALL
        if lost > _SOME_LOST or queued_ns > _SOME_QUEUED_NS:
            return _SLOW_FALL
        return _RISE

    def factor_of_silence(self, now_ns: int) -> float:
        """The change of the rate if reports stopped coming while chunks are sent."""
        if self._reported_ns is None or now_ns - self._reported_ns < _SILENT_NS or not self._log:
            return 1.0
        return _FALL if self._log[-1][2] > self._reported_ns else 1.0
