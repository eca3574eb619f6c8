"""Two serial devices joined by a modelled cable: pseudo terminals and a thread that pumps bytes between them."""

from __future__ import annotations

import contextlib
import os
import pty
import random
import select
import threading
import tty
from types import TracebackType
from typing import Self


class SerialPair:
    """Devices `a` and `b`: what is written to one is read from the other. `bit_errors`: chance that a byte is damaged.

    `muted` swallows everything while set; `hang_up` unplugs both ends for good.
    """

    def __init__(self, *, bit_errors: float = 0.0, seed: int = 1) -> None:
        self._random = random.Random(seed)
        self._bit_errors = bit_errors
        self._masters: list[int] = []
        self._slaves: list[int] = []
        for _ in range(2):
            master, slave = pty.openpty()
            tty.setraw(slave)
            os.set_blocking(master, False)
            self._masters.append(master)
            self._slaves.append(slave)
        self.a, self.b = (os.ttyname(slave) for slave in self._slaves)
        self.muted = False
        self.pumped_bytes = [0, 0]
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._pump, name="serial-pair", daemon=True)
        self._thread.start()

    def _pump(self) -> None:
        held = [b"", b""]
        while not self._closed.is_set():
            wanted = [m for m, h in zip(self._masters, held) if not h]
            full = [m for m, h in zip(reversed(self._masters), held) if h]
            readable, writable, _ = select.select(wanted, full, [], 0.02)
            for i, (source, sink) in enumerate(zip(self._masters, reversed(self._masters))):
                with contextlib.suppress(OSError):
                    if source in readable:
                        data = os.read(source, 1024)
                        held[i] = b"" if self.muted else self._damage(data)
                    if held[i] and (sink in writable or source in readable):
                        n = os.write(sink, held[i])
                        self.pumped_bytes[i] += n
                        held[i] = held[i][n:]

    def _damage(self, data: bytes) -> bytes:
        if not self._bit_errors:
            return data
        return bytes(
            byte ^ (1 << self._random.randrange(8)) if self._random.random() < self._bit_errors else byte
            for byte in data
        )

    def hang_up(self) -> None:
        """Unplug: both devices vanish."""
        self._closed.set()
        self._thread.join()
        for fd in self._masters + self._slaves:
            os.close(fd)
        self._masters, self._slaves = [], []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.hang_up()
