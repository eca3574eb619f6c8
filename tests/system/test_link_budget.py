"""The byte budget holds on the wire (sealed, framed or cut into MAVLink messages) in any window of one second."""

import random
from collections import deque

import pytest

from kiteline_codec.channel import coded_channel
from kiteline_codec.schema import Key, LivePose, NewLandmarks, RefinedLandmarks
from kiteline_codec.transport.framing import frame
from kiteline_codec.transport.seal import Direction, Opener, Sealer, seal_bytes, suite_for
from kiteline_hw.links.kinds import link_traits
from kiteline_hw.mavlink.tunnel.tunnel_end import TunnelConfig, TunnelEnd

SECOND = 1_000_000_000
KEY = bytes(range(32))


def wire_bytes(link: str, packet: bytes) -> int:
    """Bytes of a packet on a link, everything included."""
    if link == "serial:x:57600":
        return len(frame(packet))
    if link.startswith("mavlink"):
        end = TunnelEnd(TunnelConfig(rate_bytes_s=1 << 30))
        end.poll(0)
        assert end.send(packet)
        return sum(len(m) for i in range(1, 40) for m in end.poll(i * 1_000_000))
    return len(packet) + 28


@pytest.mark.parametrize("link", ["serial:x:57600", "mavlink:udp:x:1", "zenoh:udp/x:1"])
@pytest.mark.parametrize("budget", [600, 1000, 5000])
def test_no_second_exceeds_the_budget(link: str, budget: int) -> None:
    draw = random.Random(budget)
    suite = suite_for(link_traits(link))
    ends = [coded_channel(1, budget, "radio", seal_bytes(suite), link_traits(link)) for _ in range(2)]
    sealers = [Sealer(KEY, 0, 1, d, suite) for d in Direction]
    openers = [Opener({0: KEY}, d) for d in Direction]
    spent: list[deque[tuple[int, int]]] = [deque(), deque()]
    most, received = [0, 0], 0
    for tick in range(1200):
        now_ns = tick * 37_000_000
        if tick % 40 == 0:
            for part in range(6):
                ends[0].endpoint.put(Key(NewLandmarks.KIND, tick, part), draw.randbytes(draw.randrange(20, 400)))
            ends[1].endpoint.put(Key(RefinedLandmarks.KIND, tick), draw.randbytes(300))
        ends[0].endpoint.put(Key(LivePose.KIND, 0), draw.randbytes(29))
        for i, end in enumerate(ends):
            for packet in end.poll(now_ns):
                sealed = sealers[i].seal(packet)
                spent[i].append((now_ns, wire_bytes(link, sealed)))
                if draw.random() < 0.9:
                    opened = openers[i].open(sealed)
                    assert opened is not None
                    ends[1 - i].endpoint.receive(opened[1], now_ns)
                    received += 1
            while spent[i] and now_ns - spent[i][0][0] > SECOND:
                spent[i].popleft()
            most[i] = max(most[i], sum(n for _, n in spent[i]))
    assert max(most) <= budget
    if budget <= 1000:  # less than what is put: the link is busy
        assert most[0] > 0.6 * budget
    else:
        assert ends[0].endpoint.backlog_bytes <= 29  # the newest live pose at most
    assert received > 100
