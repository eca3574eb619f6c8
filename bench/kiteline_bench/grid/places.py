"""The places whose grids are judged: somebody else's recorded room, and simulated ones full of difficult objects."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from kiteline_bench.harness.bars import Bench
from kiteline_bench.harness.simulated import render
from kiteline_hw.sim.source import SimSource, open_sim
from kiteline_hw.sim.truth.occupancy import write_grid
from kiteline_hw.sim.truth.sight import SeenWorld, look
from kiteline_hw.sim.world.world import World
from kiteline_lab.grids import truth
from kiteline_lab.grids.files import GridFile, read_grid

RECORDED = "room_flight"
_SCENES = {"room": 40.0, "corridor": 35.0, "hall": 30.0}  # s: a lap of the room's course, half of one of the others
_SEED, _OTHER_SEED = 41, 52  # of the scenes; worn rigs fly other ones, so that no bar is of one scene alone
_SIGHT_M = 8.0  # m; scans of these rigs are drawn up to 6.3 m, and the truth of recall ends at 6 m
DEPTH = "depth"  # a depth camera in place of the right one
CASES = (
    *((scene, rig) for rig in ("true", "worn") for scene in _SCENES),
    ("corridor", DEPTH),
)  # scenes, and the rigs that fly them


@dataclass(frozen=True, slots=True)
class Place:
    """A flight and its truth. true: all of it; seen: what its true poses could see within range.

    sight: what they could see from farther away too, as far as any scan is drawn: what is free there is not wrong.
    world: None of a recording.
    """

    name: str
    recording: str
    true: GridFile
    seen: GridFile
    sight: GridFile
    world: World | None


def recorded(bench: Bench) -> Place:
    """The recorded room."""
    source, stem = bench.source(f"{RECORDED}.mcap"), bench.folder / f"{RECORDED}_true"
    if not stem.with_name(f"{stem.name}_seen.yaml").exists():
        bench.folder.mkdir(parents=True, exist_ok=True)
        bench.say(f"casting rays of sight in {RECORDED}")
        truth.main([source, "--boxes", bench.source(f"{RECORDED}_boxes.csv"), "--out", f"{stem}.yaml"])
    boxes = Path(bench.source(f"{RECORDED}_boxes.csv"))
    return Place(RECORDED, source, *_grids(stem, lambda: truth.seen_world(source, boxes, range_m=_SIGHT_M)), None)


def simulated(bench: Bench, scene: str, rig: str, options: str = "objects=1", share: float = 1.0) -> Place:
    """A scene with objects, flown along a part of its own course; rendered unless the bench's folder has it."""
    seconds = _SCENES[scene] * share
    name = f"{scene}_{options.replace('=', '').replace('&', '_')}_{rig}_{seconds:g}s"
    sensor, seed = ["--depth"] if rig == DEPTH else ["--rig", rig], _OTHER_SEED if rig == "worn" else _SEED
    command = [f"{scene}?{options}", "--seed", f"{seed}", "--seconds", f"{seconds:g}", *sensor]
    file = render(bench, name, command)[0]
    flown = "true" if rig == DEPTH else rig
    source = open_sim(f"{scene}?{options}", seed=seed, seconds=seconds, texture_bits=7, imu=False, rig=flown)
    title = f"{scene}, RGB-D" if rig == DEPTH else f"{scene}, {rig} rig"
    return Place(title, str(file), *_grids(file.with_suffix(""), lambda: _from_afar(source)), source.world)


def all_places(bench: Bench) -> list[Place]:
    """The recorded room, and the simulated scenes, by a true and a worn rig and by RGB-D; fewer for a quick look."""
    return [recorded(bench), *(simulated(bench, scene, rig) for scene, rig in bench.chosen(CASES))]


def _from_afar(source: SimSource) -> SeenWorld:
    true = source.worn.true
    return look(source.world, true.left, source.ground_truth.T_w_b @ true.T_b_c, range_m=_SIGHT_M)


def _grids(stem: Path, from_afar: Callable[[], SeenWorld]) -> tuple[GridFile, GridFile, GridFile]:
    """All that is true, what was seen within range, and what was in sight from farther away, cast once."""
    sight = stem.with_name(f"{stem.name}_sight.yaml")
    if not sight.exists():
        write_grid(from_afar().grid(), sight)
    return (
        read_grid(stem.with_name(f"{stem.name}.yaml")), read_grid(stem.with_name(f"{stem.name}_seen.yaml")),
        read_grid(sight),
    )  # fmt: skip
