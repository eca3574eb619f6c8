"""Progress of a long task: a bar on a terminal, else a plain line every few seconds."""

import sys
import time
from typing import TextIO

BAR_WIDTH = 28  # cells; leaves room for counts and a note in 80 columns
BAR_PERIOD_S = 0.1  # a terminal over ssh is slow
LINE_PERIOD_S = 5.0  # few lines in a log file
RATE_PERIOD_S = 2.0  # of work, before its rate tells the time left


class Progress:
    """A context manager: `with Progress("flying", 440, "frames") as p: p.update(done, "…")`."""

    def __init__(self, label: str, total: int | None, unit: str = "", stream: TextIO | None = None) -> None:
        self._label, self._total, self._unit = label, total, unit
        self._stream = sys.stderr if stream is None else stream
        self._tty = self._stream.isatty()
        self._start_s = time.monotonic()
        self._shown_s = self._start_s if not self._tty else -1e9
        self._done = 0
        self._begun: tuple[float, int] | None = None  # s and units at the first update: what loads before it is no rate
        self._note = ""
        self._width = 0

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            self._show(last=True)
        elif self._tty:
            self._stream.write("\n")
            self._stream.flush()

    def update(self, done: int, note: str = "") -> None:
        """Report that `done` units are done; drawn at most once a period."""
        self._done, self._note = done, note
        now_s = time.monotonic()
        if self._begun is None:
            self._begun = now_s, done
        if now_s - self._shown_s >= (BAR_PERIOD_S if self._tty else LINE_PERIOD_S):
            self._shown_s = now_s
            self._show(last=False)

    def _show(self, last: bool) -> None:
        elapsed_s = time.monotonic() - self._start_s
        count = f"{self._done}/{self._total}" if self._total else str(self._done)
        rest = f"  {elapsed_s:.1f} s" if last else self._left()
        note = f"  {self._note}" if self._note else ""
        if not self._tty:
            self._stream.write(f"{self._label}: {count} {self._unit}{rest}{note}\n")
            self._stream.flush()
            return
        bar = ""
        if self._total:
            full = min(BAR_WIDTH, self._done * BAR_WIDTH // self._total)
            bar = "█" * full + "░" * (BAR_WIDTH - full) + " "
        text = f"{self._label} {bar}{count} {self._unit}{rest}{note}"
        self._stream.write("\r" + text.ljust(self._width) + ("\n" if last else ""))
        self._stream.flush()
        self._width = len(text)

    def _left(self) -> str:
        """The time left by the rate since the first update; nothing while that is not known."""
        if not self._total or self._begun is None:
            return ""
        begun_s, before = self._begun
        worked_s = time.monotonic() - begun_s
        if worked_s < RATE_PERIOD_S or self._done <= before:
            return ""
        left_s = worked_s / (self._done - before) * max(0, self._total - self._done)
        return f"  {left_s:.0f} s left"
