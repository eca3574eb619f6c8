"""What each setting of the governor saves and costs, alone and together, over several recordings and starts.

Two flights that begin half a second apart differ in error by up to twice: numbers are geometric means over starts,
relative to the same flights at full effort.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_agent.governor.cost_model import PRICES_NS, cost_ns
from kiteline_agent.governor.effort import FULL, governed
from kiteline_bench.harness.bars import Bar, Bench, at_most
from kiteline_bench.harness.limited_cpu import fly_limited
from kiteline_bench.harness.recording import Recording, load
from kiteline_bench.harness.run import FlyingAgent
from kiteline_bench.harness.simulated import NAMES, simulated

TITLE = "The governor's settings"

_STARTS = 3
_APART = 12  # frames between two starts
_FRAMES = 400  # of a flight
_WHOLE_NS = 1_000_000_000  # at the start of a flight, in which no frame is skipped: the map begins
_MEASURES = ("cost_ms", "ate_m")
_SHARES = {0.5: 1.5, 0.25: 3.0}  # of the flight's own load, and what the ATE may grow by
_CONFIG = AgentConfig()


def _effort(**changes: Any) -> AgentConfig:
    return governed(_CONFIG, replace(FULL, **changes))


# name: configuration, and which frame is tracked
SETTINGS: dict[str, tuple[AgentConfig, int]] = {
    "full effort": (_CONFIG, 1),
    "every 2nd frame": (_CONFIG, 2),
    "every 3rd frame": (_CONFIG, 3),
    "every 4th frame": (_CONFIG, 4),
    "every 6th frame": (_CONFIG, 6),
    "every 8th frame": (_CONFIG, 8),
    "half of the stereo points": (_effort(stereo=0.5), 1),
    "fine pass on the finest level only": (_effort(fine_from=0), 1),
    "0.65 of the points": (_effort(points=0.65), 1),
    "0.45 of the points": (_effort(points=0.45), 1),
    "0.6 of the new landmarks": (_effort(corners=0.6), 1),
    "1.5 times as far between keyframes": (_effort(keyframes=1.5), 1),
    "2.5 times as far": (_effort(keyframes=2.5), 1),
    "half-size images": (_effort(first=1), 1),
    "every 4th frame, half-size images": (_effort(first=1), 4),
    "every 8th frame, half of the points and new landmarks": (_effort(points=0.5, corners=0.5, stereo=0.5), 8),
}


@dataclass(frozen=True, slots=True)
class FixedEffortFlight:
    """A flight at a fixed effort. cost_ms: a camera frame's, at the virtual CPU's prices. ate_m: nan without truth."""

    cost_ms: float
    ate_m: float
    lost: int
    submaps: int


def fly_at(recording: Recording, config: AgentConfig, every: int) -> FixedEffortFlight:
    """Fly at one effort, on a core that is never busy; after the first second only every `every`-th frame."""
    agent = FlyingAgent(recording.rig, recording.imu, config, vocabulary=False)
    spent_ns = 0
    for k, item in enumerate(recording.items):
        if k % every and item.frame.t_ns - recording.items[0].frame.t_ns >= _WHOLE_NS:
            spent_ns += round(PRICES_NS["steps"])
            agent.drop(item)
            continue
        agent.step(item)
        spent_ns += cost_ns(agent.box.work)
    run = agent.run
    return FixedEffortFlight(spent_ns / 1e6 / len(recording.items), run.ate_m(), run.lost, run.submaps)


def run(bench: Bench) -> list[Bar]:
    """Every setting, then the governor with all of them; with an IMU and without."""
    room = bench.source("room_flight.mcap")
    sources = {Path(s).stem: s for s in (room, *(simulated(bench, name).recording for name in NAMES))}
    bars: list[Bar] = []
    for inertial in (True, False):
        columns: dict[str, list[tuple[float, float, bool]]] = {}
        for name, source in sources.items():
            whole = load(source, imu=inertial, frames=_FRAMES + (_STARTS - 1) * _APART)
            starts = [whole.part(k * _APART, k * _APART + _FRAMES) for k in range(_STARTS)]
            what = f"{name}, {'IMU' if inertial else 'no IMU'}"
            bars += _governed(bench, what, starts)
            bench.say(f"flying {what}: every setting")
            columns[name] = _settings(starts)
        bench.more.append(_table(inertial, columns))
    return bars


def _governed(bench: Bench, what: str, starts: Sequence[Recording]) -> list[Bar]:
    """On the modelled core, at shares of the load of the same flights without a limit."""
    bench.say(f"flying {what}: governed")
    free = [fly_limited(recording, 0.0, governor=False, real=False) for recording in starts]
    bars = []
    for share, limit in _SHARES.items():
        flown = [fly_limited(c, share * f.load, governor=True, real=False) for c, f in zip(starts, free, strict=True)]
        name = f"{what}, {100 * share:.0f} %, {len(starts)} starts"
        bars += [
            at_most(f"{name}: busiest second, of the budget", max(f.peak / f.percent for f in flown), 1.0, "", 2),
            at_most(f"{name}: ATE over that without a limit", _mean([f.ate_m for f in flown])
                    / _mean([f.ate_m for f in free]), limit, "", 2),
            at_most(f"{name}: lost frames and further submaps", sum(f.lost + f.submaps - 1 for f in flown), 0, "", 0),
        ]  # fmt: skip
    return bars


def _settings(starts: Sequence[Recording]) -> list[tuple[float, float, bool]]:
    """Of each setting: cost and ATE relative to full effort, and whether a start was lost or began a new map."""
    rows: list[tuple[float, float, bool]] = []
    full: list[FixedEffortFlight] = []
    for config, every in SETTINGS.values():
        flown = [fly_at(recording, config, every) for recording in starts]
        full = full or flown
        cost, ate = (_mean([getattr(f, n) for f in flown]) / _mean([getattr(f, n) for f in full]) for n in _MEASURES)
        rows.append((cost, ate, any(f.lost or f.submaps > 1 for f in flown)))
    return rows


def _mean(values: Sequence[float]) -> float:
    """Geometric; infinite where a flight has none."""
    return float(np.exp(np.mean(np.log(values)))) if np.isfinite(values).all() else float("inf")


def _table(inertial: bool, columns: dict[str, list[tuple[float, float, bool]]]) -> str:
    """Markdown; a flight of which frames were lost, or that began a new map, is marked."""
    lines = [
        (
            f"Settings at a fixed value, {'with an IMU' if inertial else 'without an IMU'}: cost and ATE relative to "
            f"full effort, geometric means over {_STARTS} starts; *: lost in at least one of them.\n"
        ),
        f"| setting | cost | {' | '.join(f'ATE {name}' for name in columns)} |",
        "|---" * (2 + len(columns)) + "|",
    ]
    for k, setting in enumerate(SETTINGS):
        cost = _mean([rows[k][0] for rows in columns.values()])
        cells = (f"{rows[k][1]:.2f}{'*' * rows[k][2]}" for rows in columns.values())
        lines.append(f"| {setting} | {cost:.2f} | {' | '.join(cells)} |")
    return "\n".join(lines)
