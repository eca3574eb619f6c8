"""What came of one flight, over what the sensors that were there allow."""

from dataclasses import dataclass

import numpy as np

from kiteline_bench.harness.faults import Spans, within
from kiteline_bench.harness.result import tilt_rad
from kiteline_bench.reality.flown import Flown
from kiteline_bench.reality.sensors.cases import Case
from kiteline_core.arrays import F64, Bool
from kiteline_lab.evaluation.metrics import TrajectoryAlignment

PATHS = ("odometry", "live", "base")
TIMES, LEAST_M = 2.0, 0.02  # of the flight with images alone, or m, whichever is larger
ONE_CAMERA_M = {"odometry": 0.1, "live": 0.1, "base": 0.05}  # as for one camera and a whole IMU
_BLIND_M, _BLIND_SHARE = 0.02, 0.02  # off at the end of the dark by an odometer: m, and share of the way
_BLIND_M_S, _BLIND_M_S2 = 0.02, 0.04  # and by an IMU: error of its velocity, and of tilt and bias together
_LEAST_WAY_M = 1.0  # over which a scale is judged
_NAN = float("nan")


@dataclass(frozen=True, slots=True)
class Figures:
    """Figures of one flight; nan for one that is not judged, because no sensor could tell it.

    wait_s: before lengths are said to be metres: with an IMU or odometer and images, or after the first image of
    cameras that measure depth. untold: 1 if that is said though nothing tells it. false, live_scale, base_scale:
    percent; the live one after dark images, as what is off at their end is no scale. over: ATE of each path over what
    is allowed. tilt_deg: at the end. quality: median of frames with images. lost: those of them without a pose.
    """

    name: str
    wait_s: float
    untold: float
    false: float
    live_scale: float
    base_scale: float
    over: dict[str, float]
    tilt_deg: float
    quality: float
    lost: float


def judged(case: Case, flight: Flown, plain: Flown | None) -> Figures:
    """Figures of a flight. plain: the one with images alone, of cameras that measure depth; None: one camera."""
    metric_s = flight.metric_after_s
    metre_from_s = case.metre_from_s if plain is None else 0.0
    wait_s = metric_s
    if plain is None:
        wait_s = case.metre_s(metric_s) if np.isfinite(metric_s) else np.inf if np.isfinite(metre_from_s) else _NAN
    known_from_s = max(metric_s, metre_from_s)
    live_from_s = max([known_from_s, *(end_s for _, end_s in (*case.upright, *case.dark.spans))])
    live_scale = 100.0 * _scale(flight, "live", live_from_s) if _carried(case) else _NAN
    return Figures(
        case.name, wait_s, float(plain is None and not case.metre_s(np.inf) and np.isfinite(metric_s)),
        100.0 * flight.false_metric(_drifting(case)), live_scale,
        100.0 * _scale(flight, "base", known_from_s),
        {path: _over(case, flight, plain, path) for path in PATHS}, _tilt_deg(case, flight), _quality(case, flight),
        _lost(case, flight) if plain is not None or _carried(case) else _NAN,
    )  # fmt: skip


def off_after_dark_m(case: Case, way_m: float) -> float:
    """By how much a sensor that measures through the dark may be off at its end; infinite without one.

    way_m: that is flown in the dark.
    """
    (begin_s, end_s), *_ = case.dark.spans or ((0.0, 0.0),)
    seconds, allowed = end_s - begin_s, [np.inf]
    if not seconds:
        return 0.0
    if case.through_the_dark(case.odometer):
        allowed.append(_BLIND_M + _BLIND_SHARE * way_m)
    if case.through_the_dark(case.imu):
        allowed.append(_BLIND_M_S * seconds + 0.5 * _BLIND_M_S2 * seconds**2)
    return float(min(allowed))


def _carried(case: Case) -> bool:
    """True if there are images all the time, or a sensor that measures the motion where there are none."""
    return not case.dark.spans or case.through_the_dark(case.odometer) or case.through_the_dark(case.imu)


def _drifting(case: Case) -> Spans:
    """Spans whose live poses have a step that is no scale: the world is turned, or the motion is reckoned or guessed.

    What was guessed is set right when the base sees the place again.
    """
    dark = case.dark.spans if _carried(case) else ((case.dark.spans[0][0], np.inf),)
    return (*dark, *case.upright)


def _over(case: Case, flight: Flown, plain: Flown | None, path: str) -> float:
    """ATE in metres over what is allowed; nan without metres, or on board where nothing measured the motion."""
    if not np.isfinite(flight.metric_after_s) or (path != "base" and not _carried(case)):
        return _NAN
    allowed = ONE_CAMERA_M[path] if plain is None else max(TIMES * plain.ate_m(path), LEAST_M)
    if path != "base":  # a step between two halves of a path is off by half of it in both
        allowed += 0.5 * off_after_dark_m(case, _way_in_the_dark_m(case, flight))
    from_s = max(flight.metric_after_s, _upright_from_s(case)) if path == "live" else flight.metric_after_s
    return flight.ate_m(path, from_s) / allowed


def _upright_from_s(case: Case) -> float:
    """From when live poses lie in an upright world."""
    return case.upright[-1][1] if case.upright else 0.0


def _scale(flight: Flown, path: str, from_s: float) -> float:
    """Share by which lengths are off from then on; nan if too little is flown."""
    found = flight.matched(path, TrajectoryAlignment.SIM3, from_s) if np.isfinite(from_s) else None
    if found is None or _way_m(found.truth) < _LEAST_WAY_M:
        return _NAN
    return abs(1.0 / found.scale - 1.0)


def _tilt_deg(case: Case, flight: Flown) -> float:
    """Tilt of what a flight controller gets at the end, where an IMU tells the vertical of what the images track."""
    measured = within(_seconds(flight), case.imu.spans) & np.isfinite(flight.metric_after_s)
    if not _carried(case):
        measured &= _after_dark(case, flight)
    if not measured.any():
        return _NAN
    tilts = [
        tilt_rad(e, true)
        for e, true in zip(flight.run.estimates, flight.run.truth, strict=True)
        if e is not None and e.tracked and true is not None
    ]
    return float(np.degrees(np.nan_to_num(tilts[-1], nan=np.pi))) if tilts else 180.0


def _quality(case: Case, flight: Flown) -> float:
    """Median of frames that images track, in metres; without those after a loss over which nothing measured."""
    good = _seconds(flight) >= flight.metric_after_s
    if not _carried(case):
        good &= ~_after_dark(case, flight)
    found = [
        e.quality
        for e, of_images in zip(flight.run.estimates, good & _seen(case, flight), strict=True)
        if of_images and e is not None and e.tracked
    ]
    return float(np.median(found)) if found else _NAN


def _lost(case: Case, flight: Flown) -> float:
    """Frames with images and without a pose, after lengths were first metres."""
    if not np.isfinite(flight.metric_after_s):
        return _NAN
    tracked = np.array([e is not None and e.tracked for e in flight.run.estimates])
    return float((~tracked & _seen(case, flight) & (_seconds(flight) >= flight.metric_after_s)).sum())


def _seconds(flight: Flown) -> F64:
    return np.asarray((np.array(flight.run.t_ns, np.int64) - flight.begin_ns) * 1e-9, np.float64)


def _seen(case: Case, flight: Flown) -> Bool:
    return ~within(_seconds(flight), case.dark.spans)


def _after_dark(case: Case, flight: Flown) -> Bool:
    return _seconds(flight) >= case.dark.spans[-1][1]


def _way_in_the_dark_m(case: Case, flight: Flown) -> float:
    dark = within(_seconds(flight), case.dark.spans)
    true = [T for T, unseen in zip(flight.run.truth, dark, strict=True) if unseen and T is not None]
    return _way_m(np.array(true)) if true else 0.0


def _way_m(poses: F64) -> float:
    return float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())
