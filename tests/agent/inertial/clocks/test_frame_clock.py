"""When frames were taken, from stamps that scatter, and when stamps are left as they are."""

import numpy as np
import pytest

from kiteline_agent.inertial.clocks.frame_clock import FrameClock
from kiteline_agent.inertial.preintegration import Samples
from kiteline_core.arrays import F64, I64, Bool
from kiteline_core.frame import ImuCalibration
from kiteline_core.geometry import se3

PERIOD_S = 0.05
SETTLED = 60


def stamped(clock: FrameClock, stamps_s: F64) -> F64:
    """Times at which the clock says that frames were taken."""
    stamps: I64 = np.round(1e9 * stamps_s).astype(np.int64)
    out = []
    for stamp in stamps.tolist():
        clock.add(stamp)
        out.append(1e-9 * clock.taken_ns(stamp))
    return np.array(out)


def scattered(sigma_s: float, seed: int, kept: Bool | None = None, late: float = 0.0) -> tuple[F64, F64]:
    """True times and stamps of 400 frames. late: share of stamps that come 10 to 20 ms late."""
    rng = np.random.default_rng(seed)
    t = 3.0 + PERIOD_S * np.arange(400)
    t = t if kept is None else t[kept]
    delay = rng.normal(0.0, sigma_s, len(t)) + rng.uniform(0.01, 0.02, len(t)) * (rng.random(len(t)) < late)
    return t, np.maximum.accumulate(t + delay)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("sigma_ms", [0.4, 2.0, 5.0])
def test_a_constant_rate_tells_when_frames_were_taken(sigma_ms: float, seed: int) -> None:
    kept = np.random.default_rng(seed + 9).random(400) > 0.1  # frames that never came
    t, stamps = scattered(1e-3 * sigma_ms, seed, kept)
    clock = FrameClock()
    taken = stamped(clock, stamps)
    off, raw = (taken - t)[SETTLED:], (stamps - t)[SETTLED:]
    assert off.std() < 0.45 * raw.std()
    assert np.diff(off).std() < 0.1 * np.diff(raw).std()  # an interval is what the IMU is integrated over
    assert (np.diff(taken) > 0.0).all()
    assert clock.jitter_s == pytest.approx(1e-3 * sigma_ms, rel=0.4)
    assert len(clock.take_events()) == (sigma_ms > 1.0)
    assert clock.taken_ns(12345) == 12345


@pytest.mark.parametrize("sigma_ms", [0.02, 0.5])
def test_single_late_stamps_are_corrected(sigma_ms: float) -> None:
    """Also where the others are as good as the line, and are left as they are."""
    t, stamps = scattered(1e-3 * sigma_ms, 1, late=0.05)
    taken = stamped(FrameClock(), stamps)
    wrong, raw = (np.abs(np.diff(times - t)[SETTLED:]) > 2e-3 for times in (taken, stamps))
    assert wrong.mean() < 0.02 < 0.06 < raw.mean()  # two in a row, late by the same, look like another phase
    if sigma_ms < 0.1:
        good = np.abs(stamps - t) < 1e-3
        assert (np.abs(taken - stamps)[good] < 5e-9).mean() > 0.95


def test_a_stamp_that_comes_after_the_next_frame_was_taken_is_no_worse_than_before() -> None:
    t, stamps = scattered(1e-3, 4)
    stamps[100::20] += 0.035
    off = np.abs(stamped(FrameClock(), stamps) - t)
    assert off.max() < 0.04
    assert off[SETTLED:][off[SETTLED:] < 0.03].max() < 3e-3


def test_another_phase_is_seen_at_once() -> None:
    t, _ = scattered(0.0, 0)
    t[200:] += 0.02
    stamps = t + np.random.default_rng(3).normal(0.0, 5e-4, len(t))
    off = np.abs(stamped(FrameClock(), stamps) - t)
    assert (off > 5e-3).sum() <= 2


@pytest.mark.parametrize("sigma_ms", [0.0, 0.03, 25.0])
def test_stamps_that_hardly_scatter_or_tell_no_rate_are_left_as_they_are(sigma_ms: float) -> None:
    _, stamps = scattered(1e-3 * sigma_ms, 2)
    clock = FrameClock()
    taken = stamped(clock, stamps)
    changed = np.abs(taken - stamps) > 5e-9
    assert changed.mean() < (0.0 if sigma_ms < 1.0 else 0.1) + 1e-9
    assert clock.take_events() == []


def test_after_a_change_of_the_rate_stamps_count_until_the_new_one_is_known() -> None:
    rng = np.random.default_rng(5)
    t = np.concatenate([PERIOD_S * np.arange(200), PERIOD_S * 199 + PERIOD_S * 4 / 3 * np.arange(1, 200)])
    off = stamped(FrameClock(), t + rng.normal(0.0, 1e-3, len(t))) - t
    wrong = np.abs(off) > 5e-3
    assert wrong.sum() <= 4 and np.flatnonzero(wrong).max() < 206
    assert np.diff(off)[-SETTLED:].std() < 3e-4


@pytest.mark.parametrize("irregular", [False, True])
def test_rotations_refute_the_rate_where_frames_are_taken_when_their_stamps_say(irregular: bool) -> None:
    rng, clock, calibration = np.random.default_rng(7), FrameClock(), ImuCalibration()
    even = PERIOD_S * np.arange(300)
    shaken = np.maximum.accumulate(even + rng.normal(0.0, 2e-3, 300))
    true = shaken if irregular else even
    axis = np.array([0.3, -0.7, 0.5])

    def rate(t: F64) -> F64:
        return np.outer(np.sin(2.0 * t), axis)

    def angle(t: float) -> F64:
        return np.asarray(-np.cos(2.0 * t) / 2.0 * axis)

    refuted = []
    before = 0.0
    for k in range(300):
        stamp = round(1e9 * shaken[k])
        clock.add(stamp)
        taken_s = 1e-9 * clock.taken_ns(stamp)
        R = se3.so3_exp(angle(true[k]) + rng.normal(0.0, 2e-4, 3))
        t = np.linspace(0.0, max(taken_s - before, 1e-3), 12)
        samples = Samples(t, rate(before + t), np.zeros((12, 3)))
        clock.judge(stamp, R, samples, np.zeros(6), calibration)
        before = 1e-9 * clock.taken_ns(stamp)
        refuted.append(clock.refuted)
    assert refuted[-1] is irregular
    assert not irregular or refuted.index(True) < 60
    assert (clock.jitter_s == 0.0) is irregular
    assert len(clock.take_events()) == 1 + irregular
