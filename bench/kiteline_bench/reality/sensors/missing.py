"""Sensors that come late, have holes or end: what the others know is told, and nothing that no sensor knows.

Each bar is what the sensors that are there allow; docs/explanation/missing-sensors.md has the reasons.
"""

from collections.abc import Callable, Sequence

import numpy as np

from kiteline_bench.harness.bars import Bar, Bench
from kiteline_bench.harness.recording import Recording
from kiteline_bench.reality.flown import flown
from kiteline_bench.reality.sensors.cases import CASES, METRE_S, SECONDS, cameras
from kiteline_bench.reality.sensors.figures import PATHS, Figures, judged

_WAIT_S, _MOST_WAIT_S = 8.0, 15.0
_FALSE, _SCALE, _DEPTH_SCALE = 5.0, 2.0, 1.0  # %
_TILT_DEG, _MOST_TILT_DEG = 1.0, 2.0
_QUALITY = 75.0
_LOST, _LOST_ONE_CAMERA = 3.0, 10.0  # frames
_Of = Callable[[Figures], float]


def run(bench: Bench) -> list[Bar]:
    """All bars, camera by camera."""
    bars: list[Bar] = []
    bench.more.append(
        f"{len(bench.chosen(CASES))} flights of each camera, {SECONDS:g} s long, of the 60 that there are: every pair "
        "of values of IMU, odometer and images is among them. The worst flight stands behind its figure."
    )
    for camera, whole in cameras(bench).items():
        bars += _of_camera(bench, camera, whole, one_camera=whole.rig.right is None and not whole.rig.has_depth)
    return bars


def _of_camera(bench: Bench, camera: str, whole: Recording, *, one_camera: bool) -> list[Bar]:
    plain, found = None, list[Figures]()
    for case in bench.chosen(CASES):
        flight = flown(bench, f"{camera}, {case.name}", case.of(whole))
        plain = flight if case.plain and not one_camera else plain
        found.append(judged(case, flight, plain))
        bench.say(f"  {found[-1]}")
    return [*(_one_camera(camera, found) if one_camera else _depth(camera, found)), *_any(camera, found)]


def _one_camera(camera: str, found: Sequence[Figures]) -> list[Bar]:
    """Metres come from an IMU or an odometer."""
    scale = f"scale from {METRE_S:g} s of them on"
    return [
        *_spread(f"{camera}: images with an IMU or an odometer until metres", found, lambda f: f.wait_s, _WAIT_S,
                 _MOST_WAIT_S, "s", 1),
        *_spread(f"{camera}: metres said though nothing tells them", found, lambda f: f.untold, None, 0.0, "", 0),
        *_spread(f"{camera}: {scale}, live off by", found, lambda f: f.live_scale, _SCALE, _SCALE, "%", 2),
        *_spread(f"{camera}: {scale}, base off by", found, lambda f: f.base_scale, _SCALE, _SCALE, "%", 2),
        *_spread(f"{camera}: frames with images and without a pose", found, lambda f: f.lost, _LOST_ONE_CAMERA,
                 _LOST_ONE_CAMERA, "", 0),
    ]  # fmt: skip


def _depth(camera: str, found: Sequence[Figures]) -> list[Bar]:
    """Metres come from the camera, and no other sensor may change them."""
    return [
        *_spread(f"{camera}: metres after the first image", found, lambda f: f.wait_s, None, 0.0, "s", 1),
        *_spread(f"{camera}: scale, live off by", found, lambda f: f.live_scale, _DEPTH_SCALE, _DEPTH_SCALE, "%", 2),
        *_spread(f"{camera}: scale, base off by", found, lambda f: f.base_scale, _DEPTH_SCALE, _DEPTH_SCALE, "%", 2),
        *_spread(f"{camera}: frames with images and without a pose", found, lambda f: f.lost, _LOST, _LOST, "", 0),
    ]  # fmt: skip


def _any(camera: str, found: Sequence[Figures]) -> list[Bar]:
    bars = _spread(f"{camera}: metres said while the scale of 5 s is off by", found, lambda f: f.false, None, _FALSE,
                   "%", 2)  # fmt: skip
    for path in PATHS:
        bars += _spread(f"{camera}: ATE {path} over what is allowed", found, _over(path), 1.0,
                        1.0, "", 2)  # fmt: skip
    bars += _spread(f"{camera}: tilt at the end", found, lambda f: f.tilt_deg, _TILT_DEG, _MOST_TILT_DEG, "degrees", 2)
    return [*bars, *_quality(camera, found)]


def _over(path: str) -> _Of:
    return lambda figures: figures.over[path]


def _quality(camera: str, found: Sequence[Figures]) -> list[Bar]:
    known = {figures.name: figures.quality for figures in found if np.isfinite(figures.quality)}
    least, middle = min(known, key=lambda name: known[name]), float(np.median(list(known.values())))
    name, wanted = f"{camera}: quality of frames with images, median of a flight", f">= {_QUALITY:g}"
    return [
        Bar(f"{name}, median of {len(known)}", wanted, f"{middle:.0f}", middle >= _QUALITY),
        Bar(f"{name}, worst", wanted, f"{known[least]:.0f} ({least})", known[least] >= _QUALITY),
    ]


def _spread(
    name: str, found: Sequence[Figures], of: _Of, median: float | None, worst: float, unit: str, digits: int
) -> list[Bar]:
    """Bars on the median of the flights that are judged and on the worst, which is named. median: None for no bar."""
    known = {figures.name: of(figures) for figures in found if not np.isnan(of(figures))}
    most = max(known, key=lambda flight: known[flight])
    space = f" {unit}" if unit else ""
    bars = []
    if median is not None:
        middle = float(np.median(list(known.values())))
        what = f"{name}, median of {len(known)}"
        bars.append(Bar(what, f"<= {median:g}{space}", f"{middle:.{digits}f}{space}", middle <= median))
    named = f"{known[most]:.{digits}f}{space}" + (f" ({most})" if known[most] > 0.0 else "")
    return [*bars, Bar(f"{name}, worst", f"<= {worst:g}{space}", named, known[most] <= worst)]
