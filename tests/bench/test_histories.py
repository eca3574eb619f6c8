"""No id, nonce or session comes twice, whatever happens to disks, cards and clocks; planted bugs are found."""

from hypothesis import given, settings
from hypothesis import strategies as st

from kiteline_bench.trust.histories import History, found_twice


@settings(max_examples=300)
@given(st.integers(0, 1 << 32), st.integers(1, 40))
def test_nothing_comes_twice(seed: int, events: int) -> None:
    history = History(seed)
    history.run(events)
    assert history.twice == []


def test_planted_bugs_are_found() -> None:
    assert found_twice(100)[0] == []
    assert len(found_twice(200, forgets_sync=True)[0]) > 2
    assert len(found_twice(200, ignores_machine=True)[0]) > 10
