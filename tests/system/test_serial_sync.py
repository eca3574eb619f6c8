"""The link's endpoints over a serial line with noise: both sides end with the same values."""

import random
import time

from kiteline_codec.schema import Key, KeyframePose, NewLandmarks
from kiteline_codec.sync.config import SyncConfig
from kiteline_codec.sync.endpoint import Endpoint
from kiteline_codec.transport.framing import StreamFramer
from kiteline_hw.links.ends import LinkOptions
from kiteline_hw.links.open import open_link
from kiteline_hw.ports import ByteLink
from kiteline_hw.sim.links.serial_pair import SerialPair


def turn(endpoint: Endpoint, link: ByteLink) -> None:
    now_ns = time.monotonic_ns()
    for packet in link.receive():
        endpoint.receive(packet, now_ns)
    while (out := endpoint.poll(now_ns)) is not None:
        link.send(out)


def test_endpoints_agree_over_a_noisy_serial_line() -> None:
    draw = random.Random(3)
    config = SyncConfig(packet_bytes=200, first_rto_ns=100_000_000)
    agent, base = Endpoint(config, 1), Endpoint(config, 1)
    with SerialPair(bit_errors=0.0005, seed=2) as pair:
        up = open_link(f"serial:{pair.a}:57600", "agent", LinkOptions(1, StreamFramer))
        hub = open_link(f"serial:{pair.b}:57600", "base", LinkOptions(1, StreamFramer))
        down = hub.links()[1]
        try:
            for i in range(60):
                agent.put(Key(NewLandmarks.KIND, i), draw.randbytes(draw.randrange(1, 900)))
                base.put(Key(KeyframePose.KIND, i), draw.randbytes(20))
            end_s = time.monotonic() + 20.0
            while not (agent.quiet and base.quiet and agent.digest_equal and base.digest_equal):
                assert time.monotonic() < end_s, (agent.stats, base.stats)
                turn(agent, up)
                turn(base, down)
                time.sleep(0.001)
        finally:
            up.close()
            hub.close()
    assert len(base.peer_values()) == len(agent.peer_values()) == 60
    assert agent.stats.lost > 0  # the noise has cost packets
