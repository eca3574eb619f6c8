"""What of a value goes into a packet, and which values."""

import random

import pytest

from kiteline_codec.schema import Key, LivePose, NewLandmarks, Observations
from kiteline_codec.sync.config import SyncConfig
from kiteline_codec.sync.send_queue import Entry, item_of
from tests.codec.sync.endpoint_pair import Pair


@pytest.mark.parametrize(("start", "stop"), [(0, 70), (30, 100), (40, 60)])
def test_the_rest_of_a_split_value_is_sent_also_where_the_whole_would_fit_a_packet_now(start: int, stop: int) -> None:
    """A packet's header gets shorter when nothing is missing any more; the value was split before."""
    entry = Entry(5, bytes(range(100)), (0,), ((start, stop),))
    item = item_of(Key(NewLandmarks.KIND, 7), entry, 130, 130, 0, 4, None)
    assert item is not None and (item.offset, item.data) == (start, bytes(range(start, stop)))


def test_a_whole_value_that_fits_a_packet_of_its_own_waits_for_one() -> None:
    entry = Entry(5, bytes(100), (0,), ((0, 100),))
    assert item_of(Key(NewLandmarks.KIND, 7), entry, 60, 130, 0, 4, None) is None
    item = item_of(Key(NewLandmarks.KIND, 7), entry, 130, 130, 0, 4, None)
    assert item is not None and item.whole


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_short_values_are_sent_however_many_long_ones_wait_before_them(loss: float) -> None:
    """Landmarks that a full link cannot carry pile up; what fits beside a pose in its packet is not held up by them."""
    pair = Pair(SyncConfig(packet_bytes=220, overhead_bytes=7, budget_bytes=1000), loss, (20, 60))
    pair.run(300)
    for second in range(60):
        for part in range(5):
            pair.a.put(Key(NewLandmarks.KIND, second, part), random.Random(second).randbytes(165))
        pair.a.put(Key(Observations.KIND, second), random.Random(second).randbytes(80))
        for pose in range(5):
            pair.a.put(Key(LivePose.KIND, 0), random.Random(5 * second + pose).randbytes(28))
            pair.run(200)
    arrived = {key.id for key in pair.b.peer_values() if key.kind == Observations.KIND}
    landmarks = sum(key.kind == NewLandmarks.KIND for key in pair.b.peer_values())
    assert len(arrived) > 50
    assert landmarks > 60
