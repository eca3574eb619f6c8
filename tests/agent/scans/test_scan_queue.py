"""Scans that wait for a link: newest first, few under way, bounded in an outage."""

import numpy as np

from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.scans import scan_queue
from kiteline_agent.scans.scan_queue import ScanQueue
from kiteline_codec.schema import Key, KeyframeScan, Observations, Record, messages
from kiteline_codec.sync.config import default_order
from kiteline_core.ground.column_scan import ColumnScan
from kiteline_core.ids import KeyframeId


class Link(NoBaseChannel):
    """Notes what is shared; nothing arrives while it is down."""

    def __init__(self) -> None:
        super().__init__()
        self.down, self.shared = True, list[KeyframeScan]()

    def put(self, record: Record) -> Record:
        assert isinstance(record, KeyframeScan)
        self.shared.append(record)
        return record

    def arrived(self, key: Key) -> bool:
        return not self.down


def scan(keyframe: int, part: int = 0, free_m: float = 2.0) -> KeyframeScan:
    r = np.full(8, free_m)
    columns = ColumnScan(np.array([0.0, -1.0, 0.0]), 0.0, 0.1, r, r, r, np.full(8, 7, np.uint8), r, 1.0)
    return KeyframeScan(KeyframeId(keyframe), columns, np.zeros(0, np.uint8), part, np.eye(4) if part else None)


def test_the_first_scans_of_a_keyframe_go_at_once_and_before_its_observations() -> None:
    """A link that is full for a whole flight carries a grid, too."""
    link = Link()
    queue = ScanQueue(link)
    for k in range(10):
        for part in range(3):
            queue.put(scan(k, part))
    assert sum(s.part < 2 for s in link.shared) == 20 and sum(s.part == 2 for s in link.shared) == 4
    assert len(queue) == 6
    first, second, third = (default_order(scan(7, part).key()) for part in range(3))
    assert first < second < default_order(Key(Observations.KIND, 7)) < third


def test_four_are_under_way_and_the_newest_of_the_others_goes_next() -> None:
    link = Link()
    queue = ScanQueue(link)
    for k in range(10):
        queue.put(scan(k, part=2))
    assert [s.keyframe for s in link.shared] == [0, 1, 2, 3]
    link.down = False
    queue.share()
    assert [s.keyframe for s in link.shared[4:]] == [9, 8, 7, 6]
    queue.share()
    assert not len(queue)


def test_a_scan_under_the_same_key_replaces_the_waiting_one() -> None:
    link = Link()
    queue = ScanQueue(link)
    for k in range(5):
        queue.put(scan(k, part=2))
    queue.put(scan(4, part=2, free_m=3.0))
    queue.put(scan(4, part=3))
    assert len(queue) == 2
    link.down = False
    queue.share()
    again = messages.decode(Key(KeyframeScan.KIND, 4, 2), messages.encode(scan(4, part=2, free_m=3.0)))
    assert isinstance(again, KeyframeScan)
    assert [s.part for s in link.shared[4:]] == [3, 2]
    assert np.array_equal(link.shared[-1].scan.free_m, again.scan.free_m)


def test_an_outage_keeps_the_newest_scans() -> None:
    queue, most = ScanQueue(Link()), scan_queue._WAITING
    for k in range(most + 10):
        queue.put(scan(k, part=2))
    assert [key.id for key in queue._waiting] == list(range(10, most + 10))
    assert sum(map(len, queue._waiting.values())) < 300 * most
