"""Two serial devices connected by a modelled cable: pseudo terminals, and a thread that copies bytes between them."""

import contextlib
import os
import pty
import random
import select
import threading
import time
import tty

from kiteline_hw.system.closing import Closing


class SerialPair(Closing):
    """Devices `a` and `b`: bytes written to one are read from the other. bit_errors: probability of a damaged byte.

    baud: bytes pass at a tenth of it; 0: at once. turn_s: half-duplex, the directions alternate in turns of this
    length. Bytes are dropped while `muted` is set.
    """

    def __init__(self, *, bit_errors: float = 0.0, seed: int = 1, baud: int = 0, turn_s: float = 0.0) -> None:
        self._baud = baud
        self._turn_s = turn_s
        self._allowance = [0.0, 0.0]
        self._filled_s = time.monotonic()
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
            allowance = self._refill()
            wanted = [m for m, h in zip(self._masters, held) if not h]
            full = [m for m, h, r in zip(reversed(self._masters), held, allowance) if h and r]
            readable, writable, _ = select.select(wanted, full, [], 0.02 if allowance[0] and allowance[1] else 0.002)
            for i, (source, sink) in enumerate(zip(self._masters, reversed(self._masters))):
                with contextlib.suppress(OSError):
                    if source in readable:
                        data = os.read(source, 256)
                        held[i] = b"" if self.muted else self._damage(data)
                    if held[i] and allowance[i] and (sink in writable or source in readable):
                        n = os.write(sink, held[i][: allowance[i]])
                        self._allowance[i] -= n
                        self.pumped_bytes[i] += n
                        held[i] = held[i][n:]

    def _refill(self) -> list[int]:
        """Number of bytes that may pass now in each direction."""
        if not self._baud:
            return [1 << 20, 1 << 20]
        now_s = time.monotonic()
        passed_s, self._filled_s = now_s - self._filled_s, now_s
        for i in range(2):
            if not self._turn_s or int(now_s / self._turn_s) % 2 == i:
                self._allowance[i] = min(self._allowance[i] + passed_s * self._baud / 10.0, self._baud / 100.0)
        return [max(0, int(r)) for r in self._allowance]

    def _damage(self, data: bytes) -> bytes:
        if not self._bit_errors:
            return data
        return bytes(
            byte ^ (1 << self._random.randrange(8)) if self._random.random() < self._bit_errors else byte
            for byte in data
        )

    def close(self) -> None:
        """Unplug the cable: both devices vanish. May be called twice."""
        self._closed.set()
        self._thread.join()
        for fd in self._masters + self._slaves:
            os.close(fd)
        self._masters, self._slaves = [], []
