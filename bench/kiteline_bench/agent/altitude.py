"""Drones that climb over a street and look down: far landmarks, with an IMU beside the same flights without it.

What stereo measures there is some percent off in length, by a tenth of a pixel of disparity; an IMU of a true rig must
not be corrected for it, and must not make poses worse.
"""

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np

from kiteline_bench.harness.bars import Bar, Bench, at_most, table
from kiteline_bench.harness.recording import Recording, items_of
from kiteline_bench.harness.run import fly_alone
from kiteline_bench.harness.starts import median_ratio
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_hw.sim.sensors.rig import make_rig
from kiteline_hw.sim.source import open_sim
from kiteline_hw.sources.text_files import read_tum_poses
from kiteline_lab.evaluation.metrics import TrajectoryAlignment
from kiteline_lab.flights.flight_report import write_tum

STARTS_S = (0.0, 2.0, 4.0, 6.0, 8.0)
_SECONDS, _REST_S, _CLIMB_S, _EYES_M = 18.0, 3.0, 9.0, 1.6
_MOST = 1.1  # ATE with an IMU over that without


class Climb(NamedTuple):
    """A recorded motion from start_s on, lifted by height_m, with the camera turned down by down_deg in the end."""

    motion: str
    start_s: float
    height_m: float
    down_deg: float
    seed: int

    @property
    def name(self) -> str:
        """What tables call it."""
        return f"{self.motion}, {self.height_m:g} m"


CLIMBS = (Climb("MH_03_medium", 30.0, 30.0, 50.0, 5), Climb("V1_02_medium", 12.0, 20.0, 60.0, 6))


def run(bench: Bench) -> list[Bar]:
    """ATE with the IMU over that without, corrections of a true IMU, losses."""
    rows, pairs, corrected, lost = [], [], 0, 0
    for climb in CLIMBS:
        recording = climbing(bench, climb, _SECONDS)
        for begin_s in bench.chosen(STARTS_S):
            part = recording.seconds(begin_s, _SECONDS)
            plain, inertial = fly_alone(part.without_imu()), fly_alone(part)
            pairs.append((inertial.ate_m(), plain.ate_m()))
            corrected += sum("corrected" in event for events in inertial.events for event in events)
            lost += inertial.lost_after_start + plain.lost_after_start
            lengths = inertial.evaluate(inertial.found, TrajectoryAlignment.SIM3)
            off = float("nan") if lengths is None else 100.0 * (1.0 / lengths.scale - 1.0)
            rows.append((climb.name, begin_s, pairs[-1][1], pairs[-1][0], off))
            bench.say(f"  from {begin_s:g} s: {pairs[-1][1]:.3f} m without an IMU, {pairs[-1][0]:.3f} m with it")
    columns = ("flight", "start s", "ATE without IMU m", "with IMU", "lengths too long by %")
    table(bench, "The agent alone, lifted within 9 s", columns, rows)
    return [
        median_ratio(bench, "high above ground: ATE with the IMU over that without it", pairs, _MOST),
        at_most("high above ground: corrections of a true IMU", corrected, 0, "", 0),
        at_most("high above ground: frames lost", lost, 0, "", 0),
    ]


def climbing(bench: Bench, climb: Climb, seconds: float, *, mono: bool = False) -> Recording:
    """A drone that climbs over a street, in the simulator."""
    bench.say(f"rendering {climb.motion}, {climb.height_m:g} m above a street")
    path = bench.folder / f"{climb.motion}_{climb.height_m:g}m.txt"
    _write_lifted(Path(bench.source("trajectories")) / f"{climb.motion}.txt", path, climb, seconds)
    source = open_sim(
        "street", os.cpu_count() or 1, seed=climb.seed, trajectory=str(path), seconds=seconds, mono=mono
    )  # fmt: skip
    assert source.imu is not None
    return Recording(source.rig, source.imu, tuple(items_of(source)))


def _write_lifted(source: Path, out: Path, climb: Climb, seconds: float) -> None:
    """Write the motion, lifted smoothly after a while, with the camera turned down meanwhile, as a TUM file."""
    poses = read_tum_poses(source)
    begin_ns = poses[0][0] + round(1e9 * climb.start_s)
    T_b_c, lifted = make_rig().T_b_c, list[tuple[int, F64]]()
    kept = [(t_ns, T) for t_ns, T in poses if 0 <= t_ns - begin_ns < 1e9 * (seconds + 2.0)]
    origin = kept[0][1][:3, 3]
    for t_ns, T_w_b in kept:
        x = float(np.clip(((t_ns - begin_ns) * 1e-9 - _REST_S) / _CLIMB_S, 0.0, 1.0))
        share = x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
        ahead = T_w_b[:3, :3] @ T_b_c[:3, 2]
        left = np.array([-ahead[1], ahead[0], 0.0]) / np.hypot(ahead[0], ahead[1])
        turned = se3.so3_exp(np.radians(climb.down_deg) * share * left) @ T_w_b[:3, :3]
        at = T_w_b[:3, 3] - origin + np.array([0.0, 0.0, _EYES_M + climb.height_m * share])
        lifted.append((t_ns, se3.from_rt(turned, at)))
    write_tum(out, lifted)
