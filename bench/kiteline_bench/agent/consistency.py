"""Whether poses err as their covariance says: NEES, quality, image losses and tilt, over simulated flights."""

from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_agent.covariance.pose_quality import FLAGGED_BELOW
from kiteline_bench.harness.bars import Bar, Bench, at_most, is_true
from kiteline_bench.harness.faults import FAULTS_IN_MID_FLIGHT, changed, wall
from kiteline_bench.harness.result import AgentRun, PoseError
from kiteline_bench.harness.run import fly_alone
from kiteline_bench.harness.simulated import random_flight

TITLE = "Consistent poses"

FLIGHTS = 30
_NORMAL = 1.96  # 95 % of a normal distribution lie within so many deviations
_FAULTS_A_FLIGHT = 2
_LEVEL_S = 0.3  # after which a flight begun in motion must be level
_LEVEL_RAD = 0.035  # 2 degrees
_BLACK, _BLACK_FRAMES = "black, 2 s", 40
_BACK_AFTER = 3  # frames after which the track must be back
_LONG = (3, 15.0)  # number and s of the flight with ten seconds of a blank wall
_JUMP_M = 0.35  # between two frames of the odometry: 7 m/s at 20 Hz


@dataclass(slots=True)
class Counts:
    """Of all flights of one kind. nees: mean of each flight; final_nees: of its last frame. bad, good: frames whose
    error exceeds the limits or not, and how many of them were flagged by their quality.
    """

    nees: list[float] = field(default_factory=list)
    final_nees: list[float] = field(default_factory=list)
    bad: int = 0
    bad_flagged: int = 0
    good: int = 0
    good_flagged: int = 0

    def add(self, errors: list[PoseError]) -> None:
        """Count a flight."""
        limits = AgentConfig().covariance
        for error in errors:
            flagged = error.estimate.quality < FLAGGED_BELOW
            if error.position_m > limits.good_m or error.rotation_rad > limits.good_rad:
                self.bad, self.bad_flagged = self.bad + 1, self.bad_flagged + flagged
            else:
                self.good, self.good_flagged = self.good + 1, self.good_flagged + flagged
        nees = [error.nees for error in errors[1:]]
        self.nees.append(float(np.mean(nees)))
        self.final_nees.append(nees[-1])


def run(bench: Bench) -> list[Bar]:
    """All bars."""
    return consistency_bars(bench, FLIGHTS)


def consistency_bars(bench: Bench, flights: int) -> list[Bar]:
    """The bars over so many flights."""
    counts: dict[tuple[str, bool], Counts] = defaultdict(Counts)
    tilts: list[float] = []
    back_after: list[int] = []
    names = list(FAULTS_IN_MID_FLIGHT)[1:]
    for number in range(flights):
        bench.say(f"flight {number + 1} of {flights}")
        flight = random_flight(number, Path(bench.source("trajectories")), bench.folder)
        chosen = [names[(_FAULTS_A_FLIGHT * number + k) % len(names)] for k in range(_FAULTS_A_FLIGHT)]
        for fault in dict.fromkeys(["none", *chosen, _BLACK]):
            recording = FAULTS_IN_MID_FLIGHT[fault](flight.recording)
            for inertial in (True, False):
                flown = fly_alone(recording if inertial else recording.without_imu())
                errors = flown.errors()
                counts[fault, inertial].add(errors)
                if fault == "none" and inertial and flight.moving:
                    tilts.append(_largest_tilt_rad(errors))
                if fault == _BLACK and inertial:
                    first = len(flight.recording.items) // 2 + _BLACK_FRAMES
                    back_after.append(flown.frames_until_tracked(first))
    bars = [nees_bar(f"NEES of {flights} flights {'with' if imu else 'without'} IMU", counts["none", imu])
            for imu in (True, False)]  # fmt: skip
    bars += quality_bars(list(counts.values()))
    bars.append(at_most("2 s of black with IMU: frames until tracked again, worst", max(back_after), _BACK_AFTER,
                        "", 0))  # fmt: skip
    if tilts:
        bars.append(at_most(f"begun in motion: tilt after {_LEVEL_S:g} s, worst of {len(tilts)}",
                            float(np.degrees(max(tilts))), float(np.degrees(_LEVEL_RAD)), "degrees", 2))  # fmt: skip
    bars += _no_texture(bench)
    bench.more.append(_table(counts))
    return bars


def nees_band(flights: int, degrees: int = 6) -> tuple[float, float]:
    """Range in which 95 % of the means of so many draws of a chi-square with these degrees of freedom lie.

    E. Wilson, M. Hilferty, "The distribution of chi-square", 1931.
    """
    spread = 2.0 / (9.0 * degrees * flights)
    low, high = (degrees * (1.0 - spread + sign * _NORMAL * np.sqrt(spread)) ** 3 for sign in (-1.0, 1.0))
    return float(low), float(high)


def nees_bar(name: str, counts: Counts) -> Bar:
    """Whether the mean NEES of flights lies in its band."""
    mean = float(np.mean(counts.nees))
    low, high = nees_band(len(counts.nees))
    return is_true(name, f"{low:.2f} to {high:.2f}", low <= mean <= high,
                   f"{mean:.2f} (at the flights' ends {np.mean(counts.final_nees):.2f})")  # fmt: skip


def quality_bars(counts: list[Counts], what: str = "") -> list[Bar]:
    """Whether `quality` separates bad poses from good ones. what: begins the names of the bars."""
    bad, good = sum(c.bad for c in counts), sum(c.good for c in counts)
    flagged = sum(c.bad_flagged for c in counts) / bad if bad else 1.0
    wrongly = sum(c.good_flagged for c in counts) / max(good, 1)
    return [
        is_true(f"{what}quality: poses off by more than 0.2 m or 10 degrees are flagged", ">= 95 %", flagged >= 0.95,
                f"{100 * flagged:.1f} % of {bad}"),
        is_true(f"{what}quality: others are flagged", "<= 5 %", wrongly <= 0.05, f"{100 * wrongly:.1f} % of {good}"),
    ]  # fmt: skip


def _largest_tilt_rad(errors: list[PoseError]) -> float:
    """The largest tilt of what a flight controller gets, from when it must be level."""
    begin_ns = errors[0].estimate.t_ns
    late = [e.tilt_rad for e in errors if (e.estimate.t_ns - begin_ns) * 1e-9 >= _LEVEL_S]
    return float(np.nan_to_num(np.array(late), nan=np.pi).max())


def _no_texture(bench: Bench) -> list[Bar]:
    """Ten seconds of a blank wall, with and without IMU: the odometry goes on, its covariance grows."""
    bars = []
    recording = random_flight(_LONG[0], Path(bench.source("trajectories")), bench.folder, seconds=_LONG[1]).recording
    first, count = round(4e9 / recording.period_ns), round(10e9 / recording.period_ns)
    blind = changed(recording, first, first + count, wall)
    for inertial in (True, False):
        flown: AgentRun = fly_alone(blind if inertial else blind.without_imu(), vocabulary=False)
        jump = flown.largest_jump_m(recording.period_ns)
        sizes = [float(np.trace(e.cov_o[:3, :3])) for e in flown.found[first : first + count]]
        grows = bool((np.diff(sizes) >= -1e-12).all())
        name = f"10 s of no texture {'with' if inertial else 'without'} IMU: odometry goes on, its covariance grows"
        measured = f"jump {jump:.3f} m, deviation {np.sqrt(sizes[0]):.3f} to {np.sqrt(sizes[-1]):.1f} m"
        bars.append(is_true(name, f"jumps < {_JUMP_M:g} m", grows and jump < _JUMP_M, measured))
    return bars


def _table(counts: dict[tuple[str, bool], Counts]) -> str:
    lines = [
        "| fault | IMU | flights | frames off | of them flagged | others | of them flagged | NEES, median |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for (fault, inertial), c in sorted(counts.items()):
        off = "-" if not c.bad else f"{100 * c.bad_flagged / c.bad:.1f} %"
        lines.append(
            f"| {fault} | {'yes' if inertial else 'no'} | {len(c.nees)} | {c.bad} | {off} | {c.good} | "
            f"{100 * c.good_flagged / max(c.good, 1):.1f} % | {np.median(c.nees):.1f} |"
        )
    return "\n".join(lines)
