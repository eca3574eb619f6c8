"""Rolling shutter, exposure, repeated and glossy surfaces, cars: each beside the same flight without it."""

import os
from typing import Any

from kiteline_bench.harness.bars import Bar, Bench, table
from kiteline_bench.harness.recording import Recording, items_of
from kiteline_bench.reality.flown import flown, spread
from kiteline_hw.sim.source import open_sim

SEEDS = (951, 952, 953)
_SECONDS = 10.0
_TIMES, _LEAST_M = 2.0, 0.02  # times the error of the plain flight, or m, whichever is larger
_DARK = {"exposure_s": 0.004}  # of cameras under flickering lamps
KINDS: dict[str, tuple[str, dict[str, Any]]] = {
    "rolling shutter, 20 ms": ("room", {"readout_s": 0.02}),
    "exposure steps": ("room", {"exposure_step": 0.7, "exposure_every": 1.5}),
    "flicker": ("room", {"flicker": 0.6, "readout_s": 0.0, **_DARK}),
    "repeated surfaces": ("room", {"repeated": 0.6}),
    "glossy surfaces": ("room", {"glossy": 0.6}),
    "cars": ("street", {"cars": 6}),
}


def run(bench: Bench) -> list[Bar]:
    """ATE over that of the plain flight."""
    rows, bars = [], []
    plain: dict[tuple[str, int], tuple[float, float]] = {}
    for kind, (scene, options) in KINDS.items():
        ratios = []
        for seed in bench.chosen(SEEDS):
            if (scene, seed) not in plain:
                flight = flown(bench, f"{scene} {seed}, plain", _recording(scene, seed))
                plain[scene, seed] = flight.ate_m("live"), flight.ate_m("base")
            flight = flown(bench, f"{scene} {seed}, {kind}", _recording(scene, seed, **options))
            found = flight.ate_m("live"), flight.ate_m("base")
            rows.append((kind, seed, *found, *plain[scene, seed], flight.run.lost))
            ratios.append([a / max(_TIMES * b, _LEAST_M) for a, b in zip(found, plain[scene, seed], strict=True)])
            bench.say("  live {:.4f}, base {:.4f} m; plain {:.4f}, {:.4f} m; lost {}".format(*rows[-1][2:]))
        for k, path in enumerate(("live", "base")):
            bars += spread(f"{kind}: ATE {path} over the larger of {_TIMES:g} x plain and {_LEAST_M:g} m",
                           [ratio[k] for ratio in ratios], 1.0, "", 2)  # fmt: skip
    table(bench, "ATE in m", ("difficulty", "seed", "live", "base", "plain live", "plain base", "lost"), rows)
    return bars


def _recording(scene: str, seed: int, **options: Any) -> Recording:
    source = open_sim(scene, os.cpu_count() or 1, seed=seed, seconds=_SECONDS, start=2.0 * (seed % 7), **options)
    return Recording(source.rig, source.imu, tuple(items_of(source)))
