"""The places whose grids are judged: somebody else's recorded room, and simulated ones full of difficult objects."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from kiteline_bench.harness.bars import Bench
from kiteline_bench.harness.simulated import render
from kiteline_hw.sim.source import open_sim
from kiteline_hw.sim.world.world import World
from kiteline_lab.grids import truth
from kiteline_lab.grids.files import GridFile, read_grid

RECORDED = "room_flight"
_SCENES = {"room": 40.0, "corridor": 35.0, "hall": 30.0}  # s: a lap of the room's course, half of one of the others
_SEED = 41
DEPTH = "depth"  # a depth camera in place of the right one
CASES = (
    *((scene, rig) for rig in ("true", "worn") for scene in _SCENES),
    ("corridor", DEPTH),
)  # scenes, and the rigs that fly them


@dataclass(frozen=True, slots=True)
class Place:
    """A flight and its truth. true: all of it; seen: what its true poses could see. world: None of a recording."""

    name: str
    recording: str
    true: GridFile
    seen: GridFile
    world: World | None


def recorded(bench: Bench) -> Place:
    """The recorded room."""
    source, stem = bench.source(f"{RECORDED}.mcap"), bench.folder / f"{RECORDED}_true"
    if not stem.with_name(f"{stem.name}_seen.yaml").exists():
        bench.folder.mkdir(parents=True, exist_ok=True)
        bench.say(f"casting rays of sight in {RECORDED}")
        truth.main([source, "--boxes", bench.source(f"{RECORDED}_boxes.csv"), "--out", f"{stem}.yaml"])
    return Place(RECORDED, source, *_grids(stem), None)


def simulated(bench: Bench, scene: str, rig: str, options: str = "objects=1", share: float = 1.0) -> Place:
    """A scene with objects, flown along a part of its own course; rendered unless the bench's folder has it."""
    seconds = _SCENES[scene] * share
    name = f"{scene}_{options.replace('=', '').replace('&', '_')}_{rig}_{seconds:g}s"
    sensor = ["--depth"] if rig == DEPTH else ["--rig", rig]
    command = [f"{scene}?{options}", "--seed", f"{_SEED}", "--seconds", f"{seconds:g}", *sensor]
    file = render(bench, name, command)[0]
    world = open_sim(f"{scene}?{options}", seed=_SEED, seconds=seconds, texture_bits=7, imu=False).world
    return Place(
        f"{scene}, RGB-D" if rig == DEPTH else f"{scene}, {rig} rig", str(file), *_grids(file.with_suffix("")), world
    )


def all_places(bench: Bench) -> list[Place]:
    """The recorded room, and the simulated scenes, by a true and a worn rig and by RGB-D; fewer for a quick look."""
    return [recorded(bench), *(simulated(bench, scene, rig) for scene, rig in bench.chosen(CASES))]


def _grids(stem: Path) -> tuple[GridFile, GridFile]:
    return read_grid(stem.with_name(f"{stem.name}.yaml")), read_grid(stem.with_name(f"{stem.name}_seen.yaml"))
