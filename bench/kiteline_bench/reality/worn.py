"""Worn rigs: the same simulated flights by a true rig and by one that has changed since its calibration.

Seven seeds of world, path and wear for each scene. The seeds are held out: options are tuned on others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from kiteline_bench.harness.bars import Bar, Bench
from kiteline_bench.harness.recording import Recording, load
from kiteline_bench.harness.simulated import render
from kiteline_bench.reality.flown import Flown, flown, spread, table

SEEDS = tuple(range(901, 908))  # of world and wear
SECONDS = 16.0
_PATHS = {"room": ("V1_02_medium.txt", 8.0, 9.0), "hall": ("MH_03_medium.txt", 12.0, 13.0)}  # first start, step in s
_LIVE, _LIVE_M = 4.0, 0.02  # times the clean flight's error, or m, whichever is larger
_BASE, _BASE_M = 2.5, 0.01
_JUMP_MM = 3.0


@dataclass(frozen=True, slots=True)
class _Pair:
    """A flight by a true rig and the same one by a worn rig."""

    seed: int
    clean: Flown
    worn: Flown

    def over_bound(self, path: str, times: float, least_m: float) -> float:
        """Error of the worn rig over what it may be."""
        return self.worn.ate_m(path) / max(times * self.clean.ate_m(path), least_m)


def recording(bench: Bench, scene: str, seed: int, rig: str, seconds: float = SECONDS) -> Recording:
    """A simulated flight, rendered unless the bench's folder has it."""
    path, first_s, step_s = _PATHS[scene]
    start_s = first_s + step_s * (seed % len(SEEDS))
    command = [
        scene, "--trajectory", bench.source(f"trajectories/{path}"), "--start", f"{start_s:g}", "--seconds",
        f"{seconds:g}", "--seed", f"{seed}", "--rig", rig,
    ]  # fmt: skip
    return load(str(render(bench, f"{scene}_{seed}_{rig}", command)[0]))


def room(bench: Bench) -> list[Bar]:
    """Flights in a room."""
    return _bars(bench, "room")


def hall(bench: Bench) -> list[Bar]:
    """Flights in a hall."""
    return _bars(bench, "hall")


def _bars(bench: Bench, scene: str) -> list[Bar]:
    pairs = []
    for seed in bench.chosen(SEEDS):
        clean, worn = (flown(bench, f"{scene} {seed}, {rig} rig", recording(bench, scene, seed, rig))
                       for rig in ("true", "worn"))  # fmt: skip
        pairs.append(_Pair(seed, clean, worn))
        bench.say(
            f"  clean live {clean.ate_m('live'):.4f} base {clean.ate_m('base'):.4f} m; "
            f"worn live {worn.ate_m('live'):.4f} base {worn.ate_m('base'):.4f} m, jump {_jump_mm(worn):.1f} mm"
        )
    _table(bench, scene, pairs)
    return [
        *spread(f"worn {scene}: ATE live over the larger of {_LIVE:g} x clean and {_LIVE_M:g} m",
                [pair.over_bound("live", _LIVE, _LIVE_M) for pair in pairs], 1.0, "", 2),
        *spread(f"worn {scene}: ATE base over the larger of {_BASE:g} x clean and {_BASE_M:g} m",
                [pair.over_bound("base", _BASE, _BASE_M) for pair in pairs], 1.0, "", 2),
        *spread(f"worn {scene}: largest live jump beside the motion", [_jump_mm(pair.worn) for pair in pairs],
                _JUMP_MM, "mm", 1),
        *spread(f"worn {scene}: frames without a pose", [float(pair.worn.run.lost) for pair in pairs], 0.0, "", 0),
    ]  # fmt: skip


def _jump_mm(flight: Flown) -> float:
    return 1000.0 * flight.largest_jump_m()


def _table(bench: Bench, scene: str, pairs: Sequence[_Pair]) -> None:
    rows = [
        (pair.seed, *(1000.0 * flight.ate_m(path) for flight in (pair.clean, pair.worn)
                      for path in ("odometry", "live", "base")),
         _jump_mm(pair.clean), _jump_mm(pair.worn), 100.0 * pair.worn.scale_error("base"))
        for pair in pairs
    ]  # fmt: skip
    columns = ("seed", "clean odometry mm", "live", "base", "worn odometry mm", "live", "base", "jump clean mm", "worn",
               "scale of worn base off by %")  # fmt: skip
    table(bench, f"{scene}, ATE", columns, rows)
