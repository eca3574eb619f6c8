"""Link models between real peers: datagrams through a relay, bytes through a slow cable, turns and outages."""

import contextlib
import os
import socket
import time

from kiteline_bench.link.relay import UdpRelay
from kiteline_hw.sim.links.link_model import LinkModel, LinkModelConfig
from kiteline_hw.sim.links.serial_pair import SerialPair

MS = 1_000_000


def peer() -> socket.socket:
    s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    s.bind(("127.0.0.1", 0))
    s.settimeout(2.0)
    return s


def test_datagrams_are_delayed_and_lost() -> None:
    slow = LinkModelConfig(delay_ns=80 * MS)
    with peer() as a, peer() as b, UdpRelay(slow, LinkModelConfig(loss=0.5), seed=3) as relay:
        b.sendto(b"hello", ("127.0.0.1", relay.port_b))
        time.sleep(0.05)
        begin_s = time.monotonic()
        a.sendto(b"up", ("127.0.0.1", relay.port_a))
        assert b.recv(100) == b"up"
        assert 0.07 < time.monotonic() - begin_s < 1.0
        for i in range(100):
            b.sendto(bytes([i]), ("127.0.0.1", relay.port_b))
            time.sleep(0.001)
        a.settimeout(0.2)
        got = []
        with contextlib.suppress(TimeoutError):
            while True:
                got.append(a.recv(100)[0])
        assert 25 < len(got) < 75
        assert got == sorted(got)


def test_turns_and_outages_of_the_model() -> None:
    config = LinkModelConfig(rate_bytes_s=1000, turn_ns=100 * MS, turn=1, outages=((10_000 * MS, 11_000 * MS),))
    link = LinkModel(config, 1)
    link.send(bytes(50), 0)  # 50 ms of the turn that begins at 100 ms
    assert link.next_ns() == 150 * MS
    link.send(bytes(100), 0)  # 50 ms more, then the next turn
    link.deliver(150 * MS)
    assert link.next_ns() == 350 * MS
    link.deliver(9_000 * MS)
    link.send(b"lost", 10_500 * MS)
    assert link.next_ns() is None
    link.send(b"back", 11_000 * MS)
    assert link.next_ns() is not None


def test_a_half_duplex_cable() -> None:
    with SerialPair(baud=57600, turn_s=0.05) as pair:
        a, b = os.open(pair.a, os.O_RDWR | os.O_NONBLOCK), os.open(pair.b, os.O_RDWR | os.O_NONBLOCK)
        os.write(a, bytes(1500))
        os.write(b, bytes(300))
        begin_s, got = time.monotonic(), [0, 0]
        while sum(got) < 1800 and time.monotonic() - begin_s < 5.0:
            for i, fd in enumerate((b, a)):
                try:
                    got[i] += len(os.read(fd, 4096))
                except BlockingIOError:
                    continue
            time.sleep(0.002)
        took_s = time.monotonic() - begin_s
        assert got == [1500, 300]
        assert 0.3 < took_s < 2.5  # 260 ms of air at 5760 B/s, half of the time the other's
        os.close(a)
        os.close(b)
