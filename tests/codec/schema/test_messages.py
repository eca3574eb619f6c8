"""Records: fixed bytes, round trips, damage, what a keyframe costs, and records in a log."""

import json
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_codec.pacing import sections
from kiteline_codec.schema import (
    RECORD_TYPES,
    GridTile,
    Key,
    KeyframeHeader,
    KeyframePose,
    KeyframeScan,
    LivePose,
    NewLandmarks,
    Observations,
    RemovedObservations,
    StereoAlignment,
    SubmapPlacement,
    WireError,
    messages,
)
from kiteline_codec.schema.record_log import read_record, write_record
from kiteline_core.geometry import se3
from kiteline_core.ground.column_scan import ColumnScan, level_rotation
from kiteline_core.ids import AgentId, KeyframeId, SubmapId, keyframe_id, submap_id
from tests.codec.schema.some_records import a_scan, assert_same, some_cells, some_records
from tests.yardstick import slowness

GOLDEN = Path(__file__).parents[1] / "golden" / "records.json"


def test_golden_bytes() -> None:
    """The format does not change unnoticed; with a new one, PROTOCOL_VERSION rises and the file is written anew."""
    golden = json.loads(GOLDEN.read_text())
    records = some_records(1, 3)
    assert len(golden) == len(records)
    for entry, record in zip(golden, records, strict=True):
        key = Key(*entry["key"])
        assert key == messages.key(record)
        assert messages.encode(record).hex() == entry["code"], type(record).__name__
        assert_same(messages.decode(key, bytes.fromhex(entry["code"])), messages.decode(key, messages.encode(record)))


def test_every_kind_is_covered() -> None:
    assert {messages.key(r).kind for r in some_records(0, 1)} == set(RECORD_TYPES)


@given(st.integers(0, 1 << 30), st.integers(0, 60))
def test_decoding_gives_what_encodes_to_the_same_code(seed: int, n: int) -> None:
    for record in some_records(seed, n):
        key, code = messages.key(record), messages.encode(record)
        decoded = messages.decode(key, code)
        assert messages.key(decoded) == key
        assert messages.encode(decoded) == code
        assert_same(messages.decode(key, code), decoded)
        exact = (
            "index",
            "octave",
            "angle",
            "descriptor",
            "point",
            "t_ns",
            "quality",
            "parent",
            "keypoints",
            "batch",
            "images",
        )
        for name in exact:
            if hasattr(record, name):
                assert np.array_equal(getattr(record, name), getattr(decoded, name)), name
        if isinstance(record, NewLandmarks | Observations):
            assert isinstance(decoded, NewLandmarks | Observations)
            assert np.abs(record.uv - decoded.uv).max(initial=0.0) <= 1 / 32 + 1e-4


@given(st.sampled_from(sorted(RECORD_TYPES)), st.integers(-1, 1 << 60), st.integers(0, 300), st.binary(max_size=200))
def test_any_bytes_are_a_record_or_an_error(kind: int, id_: int, part: int, code: bytes) -> None:
    try:
        record = messages.decode(Key(kind, id_, part), code)
    except WireError:
        return
    messages.encode(record)


@given(st.integers(0, 1000), st.integers(1, 12), st.data())
def test_damaged_codes_are_a_record_or_an_error(seed: int, n: int, data: st.DataObject) -> None:
    record = data.draw(st.sampled_from(some_records(seed, n)))
    code = bytearray(messages.encode(record))
    for _ in range(data.draw(st.integers(1, 4))):
        code[data.draw(st.integers(0, len(code) - 1))] = data.draw(st.integers(0, 255))
    code = code[: data.draw(st.integers(0, len(code)))]
    try:
        decoded = messages.decode(messages.key(record), bytes(code))
    except WireError:
        return
    again = messages.encode(decoded)
    assert messages.encode(messages.decode(messages.key(record), again)) == again


def test_errors_say_what_was_expected() -> None:
    with pytest.raises(WireError, match="kind 15 is unknown"):
        messages.decode(Key(15, 0), b"")
    with pytest.raises(WireError, match="out of range"):
        messages.decode(Key(LivePose.KIND, 256), b"")
    pose = messages.encode(KeyframePose(KeyframeId(1), np.eye(4)))
    with pytest.raises(WireError, match="1 bytes too many"):
        messages.decode(Key(KeyframePose.KIND, 1), pose + b"\1\1")
    with pytest.raises(ValueError, match="indices must increase"):
        messages.encode(RemovedObservations(KeyframeId(1), np.array([2, 2], np.uint16)))
    with pytest.raises(ValueError, match="rigid motion"):
        messages.encode(SubmapPlacement(SubmapId(1), np.zeros((4, 4))))
    landmarks = some_records(0, 3)[5]
    assert isinstance(landmarks, NewLandmarks)
    with pytest.raises(ValueError, match="descriptors"):
        messages.encode(replace(landmarks, descriptor=landmarks.descriptor[:2]))
    tile = next(r for r in some_records(0, 1) if isinstance(r, GridTile))
    code = messages.encode(tile)
    with pytest.raises(WireError, match="shortest code"):
        messages.decode(messages.key(tile), code + b"\0")
    with pytest.raises(WireError, match="has a size"):
        messages.decode(messages.key(tile), b"\0" + code[2:])
    for wrong in (
        replace(tile, cells=tile.cells[:32]),
        replace(tile, cells=tile.cells + np.int8(3)),
        replace(tile, cell_m=0.0),
    ):
        with pytest.raises(ValueError, match=r"a tile is|cells are|a cell has"):
            messages.encode(wrong)
    with pytest.raises(ValueError, match="storey"):
        messages.key(replace(tile, storey=128))
    rig = next(r for r in some_records(0, 1) if isinstance(r, StereoAlignment))
    code = messages.encode(rig)
    with pytest.raises(WireError, match="two flags are 0 to 3, found 4"):
        messages.decode(messages.key(rig), b"\4" + code[1:])


@given(st.integers(0, 1 << 30), st.integers(1, 64), st.sampled_from([0.0, 0.01, 0.3, 1.0]))
def test_tiles_of_any_cells_pass_and_plain_ones_are_short(seed: int, patch: int, noise: float) -> None:
    rng = np.random.default_rng(seed)
    cells = some_cells(rng, patch)
    wild = rng.random((64, 64)) < noise
    cells[wild] = rng.integers(-1, 8, int(wild.sum()))
    tile = GridTile(int(rng.integers(-(1 << 23), 1 << 23)), 5, int(rng.integers(-128, 128)), 0.0001, cells)
    code = messages.encode(tile)
    assert_same(messages.decode(messages.key(tile), code), tile)
    assert len(code) <= 64 if patch == 64 and noise == 0.0 else len(code) < 2500


def test_a_tile_of_walls_and_frontiers_takes_a_hundred_bytes() -> None:
    x, y = np.arange(64)[None, :], np.arange(64)[:, None]
    cells = np.where(np.hypot(x - 20, y - 10) < 45, 0, -1).astype(np.int8)
    cells[np.abs(x + 0.3 * y - 40) < 1] = 7
    cells[30:34, 10:14] = 2
    assert len(messages.encode(GridTile(0, 0, 0, 0.05, cells))) < 100


def test_a_scan_is_rounded_by_no_more_than_the_specification_says() -> None:
    for seed in range(20):
        scan = a_scan(seed, 72)
        record = KeyframeScan(KeyframeId(5), scan, np.zeros(0, np.uint8))
        read = messages.decode(messages.key(record), messages.encode(record))
        assert isinstance(read, KeyframeScan)
        got = read.scan
        assert np.abs(got.up_c - scan.up_c).max() < 2e-4
        assert np.abs(got.azimuths_rad - scan.azimuths_rad).max() < 0.5 / (1 << 12) + 72 * 0.5 / (
            1 << 18
        )  # 1 mm at 4 m
        assert np.array_equal(got.bands, scan.bands)
        for name in ("free_m", "free_from_m", "obstacle_m", "clear_m"):
            told, held = getattr(scan, name), getattr(got, name)
            assert np.array_equal(told > 0.0, held > 0.0)
            assert np.array_equal(np.isinf(told), np.isinf(held))
            near = (told < 250.0) & (told > 0.02)
            up = 1.0 if name != "free_from_m" else 4.0  # where free ground begins is rounded up
            assert np.all(np.abs(held[near] - told[near]) <= (told[near] + 2.0) / 256.0 * up)
        assert np.all(got.free_from_m >= scan.free_from_m - (scan.free_from_m + 2.0) / 256.0)


def test_a_scan_between_keyframes_keeps_its_place_in_a_level_frame() -> None:
    """Rays, told by their direction and the camera's place in the keyframe, are within the errors of the code."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        scan = a_scan(seed, 72)
        T_k_s = se3.exp(np.concatenate([rng.normal(0.0, 1.0, 3), rng.normal(0.0, 0.6, 3)]))
        record = KeyframeScan(KeyframeId(5), scan, np.zeros(0, np.uint8), 1 + seed % 15, T_k_s)
        key, code = messages.key(record), messages.encode(record)
        read = messages.decode(key, code)
        assert isinstance(read, KeyframeScan) and read.T_k_s is not None and read.part == record.part == key.part
        assert messages.encode(read) == code
        assert np.array_equal(read.scan.up_c, [0.0, -1.0, 0.0])
        rotations = [T[:3, :3] @ level_rotation(s.up_c) for T, s in ((T_k_s, scan), (read.T_k_s, read.scan))]
        assert np.linalg.norm(se3.so3_log(rotations[0].T @ rotations[1])) < 3.4e-3
        assert np.abs(read.T_k_s[:3, 3] - T_k_s[:3, 3]).max() <= 0.5 / 256 + 1e-9
        seen = scan.bands > 0
        told, held = scan.obstacle_m[seen], read.scan.obstacle_m[seen]
        assert np.all(np.abs(held - told) <= 3.1 * (told + 2.0) / 256)
        known = scan.free_m > 0.05
        assert np.all(read.scan.free_m[known] <= scan.free_m[known] + (scan.free_m[known] + 2.0) / 256)
        assert np.all(read.scan.free_m >= read.scan.free_from_m) and not read.scan.clear_m.any()


def test_only_scans_of_later_frames_have_a_pose() -> None:
    scan, no_labels = a_scan(0, 8), np.zeros(0, np.uint8)
    for record in (
        KeyframeScan(KeyframeId(5), scan, no_labels, 1),
        KeyframeScan(KeyframeId(5), scan, no_labels, 0, np.eye(4)),
    ):
        with pytest.raises(ValueError, match="has a pose"):
            messages.encode(record)


def test_a_scan_of_a_room_is_short() -> None:
    """Walls and the floor before them, with noise of 2 cm: at most 170 bytes with the labels of 150 keypoints.

    40 of them are the labels, which are chance here; between keyframes a scan has 115 bytes.
    """
    rng = np.random.default_rng(3)
    azimuth = np.linspace(-0.7, 0.7, 72)
    wall = np.minimum(4.0 / np.cos(azimuth), 2.2 / np.maximum(np.abs(np.sin(azimuth)), 1e-3))
    wall[30:38] = 2.4
    obstacle = wall + rng.normal(0.0, 0.02, 72)
    free = np.where(np.arange(72) % 9 > 0, obstacle - 0.1 + rng.normal(0.0, 0.02, 72), 0.0)
    scan = ColumnScan(
        np.array([0.0, -0.8, -0.6]), -0.7, 1.4 / 71, np.where(free > 0.0, 1.3 / np.cos(azimuth), 0.0), free, obstacle,
        np.full(72, 7, np.uint8), obstacle + rng.normal(0.0, 0.02, 72), 1.5,
    )  # fmt: skip
    labels = rng.integers(0, 3, 150).astype(np.uint8)
    assert len(messages.encode(KeyframeScan(KeyframeId(5), scan, labels))) <= 170
    later = KeyframeScan(KeyframeId(5), scan, labels[:0], 1, se3.exp(np.full(6, 0.1)))
    assert len(messages.encode(later)) <= 115


def a_keyframe() -> tuple[KeyframeHeader, NewLandmarks, Observations]:
    """300 observations of landmarks of 12 keyframes and 180 new landmarks, in an image of 752x480 px.

    Indices as an agent assigns them: observations by landmark id, then new landmarks by image row.
    """
    rng = np.random.default_rng(5)
    submap = submap_id(2, 17, 1)
    keyframe = keyframe_id(submap, 240)

    def keypoints(n: int) -> dict[str, np.ndarray]:
        uv = rng.uniform(0, (752, 480), (n, 2))
        return {
            "uv": uv[np.argsort(uv[:, 1])].astype(np.float32),
            "inv_depth": rng.uniform(0.1, 0.6, n).astype(np.float32),
            "octave": rng.integers(0, 4, n).astype(np.uint8),
        }

    point = np.sort((keyframe - rng.integers(1, 13, 300)) << 11 | rng.integers(0, 480, 300))
    observations = Observations(keyframe, 0, np.arange(300, dtype=np.uint16), point=point, **keypoints(300))
    landmarks = NewLandmarks(
        keyframe, 0, np.arange(300, 480, dtype=np.uint16), angle=rng.integers(0, 256, 180).astype(np.uint8),
        descriptor=rng.integers(0, 256, (180, 32)).astype(np.uint8), **keypoints(180),
    )  # fmt: skip
    T_p_k = se3.exp(np.array([0.2, 0.01, 0.1, 0.02, 0.1, 0.01]))
    return (
        KeyframeHeader(keyframe, 1_700_000_000_123_456_789, KeyframeId(keyframe - 1), T_p_k, 480),
        landmarks,
        observations,
    )


def test_a_keyframe_is_short_and_its_sections_fit_packets() -> None:
    head, landmarks, observations = a_keyframe()
    value = np.random.default_rng(6).uniform(size=480)
    parts = sections.split(landmarks, value[:180]) + sections.split(observations, value[180:])
    sizes = [len(messages.encode(record)) for record in (head, *parts)]
    assert max(sizes) <= sections.SECTION_BYTES
    assert sum(sizes) <= 9500
    assert len(messages.encode(landmarks)) + len(messages.encode(observations)) <= 9100
    assert np.mean(sizes[1:]) > 700  # sections are no crumbs


@given(st.integers(0, 1000), st.integers(0, 200), st.integers(150, 3000))
def test_sections_hold_each_row_once_best_first(seed: int, n: int, section_bytes: int) -> None:
    landmarks = some_records(seed, n)[5]
    assert isinstance(landmarks, NewLandmarks)
    value = np.random.default_rng(seed).integers(0, 50, n).astype(np.float64)
    parts = sections.split(landmarks, value, section_bytes)
    assert [p.part for p in parts] == list(range(len(parts)))
    index = np.concatenate([p.index for p in parts] or [landmarks.index])
    assert np.array_equal(np.sort(index), landmarks.index)
    order = {int(i): float(v) for i, v in zip(landmarks.index, value, strict=True)}
    for a, b in pairwise(parts):
        assert min(order[int(i)] for i in a.index) >= max(order[int(i)] for i in b.index)
    for p in parts:
        assert len(messages.encode(p)) <= section_bytes
        rows = np.searchsorted(landmarks.index, p.index)
        assert np.array_equal(landmarks.descriptor[rows], p.descriptor)


def test_a_keyframe_is_coded_quickly() -> None:
    head, landmarks, observations = a_keyframe()
    best = 1e9
    for _ in range(5):
        start = time.process_time()
        for record in (head, landmarks, observations):
            messages.decode(messages.key(record), messages.encode(record))
        best = min(best, time.process_time() - start)
    assert best < 0.005 * slowness()  # typically 0.4 ms


def test_a_measured_record_is_coded_as_any_other() -> None:
    record: Any
    for record in some_records(5, 40):
        code = messages.encode(record)
        assert messages.length(record) == len(code)
        assert messages.encode(record) is messages.encode(record) == code
        assert messages.encode(replace(record)) == code


keys = st.builds(Key, st.integers(0, 255), st.integers(0, 2**62), st.integers(0, 65535))


@given(st.integers(0, 255).map(AgentId), keys, st.binary(max_size=40))
def test_what_was_written_is_read(agent: AgentId, key: Key, code: bytes) -> None:
    assert read_record(write_record(agent, key, code)) == (agent, key, code)


@given(st.binary(max_size=11))
def test_what_is_too_short_is_refused(noise: bytes) -> None:
    with pytest.raises(WireError):
        read_record(noise)
