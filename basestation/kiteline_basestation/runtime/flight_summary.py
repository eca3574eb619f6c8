"""Numbers of a base's flight for report.json: counts, keyframe poses, CPU times. Pure."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from kiteline_basestation.job_kinds import KINDS
from kiteline_basestation.mapper import Mapper
from kiteline_core.arrays import F64
from kiteline_core.ids import KeyframeId

_COUNTS = (
    "keyframes", "loops", "merges", "loop_matches", "matches_refused", "found", "triangulated", "culled",
    "keyframes_culled", "bundles", "grids", "refused_records",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class FlightSummary:
    """The base at one moment: its counts, and T_w_k of its keyframes (16 numbers by keyframe id)."""

    counts: dict[str, int]
    keyframes: dict[str, list[float]]


def flight_summary(mapper: Mapper) -> FlightSummary:
    """Counts and keyframe poses now."""
    poses = keyframe_poses(mapper)
    return FlightSummary(counts(mapper), {str(k): pose.ravel().tolist() for k, pose in poses.items()})


def keyframe_poses(mapper: Mapper) -> dict[KeyframeId, F64]:
    """S_w_k (4,4) of every keyframe of a placed submap that has a pose: T_w_k, with the scale of its submap in w."""
    poses: dict[KeyframeId, F64] = {}
    for submap, S_w_m in sorted(mapper.placements.items()):
        for keyframe in mapper.map.submaps.get(submap, []):
            pose = mapper.map.pose(keyframe)
            if pose is not None:
                poses[keyframe] = S_w_m @ pose
    return poses


def counts(mapper: Mapper) -> dict[str, int]:
    """Counts of the map as report.json names them."""
    summary = mapper.summary()
    return {"map_points": _whole(summary["points"]), **{name: _whole(summary[name]) for name in _COUNTS}}


def timings(
    jobs_ms: Mapping[str, Iterable[float]], grid_ms: Iterable[float], step_ms: Iterable[float]
) -> dict[str, list[float]]:
    """Samples of CPU time in ms: `KIND_ms` of every kind of job, `grid_ms` and `step_ms`."""
    jobs = {f"{kind}_ms": list(jobs_ms.get(kind, ())) for kind in KINDS}
    return {**jobs, "grid_ms": list(grid_ms), "step_ms": list(step_ms)}


def _whole(value: object) -> int:
    assert isinstance(value, int)
    return value
