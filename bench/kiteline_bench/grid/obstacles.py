"""OBSTACLE_DISTANCE in simulated flights, against the true distances."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_bench.harness.bars import Bar, Bench, at_most, is_true, table
from kiteline_bench.harness.run import FlyingAgent, fly_recording
from kiteline_bench.harness.simulated import random_flight
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import Rectifier
from kiteline_hw.sim.truth.sight_kernels import level_distances
from kiteline_hw.sim.world.raycast_kernels import NO_SHELL
from kiteline_hw.sim.world.world import World

# Half of the flights by worn rigs; paths, scenes and lenses change with other periods.
FLIGHTS = tuple((number, "worn" if number % 4 in (1, 2) else "true") for number in range(401, 421))
_SECONDS = 6.0
_EVERY = 2  # frames: 10 Hz
_RIGHT, _RIGHT_M = 95.0, 0.10  # percent of bins that are told, and how far they may be off, if a cell is no larger
_PHANTOM_M, _PHANTOM_S = 0.5, 0.2
_RANGES_M = (0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 20.0)  # of a table
_SLAB_M = 0.25  # m above and below the vehicle in which something stands in its way
_HEIGHTS, _INNER, _OUTER = 12, 5, 9  # rays: of the slab, inside of a sector, and up to its edges and a little beyond
_BEYOND, _INSIDE = 0.1, 0.3  # of a sector's width
_VIEW_DEG = 55.0  # from ahead: farther to the side lies nothing that the camera has seen before it moves
_STILL_M, _STILL_RAD = 0.1, 0.09  # from the start: until then it has not moved
_T_C_F = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


@dataclass(slots=True)
class Judge:
    """Compares what a vehicle is told of its surroundings with the world, at 10 Hz."""

    world: World
    bands_m: tuple[float, ...]
    told: int = 0
    right: int = 0
    unseen: int = 0  # told though it cannot have been seen
    unknown: int = 0
    asked: int = 0
    phantom_s: float = 0.0  # longest
    errors: list[F64] = field(
        default_factory=list
    )  # (n,2) true distance, and how far beyond what is right, of told bins
    _since: dict[int, int] = field(default_factory=dict)  # samples in which a sector has had a phantom
    _start: F64 | None = None

    def compare(self, distance_m: F64, T_w_f: F64, cell_m: float, reach_m: float) -> None:
        """Take one report: distances (n,) clockwise from ahead, and the true pose (4,4) of the vehicle.

        reach_m: farther obstacles are none.
        """
        self._start = T_w_f if self._start is None else self._start
        change = se3.inverse(self._start) @ T_w_f
        still = bool(
            np.linalg.norm(change[:3, 3]) < _STILL_M and np.linalg.norm(se3.so3_log(change[:3, :3])) < _STILL_RAD
        )
        near, far = (
            np.minimum(true_m, reach_m) for true_m in true_distances(self.world, T_w_f, len(distance_m), self.bands_m)
        )
        none, distance_m = np.isinf(distance_m), np.minimum(distance_m, reach_m)
        error_m = max(_RIGHT_M, cell_m)
        known = ~np.isnan(distance_m)
        right = (distance_m >= near - error_m) & (distance_m <= far + error_m)
        beyond = np.maximum(distance_m - far, 0.0) - np.maximum(near - distance_m, 0.0)
        self.errors.append(np.column_stack([far, beyond])[known & ~none])
        ahead_deg = np.abs((np.arange(len(distance_m)) * 360.0 / len(distance_m) + 180.0) % 360.0 - 180.0)
        self.asked += len(distance_m)
        self.told += int(known.sum())
        self.right += int((known & right).sum())
        self.unknown += int((~known).sum())
        if still:
            self.unseen += int((known & (ahead_deg > _VIEW_DEG)).sum())
        phantom = known & (distance_m < _PHANTOM_M) & (distance_m < near - error_m)
        self._since = {k: self._since.get(k, 0) + 1 for k in np.flatnonzero(phantom).tolist()}
        longest = max(self._since.values(), default=0)
        self.phantom_s = max(self.phantom_s, (longest - 1) * 0.05 * _EVERY if longest else 0.0)


def true_distances(world: World, T_w_f: F64, sectors: int, bands_m: Sequence[float]) -> tuple[F64, F64]:
    """Least and largest distance (n,) that is right for each sector.

    The least is that of anything in the height bands that the vehicle is in, up to a little beyond the sector's edges;
    the largest that of what stands at its own height well inside of the sector.
    """
    o, heading = T_w_f[:3, 3], np.arctan2(T_w_f[1, 0], T_w_f[0, 0])
    ground = float(world.height(o[None, :2])[0])
    low, high = o[2] - ground - _SLAB_M, o[2] - ground + _SLAB_M
    touched = [(a, b) for a, b in pairwise(bands_m) if high > a and low < b]
    low, high = min([low, *(a for a, _ in touched)]), max([high, *(b for _, b in touched)])
    own = np.array([o[2]])
    heights = np.array([*np.linspace(ground + max(low, 0.02), ground + high, _HEIGHTS), o[2] - _SLAB_M, o[2] + _SLAB_M])
    width = 2.0 * np.pi / sectors
    middle = heading - np.arange(sectors)[:, None] * width
    outer = middle + np.linspace(-0.5 - _BEYOND, 0.5 + _BEYOND, _OUTER) * width
    inner = middle + np.linspace(-_INSIDE, _INSIDE, _INNER) * width
    return _nearest(world, o[:2], heights, outer), _nearest(world, o[:2], own, inner)


def _nearest(world: World, xy: F64, heights: F64, angles: F64) -> F64:
    """Least distance (n,) of level rays at all heights and angles (n,k)."""
    out = np.empty((angles.size, len(heights)))
    shell = NO_SHELL if world.shell is None else world.shell
    level_distances(world.boxes, shell, np.ascontiguousarray(xy), heights, np.ascontiguousarray(angles.ravel()), out)
    return np.asarray(out.reshape(len(angles), -1).min(axis=1))


def run(bench: Bench) -> list[Bar]:
    """Random flights in rooms, halls and corridors, with a base."""
    rows, judges = [], []
    for number, rig in bench.chosen(FLIGHTS):
        flight = random_flight(number, Path(bench.source("trajectories")), bench.folder, seconds=_SECONDS, rig=rig)
        judge = Judge(flight.world, AgentConfig().ground.bands_m)
        fly_recording(
            flight.recording, each=_Reports(judge, Rectifier(flight.recording.rig).camera.T_b_c @ _T_C_F).take
        )
        judges.append(judge)
        told = judge.told / max(judge.asked, 1)
        row = number, rig, 100.0 * told, 100.0 * judge.right / max(judge.told, 1), judge.phantom_s, judge.unseen
        rows.append(row)
        bench.say(
            f"  flight {number}, {rig} rig: {row[2]:.0f} % of bins told, {row[3]:.1f} % of them right, "
            f"phantom {row[4]:.2f} s"
        )
    table(
        bench,
        "Flights",
        ("flight", "rig", "bins told %", "of these right %", "longest phantom s", "told but not seen"),
        rows,
    )
    _by_range(bench, np.concatenate([pairs for j in judges for pairs in j.errors]))
    n = len(judges)
    right = 100.0 * sum(j.right for j in judges) / max(sum(j.told for j in judges), 1)
    wrong = sum(j.unseen for j in judges)
    return [
        Bar(f"{n} flights: bins within {_RIGHT_M:g} m or a cell of the true distance", f">= {_RIGHT:g} %",
            f"{right:.1f} %", right >= _RIGHT),
        at_most(f"{n} flights: longest phantom nearer than {_PHANTOM_M:g} m", max(j.phantom_s for j in judges),
                _PHANTOM_S, "s", 2),
        is_true(f"{n} flights: bins told before anything was seen there", "0", wrong == 0, f"{wrong}"),
        is_true(f"{n} flights: unknown is said", "some bins", all(j.unknown > 0 for j in judges),
                f"{100.0 * sum(j.unknown for j in judges) / max(sum(j.asked for j in judges), 1):.0f} % of all bins"),
    ]  # fmt: skip


def _by_range(bench: Bench, errors: F64) -> None:
    """Show the errors of bins by the true distance. errors: (n,2), see `Judge`."""
    rows = []
    for low, high in pairwise(_RANGES_M):
        off = errors[(errors[:, 0] >= low) & (errors[:, 0] < high), 1]
        if len(off):
            shares = [100.0 * float(np.mean(v)) for v in (off < -_RIGHT_M, np.abs(off) <= _RIGHT_M, off > _RIGHT_M)]
            rows.append((f"{low:g} to {high:g}", len(off), *shares, 1000.0 * float(np.median(np.abs(off)))))
    columns = ("true distance m", "bins", "too near %", "right %", "too far %", "median error mm")
    table(bench, "Bins that tell an obstacle, by distance", columns, rows)


class _Reports:
    """Asks an agent for its surroundings every other frame, and hands them to a judge."""

    def __init__(self, judge: Judge, T_b_f: F64) -> None:
        self._judge, self._T_b_f = judge, T_b_f
        self._frames = 0

    def take(self, flying: FlyingAgent) -> None:
        """Take a step of the agent."""
        estimate, T_w_b = flying.run.estimates[-1], flying.run.truth[-1]
        self._frames += 1
        if self._frames % _EVERY or estimate is None or not estimate.tracked or T_w_b is None:
            return
        around = flying.box.surroundings(estimate, self._T_b_f)
        if around is not None:
            self._judge.compare(
                np.asarray(around.distance_m), T_w_b @ self._T_b_f, AgentConfig().local_grid.cell_m, around.reach_m
            )
