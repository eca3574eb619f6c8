"""Whether poses err as they say: covariance, quality, blackouts and level, over simulated flights."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_bench.benchmark import Bar, Bench, at_most, is_true
from kiteline_bench.harness.honest_flights import FAULTS, HonestFlight, Judged, flight, fly, no_texture
from kiteline_hw.system.vocabulary import shipped_vocabulary

TITLE = "Honest poses"

FLIGHTS = 30
_BAND = (4.82, 7.30)  # 95 % of the means of 30 draws of a chi-square with 6 degrees of freedom lie within
_FAULTS_A_FLIGHT = 2
_LEVEL_S = 0.3  # after which a flight begun in motion must be level
_LEVEL_RAD = 0.035  # 2 degrees
_BLACK = "black, 2 s"
_AGAIN = 3  # frames after which the track must be back
_LONG = (3, 15.0)  # number and s of the flight with ten seconds of a blank wall
_JUMP_M = 0.35  # between two frames of the odometry: 7 m/s at 20 Hz


@dataclass(slots=True)
class _Kept:
    """Of all flights of one kind. nees: mean over each flight. bad, good: frames off by more than the limits or not,
    and how many of them were flagged.
    """

    nees: list[float] = field(default_factory=list)
    ends: list[float] = field(default_factory=list)
    bad: int = 0
    bad_flagged: int = 0
    good: int = 0
    good_flagged: int = 0

    def count(self, frames: list[Judged]) -> None:
        limits = AgentConfig().certainty
        for frame in frames:
            flagged = frame.estimate.quality < limits.flagged_below
            if frame.off_m > limits.good_m or frame.off_rad > limits.good_rad:
                self.bad, self.bad_flagged = self.bad + 1, self.bad_flagged + flagged
            else:
                self.good, self.good_flagged = self.good + 1, self.good_flagged + flagged


def run(bench: Bench) -> list[Bar]:
    """All bars, in the order of the promise."""
    return honest_bars(bench, FLIGHTS)


def honest_bars(bench: Bench, flights: int, scale: float = 1.0) -> list[Bar]:
    """The bars over so many flights, with images of some scale."""
    kept = {True: _Kept(), False: _Kept()}
    by_fault: dict[tuple[str, bool], _Kept] = defaultdict(_Kept)
    tilts: list[float] = []
    again: list[int] = []
    words = shipped_vocabulary()
    for number in range(flights):
        bench.say(f"flight {number + 1} of {flights}")
        one = flight(number, Path(bench.source("trajectories")), bench.folder, scale)
        names = list(FAULTS)[1:]
        chosen = [names[(_FAULTS_A_FLIGHT * number + k) % len(names)] for k in range(_FAULTS_A_FLIGHT)]
        for fault in dict.fromkeys(["none", *chosen, _BLACK]):
            for inertial in (True, False):
                items = FAULTS[fault](list(one.items))
                frames = list(fly(one.rig, one.imu if inertial else None, items, words))
                by_fault[fault, inertial].count(frames)
                nees = [frame.nees for frame in frames[1:]]
                by_fault[fault, inertial].nees.append(float(np.mean(nees)))
                if fault == "none":
                    kept[inertial].nees.append(float(np.mean(nees)))
                    kept[inertial].ends.append(nees[-1])
                    if inertial and one.moving:
                        tilts.append(_tilt_rad(frames))
                if fault == _BLACK and inertial:
                    again.append(_frames_until_back(one, frames))
    bars = []
    for inertial, flown in kept.items():
        name = "with IMU" if inertial else "without IMU"
        mean = float(np.mean(flown.nees))
        inside = _BAND[0] <= mean <= _BAND[1]
        bars.append(is_true(f"NEES of {flights} flights {name}", f"{_BAND[0]:g} to {_BAND[1]:g}", inside,
                            f"{mean:.2f} (at the flights' ends {np.mean(flown.ends):.2f})"))  # fmt: skip
    total = _Kept()
    for part in by_fault.values():
        total.bad, total.bad_flagged = total.bad + part.bad, total.bad_flagged + part.bad_flagged
        total.good, total.good_flagged = total.good + part.good, total.good_flagged + part.good_flagged
    flagged = total.bad_flagged / max(total.bad, 1)
    wrongly = total.good_flagged / max(total.good, 1)
    bars.append(is_true("quality: poses off by more than 0.2 m or 10 degrees are flagged", ">= 95 %", flagged >= 0.95,
                        f"{100 * flagged:.1f} % of {total.bad}"))  # fmt: skip
    bars.append(is_true("quality: others are flagged", "<= 5 %", wrongly <= 0.05,
                        f"{100 * wrongly:.1f} % of {total.good}"))  # fmt: skip
    bars.append(at_most("2 s of black with IMU: frames until tracked again, worst", max(again), _AGAIN, "", 0))
    if tilts:
        bars.append(at_most(f"begun in motion: tilt after {_LEVEL_S:g} s, worst of {len(tilts)}",
                            float(np.degrees(max(tilts))), float(np.degrees(_LEVEL_RAD)), "degrees", 2))  # fmt: skip
    bars += _no_texture(bench, scale)
    bench.more.append(_table(by_fault))
    return bars


def _tilt_rad(frames: list[Judged]) -> float:
    """The worst tilt of what a flight controller gets, from when it must be level."""
    begin_ns = frames[0].estimate.t_ns
    late = [f.tilt_rad for f in frames if (f.estimate.t_ns - begin_ns) * 1e-9 >= _LEVEL_S]
    return float(np.nan_to_num(np.array(late), nan=np.pi).max())


def _frames_until_back(one: HonestFlight, frames: list[Judged]) -> int:
    first = len(one.items) // 2 + 40
    after = (k for k, f in enumerate(frames[first:]) if f.estimate.tracked and not f.estimate.bridged)
    return next(after, len(frames) - first)


def _no_texture(bench: Bench, scale: float) -> list[Bar]:
    """Ten seconds of a blank wall, with and without IMU: the odometry goes on and says how little it knows."""
    bars = []
    one = flight(_LONG[0], Path(bench.source("trajectories")), bench.folder, scale, _LONG[1])
    period_ns = one.items[1].frame.t_ns - one.items[0].frame.t_ns
    first, count = round(4e9 / period_ns), round(10e9 / period_ns)
    items = no_texture(list(one.items), first, count)
    for inertial in (True, False):
        frames = list(fly(one.rig, one.imu if inertial else None, items))
        moves = np.diff([f.estimate.T_o_b[:3, 3] for f in frames], axis=0)
        jump = float(np.linalg.norm(moves, axis=1).max())
        sizes = [float(np.trace(f.estimate.cov_o[:3, :3])) for f in frames[first : first + count]]
        grows = bool((np.diff(sizes) >= -1e-12).all())
        name = f"10 s of no texture {'with' if inertial else 'without'} IMU: odometry goes on, its covariance grows"
        found = f"jump {jump:.3f} m, deviation {np.sqrt(sizes[0]):.3f} to {np.sqrt(sizes[-1]):.1f} m"
        bars.append(is_true(name, f"jumps < {_JUMP_M:g} m", grows and jump < _JUMP_M, found))
    return bars


def _table(by_fault: dict[tuple[str, bool], _Kept]) -> str:
    lines = [
        "| fault | IMU | flights | frames off | of them flagged | others | of them flagged | NEES, median |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for (fault, inertial), k in sorted(by_fault.items()):
        off = "-" if not k.bad else f"{100 * k.bad_flagged / k.bad:.1f} %"
        lines.append(
            f"| {fault} | {'yes' if inertial else 'no'} | {len(k.nees)} | {k.bad} | {off} | {k.good} | "
            f"{100 * k.good_flagged / max(k.good, 1):.1f} % | {np.median(k.nees):.1f} |"
        )
    return "\n".join(lines)
