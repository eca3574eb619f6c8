"""What of a value goes into a packet."""

import pytest

from kiteline_codec.schema import Key, NewLandmarks
from kiteline_codec.sync.send_queue import Entry, item_of


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
