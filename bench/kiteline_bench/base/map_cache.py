"""The bars of windows: an agent flies in what others mapped, is found again there, and its link may fail meanwhile."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.config import AgentConfig
from kiteline_agent.runtime.warm import warm
from kiteline_basestation.config import BaseConfig
from kiteline_basestation.runtime.flight_summary import keyframe_poses
from kiteline_bench.benchmark import Bar, Bench, at_most, is_true
from kiteline_bench.harness.sorties import Flight, Flown, Part, Sortie, fly
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import Rectifier
from kiteline_core.ids import SEQUENCE_BITS, SUBMAP_BITS, AgentId, agent_of_keyframe
from kiteline_hw.sim.config import SimConfig
from kiteline_hw.sim.source import SimSource
from kiteline_hw.sources.open import open_source
from kiteline_lab.evaluation import metrics
from kiteline_lab.flights.out_file import whole_file
from kiteline_lab.flights.simulate import record

F64 = NDArray[np.float64]

TITLE = "Windows of the map"

_LITTLE = 10  # keyframes of a local map that forgets within a short flight
_DEAF_FRAMES = 230  # after the link has failed
_RADIO = (1000, 500)  # B/s up and down
_SLOW_M_S, _SLOW_RAD_S = 0.2, 0.1


def run(bench: Bench) -> list[Bar]:
    """All bars, in the order in which they are told."""
    warm()
    first = str(_recorded(bench, "window-1", 0, 44.0, 31.0))  # MH_01 sets out from where both begin
    second = str(_recorded(bench, "window-2", 1, 6.0, 24.0))  # MH_03 does, too
    return [*_together(bench, first, second), *_again(bench, first), *_lost(bench, first), *_thin(bench, first)]


def _together(bench: Bench, first: str, second: str) -> list[Bar]:
    """MH_03 begins when MH_01 has mapped the place."""
    sorties = [Sortie(first, 0, parts=(Part(0.0, 30.0),)), Sortie(second, 1, begin_s=27.0)]
    with_, without = _both(bench, "MH_03 in the map of MH_01", sorties)
    there = with_.flown(1)
    lent = {agent_of_keyframe(k) for k in with_.flight.station.supply.lent(AgentId(1))}
    return [
        is_true("MH_03 begins in the hall that MH_01 mapped", "one map, copies lent",
                with_.merges == 1 and AgentId(0) in lent, f"{with_.merges} merges, {there.copies} copies"),
        at_most("its live error in w", with_.live_m(1), 0.02, "m", 4),
        at_most("the same over that without copies", with_.live_m(1) / without.live_m(1), 1.05, "", 2),
        is_true("every frame of it tracked", "all", all(e.tracked for e in there.estimates),
                f"{sum(e.tracked for e in there.estimates)} of {len(there.estimates)}"),
        at_most("CPU of a frame with a full window, mean", _mean_ms(there), 5.0, "ms", 2),
    ]  # fmt: skip


def _again(bench: Bench, first: str) -> list[Bar]:
    """An agent ends, begins again with a new boot, and gets its old map back; then its link fails."""
    old = Sortie(first, 0, parts=(Part(0.0, 30.0),))
    new = Sortie(first, 0, boot=1, begin_s=31.0, parts=(Part(8.0, 29.0),))
    with_, _ = _both(bench, "an agent that begins again", [old, new])
    deaf = replace(new, deaf=((40.0, 1e9),))
    held, lost = _both(bench, "an agent that begins again, and whose link then fails", [old, deaf])
    placed = with_.placed_s(1)
    return [
        is_true("an agent that begins again", "in its old map", with_.merges == 1 and with_.flown(1).copies > 0,
                f"{with_.merges} merges, {with_.flown(1).copies} copies"),
        at_most("until its live pose stands in w", placed, 5.0, "s", 1),
        at_most("its live error in w", with_.live_m(1), 0.02, "m", 4),
        at_most("its link fails 9 s after it began: live error from then on over that without copies",
                held.live_m(1, -_DEAF_FRAMES) / lost.live_m(1, -_DEAF_FRAMES), 0.9, "", 2),
    ]  # fmt: skip


def _lost(bench: Bench, first: str) -> list[Bar]:
    """A dark second and a half; then a place that the agent itself has forgotten since."""
    parts = (Part(4.0, 26.0), Part(0.0, 1.5, dark=True), Part(8.0, 17.0))
    config = AgentConfig()
    little = replace(config, local_map=replace(config.local_map, keyframes=_LITTLE, searched=_LITTLE))
    base = BaseConfig()
    supply = replace(base.supply, remembered=_LITTLE)
    bench.say("flying into the dark")
    flight = fly([Sortie(first, 0, parts=parts)], little, replace(base, supply=supply))
    came_back = Judged(flight, [Sortie(first, 0, parts=parts)])
    flown = flight.sorties[0]
    after = flown.estimates[-180:]
    blind = sum(not e.tracked for e in after)
    return [
        at_most("dark for 1.5 s, then a place forgotten since: frames until it is found", blind, 3, "frames", 0),
        is_true("found by copies, in the old submap", "no new one",
                bool(flown.said("recovered by copies")) and len(flown.said("submap: opened")) == 1,
                f"{len(flown.said('submap: opened'))} submaps, recovered {len(flown.said('recovered'))} times"),
        at_most("its live error in w from then on", came_back.live_m(0, -170), 0.03, "m", 4),
    ]  # fmt: skip


def _thin(bench: Bench, first: str) -> list[Bar]:
    """A radio: corrections go first, and nobody is worse off for copies; and corrections that are told slowly."""
    old = Sortie(first, 0, parts=(Part(0.0, 30.0),))
    new = Sortie(first, 0, boot=1, begin_s=31.0, parts=(Part(8.0, 29.0),))
    with_, without = _both(bench, "an agent that begins again, by radio", [old, new], _RADIO, "radio")
    config = AgentConfig()
    slow = replace(config, smoothing=replace(config.smoothing, max_m_s=_SLOW_M_S, max_rad_s=_SLOW_RAD_S))
    bench.say("flying with slow corrections")
    flight = fly([old], slow)
    jump_m = _largest_jump(flight.sorties[0])
    smooth = Judged(flight, [old])
    return [
        at_most("by radio: live error in w over that without copies", with_.live_m(1) / without.live_m(1), 1.05, "", 2),
        at_most("largest jump of the live pose by corrections, told slowly", jump_m, 1.05 * _SLOW_M_S * 0.05, "m", 4),
        at_most("its live error in w", smooth.live_m(0), 0.08, "m", 4),
    ]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Judged:
    """A flight beside the truth: the world is laid upon it by the base's keyframes of the first sortie."""

    flight: Flight
    sorties: Sequence[Sortie]

    def flown(self, sortie: int) -> Flown:
        """What came of a sortie."""
        return self.flight.sorties[sortie]

    @property
    def merges(self) -> int:
        """How many maps were joined."""
        merger = self.flight.station.mapper.merger
        return 0 if merger is None else len(merger.merges)

    def live_m(self, sortie: int, first: int = 0) -> float:
        """Root mean square error of the live positions in w, of the frames from one on that have one."""
        flown, T_true_w = self.flown(sortie), self._world()
        pairs = [
            ((T_true_w @ e.T_w_b)[:3, 3], true[:3, 3])
            for e, true, placed in zip(flown.estimates[first:], flown.truth[first:], flown.placed[first:], strict=True)
            if e.tracked and placed and e.T_w_b is not None
        ]
        return float(np.sqrt(np.mean([np.sum((a - b) ** 2) for a, b in pairs]))) if pairs else float("inf")

    def placed_s(self, sortie: int) -> float:
        """From a sortie's first frame until its live pose stands in w for the first time."""
        estimates = self.flown(sortie).estimates
        known = [e.t_ns for e, placed in zip(estimates, self.flown(sortie).placed, strict=True) if placed]
        return (known[0] - estimates[0].t_ns) * 1e-9 if known else float("inf")

    def _world(self) -> F64:
        source = open_source(self.sorties[0].source)
        T_c_b = se3.inverse(Rectifier(source.rig).camera.T_b_c)
        source.close()
        flown, mapper = self.flown(0), self.flight.station.mapper
        truth = {e.t_ns: T for e, T in zip(flown.estimates, flown.truth, strict=True)}
        boot = flown.estimates[0].submap >> SUBMAP_BITS
        ours, theirs = [], []
        for keyframe, T_w_c in keyframe_poses(mapper).items():
            t_ns = int(mapper.map.keyframes.t_ns[mapper.map.rows[keyframe]])
            if keyframe >> SEQUENCE_BITS + SUBMAP_BITS == boot and t_ns in truth:
                ours.append((T_w_c @ T_c_b)[:3, 3])
                theirs.append(truth[t_ns][:3, 3])
        T, _ = metrics.umeyama(np.array(ours), np.array(theirs))
        return T


def _both(
    bench: Bench, what: str, sorties: Sequence[Sortie], bytes_s: tuple[int, int] = (0, 0), profile: str = "wifi"
) -> tuple[Judged, Judged]:
    """The same flight with copies and without."""
    base = BaseConfig()
    none = replace(base, supply=replace(base.supply, copies=0))
    out = []
    for config, said in ((base, ""), (none, ", without copies")):
        bench.say(f"flying: {what}{said}")
        out.append(Judged(fly(sorties, None, config, bytes_s, profile), sorties))
    return out[0], out[1]


def _mean_ms(flown: Flown) -> float:
    return float(np.mean(flown.cpu_ms))


def _largest_jump(flown: Flown) -> float:
    """How far the live position in w went at most from one frame to the next, beside the motion in o."""
    jumps = [
        float(np.linalg.norm((b.T_w_b @ se3.inverse(b.T_o_b) @ a.T_o_b)[:3, 3] - a.T_w_b[:3, 3]))
        for a, b in zip(flown.estimates[:-1], flown.estimates[1:], strict=True)
        if a.T_w_b is not None and b.T_w_b is not None
    ]
    return max(jumps)


def _recorded(bench: Bench, name: str, agent: int, start_s: float, seconds: float) -> Path:
    """A piece of MH_01 (agent 0) or MH_03 (1) in one hall; rendered once, if the folder is kept."""
    out = bench.folder / f"{name}.mcap"
    if not out.exists():
        bench.say(f"rendering {name}")
        bench.folder.mkdir(parents=True, exist_ok=True)
        path, also = (bench.source(f"trajectories/{n}.txt") for n in ("MH_01_easy", "MH_03_medium"))
        config = SimConfig("hall", trajectory=path, also=(also,), agent=agent, start=start_s, seconds=seconds)
        with whole_file(out, True) as part:
            record(SimSource(config), part)
    return out
