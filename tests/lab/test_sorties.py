"""Flights whose agents come and go: frames in the order asked for, links that fail, restarts, and a map lent back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_basestation.config import BaseConfig
from kiteline_bench.base.map_cache import Judged
from kiteline_bench.harness.sorties import TICK_NS, Flight, Part, Sortie, fly
from kiteline_core.ids import AgentId


def flown(data_dir: Path, **base: int) -> tuple[Flight, list[Sortie]]:
    """Four seconds of the room, then the first of them again, by a new boot whose link ends."""
    room = str(data_dir / "room_flight.mcap")
    sorties = [
        Sortie(room, 0, parts=(Part(0.0, 4.0),)),
        Sortie(room, 0, boot=1, begin_s=4.5, parts=(Part(0.5, 3.5),), deaf=((7.0, 7.2),)),
    ]
    config = BaseConfig()
    return fly(sorties, None, replace(config, supply=replace(config.supply, **base))), sorties


def test_a_new_boot_is_lent_the_old_boots_map_and_is_found_in_it(data_dir: Path) -> None:
    flight, sorties = flown(data_dir, remembered=2)
    first, second = flight.sorties
    assert (len(first.estimates), len(second.estimates)) == (80, 60)
    judged = Judged(flight, sorties)
    assert judged.merges == 1
    assert judged.placed_s(1) < 3.0
    assert judged.live_m(1) < 0.03
    assert second.copies > 0
    own = flight.station.supply.lent(AgentId(0))
    assert {k >> 32 for k in own} >= {first.estimates[0].submap >> 12}
    assert first.bytes_up > 0 and second.bytes_down > 0


def test_nothing_is_lent_where_nothing_may_be(data_dir: Path) -> None:
    flight, _ = flown(data_dir, copies=0)
    assert not flight.station.supply.lent(AgentId(0))
    assert flight.sorties[1].copies == 0


def test_parts_follow_one_another_and_the_dark_is_dark(data_dir: Path) -> None:
    room = str(data_dir / "room_flight.mcap")
    parts = (Part(1.0, 1.5), Part(0.0, 0.2, dark=True), Part(1.0, 1.3))
    flight = fly([Sortie(room, parts=parts, deaf=((0.0, 9.0),))], AgentConfig())
    out = flight.sorties[0]
    assert [e.t_ns for e in out.estimates] == [k * TICK_NS for k in range(20)]
    assert np.allclose(out.truth[0], out.truth[14]), "the same place again"
    assert [k for k, e in enumerate(out.estimates) if not e.inliers][1:] == [10, 11, 12, 13]
    assert not out.bytes_up and not out.bytes_down
