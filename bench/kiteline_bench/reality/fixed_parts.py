"""Things that stand still in the images, as legs, guards, the text of a video link and drops: poses, finds and grid."""

import numpy as np

from kiteline_bench.grid.accuracy import judged
from kiteline_bench.grid.flown import fly_grid
from kiteline_bench.grid.places import recorded
from kiteline_bench.harness.bars import Bar, Bench, at_most, is_true, table
from kiteline_bench.harness.recording import Recording, load
from kiteline_bench.reality.fixed_things import OVERLAYS, covered_share, with_overlay
from kiteline_bench.reality.flown import Flown, flown, spread

ROOM, ONE_CAMERA = "room_flight.mcap", "euroc_mh01_air"
_STARTS_S = {ROOM: (0.0, 1.0, 2.0), ONE_CAMERA: (0.0, 4.0)}
_FOUND = ("text", "vehicle")  # drops hardly have edges of their own
_TIMES, _LEAST_M = 2.0, 0.02  # times the error without it, or m, whichever is larger
_SHOWN = 0.1  # share of a cell that shows a part, from which it should be left out
_LEFT_OUT, _RECALL, _PRECISION = 0.6, 0.4, 1.0  # of these cells; of the recall of the plain grid; points of precision


def run(bench: Bench) -> list[Bar]:
    """ATE beside that of the plain flight, what is left out, and the grid beside the plain one."""
    rows, ratios, elsewhere, shares = list[tuple[object, ...]](), list[float](), 0, list[float]()
    for name, starts in _STARTS_S.items():
        whole = load(bench.source(name), mono=name == ONE_CAMERA)
        for start_s in bench.chosen(starts):
            part = whole.seconds(start_s, 1e9)
            plain = flown(bench, f"{name} from {start_s:g} s, plain", part)
            for kind, overlay in OVERLAYS.items():
                flight = flown(bench, f"{name} from {start_s:g} s, {kind}", with_overlay(part, overlay))
                ratios += [_over(flight, plain, path) for path in ("live", "base")]
                found, wrong = _left_out(flight, part, kind)
                elsewhere += wrong
                if kind in _FOUND and name == ROOM:
                    shares.append(found)
                ates = [f.ate_m(path) for path in ("live", "base") for f in (flight, plain)]
                rows.append((name, start_s, kind, *ates, 100.0 * found, wrong))
    table(bench, "ATE in m, cells in %", ("flight", "start s", "in view", "live", "plain", "base", "plain",
          "of its cells left out", "cells left out elsewhere"), rows)  # fmt: skip
    return [
        *spread(f"ATE over the larger of {_TIMES:g} x plain and {_LEAST_M:g} m", ratios, 1.0, "", 2),
        at_most("cells left out that show the surroundings alone", elsewhere, 2, "", 0),
        is_true(f"{ROOM}: cells with text or parts of the vehicle that are left out", f">= {100 * _LEFT_OUT:g} %",
                min(shares) >= _LEFT_OUT, f"{100 * min(shares):.0f} % at worst"),
        *_grids(bench),
    ]  # fmt: skip


def _over(flight: Flown, plain: Flown, path: str) -> float:
    return flight.ate_m(path) / max(_TIMES * plain.ate_m(path), _LEAST_M)


def _left_out(flight: Flown, recording: Recording, kind: str) -> tuple[float, int]:
    """Share of the cells with a part that are left out at the end, and how many are that show none."""
    assert flight.box is not None
    cells = flight.box.fixed_cells
    shown = covered_share(recording.rig, kind, cells.shape)
    with_part = shown > _SHOWN
    return float(np.mean(cells[with_part])), int(np.count_nonzero(cells & (shown == 0.0)))


def _grids(bench: Bench) -> list[Bar]:
    """Precision and recall of the base's grid, with text and with parts of the vehicle in view."""
    place, recording = recorded(bench), load(bench.source(ROOM))
    bars, rows = list[Bar](), list[tuple[object, ...]]()
    plain = None
    for kind in ("plain", *_FOUND):
        shown = with_overlay(recording, OVERLAYS[kind]) if kind in OVERLAYS else recording
        flight = fly_grid(bench, f"room, {kind}", shown)
        score = judged(place, flight.grid, flight.T_plane)[0]
        rows.append((kind, score.precision, score.recall))
        if plain is None:
            plain = score
            continue
        bars += [
            is_true(f"grid with {kind} in view: precision", f">= {plain.precision - _PRECISION:.2f} %",
                    bool(score.precision >= plain.precision - _PRECISION), f"{score.precision:.2f} %"),
            is_true(f"grid with {kind} in view: recall", f">= {_RECALL * plain.recall:.0f} %",
                    bool(score.recall >= _RECALL * plain.recall), f"{score.recall:.1f} %"),
        ]  # fmt: skip
    table(bench, "Grid of room_flight, %", ("in view", "precision", "recall"), rows)
    return bars
