"""Residual codes: lossless, refused if the two sides hold other values, and short."""

import random
import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_codec.coding import quantise
from kiteline_codec.coding.packing import Reader, Writer
from kiteline_codec.residuals import prediction_kernels, predictors
from kiteline_codec.residuals.residual_coding import ResidualCoder
from kiteline_codec.schema import (
    CameraIntrinsics,
    Key,
    KeyframeHeader,
    NewLandmarks,
    Observations,
    RefinedLandmarks,
    WireError,
    messages,
)
from kiteline_codec.sync.config import SyncConfig
from kiteline_codec.sync.endpoint import Endpoint
from kiteline_core.geometry import se3
from kiteline_core.ids import keyframe_id
from tests.codec.residuals.coded_flights import CAMERA, SUBMAP, coded, flight
from tests.yardstick import slowness


@given(st.integers(0, 1 << 30), st.integers(1, 4), st.integers(0, 60), st.floats(0.0, 8.0), st.integers(0, 4))
def test_residual_columns_come_back(seed: int, c: int, n: int, spread: float, shift: int) -> None:
    rng = np.random.default_rng(seed)
    values = (rng.standard_cauchy((c, n)) * 10.0**spread).clip(-(1 << 25), 1 << 25).astype(np.int64) << shift
    out = Writer()
    out.residual_columns(values)
    source = Reader(out.bytes())
    assert np.array_equal(source.residual_columns(c, n), values)
    source.end()


@given(st.integers(1, 4), st.integers(1, 300), st.binary(max_size=80))
def test_any_bytes_are_residual_columns_or_an_error(c: int, n: int, data: bytes) -> None:
    try:
        values = Reader(data).residual_columns(c, n)
    except WireError:
        return
    assert np.abs(values).max() < 1 << 30


def test_too_large_numbers_are_refused() -> None:
    with pytest.raises(ValueError, match="numbers below"):
        Writer().residual_columns(np.array([[1 << 30]]))


@given(st.integers(0, 1000), st.sets(st.integers(0, 40)))
def test_residual_codes_come_back_whatever_the_peer_lacks(seed: int, lacking: set[int]) -> None:
    values = coded(flight(seed, landmarks=20))
    known = {key: value for i, (key, value) in enumerate(values.items()) if i not in lacking}
    a, b = ResidualCoder(), ResidualCoder()
    made = 0
    for key, (_, code) in values.items():
        form = a.compress(key, code, known.get, values.get)
        if form is not None:
            made += 1
            assert len(form) < len(code)
            assert b.expand(key, form, known.get) == code
    assert made >= 6  # new landmarks need no predictors


def test_a_predicted_observation_takes_a_few_bits() -> None:
    records = flight(4, keyframes=10, landmarks=100)
    values = coded(records)
    last = next(r for r in reversed(records) if isinstance(r, Observations))
    step = 2 / quantise.PIXEL_STEPS
    last = replace(last, uv=(np.rint(last.uv / step) * step).astype(np.float32))
    key, code = messages.key(last), messages.encode(last)
    form = ResidualCoder().compress(key, code, values.get, values.get)
    assert len(form) / len(last.index) < 3.0 < 5.5 < len(code) / len(last.index)
    nothing = ResidualCoder().compress(key, code, {}.get, {}.get)
    assert nothing is None or len(nothing) > 1.5 * len(form)


def test_another_version_of_a_predictor_is_refused() -> None:
    records = flight(2)
    values = coded(records)
    key = messages.key(records[-1])
    code = values[key][1]
    form = ResidualCoder().compress(key, code, values.get, values.get)
    assert form is not None
    built_upon = 0
    for other in [k for k in values if k.kind in (KeyframeHeader.KIND, NewLandmarks.KIND, CameraIntrinsics.KIND)]:
        changed = {**values, other: (99, values[other][1])}
        missing = {k: v for k, v in values.items() if k != other}
        refused = 0
        for held in (changed, missing):
            try:
                assert ResidualCoder().expand(key, form, held.get) == code
            except WireError:
                refused += 1
        assert refused in (0, 2)  # 0: not one of those that it builds upon
        built_upon += refused == 2
        if other.id in (key.id - 1, 3):
            assert refused == 2
    assert built_upon >= 3  # a header, landmarks and the camera


@pytest.mark.parametrize("batch", [0, 5, 1 << 31])
def test_refined_depths_are_predicted_from_measured_ones(batch: int) -> None:
    records = flight(5)
    values = coded(records)
    landmarks = next(r for r in records if isinstance(r, NewLandmarks))
    rng = np.random.default_rng(1)
    depths = RefinedLandmarks(
        landmarks.keyframe, landmarks.index,
        landmarks.inv_depth * rng.normal(1, 0.004, len(landmarks.index)).astype(np.float32),
        rng.normal(0, 0.2, (len(landmarks.index), 2)).astype(np.float32), batch,
    )  # fmt: skip
    key, code = messages.key(depths), messages.encode(depths)
    form = ResidualCoder().compress(key, code, values.get, values.get)
    assert ResidualCoder().expand(key, form, values.get) == code
    assert len(form) < 0.85 * len(code)
    with pytest.raises(WireError, match="not held"):
        ResidualCoder().expand(key, form, {}.get)


@given(st.sampled_from([4, 5, 16, 17]), st.binary(max_size=120))
def test_any_bytes_are_a_code_or_an_error(kind: int, data: bytes) -> None:
    key = Key(kind, keyframe_id(SUBMAP, 3), 0)
    with pytest.raises(WireError):
        ResidualCoder().expand(key, data, coded(flight(0, landmarks=10)).get)


def test_landmarks_are_selected_by_keypoint_and_part() -> None:
    rng = np.random.default_rng(4)
    landmarks = rng.integers(0, 100, (5, 1200)).astype(np.int32)
    landmarks[4] = rng.integers(-1, 4, 1200)
    keypoint, mask = rng.integers(0, 2048, 300), 0b101
    out = np.full((4, 300), -7, np.int64)
    prediction_kernels.select(landmarks, keypoint, mask, 0, out)
    whole = np.pad(landmarks, ((0, 0), (0, 2048 - 1200)), constant_values=-1)
    named = np.isin(whole[4, keypoint], (0, 2))
    assert np.array_equal(out, np.where(named, whole[:4, keypoint], -7))
    assert predictors.parts_at(landmarks, keypoint) | {-1} == set(whole[4, keypoint].tolist()) | {-1}


def test_decoded_landmarks_take_memory_up_to_the_last_keypoint_only() -> None:
    held = coded(flight(0, landmarks=10)).get
    versions, landmarks = predictors.Predictors().landmarks(keyframe_id(SUBMAP, 0), held)
    assert versions and landmarks.nbytes <= 5 * 4 * (int(np.flatnonzero(landmarks[4] >= 0).max()) + 1)


def test_predicted_codes_are_those_of_plain_arithmetic() -> None:
    rng = np.random.default_rng(3)
    n = 200
    u, v = rng.integers(1024, 10000, n), rng.integers(1024, 8000, n)
    depth = rng.integers(0, quantise.DEPTH_CODES, n)
    T = se3.exp(np.array([0.3, -0.1, 0.2, 0.05, -0.02, 0.1]))
    out = np.empty((3, n), np.int64)
    camera = np.array([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy])
    prediction_kernels.predict(np.stack([u, v, depth]), np.zeros(n, np.int64), T[None], camera, out)
    uv, rho = quantise.pixels(np.stack([u, v])).astype(np.float64), quantise.inverse_depths(depth).astype(np.float64)
    ray = np.stack([(uv[:, 0] - CAMERA.cx) / CAMERA.fx, (uv[:, 1] - CAMERA.cy) / CAMERA.fy, np.ones(n)], 1)
    p = ray @ T[:3, :3].T + rho[:, None] * T[:3, 3]
    assert (out[0] >= 0).sum() > n // 2
    for i in range(n):
        if out[0, i] < 0:
            outside = p[i, 2] < 0.051 or not (-64 <= p[i, 0] / p[i, 2] * CAMERA.fx + CAMERA.cx < 4032)
            below = not (-64 <= p[i, 1] / p[i, 2] * CAMERA.fy + CAMERA.cy < 4032) if not outside else True
            assert depth[i] == 0 or outside or below
            continue
        expected = quantise.pixel_codes(
            np.array([[p[i, 0] / p[i, 2] * CAMERA.fx + CAMERA.cx, p[i, 1] / p[i, 2] * CAMERA.fy + CAMERA.cy]])
        )[:, 0]
        assert np.abs(out[:2, i] - expected).max() <= 1
        code = quantise.inverse_depth_codes(np.array([rho[i] / p[i, 2]], np.float32))[0]
        assert abs(int(out[2, i]) - int(code)) <= 1


def test_the_motion_of_a_header_is_inverted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The poses of ten keyframes are composed for each keyframe that is sent, from the same headers again and again."""
    invert, inverted = prediction_kernels.invert, list[int]()
    monkeypatch.setattr(prediction_kernels, "invert", lambda a, out: inverted.append(1) or invert(a, out))  # type: ignore[func-returns-value]
    records = flight(3, keyframes=8)
    values, coder, sizes = coded(records), ResidualCoder(), list[int]()
    for key, (_, code) in values.items():
        if key.kind == Observations.KIND:
            form = coder.compress(key, code, values.get, values.get)
            sizes.append(len(code if form is None else form))
    assert len(sizes) == 8 and 0 < len(inverted) <= 8


def test_a_keyframe_is_compressed_quickly() -> None:
    records = flight(4, keyframes=10, landmarks=160)
    values = coded(records)
    last = [r for r in records if getattr(r, "keyframe", None) == keyframe_id(SUBMAP, 9)]
    a, b = ResidualCoder(), ResidualCoder()
    best = 1e9
    for _ in range(4):
        start = time.process_time()
        for r in last:
            key, code = messages.key(r), values[messages.key(r)][1]
            form = a.compress(key, code, values.get, values.get)
            assert form is None or b.expand(key, form, values.get) == code
        best = min(best, time.process_time() - start)
    assert best < 0.008 * slowness()  # typically 1.5 ms


@given(st.integers(0, 10_000), st.sampled_from([0.0, 0.1, 0.4]))
def test_endpoints_agree_whatever_is_lost(seed: int, loss: float) -> None:
    """Each keyframe's sections are put as it comes, over a link that loses and delays; both ends hold the same."""
    draw = random.Random(seed)
    config = SyncConfig(packet_bytes=400, overhead_bytes=10, budget_bytes=draw.choice([None, 3000]))
    a, b = (Endpoint(config, 1, coder=ResidualCoder()) for _ in range(2))
    wire: list[tuple[int, int, bytes]] = []
    now_ns, waiting = 0, flight(seed, landmarks=24)
    while waiting or not (a.digest_equal and b.digest_equal):
        assert now_ns < 200 * 10**9
        now_ns += 50_000_000
        if waiting and draw.random() < 0.3:
            for record in waiting[:4]:
                a.put(messages.key(record), messages.encode(record))
            del waiting[:4]
        for to, end in ((1, a), (0, b)):
            while (packet := end.poll(now_ns)) is not None:
                if draw.random() >= loss:
                    wire.append((now_ns + draw.randrange(1, 200_000_000), to, packet))
        for due in sorted(w for w in wire if w[0] <= now_ns):
            (a, b)[due[1]].receive(due[2], now_ns)
        wire = [w for w in wire if w[0] > now_ns]
    assert b.peer_values() == a.own_values()
    assert b.stats.mismatches == 0
    assert not loss or b.stats.rejected <= a.stats.packets_sent // 4


def test_a_refused_residual_code_is_followed_by_the_code_itself() -> None:
    """A receiver that lost predictors gets the code itself once the sender has noticed."""
    config = SyncConfig(overhead_bytes=0)
    a, b = (Endpoint(config, 1, coder=ResidualCoder()) for _ in range(2))
    records = flight(3)
    now_ns = 0

    def run(ms: int) -> None:
        nonlocal now_ns
        for _ in range(ms // 10):
            now_ns += 10_000_000
            for end, other in ((a, b), (b, a)):
                while (packet := end.poll(now_ns)) is not None:
                    other.receive(packet, now_ns)

    for record in records[:-1]:
        a.put(messages.key(record), messages.encode(record))
    run(2000)
    for key in [k for k in b.received.present._values if k.kind == NewLandmarks.KIND]:
        version, code = b.received.present._values[key]
        b.received.present._values[key] = (version + 1000, code)  # as if they were other versions
    a.put(messages.key(records[-1]), messages.encode(records[-1]))
    run(3000)
    assert b.stats.rejected >= 1
    assert "other values" in b.stats.reasons[0][0] or "not held" in b.stats.reasons[0][0]
    assert b.peer_values()[messages.key(records[-1])] == messages.encode(records[-1])
