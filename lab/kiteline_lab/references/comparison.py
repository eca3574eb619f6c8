"""Says in words what a replay computes differently from the kept text."""

import math
import re
from dataclasses import dataclass

import numpy as np

from kiteline_core.arrays import F64
from kiteline_lab.references.observation import Half, Observation, rounded, unit_of

_COLUMNS = {
    "tracking": ("inliers",), "pose": ("x", "y", "z", "turn_x", "turn_y", "turn_z"),
    "live": ("live_x", "live_y", "live_z"), "covariance": ("quality",),
    "map": ("mean_x", "mean_y", "mean_z", "keyframes", "landmarks"), "packets": ("up", "down"),
}  # of each stage, without units  # fmt: skip
_SHOWN = {"m": (1e3, "mm"), "rad": (1e3, "mrad"), "bytes": (1.0, "bytes"), "": (1.0, "")}
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


@dataclass(frozen=True, slots=True)
class Tolerance:
    """Largest differences where libraries or CPU kernels are others. counts: relative, beside `least`."""

    position_m: float
    angle_rad: float
    counts: float
    least: float

    def allows(self, was: float, now: float, unit: str) -> bool:
        """True if two numbers count as equal."""
        if math.isnan(was) or math.isnan(now):
            return math.isnan(was) == math.isnan(now)
        if unit in ("m", "rad"):
            return abs(now - was) <= (self.position_m if unit == "m" else self.angle_rad)
        return abs(now - was) <= self.least + self.counts * abs(was)


# Measured over kernels of OpenBLAS, numpy, OpenCV and numba for other CPUs: docs/papers.md.
TOLERANCE = Tolerance(position_m=0.001, angle_rad=0.001, counts=0.02, least=2.0)


def differences(kept: Observation, found: Observation, tolerance: Tolerance | None) -> list[str]:
    """Lines of text, none if nothing differs. tolerance: None compares every digest."""
    names = [half.name for half in kept.halves], [half.name for half in found.halves]
    if names[0] != names[1]:
        return [f"{', '.join(names[1])}; kept: {', '.join(names[0])}"]
    compare = _exactly if tolerance is None else _within
    return [line for was, now in zip(kept.halves, found.halves) for line in compare(was, now, tolerance)]


def _exactly(was: Half, now: Half, _: Tolerance | None) -> list[str]:
    if (was.columns, was.stages) != (now.columns, now.stages):
        return [f"{now.name}: other columns are kept"]
    rows = min(len(was.rows), len(now.rows))
    first = {}
    for k, stage in enumerate(was.stages):
        for i in range(rows):
            if was.rows[i].digests[k] != now.rows[i].digests[k]:
                first[stage] = i
                break
    lines = []
    if first:
        stage = min(first, key=lambda name: (first[name], was.stages.index(name)))
        row = now.rows[first[stage]]
        lines.append(
            f"{now.name}: {stage} is the first stage that differs, at {now.unit} {row.number} ({row.t_s:.3f} s)"
        )
        lines += [f"  {name}: from {now.unit} {first[name]} on{_by_how_much(was, now, name)}" for name in first]
        before, after = (half.rows[first[stage]].state for half in (was, now))
        lines += [f"  {now.unit} {row.number} is {after}, was {before}"] * (before != after)
    if len(was.rows) != len(now.rows):
        lines.append(f"{now.name}: {len(now.rows)} {now.unit}s, kept {len(was.rows)}")
    facts = [f"  {name}: {now.facts.get(name)}, was {was.facts.get(name)}" for name in {**was.facts, **now.facts}
             if now.facts.get(name) != was.facts.get(name) and not name.startswith("digest ")]  # fmt: skip
    return lines + ([f"{now.name}:"] if facts and not lines else []) + facts


def _by_how_much(was: Half, now: Half, stage: str) -> str:
    """The largest differences in the columns of a stage."""
    largest: dict[str, tuple[float, int]] = {}
    for column in _of_stage(was, stage):
        before, after = _column(was, column), _column(now, column)
        n = min(len(before), len(after))
        apart = np.abs(after[:n] - before[:n])
        if np.isfinite(apart).any() and np.nanmax(apart) > 0.0:
            at, unit = int(np.nanargmax(apart)), unit_of(column)
            name = unit or column
            largest[name] = max(largest.get(name, (0.0, 0)), (float(apart[at]), at))
    if not largest:
        return ", in digits that are not printed" if _of_stage(was, stage) else ""
    return ", by up to " + " and ".join(
        f"{_shown(value, name)} (at {at})" for name, (value, at) in largest.items()
    )  # fmt: skip


def _shown(value: float, name: str) -> str:
    if name not in _SHOWN:
        return f"{value:g} {name}"
    factor, unit = _SHOWN[name]
    return f"{factor * value:.3g} {unit}"


def largest(kept: Observation, found: Observation, unit: str) -> float:
    """The largest difference between numbers of a unit, in rows that both have; inf where one has none."""
    most = 0.0
    for was, now in zip(kept.halves, found.halves):
        for column in was.columns:
            if unit_of(column) == unit:
                before, after = _column(was, column), _column(now, column)
                n = min(len(before), len(after))
                if not np.array_equal(np.isnan(before[:n]), np.isnan(after[:n])):
                    return math.inf
                most = max(most, float(np.nan_to_num(np.abs(before[:n] - after[:n])).max(initial=0.0)))
    return most


def _of_stage(half: Half, stage: str) -> list[str]:
    names = _COLUMNS.get(stage, ())
    return [column for column in half.columns if column.removesuffix(f"_{unit_of(column)}") in names]


def _column(half: Half, name: str) -> F64:
    """The printed numbers of a column; nan where there is none."""
    k = half.columns.index(name)
    return np.array([float(text) if (text := rounded(row.numbers[k], name)) != "-" else math.nan for row in half.rows])


def _within(was: Half, now: Half, tolerance: Tolerance | None) -> list[str]:
    assert tolerance is not None
    if was.columns != now.columns or len(was.rows) != len(now.rows):
        return [f"{now.name}: {len(now.rows)} {now.unit}s, kept {len(was.rows)}; or other columns"]
    lines = []
    for k, column in enumerate(was.columns):
        unit = unit_of(column)
        for before, after in zip(was.rows, now.rows):
            if not tolerance.allows(before.numbers[k], after.numbers[k], unit) and unit != "bytes":
                lines.append(
                    f"{now.name}: {column} is {rounded(after.numbers[k], column)} at {now.unit} {after.number} "
                    f"({after.t_s:.3f} s), kept {rounded(before.numbers[k], column)}: beyond the tolerance"
                )
                break
    for name, text in was.facts.items():
        pairs = zip(_NUMBER.findall(text), _NUMBER.findall(now.facts.get(name, "")))
        unit = "m" if name.endswith("in m") else ""
        if not name.startswith("digest ") and not all(tolerance.allows(float(a), float(b), unit) for a, b in pairs):
            lines.append(f"{now.name}: {name} is {now.facts.get(name)}, kept {text}: beyond the tolerance")
    return lines
