"""Link models between real processes: two UDP ports with a LinkModel or a telemetry radio between them."""

import contextlib
import select
import socket
import threading
import time
from typing import Self

from kiteline_hw.sim.links.link_model import LinkModel, LinkModelConfig
from kiteline_hw.sim.links.telemetry_radio import RoutingController
from kiteline_hw.system.closing import Closing

_TICK_S = 0.005  # s that the thread sleeps at most while packets are under way
_Address = tuple[str, int]


class _TwoPorts(Closing):
    """Two UDP ports of this machine, `port_a` and `port_b`, and a thread that forwards between them."""

    def __init__(self, name: str, far: _Address | None = None) -> None:
        self._sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
        for s in self._sockets:
            s.bind(("127.0.0.1", 0))
            s.setblocking(False)
        self.port_a: int = self._sockets[0].getsockname()[1]
        self.port_b: int = self._sockets[1].getsockname()[1]
        self._peers: list[_Address | None] = [None, far]
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def _busy(self) -> bool:
        """True if packets are in transit."""
        raise NotImplementedError

    def _forward(self, arrived: tuple[list[bytes], list[bytes]], now_ns: int) -> tuple[list[bytes], list[bytes]]:
        """Process the packets from a and from b; returns those for b and for a."""
        raise NotImplementedError

    def _run(self) -> None:
        while not self._closed.is_set():
            ready, _, _ = select.select(self._sockets, [], [], _TICK_S if self._busy() else 0.1)
            arrived: tuple[list[bytes], list[bytes]] = ([], [])
            for i, own in enumerate(self._sockets):
                while own in ready:
                    try:
                        data, self._peers[i] = own.recvfrom(65536)
                    except OSError:
                        break
                    arrived[i].append(data)
            to_b, to_a = self._forward(arrived, time.monotonic_ns())
            for i, outgoing in enumerate((to_a, to_b)):
                peer = self._peers[i]
                if peer is None:
                    continue
                for data in outgoing:
                    with contextlib.suppress(OSError):  # no listener: the packet is lost
                        self._sockets[i].sendto(data, peer)

    def close(self) -> None:
        """Stop forwarding. May be called twice."""
        self._closed.set()
        if self._thread.is_alive():
            self._thread.join(1.0)
        for s in self._sockets:
            s.close()

    def __enter__(self) -> Self:
        self._thread.start()
        return self


class UdpRelay(_TwoPorts):
    """Connects two peers that send datagrams to `port_a` and `port_b`; their addresses are those of their first ones.

    up: the link from a to b. down: from b to a. far: the address of b, if b sends nothing by itself.
    """

    def __init__(
        self, up: LinkModelConfig, down: LinkModelConfig, *, seed: int = 0, far: _Address | None = None
    ) -> None:  # fmt: skip
        super().__init__("udp-relay", far)
        self.models = (LinkModel(up, 2 * seed), LinkModel(down, 2 * seed + 1))

    def _busy(self) -> bool:
        return any(model.next_ns() is not None for model in self.models)

    def _forward(self, arrived: tuple[list[bytes], list[bytes]], now_ns: int) -> tuple[list[bytes], list[bytes]]:
        for model, packets in zip(self.models, arrived, strict=True):
            for packet in packets:
                model.send(packet, now_ns)
        return self.models[0].deliver(now_ns), self.models[1].deliver(now_ns)


class UdpController(_TwoPorts):
    """A modelled flight controller with the companion at `port_a` and the ground station at `port_b`."""

    def __init__(self, controller: RoutingController) -> None:
        super().__init__("udp-controller")
        self.controller = controller
        self._begin_ns = time.monotonic_ns()

    def _busy(self) -> bool:
        return True  # it sends telemetry of its own

    def _forward(self, arrived: tuple[list[bytes], list[bytes]], now_ns: int) -> tuple[list[bytes], list[bytes]]:
        to_a, to_b = self.controller.step(*arrived, now_ns - self._begin_ns)
        return to_b, to_a
