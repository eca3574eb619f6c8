"""A modelled link between real processes: two UDP ports, or two serial devices, and a LinkModel each way between."""

from __future__ import annotations

import select
import socket
import threading
import time
from types import TracebackType
from typing import Self

from kiteline_hw.sim.link_model import LinkModel, LinkModelConfig

_TICK_S = 0.005  # s that the thread sleeps at most while packets are under way


class UdpRelay:
    """Joins two peers that send datagrams to `port_a` and `port_b` of this machine; each is known by its first one.

    up: what happens on the way from a to b. down: from b to a.
    """

    def __init__(self, up: LinkModelConfig, down: LinkModelConfig, *, seed: int = 0) -> None:
        self.models = (LinkModel(up, 2 * seed), LinkModel(down, 2 * seed + 1))
        self._sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
        for s in self._sockets:
            s.bind(("127.0.0.1", 0))
            s.setblocking(False)
        self.port_a: int = self._sockets[0].getsockname()[1]
        self.port_b: int = self._sockets[1].getsockname()[1]
        self._peers: list[tuple[str, int] | None] = [None, None]
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="udp-relay", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._closed.is_set():
            busy = any(model.next_ns() is not None for model in self.models)
            ready, _, _ = select.select(self._sockets, [], [], _TICK_S if busy else 0.1)
            now_ns = time.monotonic_ns()
            for i, own in enumerate(self._sockets):
                while own in ready:
                    try:
                        data, self._peers[i] = own.recvfrom(65536)
                    except OSError:
                        break
                    self.models[i].send(data, now_ns)
            for i, other in enumerate(reversed(self._sockets)):
                peer = self._peers[1 - i]
                for data in self.models[i].deliver(now_ns):
                    if peer is not None:
                        try:
                            other.sendto(data, peer)
                        except OSError:  # nobody there: that is loss
                            continue

    def close(self) -> None:
        """Cut the link. May be called twice."""
        self._closed.set()
        self._thread.join(1.0)
        for s in self._sockets:
            s.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
