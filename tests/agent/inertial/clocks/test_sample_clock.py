"""When samples were taken, from stamps of their arrival."""

import numpy as np
import pytest

from kiteline_agent.inertial.clocks.sample_clock import SampleClock
from kiteline_core.arrays import F64, I64
from kiteline_core.frame import ImuBatch

PERIOD_NS = 5_000_000
SETTLED = 400


def batches(stamps_ns: I64, size: int = 10) -> list[ImuBatch]:
    """Samples whose values are their numbers."""
    n = np.arange(len(stamps_ns), dtype=np.float64)
    values = np.stack([n, n, n], axis=1)
    return [ImuBatch(stamps_ns[k : k + size], values[k : k + size], values[k : k + size])
            for k in range(0, len(stamps_ns), size)]  # fmt: skip


def timed(clock: SampleClock, stamps_ns: I64) -> tuple[F64, I64]:
    """Numbers and times that the clock gives."""
    out = [clock.timed(batch) for batch in batches(stamps_ns)]
    kept = [batch for batch in out if batch is not None]
    return np.concatenate([b.gyro[:, 0] for b in kept]), np.concatenate([b.t_ns for b in kept])


def true_ns(count: int = 3000) -> I64:
    return 7_000_000_000 + PERIOD_NS * np.arange(count, dtype=np.int64)


def scattered(sigma_ns: float, seed: int) -> I64:
    off = np.random.default_rng(seed).normal(0.0, sigma_ns, 3000).astype(np.int64)
    return np.maximum.accumulate(np.sort(true_ns() + off) + np.arange(3000))


def in_bursts(every_ns: int) -> I64:
    """Samples that arrive together, 50 us apart, as a serial converter with a latency timer delivers them."""
    stamps = (true_ns() + every_ns - 1) // every_ns * every_ns
    for k in range(1, len(stamps)):
        stamps[k] = max(stamps[k], stamps[k - 1] + 50_000)
    return stamps


@pytest.mark.parametrize("stamps", [scattered(1e6, 1), scattered(2e6, 2), in_bursts(8_000_000), in_bursts(16_000_000)])
def test_samples_are_counted_where_stamps_scatter(stamps: I64) -> None:
    clock = SampleClock()
    numbers, times = timed(clock, stamps)
    assert (np.diff(times) > 0).all() and len(times) > 2950
    off = times - true_ns()[numbers.astype(np.int64)]
    raw = stamps - true_ns()
    assert off[SETTLED:].std() < 0.25 * raw[SETTLED:].std()  # a constant delay is left to the time offset
    assert np.diff(off)[SETTLED:].std() < 0.1 * np.diff(raw)[SETTLED:].std()
    assert clock.jitter_s > 5e-4
    assert len(clock.take_events()) == 1


def test_even_stamps_are_left_as_they_are_also_where_samples_are_missing() -> None:
    rng = np.random.default_rng(3)
    kept = true_ns()[(rng.random(3000) > 0.25) & ((np.arange(3000) < 900) | (np.arange(3000) > 960))]
    for stamps in (true_ns(), kept, true_ns() + rng.integers(-200_000, 200_000, 3000)):
        clock = SampleClock()
        for batch in batches(stamps):
            assert clock.timed(batch) is batch
        assert clock.jitter_s == 0.0 and clock.take_events() == []


def test_samples_that_are_missing_are_not_counted_away() -> None:
    there = np.ones(3000, np.bool_)
    there[1500:1600] = False  # 0.45 s are lost
    stamps = scattered(1e6, 4)[there]
    numbers, times = timed(SampleClock(), stamps)
    off = times - true_ns()[there][numbers.astype(np.int64)]
    assert np.abs(off[SETTLED:]).max() < 5e6  # half a sample, where stamps scatter by 1 ms


def test_after_a_silence_or_a_clock_that_was_set_back_it_begins_again() -> None:
    clock = SampleClock()
    for shift_ns in (0, 20_000_000_000, -60_000_000_000):
        numbers, times = timed(clock, scattered(1e6, 5) + shift_ns)
        assert len(times) > 2950
        off = times - shift_ns - true_ns()[numbers.astype(np.int64)]
        assert off[SETTLED:].std() < 3e5
    assert clock.timed(None) is None


@pytest.mark.parametrize("rate_hz", [400, 1000])
@pytest.mark.parametrize("silence_ns", [3 * 10**9, 100 * 10**9])
def test_a_silence_within_a_batch_is_no_scatter(rate_hz: int, silence_ns: int) -> None:
    """A recording that paused: the samples before and after come with the same frame."""
    stamps = 7_000_000_000 + 1_000_000_000 // rate_hz * np.arange(3000, dtype=np.int64)
    stamps[1004:] += silence_ns
    clock = SampleClock()
    numbers, times = timed(clock, stamps)
    assert np.array_equal(times, stamps) and len(numbers) == 3000
    assert clock.jitter_s == 0.0 and clock.take_events() == []


def test_a_batch_of_many_uneven_samples() -> None:
    clock, stamps = SampleClock(), in_bursts(16_000_000)
    values = np.zeros((len(stamps), 3))
    out = clock.timed(ImuBatch(stamps, values, values))  # the samples before the first frame
    assert out is not None and len(out.t_ns) > 0.9 * len(stamps) and (np.diff(out.t_ns) > 0).all()


def test_samples_sent_twice_or_out_of_order_are_left_out() -> None:
    clock, stamps = SampleClock(), true_ns(1000)
    twice = np.sort(np.concatenate([stamps, stamps[::20]]))
    numbers, times = (twice - stamps[0]) // PERIOD_NS, []
    for k in range(0, len(twice), 10):
        values = np.tile(numbers[k : k + 10, None].astype(np.float64), (1, 3))
        batch = clock.timed(ImuBatch(twice[k : k + 10], values, values))
        times += [] if batch is None else batch.t_ns.tolist()
    assert times == stamps.tolist()
    swapped = true_ns(10)
    swapped[[4, 5]] = swapped[[5, 4]]
    values = np.arange(30.0).reshape(10, 3)
    batch = SampleClock().timed(ImuBatch(swapped, values, values))
    assert batch is not None and batch.t_ns.tolist() == sorted({*swapped.tolist()} - {int(swapped[5])})


def test_batches_sent_twice_are_left_out() -> None:
    clock, stamps, times = SampleClock(), true_ns(600), []
    for batch in batches(stamps):
        for _ in range(2):
            out = clock.timed(batch)
            times += [] if out is None else out.t_ns.tolist()
    assert times == stamps.tolist()


@pytest.mark.parametrize("ahead_ns", [1_000_000_000_000, 2_000_000_000])
@pytest.mark.parametrize("at", [500, 504, 509])
def test_one_stamp_far_ahead_stops_nothing(ahead_ns: int, at: int) -> None:
    stamps = true_ns(2000)
    true = stamps.copy()
    stamps[at] += ahead_ns
    _, times = timed(SampleClock(), stamps)
    assert len(set(times.tolist()) & set(true.tolist())) > 1980


def test_a_clock_that_is_set_back_goes_on() -> None:
    stamps = true_ns(2000)
    stamps[1004:] -= 3_000_000_000
    _, times = timed(SampleClock(), stamps)
    assert len(times) > 1980


@pytest.mark.parametrize("jitter_ms", [0.0, 4.0])
@pytest.mark.parametrize("rates_hz", [(50, 200), (100, 200), (200, 100), (200, 50), (200, 150), (200, 125)])
def test_a_rate_that_changes_in_flight_is_followed(rates_hz: tuple[int, int], jitter_ms: float) -> None:
    """A flight controller that is asked for more samples, or for fewer by a ground station."""
    before_hz, after_hz = rates_hz
    true = np.concatenate([np.arange(0.0, 9.0, 1.0 / before_hz), np.arange(9.0, 16.0, 1.0 / after_hz)]) + 7.0
    late_s = 1e-3 * np.random.default_rng(7).uniform(0.0, jitter_ms, len(true)) if jitter_ms else np.zeros(len(true))
    stamps = np.maximum.accumulate(np.round(1e9 * (true + late_s)).astype(np.int64) + np.arange(len(true)))
    clock = SampleClock()
    numbers, times = timed(clock, stamps)
    taken_s = true[numbers.astype(np.int64)]
    off_ms = 1e3 * (1e-9 * times - taken_s) - 0.5 * jitter_ms
    if jitter_ms == 0.0:
        assert len(times) == len(true) and np.abs(off_ms).max() < 0.1
        assert clock.take_events() == []
    assert (np.diff(times) > 0).all() and len(times) > len(true) - 12
    assert np.abs(off_ms).max() < 50.0
    assert np.abs(off_ms[taken_s > 20.5]).max() < 1.5  # 4.5 s later
