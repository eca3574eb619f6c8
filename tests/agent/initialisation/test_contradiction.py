"""Images and IMU that contradict each other: no map in metres begins, the user is told what to check, images go on."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kiteline_agent.config import AgentConfig
from kiteline_agent.governor.cost_model import Work
from kiteline_agent.inertial.clocks.frame_clock import FrameClock
from kiteline_agent.inertial.imu_prior import ImuPrior
from kiteline_agent.inertial.preintegration import TimeOffset
from kiteline_agent.inertial_start_config import ContradictionConfig
from kiteline_agent.initialisation import inertial_start
from kiteline_agent.initialisation.contradiction import ContradictionWatch, contradicts, exceeds_lens_errors
from kiteline_agent.initialisation.corner_tracks import CornerObservations
from kiteline_agent.initialisation.inertial_start import InertialStart
from kiteline_agent.initialisation.window.inertial_terms import CutSamples
from kiteline_core.arrays import F64
from tests.agent.initialisation.test_inertial_start import CAMERA, Recorded, Tracks
from tests.agent.initialisation.window.test_window_bundle import CALIBRATION, PRIOR, changed, window

Change = Callable[[CornerObservations, CutSamples], tuple[CornerObservations, CutSamples]]


def start_with(monkeypatch: pytest.MonkeyPatch, change: Change) -> tuple[float, list[str]]:
    """Seconds until a map begins (infinite if none does in 7) on a changed window, and the warnings until then.

    A contradiction is told after half the usual time: each further window takes up to a second of CPU.
    """
    keyframes, config = 29, AgentConfig()
    brief = replace(config.inertial_start, contradiction=replace(config.inertial_start.contradiction, lasts_s=2.5))
    corners, cut, _ = window(1, keyframes=keyframes, noise_px=0.2)
    corners, cut = change(corners, cut)
    monkeypatch.setattr(inertial_start, "window_points", lambda *_: SimpleNamespace(sigma_rho=np.ones(100)))
    monkeypatch.setattr(inertial_start, "realigned", lambda _keyframes, observations, *_: observations)
    start = InertialStart(CAMERA, CALIBRATION, replace(config, inertial_start=brief), Work())
    start._tracks = Tracks(corners)  # type: ignore[assignment]
    monkeypatch.setattr(inertial_start, "WindowSamples", lambda *args: Recorded(cut, len(args[2])))
    monkeypatch.setattr(start._noise, "measure", lambda *_: None)  # noise as calibrated
    warnings: list[str] = []
    for k in range(keyframes):
        ctx: Any = SimpleNamespace(t_ns=250_000_000 * k, images=SimpleNamespace(left=None))
        found = start.add(ctx, ImuPrior(None, TimeOffset(0.0, 0.02), lambda samples: samples, FrameClock()))
        warnings += start.take_warnings()
        if found is not None:
            return ctx.t_ns * 1e-9, warnings
    return float("inf"), warnings


def unchanged(corners: CornerObservations, cut: CutSamples) -> tuple[CornerObservations, CutSamples]:
    return corners, cut


def longer_focal_length(corners: CornerObservations, cut: CutSamples) -> Any:
    """Corners as a camera shows them whose focal length is a tenth longer than told."""
    return replace(corners, xy=1.1 * corners.xy), cut


def turned(R: F64) -> Change:
    def change(corners: CornerObservations, cut: CutSamples) -> Any:
        return corners, changed(cut, lambda s: replace(s, gyro=s.gyro @ R.T, accel=s.accel @ R.T))

    return change


def in_g(corners: CornerObservations, cut: CutSamples) -> Any:
    return corners, changed(cut, lambda s: replace(s, accel=s.accel / 9.81))


def in_degrees(corners: CornerObservations, cut: CutSamples) -> Any:
    return corners, changed(cut, lambda s: replace(s, gyro=np.degrees(s.gyro)))


def test_a_rig_as_calibrated_begins_a_map_and_warns_of_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    begun_s, warnings = start_with(monkeypatch, unchanged)
    assert begun_s < 6.0
    assert warnings == []


@pytest.mark.parametrize(
    "change",
    [
        longer_focal_length,
        turned(np.diag([1.0, -1.0, -1.0])),
        turned(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])),
        in_g,
        in_degrees,
    ],
    ids=["focal length", "two axes negated", "a quarter turn", "accelerations in g", "rates in degrees"],
)
def test_a_rig_that_is_not_as_calibrated_begins_none_and_says_so_once(
    monkeypatch: pytest.MonkeyPatch, change: Change
) -> None:
    begun_s, warnings = start_with(monkeypatch, change)
    assert begun_s == float("inf")
    assert len(warnings) == 1
    assert "T_BS" in warnings[0]


@pytest.mark.parametrize(
    ("lens_chi2", "gyro_noise", "accel_bias_m_s2", "wrong"),
    [
        (2.0, 2.8, 0.1, False),  # a gyro that is noisier than told
        (17.0, 1.2, 0.3, False),  # worn rigs
        (14.0, 1.9, 0.1, True),  # a focal length that is off by a tenth
        (32.0, 1.2, 0.1, True),
        (2.0, 7.0, 0.1, True),  # two axes negated
        (2.0, 0.8, 8.0, True),  # accelerations in g
    ],
)
def test_what_calibrated_and_worn_rigs_show_is_no_contradiction(
    lens_chi2: float, gyro_noise: float, accel_bias_m_s2: float, wrong: bool
) -> None:
    info = np.diag(np.full(8, 1e4))
    lens = np.array([1.0, 0, 0, 0, 0, 0, 0, 0]) * np.sqrt(lens_chi2 / 1e4)
    solution: Any = SimpleNamespace(
        state=SimpleNamespace(lens=lens), bias=np.array([0.0, 0.0, 0.0, 0.0, accel_bias_m_s2, 0.0])
    )
    assert contradicts(solution, gyro_noise, PRIOR, info) is wrong


def test_the_imu_is_given_up_for_what_it_shows_and_for_a_lens_alone_much_later() -> None:
    config = ContradictionConfig(lasts_s=5.0, unsure_s=24.0)
    watch = ContradictionWatch(config)
    assert not any(watch.note(k * 10**9, contradicts=True, by_imu=k == 3) and watch.certain for k in range(9))
    assert not watch.certain  # a lens may be off beside a true IMU
    for k in range(9, 24):
        watch.note(k * 10**9, contradicts=True, by_imu=False)
    assert not watch.certain
    watch.note(24 * 10**9, contradicts=True, by_imu=False)
    assert watch.certain
    watch.note(25 * 10**9, contradicts=False)
    assert not watch.certain
    for k in range(26, 32):
        watch.note(k * 10**9, contradicts=True, by_imu=True)
    assert watch.certain
    assert not watch.note(32 * 10**9, contradicts=False) and not watch.certain
    for k in range(33, 50):  # people in view: windows that fit nothing in between
        watch.note(k * 10**9, contradicts=True if k % 3 else None, by_imu=True)
        assert not watch.certain
    # windows as starts show them: the real flight backward, whose lens is off; two axes negated; accelerations in g
    for gyro_noise, bias_m_s2, imu in ((0.2, 0.16, False), (7.4, 0.1, True), (0.2, 8.3, True)):
        solution: Any = SimpleNamespace(bias=np.array([0.0, 0.0, 0.0, 0.0, bias_m_s2, 0.0]))
        assert exceeds_lens_errors(solution, gyro_noise, PRIOR) is imu


def test_a_contradiction_is_told_once_it_lasts_and_again_after_an_end() -> None:
    watch = ContradictionWatch(ContradictionConfig(lasts_s=5.0))
    said: list[int] = []
    for k in range(60):
        tells = k % 3 != 1  # every third window tells neither
        events = watch.note(500_000_000 * k, contradicts=k not in (3, 30) if tells else None)
        said += [k] * len(events)
    assert said == [15, 42]


def test_windows_that_tell_no_scale_are_told_of_once_and_rests_do_not_count() -> None:
    watch = ContradictionWatch(ContradictionConfig())
    said: list[tuple[float, str]] = []

    def fly(first_s: float, last_s: float) -> None:
        for t_s in np.arange(first_s, last_s, 0.5):
            said.extend((t_s, event) for event in watch.note(round(1e9 * t_s), contradicts=None))

    fly(2.5, 6.0)
    fly(100.0, 103.0)  # after a rest
    watch.begin_again()  # a map began, and was lost
    fly(200.0, 209.5)
    assert not said
    fly(209.5, 260.0)
    assert [t_s for t_s, _ in said] == [210.0]
    assert said[0][1].startswith("imu: no scale is known after 10 s in motion")


def test_a_wait_for_the_scale_says_how_well_it_is_known_and_what_shakes() -> None:
    def said(sigma: float, vibration_m_s2: float) -> str:
        watch = ContradictionWatch(ContradictionConfig())
        watch.note_lengths(sigma, 0.02, vibration_m_s2)
        return next(e for k in range(40) for e in watch.note(500_000_000 * k, contradicts=False))

    assert "lengths are known to 6.2 %, and 2 % are needed, with vibration of 1.1 m/s^2 (a softer" in said(0.062, 1.14)
    assert "lengths are known to 6.2 %, and 2 % are needed: speed up" in said(0.062, 0.0)
    assert "lengths are known" not in said(0.018, 0.0)  # but windows do not agree
    assert "--no-imu" in said(0.062, 0.0)
