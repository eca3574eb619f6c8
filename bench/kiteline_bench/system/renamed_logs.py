"""Copy a log of an earlier version under today's names: `python -m kiteline_bench.system.renamed_logs OLD NEW`.

A rule maps an old name to the new one, to None where the name is gone, or to (new name, function of the old value).
All messages else are copied byte for byte, in their order.
"""

from __future__ import annotations

import json
import re
import sys
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer

from kiteline_hw.logs.mcap_file import McapFile
from kiteline_hw.logs.mcap_log import CHUNK_BYTES

Rule = str | tuple[str, Callable[[Any], Any]] | None
Rules = Mapping[str, Rule]


def _share_of_width(px: float) -> float:
    """Pixels of a 752 px wide image as a share of its width."""
    return round(px / 752.0, 3)


def _agent_events(events: list[str]) -> list[str]:
    """Events of an agent's step in today's words."""
    return [next((re.sub(old, new, e) for old, new in _AGENT_EVENTS if re.match(old, e)), e) for e in events]


_AGENT_EVENTS = (
    (r"recovered by copies$", "relocalised by the map cache"),
    (r"recovered$", "relocalised"),
    (r"governor: (search|keyframe) put off$", r"governor: \1 postponed"),
    (r"keyframe: carried by the IMU$", "keyframe: by dead reckoning"),
    (r"submap lies (.*) degrees askew$", r"submap tilted by \1 degrees"),
)  # patterns of old texts, and today's

# dotted TOML name of an option, or of a section with all that it holds
CONFIG: dict[str, Rules] = {
    "agent": {
        "window.hold_radius_px": None,
        "window.min_hold": None,
        "window.doubt_depth": None,
        "window.doubt_rad": None,
        "window.hold_px": None,
        "window.copies": "map_cache.keyframes",
        "window.points": "map_cache.landmarks",
        "window.min_met": "map_cache.min_matches",
        "window.min_found": "map_cache.min_relocalisation_matches",
        "window.beyond_px": ("map_cache.beyond", _share_of_width),
        "window": "map_cache",
        "local_map.births": "local_map.landmarks",
        "inertial.askew_rad": "inertial.min_tilt_rad",
        "inertial.trusted_blind_s": "inertial.trusted_dead_reckoning_s",
        "inertial.max_coast_s": "inertial.max_dead_reckoning_s",
        "certainty.blind_accel_m_s2": "covariance.unmeasured_accel_m_s2",
        "certainty.blind_turn_rad_s2": "covariance.unmeasured_turn_rad_s2",
        "certainty.blind_velocity_m_s": "covariance.lost_velocity_m_s",
        "certainty.blind_rate_rad_s": "covariance.lost_rate_rad_s",
        "certainty.blind_speed_m_s": "covariance.unknown_velocity_m_s",
        "certainty.blind_speed_rad_s": "covariance.unknown_rate_rad_s",
        "certainty.surprise_blind": "covariance.surprise_unmeasured",
        "certainty.dispute_frames": "covariance.imu_offset_frames",
        "certainty.pull_share": "covariance.imu_offset_share",
        "certainty.doubt_frames": "covariance.low_quality_frames",
        "certainty.strange": "covariance.far_deviations",
        "certainty": "covariance",
        "motion": "depth_from_motion",
        "mono_start": "two_view_start",
        "recovery.carried_m": "relocalisation.dead_reckoning_m",
        "recovery.carried_rad": "relocalisation.dead_reckoning_rad",
        "recovery.beside_frames": "relocalisation.join_frames",
        "recovery.twins": "relocalisation.ambiguous_candidates",
        "recovery.twin_share": "relocalisation.ambiguous_share",
        "recovery.twin_ratio": "relocalisation.ambiguous_ratio",
        "recovery.twin_rad": "relocalisation.ambiguous_rad",
        "recovery.beyond_px": ("relocalisation.beyond", _share_of_width),
        "recovery": "relocalisation",
    },
    "base": {
        "intake.orphan_s": "intake.missing_root_s",
        "intake.carry_s": "intake.odometry_gap_s",
        "intake.per_step": "intake.max_per_step",
        "loops.candidates_here": "loops.candidates_same_map",
        "loops.min_of_neighbours": "loops.min_neighbour_ratio",
        "loops.neighbours": "loops.max_neighbours",
        "loops.min_share": "loops.min_matched_share",
        "loops.scale_points": "loops.min_scale_points",
        "loops.cell_points": "loops.cell_inliers",
        "loops.votes": "loops.min_keyframes",
        "loops.memory": "loops.recent_keyframes",
        "loops.ask_before": "loops.predecessors",
        "loops.own_drift_path": "loops.monocular_drift_path",
        "loops.own_drift_scale": "loops.max_scale_drift",
        "loops.small_m": "loops.fuse_m",
        "loops.small_rad": "loops.fuse_rad",
        "loops.small_scale": "loops.fuse_scale",
        "loops.twin_m": "loops.ambiguous_m",
        "graph.scaled_iterations": "graph.scale_iterations",
        "graph.revisits": "graph.requeries",
        "measurement.sigma_settled_px": "measurement.sigma_calibrated_px",
        "measurement.fused_px": "measurement.sigma_fused_px",
        "measurement.fused_growth": "measurement.sigma_fused_growth",
        "window.free": "bundle_window.max_free",
        "window.fixed": "bundle_window.max_fixed",
        "window.min_points": "bundle_window.min_landmarks",
        "window": "bundle_window",
        "links.enough": "odometry_factors.enough_observations",
        "links.enough_px": "odometry_factors.rotation_sigma_px",
        "links": "odometry_factors",
        "refind.keyframes": "landmark_matching.max_covisible",
        "refind.near_keyframes": "landmark_matching.max_nearby",
        "refind.min_gap": None,
        "refind": "landmark_matching",
        "new_points.keyframes": "triangulation.max_covisible",
        "new_points": "triangulation",
        "disparity.again": "disparity.retry_growth",
        "disparity.stands_out": "disparity.min_significance",
        "disparity.settled_px": "disparity.calibrated_px",
        "cull.age": "cull.landmark_age",
        "supply.copies": "map_cache.max_keyframes",
        "supply.every_s": "map_cache.period_s",
        "supply.remembered": "map_cache.local_keyframes",
        "supply.reach": "map_cache.max_distance_ratio",
        "supply.looked_at": "map_cache.max_candidates",
        "supply.min_points": "map_cache.min_landmarks",
        "supply.keep": "map_cache.hysteresis",
        "supply.length": "map_cache.max_scale_change",
        "supply": "map_cache",
        "grid.floor.peak_points": "grid.ground.min_peak_points",
        "grid.floor.plane_points": "grid.ground.min_plane_points",
        "grid.floor.level_m": "grid.ground.slope_prior_m",
        "grid.floor": "grid.ground",
    },
}
# by topic (the base's without "/agentN"): field of the JSON message
FIELDS: dict[str, Rules] = {"/events": {"events": ("events", _agent_events)}}
# option of the process, in the `spec` metadata
SPEC: dict[str, Rules] = {
    "agent": {
        "kill_at_s": ("kill_at_s", lambda at_s: at_s if at_s >= 0 else None),
        "await_base_at_s": ("await_base_at_s", lambda at_s: at_s if at_s >= 0 else None),
    },
    "base": {
        "kill_at_s": ("kill_at_s", lambda at_s: at_s if at_s >= 0 else None),
    },
}
TOPICS: dict[str, str] = {}  # without "/agentN"
JOB_KINDS: dict[str, str] = {}  # name of a job's kind in the base's steps

_AGENT_PREFIX = re.compile(r"^(/agent\d+)?(.*)$")


def copy_renamed(old: Path, new: Path) -> None:
    """Copy a log under new names. Raises SourceError when `old` is no MCAP file.

    Where OLD.job_values.json lies beside `old`, its list replaces the logged fingerprints of the jobs' results,
    in order.
    """
    log = McapFile(old)
    role = next((r.metadata.get("role", "") for r in log.metadata if r.name == "kiteline"), "")
    results = _job_results(old)
    with new.open("wb") as stream:
        writer = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)
        writer.start("", "kiteline")
        for record in log.metadata:
            writer.add_metadata(record.name, renamed_metadata(record.metadata, role))
        schemas = {0: 0}
        for number, schema in sorted(log.schemas.items()):
            schemas[number] = writer.register_schema(schema.name, schema.encoding, schema.data)
        channels = {
            number: writer.register_channel(
                renamed_topic(channel.topic), channel.message_encoding, schemas[channel.schema_id], channel.metadata
            )
            for number, channel in sorted(log.channels.items())
        }
        for message in log.messages(ordered=False):
            channel, data = log.channels[message.channel], message.data
            if channel.message_encoding == "json":
                data = renamed_message(channel.topic, data, results)
            writer.add_message(channels[message.channel], message.log_ns, data, message.publish_ns, message.sequence)
        writer.finish()


def renamed_metadata(metadata: Mapping[str, str], role: str) -> dict[str, str]:
    """The metadata with the options of `config` and `spec` renamed."""
    out = dict(metadata)
    if CONFIG.get(role) and "config" in out:
        out["config"] = renamed_config(out["config"], CONFIG[role])
    if SPEC.get(role) and "spec" in out:
        out["spec"] = json.dumps(_renamed_fields(json.loads(out["spec"]), SPEC[role]))
    return out


def renamed_config(text: str, rules: Rules) -> str:
    """A TOML text with its options renamed; the rule with the longest matching name counts."""
    sections: dict[str, list[str]] = {"": []}
    for name, value in _options(tomllib.loads(text), ""):
        whole = next((name[:n] for n in _ends(name) if name[:n] in rules), None)
        if whole is not None:
            new, value = _apply(rules[whole], value)
            if new is None:
                continue
            name = new + name[len(whole) :]
        section, _, key = name.rpartition(".")
        sections.setdefault(section, []).append(f"{key} = {_toml(value)}")
    heads = {section: [f"[{section}]"] if section else [] for section in sections}
    return "\n\n".join("\n".join(heads[s] + lines) for s, lines in sections.items() if lines) + "\n"


def renamed_topic(topic: str) -> str:
    """A topic under its new name."""
    prefix, rest = _split(topic)
    return prefix + TOPICS.get(rest, rest)


def renamed_message(topic: str, data: bytes, results: list[str]) -> bytes:
    """A JSON message with its fields renamed. results: fingerprints of jobs that are still to come, first one first."""
    rules = FIELDS.get(_split(topic)[1], {})
    is_step, is_job = topic == "/step" and bool(JOB_KINDS), topic == "/job" and bool(results)
    if not (rules or is_step or is_job):
        return data
    value = json.loads(data)
    if is_step and "jobs" in value:
        value["jobs"] = [[number, JOB_KINDS.get(kind, kind)] for number, kind in value["jobs"]]
    if is_job:
        value["result"] = results.pop(0)
    return json.dumps(_renamed_fields(value, rules), separators=(",", ":"), allow_nan=False).encode()


def _job_results(log: Path) -> list[str]:
    path = log.with_name(log.stem + ".job_values.json")
    return list(json.loads(path.read_text())) if path.exists() else []


def _renamed_fields(value: dict[str, Any], rules: Rules) -> dict[str, Any]:
    out = {}
    for name, field in value.items():
        new, field = _apply(rules.get(name, name), field)
        if new is not None:
            out[new] = field
    return out


def _apply(rule: Rule, value: Any) -> tuple[str | None, Any]:
    """New name and value."""
    if isinstance(rule, tuple):
        name, convert = rule
        return name, convert(value)
    return rule, value


def _options(table: Mapping[str, Any], path: str) -> list[tuple[str, Any]]:
    """Dotted names and values of a TOML table, in order."""
    out: list[tuple[str, Any]] = []
    for key, value in table.items():
        out += _options(value, f"{path}{key}.") if isinstance(value, dict) else [(path + key, value)]
    return out


def _ends(name: str) -> list[int]:
    """Lengths of a dotted name and of the sections that hold it, longest first."""
    return [len(name), *(m.start() for m in reversed(list(re.finditer(r"\.", name))))]


def _toml(value: Any) -> str:
    if isinstance(value, list):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    return json.dumps(value) if isinstance(value, bool | str) else repr(value)


def _split(topic: str) -> tuple[str, str]:
    match = _AGENT_PREFIX.match(topic)
    assert match is not None
    return match.group(1) or "", match.group(2)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    copy_renamed(Path(sys.argv[1]), Path(sys.argv[2]))
