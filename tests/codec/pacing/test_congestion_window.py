"""The congestion window of a link without a budget."""

from kiteline_codec.pacing.congestion_window import CongestionWindow

MS = 1_000_000


def test_it_grows_while_nothing_queues() -> None:
    window = CongestionWindow(64)
    first = window.packets
    for i in range(20):
        window.measured(100 * MS + i * MS, 5, window.packets, i * 100 * MS)
    assert first < window.packets == 64


def test_it_does_not_grow_unused() -> None:
    window = CongestionWindow(64)
    first = window.packets
    for i in range(20):
        window.measured(100 * MS, 1, 2, i * 100 * MS)
    assert window.packets == first


def test_it_shrinks_once_a_round_trip_while_packets_queue() -> None:
    window = CongestionWindow(64)
    for i in range(20):
        window.measured(100 * MS, 5, 60, i * 100 * MS)
    window.measured(1400 * MS, 5, 64, 10_000 * MS)
    assert window.packets == 64 * 350 // 1400
    window.measured(1400 * MS, 5, 64, 10_500 * MS)
    assert window.packets == 64 * 350 // 1400
    for i in range(20):
        window.measured(3000 * MS, 5, 64, (20 + 4 * i) * 1000 * MS)
    assert window.packets == 3


def test_a_path_that_became_longer_is_accepted_in_the_end() -> None:
    window = CongestionWindow(64)
    window.measured(50 * MS, 1, 10, 0)
    for i in range(300):
        window.measured(800 * MS, 2, 64, i * 1000 * MS)
    assert window.packets == 64
