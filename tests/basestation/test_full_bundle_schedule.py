"""When whole maps are bundled."""

from __future__ import annotations

from kiteline_basestation.config import GraphConfig
from kiteline_basestation.refinement.full_bundle_schedule import FullBundleSchedule
from kiteline_core.ids import SubmapId, submap_id

ONE, TWO = submap_id(0, 0, 0), submap_id(1, 0, 0)
CONFIG = GraphConfig(first_full=12, full_share=0.1)
SECOND = 1_000_000_000


def test_a_map_is_bundled_when_it_has_grown_and_no_more_often() -> None:
    whole = FullBundleSchedule(CONFIG)
    assert whole.next({ONE: 11}, (), 0) is None
    assert whole.next({ONE: 12}, (), 1) == ONE
    assert whole.next({ONE: 12}, (), 2) is None and not whole.waiting({ONE: 12})
    assert whole.next({ONE: 13}, (), 3) == ONE


def test_the_worker_rests_in_between() -> None:
    whole = FullBundleSchedule(CONFIG)
    assert whole.next({ONE: 20}, (), 0) == ONE
    whole.done(SECOND // 10, SECOND)  # a tenth of a second: a tenth of the next
    assert whole.next({ONE: 21}, (), 2 * SECOND - 1) is None
    assert whole.waiting({ONE: 21}) == [ONE]  # what is left for a quiet moment
    assert whole.next({ONE: 21}, (), 2 * SECOND) == ONE


def test_the_map_that_grew_most_is_next_unless_it_is_busy() -> None:
    sizes: dict[SubmapId, int] = {ONE: 40, TWO: 20}
    whole = FullBundleSchedule(CONFIG)
    whole.bundled.update({ONE: 36, TWO: 15})  # a tenth and a quarter
    assert whole.next(sizes, (TWO,), 0) == ONE
    assert whole.next(sizes, (), 1) == TWO
    assert whole.next(sizes, (), 2) is None


def test_a_map_of_which_a_part_was_taken_is_bundled_anew() -> None:
    whole = FullBundleSchedule(CONFIG)
    whole.bundled[ONE] = 40
    assert whole.next({ONE: 25}, (), 0) == ONE
