"""How a flight of the base went: what it came to, and what it cost. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from kiteline_basestation.mapper import Mapper
from kiteline_basestation.runtime.outputs import counts, keyframe_poses


@dataclass(slots=True)
class FlightSummary:
    """The base at one moment: its counts, and where its keyframes are (T_w_k as 16 numbers by keyframe id)."""

    counts: dict[str, int]
    keyframes: dict[str, list[float]]


def flight_summary(mapper: Mapper) -> FlightSummary:
    """The base as it stands."""
    poses = keyframe_poses(mapper)
    return FlightSummary(counts(mapper), {str(k): pose.ravel().tolist() for k, pose in poses.items()})


def timings(jobs_ms: Mapping[str, Iterable[float]], step_ms: Iterable[float]) -> dict[str, list[float]]:
    """Samples of CPU time, of jobs by kind and of steps, as report.json names them."""
    return {
        "bundle_ms": list(jobs_ms.get("bundle", ())),
        "grid_ms": list(jobs_ms.get("grid", ())),
        "step_ms": list(step_ms),
    }
