"""Worn rigs: the same simulated flights by a true rig and by one that has changed since its calibration.

Then the IMU of each rig flies twice more, with what its rig file keeps of it. Seven seeds of world, path and wear for
each scene. The seeds are held out: options are tuned on others.
"""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_bench.harness.bars import Bar, Bench, table
from kiteline_bench.harness.recording import Recording, load
from kiteline_bench.harness.simulated import render
from kiteline_bench.reality.flown import Flown, flown, spread
from kiteline_core.arrays import F64
from kiteline_core.frame import ImuBatch
from kiteline_hw.logs.rig_json import rig_from_json

SEEDS = tuple(range(901, 908))  # of world and wear
SECONDS = 16.0
_PATHS = {"room": ("V1_02_medium.txt", 8.0, 9.0), "hall": ("MH_03_medium.txt", 12.0, 13.0)}  # first start, step in s
_LIVE, _LIVE_M = 4.0, 0.02  # times the clean flight's error, or m, whichever is larger
_BASE, _BASE_M = 2.5, 0.01
_JUMP_MM = 3.0
_LEFT = 1.0 / 3.0  # of what the told calibration is off by
_UNHURT = 1.05


@dataclass(frozen=True, slots=True)
class _Pair:
    """A flight by a true rig, also without self-calibration, and the same one by a worn rig.

    found: `unfound` after it. kept: after the last of three flights with the rig file's IMU.
    """

    seed: int
    clean: Flown
    plain: Flown
    worn: Flown
    found: dict[str, float]
    kept: dict[str, float]

    def over_bound(self, path: str, times: float, least_m: float) -> float:
        """Error of the worn rig over what it may be."""
        return self.worn.ate_m(path) / max(times * self.clean.ate_m(path), least_m)


def recording(bench: Bench, scene: str, seed: int, rig: str) -> Recording:
    """A simulated flight, rendered unless the bench's folder has it."""
    path, first_s, step_s = _PATHS[scene]
    start_s = first_s + step_s * (seed % len(SEEDS))
    command = [
        scene, "--trajectory", bench.source(f"trajectories/{path}"), "--start", f"{start_s:g}", "--seconds",
        f"{SECONDS:g}", "--seed", f"{seed}", "--rig", rig,
    ]  # fmt: skip
    return load(str(render(bench, f"{scene}_{seed}_{rig}", command)[0]))


def room(bench: Bench) -> list[Bar]:
    """Flights in a room."""
    return _bars(bench, "room")


def hall(bench: Bench) -> list[Bar]:
    """Flights in a hall."""
    return _bars(bench, "hall")


def _bars(bench: Bench, scene: str) -> list[Bar]:
    pairs, seeds = [], bench.chosen(SEEDS)
    for k, seed in enumerate(seeds):
        true_rig = recording(bench, scene, seed, "true")
        clean = flown(bench, f"{scene} {seed}, true rig", true_rig)
        plain = flown(bench, f"{scene} {seed}, true rig, no self-calibration", true_rig, config=_uncalibrated())
        worn = flown(bench, f"{scene} {seed}, worn rig", recording(bench, scene, seed, "worn"))
        found = unfound(worn.box, _truth(bench, scene, seed))
        later = [seeds[(k + n) % len(seeds)] for n in (1, 2)]
        pairs.append(_Pair(seed, clean, plain, worn, found, _kept(bench, scene, seed, later, worn)))
        bench.say(
            f"  clean live {clean.ate_m('live'):.4f} base {clean.ate_m('base'):.4f} m; "
            f"worn live {worn.ate_m('live'):.4f} base {worn.ate_m('base'):.4f} m, jump {_jump_mm(worn):.1f} mm, "
            f"not found: {', '.join(f'{name} {share:.2f}' for name, share in pairs[-1].found.items())}"
        )
    _table(bench, scene, pairs)
    return [
        *spread(f"worn {scene}: ATE live over the larger of {_LIVE:g} x clean and {_LIVE_M:g} m",
                [pair.over_bound("live", _LIVE, _LIVE_M) for pair in pairs], 1.0, "", 2),
        *spread(f"worn {scene}: ATE base over the larger of {_BASE:g} x clean and {_BASE_M:g} m",
                [pair.over_bound("base", _BASE, _BASE_M) for pair in pairs], 1.0, "", 2),
        *spread(f"worn {scene}: largest live jump beside the motion", [_jump_mm(pair.worn) for pair in pairs],
                _JUMP_MM, "mm", 1),
        *(bar for name in _names(pair.found for pair in pairs)
          for bar in spread(f"worn {scene}: {name}, error that is left over that of the calibration",
                            [pair.found.get(name, 1.0) for pair in pairs], _LEFT, "", 2)),
        *(bar for name in _names(pair.kept for pair in pairs)
          for bar in spread(f"worn {scene}: {name}, the same after three flights with the rig file",
                            [pair.kept.get(name, 1.0) for pair in pairs], _LEFT, "", 2)),
        *spread(f"true {scene}: ATE live over that without self-calibration",
                [pair.clean.ate_m("live") / pair.plain.ate_m("live") for pair in pairs], _UNHURT, "", 2),
        *spread(f"worn {scene}: frames without a pose", [float(pair.worn.run.lost) for pair in pairs], 0.0, "", 0),
    ]  # fmt: skip


def _names(found: Iterable[dict[str, float]]) -> list[str]:
    """Parts of a rig that any flight has found; a flight that left its IMU found none."""
    return list(dict.fromkeys(name for shares in found for name in shares))


def _truth(bench: Bench, scene: str, seed: int) -> Any:
    return json.loads((bench.folder / f"{scene}_{seed}_worn.rig_truth.json").read_text())


def _kept(bench: Bench, scene: str, seed: int, later: Sequence[int], first: Flown) -> dict[str, float]:
    """What is unfound of the IMU of a rig after two more flights along other paths, without a base."""
    truth, flight = _truth(bench, scene, seed), first
    for other in later:
        known = None if flight.box is None else flight.box.known_rig()
        assert known is not None
        config = AgentConfig(known_rig=replace(known, rows_px=(), rows_read=False, disparity_px=()))  # other cameras
        there = as_measured_by(recording(bench, scene, other, "worn"), _truth(bench, scene, other), truth)
        flight = flown(bench, f"{scene} {other}, IMU of {seed}", there, base=False, config=config)
    return unfound(flight.box, truth)


def as_measured_by(flight: Recording, truth: dict[str, Any], other: dict[str, Any]) -> Recording:
    """A flight as the IMU of another rig measures it, with frames as late as there. truth, other: rig_truth.json."""
    gyro, accel = (_axes(other, name) @ np.linalg.inv(_axes(truth, name)) for name in ("gyro", "accel"))
    earlier_ns = round(1e9 * (other["frame_stamps_late_s"] - truth["frame_stamps_late_s"]))

    def measured(imu: ImuBatch | None) -> ImuBatch | None:
        return None if imu is None else ImuBatch(imu.t_ns - earlier_ns, imu.gyro @ gyro.T, imu.accel @ accel.T)

    return replace(flight, items=tuple(replace(item, imu=measured(item.imu)) for item in flight.items))


def _axes(truth: dict[str, Any], name: str) -> F64:
    """(3,3) of measured = axes @ true, of "gyro" or "accel", in the axes of the body by the camera."""
    told, true = (rig_from_json(truth[key])[0].T_b_c[:3, :3] for key in ("told", "true"))
    return np.asarray(np.array(truth[f"{name}_matrix"]) @ true @ told.T)


def _uncalibrated() -> AgentConfig:
    """The agent without self-calibration of the IMU."""
    config = AgentConfig()
    off = replace(config.inertial.calibration, apply_axes=False, apply_offset=False)
    return replace(config, inertial=replace(config.inertial, calibration=off))


def unfound(box: Agent | None, truth: dict[str, Any]) -> dict[str, float]:
    """What the agent's calibration is off by at the end, over what the told one was off by, for each part of the rig.

    truth: rig_truth.json. Axes of the IMU are those of the body by the camera, as the agent has them: an error of the
    camera's rotation is one of both.
    """
    reports = {} if box is None else box.motion_reports()
    found, offset = reports.get("imu_calibration"), reports.get("time_offset")
    if found is None or offset is None:
        return {}
    shares = {}
    for name in ("gyro", "accel"):
        wanted = _axes(truth, name)
        off = np.linalg.norm(np.array(found[name]["matrix"]) - wanted)
        shares[f"axes of the {name}"] = float(off / np.linalg.norm(wanted - np.eye(3)))
    late_ms = 1000.0 * truth["frame_stamps_late_s"]
    shares["time offset"] = abs(offset["ms"] + late_ms) / late_ms
    return shares


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
