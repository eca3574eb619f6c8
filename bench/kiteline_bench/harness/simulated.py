"""Simulated flights: along recorded paths, rendered to a file once; and random ones, rendered into memory."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kiteline_bench.harness.bars import Bench
from kiteline_bench.harness.recording import Recording, items_of
from kiteline_core.frame import OdometryBatch
from kiteline_core.geometry import se3, tum
from kiteline_hw.sim.sensors.rig import make_rig
from kiteline_hw.sim.source import open_sim
from kiteline_hw.sim.world.world import World
from kiteline_lab.flights import simulate

SIM_SECONDS = 30.0
# name: scene, trajectory, s into it, seed
_PATHS = {"MH_03": ("hall", "MH_03_medium.txt", 15.0, 3), "V1_02": ("room", "V1_02_medium.txt", 20.0, 4)}
NAMES = tuple(_PATHS)
_ODOMETRY_HZ = 50.0
_LOOKS_AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # a level camera that looks along x
_RECORDED = (("V1_02_medium", "room"), ("MH_03_medium", "hall"), ("MH_01_easy", "hall"))


# rendered to files


@dataclass(frozen=True, slots=True)
class SimulatedFlight:
    """A simulated flight: its recording, and the scene and options that made it."""

    recording: str
    scene: str
    options: Mapping[str, Any]

    def odometry(self, **errors: Any) -> OdometryBatch:
        """What an odometer measures on it; errors: options of the simulator."""
        measured = open_sim(self.scene, **self.options, odometry=_ODOMETRY_HZ, **errors).odometry()
        assert measured is not None
        return measured


def simulated(bench: Bench, name: str) -> SimulatedFlight:
    """A flight of NAMES, rendered if it is not there yet."""
    scene, trajectory, start_s, seed = _PATHS[name]
    path = bench.source(f"trajectories/{trajectory}")
    options = {"trajectory": path, "start": start_s, "seed": seed, "seconds": SIM_SECONDS}
    command = [argument for key, value in options.items() for argument in (f"--{key}", f"{value}")]
    return SimulatedFlight(str(render(bench, name, [scene, *command])[0]), scene, options)


def render(bench: Bench, name: str, command: Sequence[str], agents: int = 1) -> list[Path]:
    """Recordings of `kiteline sim` with these arguments; rendered once, if the folder is kept."""
    out = [bench.folder / (f"{name}-{i}.mcap" if i else f"{name}.mcap") for i in range(agents)]
    if not all(path.exists() for path in out):
        bench.say(f"rendering {name}")
        bench.folder.mkdir(parents=True, exist_ok=True)
        simulate.main([*command, "--force", "--out", str(out[0])])
    return out


def rendered_paths(bench: Bench, name: str, scene: str, paths: Sequence[str], seconds: float = 0.0) -> list[Path]:
    """Recordings of agents that fly these paths in one world. seconds: 0 is the whole path."""
    files = [bench.source(f"trajectories/{path}") for path in paths]
    part = ["--seconds", f"{seconds:g}"] if seconds else []
    also = ["--also", *files[1:]] if files[1:] else []
    return render(bench, name, [scene, "--trajectory", files[0], *part, *also], len(paths))


# random flights in memory


@dataclass(frozen=True, slots=True)
class RandomFlight:
    """A simulated flight in memory. moving: it begins in full motion. world: what is true of it."""

    recording: Recording
    moving: bool
    world: World


def random_flight(
    number: int, trajectories: Path, scratch: Path, scale: float = 1.0, seconds: float = 0.0, **more: Any
) -> RandomFlight:
    """Flight `number`: 9 to 13 s of a recorded path, or of a random smooth one, with world, lens and noise of its own.

    scale: of the images. seconds: another length. more: options of the simulator, such as rig="worn".
    """
    rng = np.random.default_rng([number, 77])
    drawn = float(rng.uniform(9.0, 13.0))
    seconds = seconds or drawn
    options: dict[str, Any] = {
        "seed": 1000 + number, "seconds": seconds, "scale": scale,
        "lens": ("radtan", "radtan", "equidistant")[int(rng.integers(3))],
        "read_noise": float(rng.uniform(0.8, 2.5)), "shot_noise": float(rng.uniform(0.01, 0.04)),
        "rest": float(rng.choice([0.0, 1.0, 1.0])),
    }  # fmt: skip
    if number % 3 == 0:
        name, scene = _RECORDED[number // 3 % 3]
        file = trajectories / f"{name}.txt"
        stamps = np.loadtxt(file, usecols=0)
        start_s = float(rng.uniform(5.0, stamps[-1] - stamps[0] - seconds - 5.0))
        options |= {"trajectory": str(file), "start": start_s}
    elif number % 6 == 5:
        scene = "corridor"
        options["start"] = float(rng.uniform(0.0, 50.0))
    else:
        scene = "room" if number % 3 == 1 else "hall"
        path = scratch / f"path{number}.txt"
        _write_path(path, rng, seconds, (1.6, 1.8, 0.4) if scene == "room" else (4.0, 4.0, 0.8))
        options["trajectory"] = str(path)
    source = open_sim(scene, os.cpu_count() or 1, **options, **more)
    assert source.imu is not None and source.ground_truth is not None
    recording = Recording(source.rig, source.imu, tuple(items_of(source)))
    return RandomFlight(recording, options["rest"] == 0.0, source.world)


def _write_path(file: Path, rng: np.random.Generator, seconds: float, size_m: tuple[float, float, float]) -> None:
    """Write a smooth path as a TUM file: sums of slow waves, the camera turning left and right."""
    t = np.arange(0.0, seconds + 3.0, 0.05)
    p = np.tile([0.0, 0.0, 1.4], (len(t), 1))
    for axis, size in enumerate(size_m):
        for _ in range(3):
            wave = np.sin(2 * np.pi * t / rng.uniform(6.0, 16.0) + rng.uniform(0.0, 2 * np.pi))
            p[:, axis] += size * rng.uniform(0.3, 1.0) / 1.5 * wave
    yaw = rng.uniform(0.0, 2 * np.pi) + rng.uniform(-0.25, 0.25) * t
    for _ in range(2):
        yaw = yaw + rng.uniform(0.2, 0.7) * np.sin(2 * np.pi * t / rng.uniform(4.0, 12.0) + rng.uniform(0.0, 2 * np.pi))
    roll, pitch = (0.08 * np.sin(2 * np.pi * t / rng.uniform(2.0, 5.0)) for _ in "rp")
    T_c_b = se3.inverse(make_rig().T_b_c)
    lines = []
    for i in range(len(t)):
        r = (
            se3.so3_exp(np.array([0.0, 0.0, yaw[i]]))
            @ se3.so3_exp(np.array([roll[i], 0.06 + pitch[i], 0.0]))
            @ _LOOKS_AHEAD
        )
        lines.append(tum.line(round(t[i] * 1e9), se3.from_rt(r, p[i]) @ T_c_b))
    file.write_text("".join(lines))
