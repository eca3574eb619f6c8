"""`kiteline bench papers/ds-ptam`: throttled replay, in the four configurations of "DS-PTAM", §4.3 and §4.4.

Tracker; tracker and mapper on one computer; the two on two computers; the monolith: each with shares of a core. The
limit covers both halves on one computer, and the agent alone where they are distributed. Frames that come while the
agent is busy are dropped, as by a live camera. Lock-step flights with the virtual CPU, so that the same numbers come
out on every machine; beside them flights in real time under the kernel's limit, where that may be set.
"""

import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from kiteline_bench.harness.bars import Bar, Bench, FlightFailed, Run, at_most, is_true
from kiteline_bench.harness.starts import cut, length_s
from kiteline_bench.papers import ds_ptam_kernel
from kiteline_bench.papers.ds_ptam_plot import plot_throttled
from kiteline_bench.papers.several_maps.street import street_recording
from kiteline_bench.papers.throttled import MODES, Throttled, fly_throttled, medians, outcome
from kiteline_hw.ports import SourceError
from kiteline_hw.system.cpu import QuotaError
from kiteline_lab.tools import convert

TITLE = "DS-PTAM's throttled replay"

PERCENTS = (100.0, 50.0, 25.0, 12.5, 6.25)  # of a laptop's core; of a Raspberry Pi 4's, modelled as a quarter of it,
# the last three are 100, 50 and 25 %
_SLOW = 6.25
_STREET_M = 1000.0
_PAPER_RATIO = 48.0 / 16.6  # KITTI 00: largest error of the tracker alone over that of the distributed system
_RATIO = 1.5


@dataclass(frozen=True, slots=True)
class Recorded:
    """A recording and how it is flown. starts_s: how far into it its flights begin."""

    name: str
    what: str
    imu: bool
    mono: bool
    starts_s: tuple[float, ...]


RECORDED = (
    Recorded("room_flight.mcap", "room_flight, stereo", False, False, (0.0, 1.0, 2.0)),
    Recorded("kitti_straight", "kitti_straight, stereo", False, False, (0.0, 0.5, 1.0)),
    Recorded("euroc_mh01_air", "EuRoC MH_01 in the air, one camera and IMU", True, True, (0.0, 1.5, 3.0)),
)
_PAPER = """The paper, largest absolute error and tracking time (EuRoC MH_01, whole, stereo):

| robot | tracker | tracker + mapper | distributed | monolith |
|---|---|---|---|---|
| 4 cores, 3.4 GHz | .340 m, 39 ms | .257 m, 42 ms | .266 m, 38 ms | .223 m, 38 ms |
| 2 cores, 3.4 GHz | .417 m, 67 ms | .718 m, 97 ms | .253 m, 65 ms | .441 m, 96 ms |
| 2 cores, 2.4 GHz | .515 m, 97 ms | lost | .444 m, 89 ms | lost |
"""

Flights = dict[tuple[str, float], list[Throttled]]  # of all starts, by mode and percent


def run(bench: Bench) -> list[Bar]:
    """All recordings on the modelled core, the kernel's limit, and the street."""
    bars: list[Bar] = []
    bench.more.append(_PAPER)
    flown: dict[str, Flights] = {}
    for recorded in RECORDED:
        pieces = _pieces(bench, recorded)
        flown[recorded.what] = flights = _fly_all(bench, recorded, pieces)
        bench.more.append(table(recorded.what, flights))
        bench.say(bench.more[-1])
        bars += throttled_bars(recorded.what, flights)
    _plot(bench, flown)
    bars += _unless_failed(bench, "throttled by the kernel, in real time", ds_ptam_kernel.run)
    return bars + _unless_failed(bench, "street of 1 km", _street_bars)


def _unless_failed(bench: Bench, what: str, part: Run) -> list[Bar]:
    """The bars of a part; one that is not met where it could not be flown, so that what was flown before stays."""
    try:
        return part(bench)
    except (FlightFailed, SourceError, QuotaError) as error:
        return [is_true(f"{what}: flown", "yes", False, str(error)[:200])]


def _pieces(bench: Bench, recorded: Recorded) -> list[Path]:
    """The recording from the chosen starts on."""
    source = Path(bench.source(recorded.name))
    if source.suffix != ".mcap":
        log = bench.folder / f"{source.name}.mcap"
        if not log.exists():
            bench.folder.mkdir(parents=True, exist_ok=True)
            convert.main([str(source), str(log), *["--mono"] * recorded.mono])
        source = log
    end_s = length_s(source) + 1.0
    return [
        cut(bench, source, f"{source.stem}_from_{start_s:g}", start_s, end_s)
        for start_s in bench.chosen(recorded.starts_s)
    ]


def _fly_all(bench: Bench, recorded: Recorded, pieces: Sequence[Path]) -> Flights:
    """All configurations, shares and starts, as many at once as there are cores: flights in lock-step do not mind."""
    count = len(MODES) * len(PERCENTS) * len(pieces)
    bench.say(f"{recorded.what}: {count} flights")
    quiet = replace(bench, say=_silent, more=[])
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        flying = {
            (mode, percent): [
                pool.submit(fly_throttled, quiet, piece, mode, percent, imu=recorded.imu, mono=recorded.mono)
                for piece in pieces
            ]
            for percent in PERCENTS
            for mode in MODES
        }
        flights: Flights = {}
        for (mode, percent), waiting in flying.items():
            flights[mode, percent] = found = [future.result() for future in waiting]
            bench.say(f"  {percent:g} % of a core, {MODES[mode]}: {medians(found).max_abs_m:.3f} m")
    return flights


def _silent(text: str) -> None:
    """Say nothing: flights at once would speak over each other."""


def throttled_bars(what: str, flights: Flights) -> list[Bar]:
    """The paper's two claims: what distribution keeps on a slow robot, and what one computer loses there."""
    bars = []
    for percent, core in ((25.0, "25 % of a core"), (_SLOW, "25 % of a Raspberry Pi 4's core")):
        full = flights["distributed", 100.0 if percent == 25.0 else 4.0 * _SLOW]
        slow, together = flights["distributed", percent], flights["local", percent]
        ratios = [a.errors.max_abs_m / b.errors.max_abs_m for a, b in zip(slow, full, strict=True)]
        bars += [
            at_most(f"{what}, distributed, {core}: largest error over that at 100 %, median of {len(slow)}",
                    float(np.median(ratios)), _RATIO, "", 2),
            is_true(f"{what}, {core}: tracker + mapper on one computer", "what it loses is said", True,
                    _losses(together, slow)),
        ]  # fmt: skip
    return bars


def _losses(together: Sequence[Throttled], apart: Sequence[Throttled]) -> str:
    """Frames and accuracy on one computer, beside those of the distributed flights."""
    missing = [100.0 * float(np.mean([f.missing for f in flights])) for flights in (together, apart)]
    errors = [medians(flights).max_abs_m for flights in (together, apart)]
    loses = missing[0] > missing[1] + 1.0 or errors[0] > 1.1 * errors[1]
    return (
        f"{'loses' if loses else 'loses nothing'}: {missing[0]:.0f} % of the frames without a pose and "
        f"{errors[0]:.3f} m, distributed {missing[1]:.0f} % and {errors[1]:.3f} m"
    )


def table(what: str, flights: Flights) -> str:
    """Markdown with the paper's columns; medians over the starts."""
    starts = len(next(iter(flights.values())))
    columns = (
        "% of a core", "configuration", "max t_abs m", "max t_rel m", "RMSE t_rel m", "max r_abs deg", "max r_rel deg",
        "RMSE r_rel deg", "tracking ms", "base: max t_abs m", "frames without a pose",
    )  # fmt: skip
    lines = [
        f"{what}: median of {starts} start{'s' * (starts > 1)}, live poses aligned at the first one.\n",
        f"| {' | '.join(columns)} |",
        "|---" * len(columns) + "|",
    ]
    for percent in PERCENTS:
        for mode, name in MODES.items():
            found = flights[mode, percent]
            e = medians(found)
            base = float(np.median([f.base_max_m for f in found]))
            lines.append(
                f"| {percent:g} | {name} | {e.max_abs_m:.3f} | {e.max_rel_m:.3f} | {e.rmse_rel_m:.4f} "
                f"| {e.max_abs_deg:.2f} | {e.max_rel_deg:.2f} | {e.rmse_rel_deg:.3f} "
                f"| {np.mean([f.tracking_ms for f in found]):.0f} | {'-' if np.isinf(base) else f'{base:.3f}'} "
                f"| {100.0 * np.mean([f.missing for f in found]):.0f} % |"
            )
    return "\n".join(lines)


def _plot(bench: Bench, flown: dict[str, Flights]) -> None:
    folder = Path("docs") if Path("docs").is_dir() else bench.folder
    (folder / "images").mkdir(exist_ok=True)
    name = "images/papers-ds-ptam.png"
    plot_throttled(folder / name, flown, PERCENTS)
    bench.more.append(f"![Errors and frames with a pose by share of a core]({name})")


def _street_bars(bench: Bench) -> list[Bar]:
    """The first kilometre of KITTI 06 in a simulated street, by stereo alone: what the mapper is worth."""
    bench.say("a street of 1.2 km: rendering it takes half an hour or more, unless --keep holds it already")
    source = street_recording(bench)
    lines = [
        (
            "KITTI 06 in a simulated street, stereo at 10 Hz without an IMU, no limit on the CPU. The paper's KITTI 00 "
            "(3.7 km, real): tracker 48.0 m, distributed 16.6 m.\n"
        ),
        "| path | configuration | max t_abs m | RMSE t_rel m | max r_abs deg | frames without a pose | loops closed |",
        "|---|---|---|---|---|---|---|",
    ]
    first: dict[str, Throttled] = {}
    for mode in ("tracker", "distributed"):
        flown = bench.fly(source, f"street-{mode}", shown=True, mode=mode, imu=False)
        first[mode] = outcome(flown, source, mode, 0.0, _STREET_M)
        for path, found in (("first km", first[mode]), ("whole", outcome(flown, source, mode, 0.0))):
            e = found.errors
            lines.append(
                f"| {path} | {MODES[mode]} | {e.max_abs_m:.2f} | {e.rmse_rel_m:.4f} | {e.max_abs_deg:.2f} "
                f"| {100.0 * found.missing:.1f} % | {found.loops if path == 'whole' else ''} |"
            )
    bench.more.append("\n".join(lines))
    ours, theirs = first["distributed"].errors.max_abs_m, first["tracker"].errors.max_abs_m
    return [
        is_true("street of 1 km: largest error, tracker : distributed", f"shown; the paper's is {_PAPER_RATIO:.1f}",
                bool(np.isfinite([ours, theirs]).all()), f"{theirs:.2f} : {ours:.2f} m = {theirs / ours:.1f}"),
    ]  # fmt: skip
