"""Bars on the ratio of two flights' errors, as a median over several starts; and the pieces of recordings for that.

Errors of some millimetres vary by a fifth if a flight begins half a second later: it gets other keyframes.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from kiteline_bench.harness.bars import Bar, Bench, at_most
from kiteline_lab.evaluation import trajectories
from kiteline_lab.tools import convert, logs

ROOM_STARTS_S = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0)
KITTI_STARTS_S = (0.0, 0.2, 0.4, 0.6, 0.8)  # of 5 s
_SHIFTS_S = (0.0, -6.0, 6.0)  # by which the cuts of a flight in pieces are moved

Ate = Callable[[Sequence[Path], str, str], float]  # (recordings, name of the folder, mode) -> joint ATE in m


def median_ratio(bench: Bench, name: str, pairs: Sequence[tuple[float, float]], limit: float) -> Bar:
    """A bar on the median ratio of pairs of errors in m (ours, other); the pairs are listed below the bars."""
    ratios = [ours / other for ours, other in pairs]
    listed = ", ".join(
        f"{1000 * a:.1f} / {1000 * b:.1f} = {ratio:.2f}" for (a, b), ratio in zip(pairs, ratios, strict=True)
    )
    bench.more.append(f"{name}, mm: {listed}.")
    return at_most(f"{name}: median of {len(pairs)}", float(np.median(ratios)), limit, "", 2)


def compared_with_monolith(bench: Bench, ate: Ate) -> list[Bar]:
    """Base ATE with codec and link, over that of the same flight without them."""
    kitti = bench.folder / "kitti.mcap"
    if not kitti.exists():
        bench.folder.mkdir(parents=True, exist_ok=True)
        convert.main([bench.source("kitti_straight"), str(kitti)])
    bars = []
    for name, source, starts in (
        ("room_flight", Path(bench.source("room_flight.mcap")), ROOM_STARTS_S),
        ("kitti_straight", kitti, KITTI_STARTS_S),
    ):
        pairs = []
        for start_s in starts:
            piece = cut(bench, source, f"{name}_from_{start_s:g}", start_s, length_s(source) + 1.0)
            ours, other = (ate([piece], f"{piece.stem}_{mode}", mode) for mode in ("distributed", "monolith"))
            pairs.append((ours, other))
        bars.append(median_ratio(bench, f"{name}: ATE base over that of a monolith, by start", pairs, 1.1))
    return bars


def in_pieces(bench: Bench, uncut: Sequence[tuple[str, Path, float]], count: int, overlap: float, ate: Ate) -> Bar:
    """Joint ATE of flights cut in pieces for as many agents, over that of the uncut flight.

    uncut: name, recording and ATE in m of each. overlap: share of the frames that two neighbouring pieces share.
    """
    pairs = []
    for name, source, whole_m in uncut:
        for shift_s in _SHIFTS_S:
            parts = pieces(bench, source, f"{name}{shift_s:+g}", count, overlap, shift_s)
            pairs.append((ate(parts, f"{name}_cut{shift_s:+g}", "distributed"), whole_m))
    names = " and ".join(name for name, _, _ in uncut)
    return median_ratio(bench, f"{names} cut in {count}: joint ATE over that of the uncut flight", pairs, 1.3)


def pieces(bench: Bench, source: Path, name: str, count: int, overlap: float, shift_s: float = 0.0) -> list[Path]:
    """A recording cut in overlapping pieces; the cuts are moved by shift_s."""
    length = length_s(source)
    each, more = length / count, 0.5 * overlap * length
    middle = [i * each + shift_s for i in range(1, count)]
    begins, ends = [0.0, *(m - more for m in middle)], [*(m + more for m in middle), length + 1.0]
    return [cut(bench, source, f"{name}_piece{i}", a, b) for i, (a, b) in enumerate(zip(begins, ends, strict=True))]


def cut(bench: Bench, source: Path, name: str, begin_s: float, end_s: float) -> Path:
    """A part of a recording, as a recording of its own."""
    out = bench.folder / f"{name}.mcap"
    bench.folder.mkdir(parents=True, exist_ok=True)
    logs.main(["cut", "--from", f"{begin_s:.3f}", "--to", f"{end_s:.3f}", "--force", str(source), str(out)])
    return out


def length_s(source: Path) -> float:
    """Time from a recording's first true pose to its last."""
    stamps = trajectories.read(f"mcap:{source}").trajectory.t_ns
    return float(stamps[-1] - stamps[0]) * 1e-9
