"""The other front-ends follow a flight too, so that the comparison is one; and the benchmark's table and bars."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from kiteline_bench.agent import front_end as bench
from kiteline_bench.agent.front_end import KINDS, Flown
from kiteline_core.frame import Frame, ImuBatch
from kiteline_hw.ports import FrameSource
from kiteline_hw.sources.open import open_source


class Beginning:
    """The first items of a source."""

    def __init__(self, source: FrameSource, items: int) -> None:
        self._source, self._items = source, items

    def __getattr__(self, name: str) -> object:
        return getattr(self._source, name)

    def __iter__(self) -> Iterator[Frame | ImuBatch]:
        return islice(iter(self._source), self._items)


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_each_front_end_follows_the_room(data_dir: Path, kind: str) -> None:
    def opened() -> FrameSource:
        return Beginning(open_source(str(data_dir / "room_flight.mcap"), imu=False), 60)  # type: ignore[return-value]

    flown = bench.fly(kind, opened, starts=1)
    assert flown.tracked == flown.frames == 60
    assert flown.submaps == 1
    assert 2 <= flown.keyframes <= 20
    assert flown.inliers > 80
    assert flown.rpe_mm < 8.0
    assert flown.cpu_ms.shape == (60,)


def test_the_table_has_a_line_a_flight_and_front_end_and_names_what_was_lost() -> None:
    good = Flown(np.array([1.0, 3.0]), 0.01, 1.5, 0.02, 7.0, 200.0, 10, 10, 1)
    bad = Flown(np.array([1.0, 3.0]), 0.5, 20.0, 0.2, 9.0, 50.0, 8, 10, 2)
    lines = bench.table({("a room", "templates"): good, ("a room", "flow"): bad}).splitlines()
    assert lines[-2] == "| a room | templates | 2.00 | 2.90 | 0.0100 | 1.50 | 0.0200 | 7 | 200 | all |"
    assert lines[-1].endswith("| 8 of 10, 2 submaps |")
    assert lines[-3].count("|") == lines[-4].count("|") == lines[-1].count("|")
