"""`kiteline bench papers/segfloor`: the table, the memory and the time of an update of "Segfloor", beside ours.

The thesis, sections 7.3 and 7.4: maps are opened, aligned with the truth and judged by 30 road maps against all that is
free in truth, whether a camera could see it or not.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.grid.grid_updates import GridUpdates
from kiteline_bench.grid.flown import FlownGrid, fly_grid, picture_path
from kiteline_bench.grid.scans import Scanner, as_file
from kiteline_bench.grid.sparse import binary_grid, labels_by_height
from kiteline_bench.harness.bars import Bar, Bench, at_most, is_true, table
from kiteline_bench.harness.recording import Recording
from kiteline_bench.papers.segfloor.plot import plot_scenes, plot_updates
from kiteline_bench.papers.segfloor.scenes import Scene, corridor_1, corridor_2, rendered, synthetic, trajectory
from kiteline_codec.channel import RecordChannel
from kiteline_codec.schema import KeyframeScan, Record
from kiteline_core.arrays import F64
from kiteline_hw.sim.source import SimSource
from kiteline_hw.sim.truth.occupancy import OCCUPIED as BLACK
from kiteline_hw.sim.truth.occupancy import UNKNOWN as GREY
from kiteline_hw.sim.truth.occupancy import TrueGrid, occupancy
from kiteline_hw.sim.truth.sight import HEIGHTS_M, look
from kiteline_lab.grids.files import FREE, OCCUPIED, UNKNOWN, GridFile
from kiteline_lab.grids.picture import draw_comparison
from kiteline_lab.grids.prm import GridEvalConfig, GridScore, score

TITLE = "Occupancy grids, and Segfloor"

_FINE_M, _COARSE_M = 0.01, 0.05  # cells of Segfloor, and of RTAB-Map in the corridors
# precision and recall in percent, by scene: of Segfloor at 1 cm, and the best of RTAB-Map's two columns
_SEGFLOOR = {"synthetic": (99.41, 98.52), "corridor 1": (99.48, 97.70), "corridor 2": (99.64, 97.23)}
_RTAB_MAP = {"synthetic": (98.44, 31.67), "corridor 1": (99.66, 94.94), "corridor 2": (99.31, 96.21)}
_THEIR_MB, _THEIR_MEAN_S, _THEIR_PEAK_S = 0.073, 0.19, 0.39  # an update of Segfloor


@dataclass(frozen=True, slots=True)
class Truth:
    """True grids of a scene at one size of cells. everything: all that is there; seen: from the true poses."""

    everything: GridFile
    seen: GridFile


@dataclass(frozen=True, slots=True)
class Growth:
    """What the grid costs, by update. put_ms: CPU; mb: memory of tiles and scans after each."""

    put_ms: F64
    mb: F64

    @property
    def mb_an_update(self) -> float:
        """Slope of the memory, least squares; 0 with fewer than two updates."""
        return 0.0 if len(self.mb) < 2 else float(np.polyfit(np.arange(len(self.mb)), self.mb, 1)[0])


@dataclass(frozen=True, slots=True)
class Drawn:
    """A scene's grid at one size of cells, its scores by all that is true and by what was seen, and its costs."""

    cell_m: float
    grid: GridFile
    whole: GridScore
    seen: GridScore
    growth: Growth


class ScanTap:
    """An end of a link that keeps the scans that arrive. It is the wrapped end in all else."""

    def __init__(self, channel: RecordChannel, scans: list[KeyframeScan]) -> None:
        self._channel, self._scans = channel, scans

    def __getattr__(self, name: str) -> object:
        return getattr(self._channel, name)

    def receive(self, packets: Sequence[bytes], now_ns: int) -> list[Record]:
        """Take in packets, and keep their scans."""
        records = self._channel.receive(packets, now_ns)
        self._scans += [record for record in records if isinstance(record, KeyframeScan)]
        return records


def run(bench: Bench) -> list[Bar]:
    """All scenes."""
    bars: list[Bar] = []
    rows: list[Sequence[object]] = []
    growths: dict[str, Growth] = {}
    plans: dict[str, tuple[TrueGrid, F64]] = {}
    for make in bench.chosen((corridor_1, corridor_2, synthetic)):
        scene = make()
        bench.say(f"rendering {scene.name}")
        plans[scene.name] = plan(scene)
        recording, source = rendered(scene, bench.folder / "paths")
        flight, scans = fly_with_scans(bench, scene.name, recording)
        bench.say(f"  {len(scans)} scans, keyframes {1000 * flight.keyframe_m:.1f} mm off; drawing and judging")
        drawn = [draw(scene, source, flight, scans, cell_m) for cell_m in (_FINE_M, _COARSE_M)]
        for d in drawn:
            growths[f"{scene.name}, {100 * d.cell_m:g} cm"] = d.growth
            rows.append(_row(scene, d))
            bars += _table_bars(scene, d)
        rows.append(_reference_row(scene, source, flight))
        bench.say("; ".join(f"{d.cell_m:g} m: {d.whole.precision:.2f} / {d.whole.recall:.2f} %" for d in drawn))
        draw_comparison(picture_path(bench, scene.name), drawn[1].grid, truth(source, _COARSE_M).seen, flight.T_plane)
        bars += _cost_bars(scene, recording, drawn)
    columns = (
        "scene", "method", "cell m", "precision %", "recall %", "recall of what was in sight %", "theirs",
        "free m2", "keyframes with a scan",
    )  # fmt: skip
    table(bench, "Road maps, 30 draws", columns, rows)
    name, scenes_name = Path("images/papers-segfloor.png"), Path("images/papers-segfloor-scenes.png")
    folder = Path("docs") if Path("docs").is_dir() else bench.folder
    (folder / name.parent).mkdir(exist_ok=True)
    plot_scenes(folder / scenes_name, plans)
    plot_updates(folder / name, {title: (g.put_ms, g.mb) for title, g in growths.items()}, _THEIR_MB)
    bench.more.append(f"![The scenes from above]({scenes_name})\n\n![Memory and CPU time by update]({name})")
    return bars


def fly_with_scans(bench: Bench, name: str, recording: Recording) -> tuple[FlownGrid, list[KeyframeScan]]:
    """A flight with a base, and the scans that the base received."""
    scans: list[KeyframeScan] = []
    flight = fly_grid(bench, name, recording, channels=lambda channel: cast(RecordChannel, ScanTap(channel, scans)))
    return flight, scans


def plan(scene: Scene) -> tuple[TrueGrid, F64]:
    """True occupancy of a scene, and the way of its camera (n,2)."""
    return occupancy(scene.world, HEIGHTS_M[0], HEIGHTS_M[-1], 0.02), trajectory(scene)[1][:, :2, 3]


def truth(source: SimSource, cell_m: float) -> Truth:
    """The true grids of a flight."""
    true = source.worn.true
    seen = look(source.world, true.left, source.ground_truth.T_w_b @ true.T_b_c, cell_m=cell_m)
    return Truth(_file(seen.grid(seen=False)), _file(seen.grid(HEIGHTS_M[0], HEIGHTS_M[-1])))


def _file(grid: TrueGrid) -> GridFile:
    states = np.where(grid.image == BLACK, OCCUPIED, np.where(grid.image == GREY, UNKNOWN, FREE)).astype(np.int8)
    return GridFile(grid.cell_m, (float(grid.corner[0]), float(grid.corner[1]), 0.0), states)


def draw(
    scene: Scene, source: SimSource, flight: FlownGrid, scans: Sequence[KeyframeScan], cell_m: float
) -> Drawn:  # fmt: skip
    """Draw the scans of a flight at the final poses in cells of one size, one update after the other, and judge it."""
    config, mapper = BaseConfig(), flight.run.station.mapper
    config = replace(config, grid=replace(config.grid, cell_m=cell_m))
    updates = GridUpdates(config, mapper.map, mapper.placements)
    put_ms, mb = [], []
    for scan in scans:
        begin_ns = time.process_time_ns()
        updates.add_scan(scan)
        updates.update()
        put_ms.append(1e-6 * (time.process_time_ns() - begin_ns))
        mb.append(1e-6 * updates.grid.nbytes)
    grid = as_file(updates.settled())
    true = truth(source, cell_m)
    prm = GridEvalConfig(nodes=scene.nodes)
    whole, seen = (score(grid, other, flight.T_plane, prm) for other in (true.everything, true.seen))
    return Drawn(cell_m, grid, whole, seen, Growth(np.array(put_ms), np.array(mb)))


def _table_bars(scene: Scene, d: Drawn) -> list[Bar]:
    """The rows of the thesis's tables 4 and 5 at the same size of cells."""
    method, (precision, recall) = (
        ("Segfloor", _SEGFLOOR[scene.name]) if d.cell_m == _FINE_M else ("RTAB-Map", _RTAB_MAP[scene.name])
    )
    name = f"{scene.name}, cells of {d.cell_m:g} m, beside {method}"
    return [
        is_true(f"{name}: precision", f">= {precision:g} %", d.whole.precision >= precision,
                f"{d.whole.precision:.2f} %"),
        is_true(f"{name}: recall", f">= {recall:g} %", d.whole.recall >= recall, f"{d.whole.recall:.2f} %"),
    ]  # fmt: skip


def _cost_bars(scene: Scene, recording: Recording, drawn: Sequence[Drawn]) -> list[Bar]:
    """Time and memory of an update: the scan on the agent and the drawing on the base."""
    scanner, scan_ms = Scanner(recording.rig), []
    for item in recording.items[5::10]:
        if item.T_w_b is None:
            continue
        begin_ns = time.process_time_ns()
        scanner.scan(item.frame, item.T_w_b)
        scan_ms.append(1e-6 * (time.process_time_ns() - begin_ns))
    bars: list[Bar] = []
    for d in drawn:
        if not len(d.growth.mb):
            bars.append(
                is_true(f"{scene.name}, cells of {d.cell_m:g} m: scans", "some", False, "the ground is not found")
            )
            continue
        total = 1e-3 * (float(np.mean(scan_ms)) + float(np.mean(d.growth.put_ms)))
        peak = 1e-3 * (float(np.max(scan_ms[1:])) + float(np.max(d.growth.put_ms)))
        name = f"{scene.name}, cells of {d.cell_m:g} m"
        bars += [
            at_most(f"{name}: CPU of an update, scan and drawing, mean", total, _THEIR_MEAN_S, "s", 4),
            at_most(f"{name}: the same, peak", peak, _THEIR_PEAK_S, "s", 4),
            at_most(f"{name}: memory of an update", d.growth.mb_an_update, _THEIR_MB, "MB", 4),
        ]
    return bars


def _row(scene: Scene, d: Drawn) -> Sequence[object]:
    theirs = _SEGFLOOR[scene.name] if d.cell_m == _FINE_M else _RTAB_MAP[scene.name]
    return (
        scene.name, "kiteline", d.cell_m, f"{d.whole.precision:.2f}", f"{d.whole.recall:.2f}", f"{d.seen.recall:.2f}",
        f"{theirs[0]:.2f} / {theirs[1]:.2f}", f"{d.whole.free_est_m2:.1f} of {d.whole.free_true_m2:.1f}",
        len(d.growth.mb),
    )  # fmt: skip


def _reference_row(scene: Scene, source: SimSource, flight: FlownGrid) -> Sequence[object]:
    """Segfloor's own layers, drawn from the landmarks of our flight."""
    sparse, true = flight.sparse, truth(source, _COARSE_M)
    grid = binary_grid(sparse, labels_by_height(sparse)[0], _COARSE_M)
    prm = GridEvalConfig(nodes=scene.nodes)
    whole, seen = (score(grid, other, flight.T_plane, prm) for other in (true.everything, true.seen))
    return (
        scene.name, "Segfloor's layers from our landmarks", _COARSE_M, f"{whole.precision:.2f}", f"{whole.recall:.2f}",
        f"{seen.recall:.2f}", "-", f"{whole.free_est_m2:.1f} of {whole.free_true_m2:.1f}", "-",
    )  # fmt: skip
