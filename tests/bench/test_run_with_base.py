"""Flights whose agents come and go: frames in the order asked for, link outages, restarts, and a map sent back."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_basestation.config import BaseConfig
from kiteline_bench.harness.placed import KeyframesInWorld
from kiteline_bench.harness.run import TICK_NS, JointRun, Part, Scenario, fly_with_base
from kiteline_core.ids import AgentId


def flown(data_dir: Path, seconds: float, **base: int) -> JointRun:
    """Some seconds of the room, then the first of them again, by a new boot whose link is down for a moment."""
    room = str(data_dir / "room_flight.mcap")
    scenarios = [
        Scenario(room, 0, parts=(Part(0.0, seconds),)),
        Scenario(room, 0, boot=1, begin_s=seconds + 0.5, parts=(Part(0.5, seconds - 0.5),), outages=((7.0, 7.2),)),
    ]
    config = BaseConfig()
    return fly_with_base(scenarios, None, replace(config, map_cache=replace(config.map_cache, **base)))


def test_a_new_boot_is_sent_the_old_boots_map_and_is_merged_with_it(data_dir: Path) -> None:
    flight = flown(data_dir, 4.0, local_keyframes=2)
    first, second = flight.agents
    assert (len(first.estimates), len(second.estimates)) == (80, 60)
    world = KeyframesInWorld(flight)
    assert world.merges == 1
    assert world.placed_s(1) < 3.0
    assert world.live_m(1) < 0.03
    assert second.cached_keyframes > 0
    own = flight.station.map_cache_planner.cached(AgentId(0))
    assert {k >> 32 for k in own} >= {first.found[0].submap >> 12}
    assert first.bytes_up > 0 and second.bytes_down > 0


def test_nothing_is_sent_where_the_cache_may_hold_nothing(data_dir: Path) -> None:
    flight = flown(data_dir, 2.5, local_keyframes=2, max_keyframes=0)
    assert not flight.station.map_cache_planner.cached(AgentId(0))
    assert flight.agents[1].cached_keyframes == 0


def test_parts_follow_one_another_and_dark_ones_show_nothing(data_dir: Path) -> None:
    room = str(data_dir / "room_flight.mcap")
    parts = (Part(1.0, 1.5), Part(0.0, 0.2, dark=True), Part(1.0, 1.3))
    flight = fly_with_base([Scenario(room, parts=parts, outages=((0.0, 9.0),))], AgentConfig())
    out = flight.agents[0]
    first, again = out.truth[0], out.truth[14]
    assert out.t_ns == [e.t_ns for e in out.found] == [k * TICK_NS for k in range(20)]
    assert np.allclose(first, again), "the same place again"
    assert [k for k, e in enumerate(out.found) if not e.inliers][1:] == [10, 11, 12, 13]
    assert not out.bytes_up and not out.bytes_down


def test_a_base_goes_on_after_the_last_frame_until_it_has_nothing_left_to_do(data_dir: Path) -> None:
    steps, at_last_frame = [], []
    scenarios = [Scenario(str(data_dir / "room_flight.mcap"), parts=(Part(0.0, 2.0),))]

    def note(run: JointRun) -> None:
        at_last_frame.append(len(run.agents[0].found))
        real = run.station.step
        run.station.step = lambda *given: steps.append(given[2]) or real(*given)  # type: ignore[method-assign,func-returns-value]

    fly_with_base(scenarios, at_end=note)
    assert at_last_frame == [40] and len(steps) * TICK_NS >= 5_000_000_000
