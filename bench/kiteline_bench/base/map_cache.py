"""The bars of the map cache: an agent flies in what others mapped, is relocalised there, and its link may fail."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_agent.runtime.warm import warm
from kiteline_basestation.config import BaseConfig
from kiteline_bench.harness.bars import Bar, Bench, at_most, is_true
from kiteline_bench.harness.placed import KeyframesInWorld
from kiteline_bench.harness.run import TICK_NS, Part, Scenario, fly_with_base
from kiteline_core.ids import AgentId, agent_of_keyframe
from kiteline_hw.sim.config import SimConfig
from kiteline_hw.sim.source import SimSource
from kiteline_lab.flights.simulate import record
from kiteline_lab.outputs.out_file import whole_file

TITLE = "The map cache"

_SMALL_MAP = 10  # keyframes of a local map that forgets within a short flight
_OUTAGE_FRAMES = 230  # after the link has failed
_RADIO = (1000, 500)  # B/s up and down
_SLOW_M_S, _SLOW_RAD_S = 0.2, 0.1


def run(bench: Bench) -> list[Bar]:
    """All bars, in the order in which they are listed."""
    warm()
    first = _rendered(bench, 0, 44.0, 31.0)  # MH_01 leaves from where both begin
    second = _rendered(bench, 1, 6.0, 24.0)  # so does MH_03
    return [*_together(bench, first, second), *_restarted(bench, first), *_lost(bench, first), *_thin(bench, first)]


def _together(bench: Bench, first: str, second: str) -> list[Bar]:
    """MH_03 begins when MH_01 has mapped the place."""
    scenarios = [Scenario(first, 0, parts=(Part(0.0, 30.0),)), Scenario(second, 1, begin_s=27.0)]
    with_, without = _both(bench, "MH_03 in the map of MH_01", scenarios)
    there = with_.agent(1)
    sent = {agent_of_keyframe(k) for k in with_.flight.station.map_cache_planner.cached(AgentId(1))}
    tracked = sum(e.tracked for e in there.found)
    return [
        is_true("MH_03 begins in the hall that MH_01 mapped", "one map, keyframes sent",
                with_.merges == 1 and AgentId(0) in sent, f"{with_.merges} merges, {there.cached_keyframes} keyframes"),
        at_most("its live error in w", with_.live_m(1), 0.02, "m", 4),
        at_most("the same over that without a cache", with_.live_m(1) / without.live_m(1), 1.05, "", 2),
        is_true("every frame of it tracked", "all", tracked == len(there.found), f"{tracked} of {len(there.found)}"),
        at_most("CPU of a frame with a full cache, mean", float(np.mean(there.cpu_ns)) / 1e6, 5.0, "ms", 2),
    ]  # fmt: skip


def _restarted(bench: Bench, first: str) -> list[Bar]:
    """An agent ends, begins again with a new boot, and gets its old map back; then its link fails."""
    old = Scenario(first, 0, parts=(Part(0.0, 30.0),))
    new = Scenario(first, 0, boot=1, begin_s=31.0, parts=(Part(8.0, 29.0),))
    with_, _ = _both(bench, "an agent that begins again", [old, new])
    cut_off = replace(new, outages=((40.0, 1e9),))
    held, lost = _both(bench, "an agent that begins again, and whose link then fails", [old, cut_off])
    again = with_.agent(1)
    return [
        is_true("an agent that begins again", "in its old map", with_.merges == 1 and again.cached_keyframes > 0,
                f"{with_.merges} merges, {again.cached_keyframes} keyframes"),
        at_most("until its live pose stands in w", with_.placed_s(1), 5.0, "s", 1),
        at_most("its live error in w", with_.live_m(1), 0.02, "m", 4),
        at_most("its link fails 9 s after it began: live error from then on over that without a cache",
                held.live_m(1, -_OUTAGE_FRAMES) / lost.live_m(1, -_OUTAGE_FRAMES), 0.9, "", 2),
    ]  # fmt: skip


def _lost(bench: Bench, first: str) -> list[Bar]:
    """Black images for a second and a half; then a place that the agent has evicted since."""
    parts = (Part(4.0, 26.0), Part(0.0, 1.5, dark=True), Part(8.0, 17.0))
    config = AgentConfig()
    small = replace(config, local_map=replace(config.local_map, keyframes=_SMALL_MAP, searched=_SMALL_MAP))
    base = BaseConfig()
    bench.say("flying with black images")
    found = KeyframesInWorld(
        fly_with_base(
            [Scenario(first, 0, parts=parts)],
            small,
            replace(base, map_cache=replace(base.map_cache, local_keyframes=_SMALL_MAP)),
        )
    )
    flown = found.agent(0)
    opened = len(flown.frames_with_event("submap: opened"))
    return [
        at_most("black for 1.5 s, then a place evicted since: frames until it is found",
                sum(not e.tracked for e in flown.found[-180:]), 3, "frames", 0),
        is_true("found by cached keyframes, in the old submap", "no new one",
                bool(flown.frames_with_event("relocalised by the map cache")) and opened == 1,
                f"{opened} submaps, relocalised {len(flown.frames_with_event('relocalised'))} times"),
        at_most("its live error in w from then on", found.live_m(0, -170), 0.03, "m", 4),
    ]  # fmt: skip


def _thin(bench: Bench, first: str) -> list[Bar]:
    """A radio, where corrections go first and the cache must do no harm; and corrections that are applied slowly."""
    old = Scenario(first, 0, parts=(Part(0.0, 30.0),))
    new = Scenario(first, 0, boot=1, begin_s=31.0, parts=(Part(8.0, 29.0),))
    with_, without = _both(bench, "an agent that begins again, by radio", [old, new], _RADIO, "radio")
    config = AgentConfig()
    slow = replace(config, smoothing=replace(config.smoothing, max_m_s=_SLOW_M_S, max_rad_s=_SLOW_RAD_S))
    bench.say("flying with slow corrections")
    smooth = KeyframesInWorld(fly_with_base([old], slow))
    return [
        at_most("by radio: live error in w over that without a cache", with_.live_m(1) / without.live_m(1),
                1.05, "", 2),
        at_most("largest change of the live pose by corrections, applied slowly", smooth.largest_correction_m(0),
                1.05 * _SLOW_M_S * TICK_NS * 1e-9, "m", 4),
        at_most("its live error in w", smooth.live_m(0), 0.08, "m", 4),
    ]  # fmt: skip


def _both(
    bench: Bench, what: str, scenarios: Sequence[Scenario], bytes_s: tuple[int, int] = (0, 0), profile: str = "wifi"
) -> tuple[KeyframesInWorld, KeyframesInWorld]:
    """The same flight with a map cache and without."""
    base = BaseConfig()
    none = replace(base, map_cache=replace(base.map_cache, max_keyframes=0))
    out = []
    for config, condition in ((base, ""), (none, ", without a cache")):
        bench.say(f"flying: {what}{condition}")
        out.append(KeyframesInWorld(fly_with_base(scenarios, None, config, bytes_s, profile)))
    return out[0], out[1]


def _rendered(bench: Bench, agent: int, start_s: float, seconds: float) -> str:
    """A piece of MH_01 (agent 0) or MH_03 (1) in one hall; rendered once, if the folder is kept."""
    out = bench.folder / f"map-cache-{agent}.mcap"
    if not out.exists():
        bench.say(f"rendering {out.name}")
        bench.folder.mkdir(parents=True, exist_ok=True)
        path, also = (bench.source(f"trajectories/{n}.txt") for n in ("MH_01_easy", "MH_03_medium"))
        config = SimConfig("hall", trajectory=path, also=(also,), agent=agent, start=start_s, seconds=seconds)
        with whole_file(out, force=True) as part:
            record(SimSource(config), part)
    return str(out)
