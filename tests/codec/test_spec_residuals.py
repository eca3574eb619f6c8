"""A second reader of residual codes, written from codec/SPEC.md in plain Python, reads what the codec writes."""

import struct
from collections.abc import Callable
from math import floor
from typing import Any
from zlib import crc32

import numpy as np
import pytest

from kiteline_codec.residuals.residual_coding import ResidualCoder
from kiteline_codec.schema import CameraIntrinsics, Key, KeyframeHeader, NewLandmarks, Observations, messages
from tests.codec.residuals.coded_flights import coded, flight
from tests.codec.second_reader import Source, residual_columns, varint

Rows = list[list[int]]


def ungap(gaps: list[int]) -> list[int]:
    out, last = [], -1
    for g in gaps:
        last += g + 1
        out.append(last)
    return out


def product(a: Rows, b: Any) -> Any:
    out = [[a[i][0] * b[0][j] + a[i][1] * b[1][j] + a[i][2] * b[2][j] for j in range(4)] for i in range(3)]
    return [[*row[:3], row[3] + a[i][3]] for i, row in enumerate(out)]


def inverse(a: Any) -> Any:
    return [[a[0][i], a[1][i], a[2][i], -(a[0][i] * a[0][3] + a[1][i] * a[1][3] + a[2][i] * a[2][3])] for i in range(3)]


def predict(landmark: list[int], T: Any, camera: Any) -> list[int] | None:
    u, v, code = landmark[:3]
    if not code:
        return None
    e, m = divmod(code, 1024)
    r = ((1024 + m) * 2**e / 1024 - 1) / 128
    x, y = (u / 16 - 64 - camera.cx) / camera.fx, (v / 16 - 64 - camera.cy) / camera.fy
    p = [T[i][0] * x + T[i][1] * y + T[i][2] + T[i][3] * r for i in range(3)]
    if not p[2] > 0.05:
        return None
    a = floor((p[0] / p[2] * camera.fx + camera.cx + 64) * 16 + 0.5)
    b = floor((p[1] / p[2] * camera.fy + camera.cy + 64) * 16 + 0.5)
    if not (0 <= a < 65536 and 0 <= b < 65536):
        return None
    w, e = r / p[2] / 0.0078125 + 1, 0
    while w >= 2 and e < 13:
        w, e = w / 2, e + 1
    return [a, b, min(max(1024 * e + floor((w - 1) * 1024 + 0.5), 1), 13311)]


def read_observations(key: Key, form: bytes, values: Any) -> tuple[dict[str, list[int]], list[int], Any]:
    """Columns, versions used, and the source before its checksum."""
    s = Source(form)
    n, step = s.varint(), s.varint()
    records = {k: messages.decode(k, code) for k, (_, code) in values.items()}
    heads = {
        k.id: (values[k][0], r.parent, r.T_p_k.tolist()) for k, r in records.items() if isinstance(r, KeyframeHeader)
    }
    if step:
        heads[key.id] = (0, key.id - step, s.pose())
    table, last = [], key.id
    for _ in range(s.varint()):
        last -= s.varint()
        table.insert(0, last)
    counts, masks = residual_columns(s, 2, len(table))
    gaps = residual_columns(s, 1, n)[0]
    points, landmarks, used, octave = [], [], [], []
    for a, count, mask in zip(table, counts, masks, strict=True):
        known: dict[int, list[int]] = {}
        for part in range(mask.bit_length()):
            if mask >> part & 1:
                version, code = values[Key(4, a, part)]
                b = Source(code)
                columns = b.columns(6, b.varint())
                known |= {i: [u, v, d, o] for i, u, v, d, o, _ in zip(*columns, strict=True)}
                used.append(version)
        for keypoint in ungap(gaps[len(points) : len(points) + count]):
            points.append(a << 11 | keypoint)
            landmarks.append((a, known.get(keypoint)))
    ways: dict[int, Any] = {}
    on_way: dict[int, int] = {}
    for a in [a for a, mask in zip(table, masks, strict=True) if mask]:
        up = [key.id]
        while up[-1] in heads and heads[up[-1]][1] >= 0:
            up.append(heads[up[-1]][1])
        down = [a]
        while down[-1] not in up:
            down.append(heads[down[-1]][1])
        above = up[: up.index(down[-1])]
        T: Any = np.eye(4).tolist()
        for k in above:
            T = product(T, inverse(heads[k][2]))
        for k in reversed(down[:-1]):
            T = product(T, heads[k][2])
        ways[a] = T
        on_way |= {k: heads[k][0] for k in above + down[:-1]}
    if ways:
        used += [on_way[k] for k in sorted(on_way)]
        used.append(next(v for k, (v, _) in values.items() if k.kind == CameraIntrinsics.KIND))
    camera = next(r.camera for r in records.values() if isinstance(r, CameraIntrinsics))
    seen = [predict(b, ways[a], camera) if b else None for a, b in landmarks]
    steps = s.u8()
    su, sd = steps >> 4, steps & 15
    index, octave = residual_columns(s, 2, n)
    near = residual_columns(s, 3, sum(x is not None for x in seen))
    far = residual_columns(s, 3, sum(x is None for x in seen))
    rows = []
    i = j = 0
    for x in seen:
        if x is None:
            rows.append([far[c][j] for c in range(3)])
            j += 1
            continue
        z = near[2][i] - 1
        depth = 0 if z < 0 else ((-(z + 1) // 2 if z % 2 else z // 2) + (x[2] >> sd)) << sd
        rows.append([(near[0][i] + (x[0] >> su)) << su, (near[1][i] + (x[1] >> su)) << su, depth])
        i += 1
    columns = {
        "index": [k + v for k, v in enumerate(index)],
        "u": [r[0] for r in rows], "v": [r[1] for r in rows], "depth": [r[2] for r in rows],
        "octave": [o + (b[3] if b else 0) for o, (_, b) in zip(octave, landmarks, strict=True)], "point": points,
    }  # fmt: skip
    return columns, used, s


@pytest.mark.parametrize("held", [lambda key: True, lambda key: key.kind != KeyframeHeader.KIND or key.id % 64 < 5])
def test_observations(held: Callable[[Key], bool]) -> None:
    values = coded(flight(7, keyframes=6, landmarks=40))
    compared = 0
    for key, (_, code) in values.items():
        if key.kind != Observations.KIND:
            continue
        known = {k: v for k, v in values.items() if held(k)}
        form = ResidualCoder().compress(key, code, known.get, values.get)
        if form is None:
            continue
        columns, used, s = read_observations(key, form, known)
        record = messages.decode(key, code)
        assert isinstance(record, Observations)
        n = Source(code).varint()
        plain = Source(code[len(varint(n)) :]).columns(5, n)
        assert [columns[c] for c in ("index", "u", "v", "depth", "octave")] == plain
        assert columns["point"] == record.point.tolist()
        checksum = crc32(code + b"".join(struct.pack("<q", v) for v in used))
        assert s.raw(4) == checksum.to_bytes(4, "little")
        assert s.at == len(form)
        compared += len(columns["index"])
    assert compared > 200


def test_new_landmarks() -> None:
    values = coded(flight(7, keyframes=1, landmarks=40))
    landmarks = {key: code for key, (_, code) in values.items() if key.kind == NewLandmarks.KIND}
    assert landmarks
    for key, code in landmarks.items():
        form = ResidualCoder().compress(key, code, {}.get, {}.get)
        assert form is not None
        s = Source(form)
        head = s.varint()
        n, size = head // 4, (0, 16, 32)[head % 4]
        columns = residual_columns(s, 6, n)
        plain = Source(code)
        assert plain.varint() == n
        assert [ungap(columns[0]), *columns[1:]] == plain.columns(6, n)
        assert s.raw(size * n) == plain.raw(size * n)
        assert s.raw(4) == crc32(code).to_bytes(4, "little")
