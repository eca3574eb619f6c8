"""The link model: reproducible, with the rates that its settings state."""

from collections import Counter
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kiteline_hw.sim.links.link_model import LinkModel, LinkModelConfig, LinkModels, link_seed

chances = st.floats(0.0, 1.0)
configs = st.builds(
    LinkModelConfig,
    rate_bytes_s=st.sampled_from([0, 100, 1000, 100_000]),
    overhead_bytes=st.integers(0, 30),
    queue_bytes=st.integers(1, 5000),
    delay_ns=st.integers(0, 10**9),
    jitter_ns=st.integers(0, 10**8),
    loss=chances,
    burst=chances,
    burst_packets=st.floats(1.0, 20.0),
    duplicate=chances,
    reorder=chances,
    reorder_ns=st.integers(0, 10**9),
)
sends = st.lists(st.tuples(st.integers(0, 10**8), st.integers(0, 300)), max_size=60)  # (ns since the last, bytes)
LONG_NS = 10**15


def packet(i: int, size: int) -> bytes:
    return b"%04d" % i + bytes(size)


@settings(max_examples=80, deadline=None)
@given(configs, st.integers(0, 99), sends)
def test_equal_seeds_give_equal_deliveries_of_sent_packets(
    config: LinkModelConfig, seed: int, sends: list[tuple[int, int]]
) -> None:
    one, two = LinkModel(config, seed), LinkModel(config, seed)
    now_ns, sent, got, got_late = 0, Counter[bytes](), Counter[bytes](), Counter[bytes]()
    sent_ns: dict[bytes, int] = {}
    for i, (gap_ns, size) in enumerate(sends):
        now_ns += gap_ns
        p = packet(i, size)
        taken = one.send(p, now_ns)
        assert two.send(p, now_ns) == taken
        sent[p] += taken
        sent_ns[p] = now_ns
        arrived = one.deliver(now_ns)
        assert all(now_ns >= sent_ns[a] + config.delay_ns for a in arrived)
        got.update(arrived)
    got.update(one.deliver(LONG_NS))
    got_late.update(two.deliver(LONG_NS))  # how often one asks changes nothing
    assert got == got_late and one.stats == two.stats
    assert one.next_ns() is None
    assert all(count <= 2 * sent[p] for p, count in got.items())
    s = one.stats
    assert s.sent == len(sends)
    assert s.delivered == s.sent - s.lost - s.overflowed + s.duplicated


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 5000), st.integers(0, 20), sends, st.integers(0, 99))
def test_rate_holds_in_any_window_and_order_is_kept(
    rate: int, overhead: int, sends: list[tuple[int, int]], seed: int
) -> None:
    config = LinkModelConfig(rate_bytes_s=rate, overhead_bytes=overhead, queue_bytes=10**9)
    link = LinkModel(config, seed)
    now_ns = 0
    for i, (gap_ns, size) in enumerate(sends):
        now_ns += gap_ns
        assert link.send(packet(i, size), now_ns)
    arrivals: list[tuple[int, bytes]] = []
    while (at_ns := link.next_ns()) is not None:
        arrivals += [(at_ns, p) for p in link.deliver(at_ns)]
    assert [p for _, p in arrivals] == [packet(i, size) for i, (_, size) in enumerate(sends)]
    for first in range(len(arrivals)):
        for last in range(first + 1, len(arrivals)):
            size = sum(len(p) + overhead for _, p in arrivals[first + 1 : last + 1])
            assert size <= rate * (arrivals[last][0] - arrivals[first][0]) / 1e9 + 1e-6


def test_delivery_times_by_hand() -> None:
    link = LinkModel(LinkModelConfig(rate_bytes_s=1000, overhead_bytes=10, delay_ns=5_000_000, queue_bytes=200), 1)
    assert link.send(bytes(90), 0)  # on the wire until 100 ms
    assert link.send(bytes(90), 0)  # until 200 ms; the queue is full now
    assert not link.send(bytes(1), 0)
    assert link.deliver(104_999_999) == []
    assert link.deliver(105_000_000) == [bytes(90)]
    assert link.send(bytes(40), 150_000_000)  # until 250 ms
    assert link.next_ns() == 205_000_000
    assert link.deliver(255_000_000) == [bytes(90), bytes(40)]
    assert link.stats.overflowed == 1 and link.stats.wire_bytes == 250


def test_loss_duplicate_and_reorder_rates() -> None:
    config = LinkModelConfig(loss=0.2, duplicate=0.1, reorder=0.3, reorder_ns=10_000_000)
    link = LinkModel(config, 7)
    for i in range(4000):
        link.send(b"%d" % i, i * 1_000_000)
    got = [int(p) for p in link.deliver(LONG_NS)]
    assert 0.17 < link.stats.lost / 4000 < 0.23
    assert 0.08 < link.stats.duplicated / link.stats.delivered < 0.12
    assert sum(a > b for a, b in pairwise(got)) > 500  # many were overtaken


def test_bursts_are_long() -> None:
    link = LinkModel(LinkModelConfig(burst=0.01, burst_packets=10.0), 3)
    arrived = []
    for i in range(20000):
        link.send(b"x", i)
        arrived.append(bool(link.deliver(i)))
    runs, length = [], 0
    for ok in arrived:
        if not ok:
            length += 1
        elif length:
            runs.append(length)
            length = 0
    assert 8.0 < sum(runs) / len(runs) < 12.0


@pytest.mark.parametrize(
    "bad", [{"loss": 1.5}, {"reorder": float("nan")}, {"rate_bytes_s": -1}, {"burst_packets": 0.5}]
)
def test_invalid_settings(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        LinkModelConfig(**bad)  # type: ignore[arg-type]


def test_each_receiver_has_a_link_of_its_own() -> None:
    config = LinkModelConfig(loss=0.5, delay_ns=10)
    links, alone = LinkModels(config, lambda to: 40 + to), LinkModel(config, 43)
    assert links.deliver(0) == {}
    packets = [bytes([k]) for k in range(100)]
    links.send(3, packets, 0)
    links.send(1, packets, 0)
    for packet in packets:
        alone.send(packet, 0)
    assert links.deliver(5) == {1: (), 3: ()}
    delivered = links.deliver(10)
    assert list(delivered) == [1, 3]
    assert delivered[3] == tuple(alone.deliver(10)) != delivered[1]


def test_no_two_directions_of_256_agents_in_neighbouring_flights_share_a_seed() -> None:
    seeds = {link_seed(flight, agent, up=up) for flight in range(4) for agent in range(256) for up in (False, True)}
    assert len(seeds) == 4 * 256 * 2
