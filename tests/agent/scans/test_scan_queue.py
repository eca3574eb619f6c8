"""Scans that wait for a link: newest first, few under way, bounded in an outage."""

import numpy as np

from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.scans import scan_queue
from kiteline_agent.scans.scan_queue import ScanQueue
from kiteline_codec.schema import Key, KeyframeScan, Record, messages
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


def test_four_are_under_way_and_the_newest_of_the_others_goes_next() -> None:
    link = Link()
    queue = ScanQueue(link)
    for k in range(10):
        queue.put(scan(k))
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
        queue.put(scan(k))
    queue.put(scan(4, free_m=3.0))
    queue.put(scan(4, part=1))
    assert len(queue) == 2
    link.down = False
    queue.share()
    again = messages.decode(Key(KeyframeScan.KIND, 4), messages.encode(scan(4, free_m=3.0)))
    assert isinstance(again, KeyframeScan)
    assert [s.part for s in link.shared[4:]] == [1, 0]
    assert np.array_equal(link.shared[-1].scan.free_m, again.scan.free_m)


def test_an_outage_keeps_scans_of_keyframes_longest() -> None:
    queue, most = ScanQueue(Link()), scan_queue._WAITING
    for k in range(most):
        queue.put(scan(k))
        queue.put(scan(k, part=1))
    assert len(queue) == most
    kept = list(queue._waiting)
    assert sum(key.part for key in kept) <= 4
    assert kept[-2].id == most - 1
    assert sum(map(len, queue._waiting.values())) < 300 * most
