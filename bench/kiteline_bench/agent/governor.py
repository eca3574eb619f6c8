"""The governor's bars: flights on a share of their own load, modelled and by the kernel, governor on and off."""

from collections.abc import Callable, Sequence
from pathlib import Path

from kiteline_bench.agent.governor_plot import plot_governor
from kiteline_bench.harness import processes
from kiteline_bench.harness.bars import Bar, Bench, at_most, is_true
from kiteline_bench.harness.limited_cpu import LimitedFlight, fly_limited
from kiteline_bench.harness.recording import Recording, load
from kiteline_bench.harness.starts import median_ratio
from kiteline_hw.system.cpu import CpuQuota

_SHARES = (1.0, 0.5, 0.25, 0.12)  # of the flight's own load without a governor
_ATE_RATIO = {0.5: 1.5, 0.25: 3.0}  # that the governor may cost
_FRAMES = 440  # of a flight on the virtual core
_REAL_FRAMES = 300  # of one that takes as long as it lasts
_BEGINS = (0, 12, 24, 36, 48)  # first frames of the flights: the effect of a limit on one flight's error is chance
_REAL_BEGINS = (0, 12, 24)

Fly = Callable[[float, bool], LimitedFlight]  # at a percentage of a core, with the governor or without


def bars(bench: Bench, others: Sequence[str] = ()) -> list[Bar]:
    """On the modelled core, then under the kernel's limit. others: further recordings with an IMU."""
    found: list[Bar] = []
    texts = []
    for source in (bench.source("room_flight.mcap"), *others):
        whole, name = load(source, frames=_BEGINS[-1] + _FRAMES), Path(source).stem
        starts = [_modelled(whole.part(begin, begin + _FRAMES)) for begin in _BEGINS]
        rows = _flown(bench, f"{name}, virtual CPU", starts[0])
        found += _bars(bench, f"{name}, virtual CPU", rows, starts[1:])
        texts.append((f"{name} (virtual CPU)", rows))
    reason = CpuQuota.unavailable()
    if reason is not None:
        found.append(is_true("governor under the kernel's limit", "where the machine allows it", True, reason))
    else:
        starts = [_limited(bench.source("room_flight.mcap"), begin) for begin in _REAL_BEGINS]
        rows = _flown(bench, "room_flight, kernel's limit", starts[0])
        found += _bars(bench, "room_flight, kernel's limit", rows, starts[1:])
        texts.append((f"room_flight (kernel's limit, {_REAL_FRAMES} frames)", rows))
    _write(bench, texts)
    return found


def _modelled(recording: Recording) -> Fly:
    return lambda percent, governor: fly_limited(recording, percent, governor=governor, real=False)


def _limited(source: str, begin: int) -> Fly:
    def flown(percent: float, governor: bool) -> LimitedFlight:
        frames = ["--begin", f"{begin}", "--frames", f"{_REAL_FRAMES}"]
        options = ["--percent", f"{percent}", *frames, *["--governor"] * governor]
        return LimitedFlight(**processes.start("quota", source, *options))

    return flown


def _flown(bench: Bench, what: str, flown: Fly) -> list[tuple[float, LimitedFlight]]:
    """The flight without a limit, then each share with the governor and without it."""
    bench.say(f"flying {what}: no limit")
    free = flown(0.0, False)
    rows = [(1.0, free)]
    for share in _SHARES:
        for governor in (True, False):
            bench.say(f"flying {what}: {100 * share:.0f} % of its load, governor {'on' if governor else 'off'}")
            rows.append((share, flown(share * free.load, governor)))
    bench.say(governor_table(rows))
    return rows


def _bars(bench: Bench, what: str, rows: Sequence[tuple[float, LimitedFlight]], others: Sequence[Fly]) -> list[Bar]:
    """rows: flights of the first start. others: further starts, whose ATE counts too."""
    free, found = rows[0][1], []
    bench.say(f"flying {what}: {len(others)} further starts")
    pairs: dict[float, list[tuple[float, float]]] = {share: [] for share in _ATE_RATIO}
    for fly in others:
        unlimited = fly(0.0, False)
        for share, found_at in pairs.items():
            found_at.append((fly(share * unlimited.load, True).ate_m, unlimited.ate_m))
    for share, flight in rows:
        if not flight.governor:
            continue
        name = f"governor, {what}, {100 * share:.0f} %"
        found.append(at_most(f"{name}: busiest second, of the budget", flight.peak / flight.percent, 1.0, "", 2))
        if share in _ATE_RATIO:
            both = [(flight.ate_m, free.ate_m), *pairs[share]]
            found.append(median_ratio(bench, f"{name}: ATE over that without a limit", both, _ATE_RATIO[share]))
        if share >= 0.25:
            lost = flight.lost + flight.submaps - 1
            found.append(at_most(f"{name}: lost frames and further submaps", lost, 0, "", 0))
        else:
            whole = flight.tracked + flight.lost + flight.dropped == flight.frames
            close = flight.ate_m <= _ATE_RATIO[0.25] * free.ate_m
            found.append(is_true(f"{name}: all frames accounted for", "and quality falls where errors grow",
                                 whole and (close or flight.quality < free.quality),
                                 f"{flight.tracked} tracked, {flight.lost} lost, {flight.dropped} dropped of "
                                 f"{flight.frames}; ATE {1000 * flight.ate_m:.1f} mm, was {1000 * free.ate_m:.1f}; "
                                 f"quality {flight.quality:.0f}, was {free.quality:.0f}"))  # fmt: skip
    return found


def governor_table(rows: Sequence[tuple[float, LimitedFlight]]) -> str:
    """Markdown of flights, each with its share of the load of the first, which has no limit."""
    heads = (
        "share", "governor", "budget %", "load %", "busiest second %", "tracked", "lost", "dropped", "submaps",
        "ATE mm", "relative mm", "quality",
    )  # fmt: skip
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for share, f in rows:
        limit = f"{f.percent:.2f}" if f.percent else "none"
        lines.append(
            f"| {100 * share:.0f} % | {'on' if f.governor else 'off'} | {limit} | {f.load:.2f} | {f.peak:.2f} | "
            f"{f.tracked} | {f.lost} | {f.dropped} | {f.submaps} | {1000 * f.ate_m:.1f} | {f.rpe_mm:.2f} | "
            f"{f.quality:.0f} |"
        )
    return "\n".join(lines)


_INTRODUCTION = """# The CPU governor, measured

Made by `kiteline bench agent/governor`. Each flight is flown without a limit first; then with a share of that load
as its budget, with the governor and without it (the newest frame wins on a core that is too slow). A frame that is
skipped counts as dropped; errors are those of the others. The busiest second is the
largest sum in any one-second window after the third second. How the rows of the ladder were put in order:
[decisions/governor-ladder.md](decisions/governor-ladder.md). Tables and figures are of one start; in
`docs/results.md` errors at a half and a quarter of the load are medians over several.
"""


def _write(bench: Bench, flights: Sequence[tuple[str, Sequence[tuple[float, LimitedFlight]]]]) -> None:
    out = Path("docs") if Path("docs").is_dir() else bench.folder
    page = out / "governor.md"
    parts = [_INTRODUCTION, *_bought(page.read_text() if page.exists() else "")]
    for k, (title, rows) in enumerate(flights):
        figure = f"images/governor-{k}.png"
        (out / "images").mkdir(exist_ok=True)
        plot_governor(out / figure, [flight for _, flight in rows], title)
        parts.append(f"## {title}\n\n{governor_table(rows)}\n\n![CPU against error]({figure})\n")
    page.write_text("\n".join(parts))


def _bought(page: str) -> list[str]:
    """The page's section on what the ladder buys, which people write."""
    _, heading, rest = page.partition("## What the ladder buys\n")
    section, _, _ = rest.partition("\n## ")
    return [f"{heading}{section.rstrip()}\n"] if heading else []
