"""Pairing by time, and the checks of inertial samples."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_core.frame import UNMEASURED, Frame, ImuBatch, OdometryBatch
from kiteline_core.geometry.cameras import CameraModel, CameraRig
from kiteline_hw.logs.mcap_log import ODOMETER, LogReader, LogWriter
from kiteline_hw.ports import SourceError, SourceReport
from kiteline_hw.sensors.frames import PAIR_TOLERANCE_NS, EncodedFrame, decode_frames, pair_by_time, pair_tolerance_ns
from kiteline_hw.sensors.images import encode_image
from kiteline_hw.sensors.imu_buffer import ImuStream, ImuTable, NoImu
from kiteline_hw.sensors.odometry_buffer import OdometerStream, insert_before_frames, reported_covariance

STAMPS = st.lists(st.integers(0, 300), max_size=25, unique=True).map(sorted)


@given(STAMPS, STAMPS, st.integers(0, 12))
def test_pairs_are_within_tolerance_ordered_and_complete(left: list[int], right: list[int], tolerance: int) -> None:
    report = SourceReport()
    items = sorted([(t, 0, ("l", t)) for t in left] + [(t, 1, ("r", t)) for t in right])
    found = list(pair_by_time(items, tolerance, ("left", "right"), report))
    assert [t for t, _, _ in found] == left  # one without a partner comes alone
    pairs = [(t, a, b) for t, a, b in found if b is not None]
    lefts, rights = [p[1][1] for p in pairs], [p[2][1] for p in pairs]
    assert all(p[0] == p[1][1] and p[1][0] == "l" and p[2][0] == "r" for p in pairs)
    assert all(abs(a - b) <= tolerance for a, b in zip(lefts, rights, strict=True))
    assert lefts == sorted(set(lefts)) and rights == sorted(set(rights))
    # Every item is either paired or counted.
    assert report.skipped.get("missing right", 0) == len(left) - len(pairs)
    assert report.skipped.get("missing left", 0) == len(right) - len(pairs)
    # An item whose partner is the nearest from both sides, and alone within reach, is never left out.
    for t in left:
        near = [r for r in right if abs(r - t) <= tolerance]
        if len(near) == 1 and [a for a in left if abs(a - near[0]) <= tolerance] == [t]:
            assert (t, near[0]) in list(zip(lefts, rights, strict=True))
    # Equal stamps always find each other.
    assert set(left) & set(right) <= {a for a, b in zip(lefts, rights, strict=True) if a == b}


def test_the_nearer_of_two_candidates_is_paired() -> None:
    items = [(0, 0, "l0"), (4, 1, "r4"), (5, 0, "l5"), (100, 0, "l100")]
    report = SourceReport()
    assert list(pair_by_time(items, 6, ("left", "right"), report)) == [
        (0, "l0", None), (5, "l5", "r4"), (100, "l100", None),
    ]  # fmt: skip
    assert report.skipped == {"missing right": 2}


def test_tolerance_is_half_a_period_at_most() -> None:
    assert pair_tolerance_ns(np.array([0, 50_000_000, 100_000_000])) == 5_000_000
    assert pair_tolerance_ns(np.array([0, 5_000_000, 10_000_000])) == 2_500_000
    assert pair_tolerance_ns(np.array([7])) == 5_000_000


@given(st.lists(st.tuples(st.integers(0, 100), st.booleans()), max_size=40), st.integers(0, 110))
def test_stream_and_table_keep_the_same_samples(samples: list[tuple[int, bool]], until: int) -> None:
    times = np.array([t for t, _ in samples], np.int64)
    gyro = np.array([[np.nan if bad else 0.5] * 3 for _, bad in samples]).reshape(-1, 3)
    accel = np.arange(3.0 * len(samples)).reshape(-1, 3)
    reports = SourceReport(), SourceReport()
    table, stream = ImuTable(times, gyro, accel, reports[0]), ImuStream(reports[1])
    for t, g, a in zip(times, gyro, accel, strict=True):
        stream.add(int(t), (*g, *a))
    got = [b for b in (table.take_until(until), table.take_until(1000), table.take_until(2000)) if b is not None]
    kept = np.concatenate([b.t_ns for b in got]) if got else np.zeros(0, np.int64)
    best, expected = -1, []
    for t, bad in samples:
        if not bad and t > best:
            best = t
            expected.append(t)
    assert kept.tolist() == expected
    batch = stream.take_until(1000)
    assert (batch.t_ns.tolist() if batch is not None else []) == expected
    assert reports[0].skipped == reports[1].skipped
    assert sum(reports[0].skipped.values()) == len(samples) - len(expected)
    assert all((np.diff(b.t_ns) > 0).all() and np.isfinite(b.gyro).all() for b in got)


@pytest.mark.parametrize("wrong", [0, 4])
def test_one_stamp_far_ahead_is_dropped_alone(wrong: int) -> None:
    times = np.arange(10, dtype=np.int64) * 5_000_000
    times[wrong] += 3600 * 10**9
    report, of_stream = SourceReport(), SourceReport()
    batch = ImuTable(times, np.zeros((10, 3)), np.zeros((10, 3)), report).take_until(10**12)
    assert len(batch.t_ns) == 9 and report.skipped == {"imu stamp not increasing": 1}
    stream = ImuStream(of_stream)
    for t_ns in times.tolist():
        stream.add(t_ns, (0.0,) * 6)
    assert np.array_equal(stream.take_until(10**12).t_ns, batch.t_ns) and of_stream.skipped == report.skipped


def test_samples_that_are_all_stamped_after_the_images_are_told() -> None:
    camera = CameraModel(8, 4, 5.0, 5.0, 3.5, 1.5)
    rig, image = CameraRig(camera, None, np.eye(4), None), encode_image(np.zeros((4, 8), np.uint8))
    frames = [EncodedFrame(50_000_000 * k, image) for k in range(20)]
    times = np.arange(200, dtype=np.int64) * 5_000_000
    for shift_ns, notes in ((0, 0), (60_950_000_000, 1)):
        report = SourceReport()
        table = ImuTable(times + shift_ns, np.zeros((200, 3)), np.ones((200, 3)), report)
        assert sum(isinstance(item, Frame) for item in decode_frames(frames, table, rig, report, "made")) == 20
        assert len(report.notes) == notes and all("begin 60.0 s after the last image" in note for note in report.notes)


@pytest.mark.parametrize(("period_ns", "told"), [(50_000_000, ""), (50_000, "0.05"), (50_000_000_000, "50000")])
def test_stamps_in_another_unit_are_told(period_ns: int, told: str) -> None:
    camera = CameraModel(8, 4, 5.0, 5.0, 3.5, 1.5)
    rig, image = CameraRig(camera, None, np.eye(4), None), encode_image(np.zeros((4, 8), np.uint8))
    report, frames = SourceReport(), [EncodedFrame(period_ns * k, image) for k in range(20)]
    assert len(list(decode_frames(frames, NoImu(), rig, report, "made"))) == 20
    assert report.notes == [
        f"images: {told} ms apart by their stamps: are these in the unit that the format expects?"
    ] * (told != "")


@pytest.mark.parametrize(("skew_ns", "told"), [(0, False), (300_000, False), (2_000_000, True), (-2_000_000, True)])
def test_pairs_that_are_not_taken_together_are_named(skew_ns: int, told: bool) -> None:
    stamps = 50_000_000 * np.arange(1, 121)
    items = sorted([(int(t), 0, "l") for t in stamps] + [(int(t) + skew_ns, 1, "r") for t in stamps])
    report = SourceReport()
    pairs = list(pair_by_time(items, PAIR_TOLERANCE_NS, ("left image", "right image"), report))
    assert all(right is not None for _, _, right in pairs) and len(pairs) == 120
    assert len(report.notes) == told and all("2.0 ms apart: while the cameras turn" in note for note in report.notes)


RNG = np.random.default_rng(3)


def batch(*t_ns: int) -> OdometryBatch:
    n = len(t_ns)
    cov = np.tile(0.01 * np.eye(3), (n, 1, 1))
    return OdometryBatch(np.array(t_ns, np.int64), RNG.normal(size=(n, 3)), RNG.normal(size=(n, 3)), cov, 2.0 * cov)


def same(a: OdometryBatch, b: OdometryBatch) -> bool:
    names = ("t_ns", "velocity", "rate", "velocity_cov", "rate_cov")
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in names)


def test_samples_up_to_a_frame_are_taken() -> None:
    stream = OdometerStream()
    stream.add(batch(10, 20))
    stream.add(batch(30))
    first, second = stream.take_until(20), stream.take_until(40)
    assert (first.t_ns.tolist(), second.t_ns.tolist()) == ([10, 20], [30])
    assert stream.take_until(100) is None


def test_late_repeated_and_broken_samples_are_counted() -> None:
    report = SourceReport()
    stream = OdometerStream(report)
    broken = batch(25)
    broken.velocity[0, 1] = np.nan
    for part in (batch(10, 20), batch(20, 15), broken, batch(30)):
        stream.add(part)
    taken = stream.take_until(100)
    assert taken.t_ns.tolist() == [10, 20, 30]
    assert report.skipped == {"odometer sample not plausible": 1, "odometer stamp not increasing": 2}


def test_odometry_is_inserted_before_its_frame() -> None:
    stream = OdometerStream()
    stream.add(batch(5, 15))
    image = np.zeros((2, 2), np.uint8)
    items = [ImuBatch(np.array([4]), np.zeros((1, 3)), np.zeros((1, 3))), Frame(10, image), Frame(20, image)]
    kinds = [type(item).__name__ for item in insert_before_frames(items, stream)]
    assert kinds == ["ImuBatch", "OdometryBatch", "Frame", "OdometryBatch", "Frame"]


def test_variances_reported_by_drivers() -> None:
    cov = reported_covariance(np.array([0.04, 0.0, 99999.0]), 0.1)
    np.testing.assert_allclose(cov.diagonal(), [0.04, 0.01, UNMEASURED])
    np.testing.assert_allclose(reported_covariance(np.full(3, np.nan), 0.1), 0.01 * np.eye(3))


def test_a_logged_batch_is_exact(tmp_path: Path) -> None:
    told = batch(100, 200, 300)
    with LogWriter(tmp_path / "log.mcap", {}) as log:
        log.odometer(ODOMETER, 300, told)
        log.blob("/other", 300, b"x")
    with LogReader(tmp_path / "log.mcap") as log:
        message, other = log.messages()
        assert same(message.odometry(), told)
        with pytest.raises(SourceError, match=r"not kiteline\.Odometry"):
            other.odometry()
