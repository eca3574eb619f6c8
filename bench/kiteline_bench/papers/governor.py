"""`kiteline bench papers/governor`: the governor's ladder beside the simplest ways to stay within a CPU budget.

At the same share of a flight's own load: the ladder; every n-th frame, with n chosen for the share and the newest frame
on a core that is busy even so; the newest frame alone. The ladder makes no scans of the ground below full effort, so
its rivals make none either; the last one does. Errors of two flights that begin half a second apart differ by
up to twice, so every row is a geometric mean over ten starts.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from kiteline_bench.harness.bars import Bar, Bench, at_most, is_true
from kiteline_bench.harness.limited_cpu import LimitedFlight, fly_limited
from kiteline_bench.harness.recording import Recording, load
from kiteline_bench.harness.simulated import NAMES, simulated

TITLE = "The governor beside its simplest rivals"

STARTS = tuple(range(0, 120, 12))  # first frames
SHARES = (0.5, 0.25, 0.12)  # of the flight's own load
_MONO_SHARES = (0.8,)  # of one camera with an IMU, whose start alone takes half of it
RIVALS = ("ladder", "every n-th frame", "newest frame", "newest frame, with scans")
_EVERY = {0.8: 2, 0.5: 3, 0.25: 7, 0.12: 16}  # whose cost is the share, by docs/decisions/governor-ladder.md
_AIR = "euroc_mh01_air"
_FRAMES = 400  # of a flight
_NO_WORSE = 1.2  # times the best rival's error: what chance makes of ten starts


@dataclass(frozen=True, slots=True)
class Outcome:
    """Flights of one rival at one share, from all starts, and what the same flights had without a limit."""

    rival: str
    share: float
    flights: Sequence[LimitedFlight]
    free: Sequence[LimitedFlight]

    @property
    def ratio(self) -> float:
        """Geometric mean of the ATE over that without a limit; infinite if a flight has none."""
        ratios = [f.ate_m / free.ate_m for f, free in zip(self.flights, self.free, strict=True)]
        return float(np.exp(np.mean(np.log(ratios)))) if np.isfinite(ratios).all() else float("inf")

    @property
    def failures(self) -> int:
        """Starts in which frames were lost, a further submap began or none did, or too few poses have an error."""
        pairs = zip(self.flights, self.free, strict=True)
        return sum(f.lost > free.lost or f.submaps != 1 or not np.isfinite(f.ate_m) for f, free in pairs)

    def mean(self, name: str) -> float:
        """Mean of a field over the starts."""
        return float(np.mean([getattr(f, name) for f in self.flights]))

    def of_budget(self, name: str) -> list[float]:
        """A load as a share of the budget, by start."""
        return [getattr(f, name) / f.percent for f in self.flights]


def run(bench: Bench) -> list[Bar]:
    """Every recording, share and rival."""
    bars: list[Bar] = []
    for name, recording, shares in _recordings(bench):
        outcomes = compare(bench, name, recording, shares)
        bench.more.append(table(name, outcomes))
        bench.say(bench.more[-1])
        bars += _bars(name, outcomes)
    return bars


def _recordings(bench: Bench) -> Iterator[tuple[str, Recording, Sequence[float]]]:
    """A rendered room with an IMU and without, simulated flights, and a real flight with one camera and IMU."""
    frames = STARTS[-1] + _FRAMES
    room = load(bench.source("room_flight.mcap"), frames=frames)
    yield "room_flight", room, SHARES
    yield "room_flight, no IMU", room.without_imu(), SHARES
    for name in NAMES:
        yield name, load(simulated(bench, name).recording, frames=frames), SHARES
    yield "euroc_mh01_air, one camera and IMU", load(bench.source(_AIR), mono=True, frames=frames), _MONO_SHARES


def compare(bench: Bench, name: str, recording: Recording, shares: Sequence[float] = SHARES) -> list[Outcome]:
    """Fly all rivals at all shares from the chosen starts."""
    starts = [recording.part(begin, begin + _FRAMES) for begin in bench.chosen(STARTS)]
    bench.say(f"{name}: {len(starts)} starts without a limit")
    free = [fly_limited(start, 0.0, governor=False, real=False) for start in starts]
    outcomes = []
    for share in shares:
        for rival in RIVALS:
            bench.say(f"{name}: {len(starts)} starts at {100 * share:g} % of their load, {rival}")
            flights = [fly_rival(start, rival, share, f.load) for start, f in zip(starts, free, strict=True)]
            outcomes.append(Outcome(rival, share, flights, free))
    return outcomes


def fly_rival(recording: Recording, rival: str, share: float, load_percent: float) -> LimitedFlight:
    """A flight on the modelled core with a share of the load that it has without a limit."""
    every = _EVERY[share] if rival == "every n-th frame" else 1
    ladder, scans = rival == "ladder", rival.endswith("with scans")
    return fly_limited(
        recording, share * load_percent, governor=ladder, real=False, every=every, scans=scans or ladder
    )  # fmt: skip


def _bars(name: str, outcomes: Sequence[Outcome]) -> list[Bar]:
    """The ladder holds the budget, loses no flight that a rival flies, and is no worse than the best rival."""
    bars = []
    for share in dict.fromkeys(o.share for o in outcomes):
        ladder, *rivals = (o for o in outcomes if o.share == share)
        what = f"{name}, {100 * share:g} % of the load, {len(ladder.flights)} starts"
        fewest, best = min(o.failures for o in rivals), min(o.ratio for o in rivals)
        bars += [
            at_most(f"{what}: busiest second, of the budget", max(ladder.of_budget("peak")), 1.0, "", 2),
            is_true(f"{what}: starts that lose frames", f"no more than the best rival's {fewest}",
                    ladder.failures <= fewest, f"{ladder.failures}"),
            is_true(f"{what}: ATE over that without a limit", f"<= {_NO_WORSE:g} times the best rival's {best:.2f}",
                    ladder.ratio <= _NO_WORSE * best, f"{ladder.ratio:.2f}"),
        ]  # fmt: skip
    return bars


def table(name: str, outcomes: Sequence[Outcome]) -> str:
    """Markdown of one recording."""
    starts = len(outcomes[0].flights)
    columns = (
        "share", "rival", "load, of the budget", "busiest second, worst", "frames with a pose",
        "starts that lose frames", "ATE", "delay p95 ms",
    )  # fmt: skip
    about = (
        f"{name}, {starts} starts of {_FRAMES} frames, modelled core. ATE: geometric mean over that without a limit. "
        "Delay: from a frame's stamp until its pose on a core that has no more than the budget.\n"
    )
    lines = [about, f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    for o in outcomes:
        lines.append(
            f"| {100 * o.share:g} % | {o.rival} | {np.mean(o.of_budget('load')):.2f} | {max(o.of_budget('peak')):.2f} "
            f"| {o.mean('tracked'):.0f} | {o.failures} | {o.ratio:.2f} | {o.mean('delay_ms'):.0f} |"
        )
    return "\n".join(lines)
