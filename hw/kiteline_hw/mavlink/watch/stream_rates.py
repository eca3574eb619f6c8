"""Rate and jitter of a stream of messages by their arrivals. Pure."""

from dataclasses import dataclass, field


@dataclass(slots=True)
class StreamRate:
    """Arrivals in, rate and jitter out."""

    _arrivals_ns: list[int] = field(default_factory=list)

    def add(self, now_ns: int) -> None:
        """A message arrived."""
        self._arrivals_ns.append(now_ns)

    @property
    def rate_hz(self) -> float | None:
        """Mean rate; None before the third message."""
        if len(self._arrivals_ns) < 3:
            return None
        return (len(self._arrivals_ns) - 1) * 1e9 / max(1, self._arrivals_ns[-1] - self._arrivals_ns[0])

    @property
    def jitter_ms(self) -> float:
        """95 % of the gaps differ from their median by at most this."""
        gaps = sorted(b - a for a, b in zip(self._arrivals_ns, self._arrivals_ns[1:], strict=False))
        if not gaps:
            return 0.0
        middle = gaps[len(gaps) // 2]
        off = sorted(abs(gap - middle) for gap in gaps)
        return off[round(0.95 * (len(off) - 1))] * 1e-6
