"""A second reader of the codec's bytes, written from codec/SPEC.md alone in plain Python."""

import struct
from math import sqrt
from pathlib import Path
from typing import Any

import numpy as np

from kiteline_core.geometry import se3


class Source:
    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def raw(self, n: int) -> bytes:
        self.at += n
        assert self.at <= len(self.data)
        return self.data[self.at - n : self.at]

    def u8(self) -> int:
        return self.raw(1)[0]

    def varint(self) -> int:
        value = shift = 0
        while True:
            b = self.u8()
            value |= (b & 127) << shift
            shift += 7
            if b < 128:
                return value

    def signed(self) -> int:
        z = self.varint()
        return -(z + 1) // 2 if z % 2 else z // 2

    def batch(self) -> int:
        return self.varint() if self.at < len(self.data) else 0

    def columns(self, c: int, n: int) -> list[list[int]]:
        if not n:
            return [[] for _ in range(c)]
        heads = []
        for _ in range(c):
            head = self.u8()
            mode, width = head >> 6, head & 63
            heads.append((mode, width, self.signed(), self.signed() if mode else 0))
        bits = sum(w * (n - m) for m, w, _, _ in heads)
        stream = int.from_bytes(self.raw((bits + 7) // 8), "little")
        out = []
        for mode, width, first, step in heads:
            column = [first] if mode else []
            while len(column) < n:
                number = stream % (1 << width)
                stream >>= width
                column.append(column[-1] + step + number if mode else first + number)
            out.append(column)
        assert stream == 0
        return out

    def pose(self, per_m: int = 10_000, per_rotation: int = 1 << 19) -> list[list[float]]:
        t = [self.signed() / per_m for _ in range(3)]
        s = [self.signed() / per_rotation for _ in range(3)]
        ss = sum(c * c for c in s)
        w, x, y, z = (1 - ss) / (1 + ss), *(2 * c / (1 + ss) for c in s)
        assert abs(sqrt(w * w + x * x + y * y + z * z) - 1) < 1e-12
        return [[float(v) for v in row] for row in se3.from_quaternion(np.array([w, x, y, z]), np.array(t))]


def residual_columns(s: Source, c: int, n: int) -> list[list[int]]:
    if not n:
        return [[] for _ in range(c)]
    heads = []
    for _ in range(c):
        first, start = s.u8(), s.u8()
        heads.append((first >> 3, first & 7, start, 0 if first >> 3 == 3 else s.signed()))
    bits = 8 * s.at

    def bit() -> int:
        nonlocal bits
        bits += 1
        return s.data[(bits - 1) >> 3] >> ((bits - 1) & 7) & 1

    def number(width: int) -> int:
        return sum(bit() << i for i in range(width))

    out = []
    for mode, shift, start, first in heads:
        total, count, column = 1 << start, 1, []
        for j in range(n):
            if mode == 2 and j == 0:
                column.append(first)
                continue
            if mode == 0:
                column.append(first + number(start))
                continue
            k = next((k for k in range(15) if count << k >= total), 15)
            q = 0
            while q < 20 and bit():
                q += 1
            v = (q << k) + number(k) if q < 20 else number(32)
            total, count = total + v, count + 1
            if count == 16:
                total, count = total // 2, 8
            z = -(v + 1) // 2 if v % 2 else v // 2
            column.append({1: first + v, 2: column[-1] + z if column else 0, 3: z}[mode])
        out.append([v << shift for v in column])
    s.at = (bits + 7) // 8
    return out


def ranges(codes: list[int]) -> list[float]:
    return [2 * ((1 + code % 128 / 128) * 2 ** (code // 128) - 1) for code in codes]


def direction(half: int, p: float, q: float) -> list[float]:
    ss = p * p + q * q
    return [2 * p / (1 + ss), (1 if half else -1) * (1 - ss) / (1 + ss), 2 * q / (1 + ss)]


def inverse_depth(code: int) -> float:
    e, m = divmod(code, 1024)
    return float(((1 + m / 1024) * 2**e - 1) / 128)


def deviation(code: int) -> float:
    return (8 + code % 8) * 2.0 ** (code // 8 - 20) if code else 0.0


def points(s: Source, n: int) -> list[int]:
    table, last = [], 0
    for _ in range(s.varint() if n else 0):
        last += s.varint()
        table.append(last)
    place, keypoint = s.columns(2, n)
    return [(table[p] << 11) + k for p, k in zip(place, keypoint, strict=True)]


class Decisions:
    """Reads decisions from a code."""

    def __init__(self, data: bytes, first: list[int], rate: int) -> None:
        self.data, self.p, self.r = data, first, [rate] * len(first)
        self.at, self.size, self.number = 4, 2**32 - 1, int.from_bytes(data[:4].ljust(4, b"\0"), "big")

    def __call__(self, context: int) -> int:
        p, r = self.p, self.r
        bit = self._take((self.size >> 12) * p[context])
        p[context] += -(p[context] >> r[context]) if bit else (4096 - p[context]) >> r[context]
        p[context] = min(max(p[context], 32), 4064)
        r[context] = min(r[context] + 1, 5)
        return bit

    def even(self) -> int:
        return self._take(self.size >> 1)

    def _take(self, bound: int) -> int:
        bit = int(self.number >= bound)
        self.number, self.size = (self.number - bound, self.size - bound) if bit else (self.number, bound)
        while self.size < 2**24:
            byte = self.data[self.at] if self.at < len(self.data) else 0
            self.number, self.size, self.at = self.number << 8 | byte, self.size << 8, self.at + 1
        return bit

    def difference(self, c: int) -> int:
        bits = 0
        while bits < 10 and self(c + min(bits, 7)):
            bits += 1
        if not bits:
            return 0
        negative, size = self.even(), 1
        for _ in range(bits - 1):
            size = 2 * size + self.even()
        return -size if negative else size


def scan(data: bytes, n: int, m: int) -> tuple[dict[str, list[int]], list[int]]:
    """Rows of codes by name, and labels."""
    text = (Path(__file__).parents[2] / "codec" / "SPEC.md").read_text()
    numbers = text.split("p is 64 times: ")[1].split(".")[0]
    decide = Decisions(data, [64 * int(v) for v in numbers.split(",")], 3)
    out: dict[str, list[int]] = {name: [] for name in ("obstacle", "clear", "free", "from", "bands")}
    flags = {0: 1, 15: 1, 17: 1, 19: 1, 21: 0}
    mask, before = 0, {"obstacle": (0, 0), "clear": (0, 0), "free": (0, 0), "from": (0, 0)}

    def flag(context: int) -> int:
        flags[context] = decide(context + flags[context])
        return flags[context]

    def of(name: str) -> int:
        last, step = before[name]
        step = decide.difference(39 if name == "from" else 31 if abs(step) >= 4 else 23)
        before[name] = last + step, step
        return last + step

    for _ in range(n):
        if flag(0):
            bits, node = [decide(2 + k) for k in range(5)], 1
            for _ in range(3):
                node = 2 * node + decide(7 + node)
            mask = sum(bit << 7 - k for k, bit in enumerate(bits)) + node - 8
        row = {"bands": mask, "obstacle": of("obstacle") if mask else 0, "clear": 0, "free": 0, "from": 0}
        for name, absent, other in (("clear", 15, 17), ("free", 19, 21)):
            if not flag(absent):
                differs = flag(other) if mask else 1
                row[name] = of(name) if differs else row["obstacle"]
                before[name] = row[name], before[name][1]
        if row["free"]:
            row["from"] = of("from")
        for name, value in row.items():
            out[name].append(value)
    labels = [0, 0]
    for _ in range(m):
        one, two = labels[-1], labels[-2]
        labels.append((one + 1 + decide(56 + one)) % 3 if decide(47 + 3 * one + two) else one)
    return out, labels[2:]


def cells(data: bytes) -> list[int]:
    out: list[int] = []
    decide = Decisions(data, [2048] * 226, 1)
    for i in range(4096):
        row, column = divmod(i, 64)
        places = [(row, column - 1), (row - 1, column), (row - 1, column - 1), (row - 1, column + 1)]
        near = [out[64 * a + b] if a >= 0 and 0 <= b < 64 else -1 for a, b in places]
        w, s, sw, se = (min(max(v, -1), 1) + 1 for v in near)
        c = 27 * w + 9 * s + 3 * sw + se
        if not decide(c):
            out.append(-1)
        elif not decide(81 + c):
            out.append(0)
        else:
            base, node = 162 + 8 * next((v for v in near if v > 0), 0), 1
            for _ in range(3):
                node = 2 * node + decide(base + node)
            out.append(node - 8)
    return out


def read_code(kind: int, id_: int, data: bytes, part: int = 0) -> dict[str, Any]:
    s = Source(data)
    out: dict[str, Any] = {}
    if kind == 1:
        out["size"] = (s.varint(), s.varint())
        out["floats"] = struct.unpack("<5d", s.raw(40))
        out["stereo"] = s.u8()
        out["T_b_c"] = np.reshape(struct.unpack("<12d", s.raw(96)), (3, 4)).tolist()
    elif kind == 2:
        out["t_ns"], out["keyframe"], out["T_k_c"], out["quality"] = s.varint(), s.varint() - 1, s.pose(), s.signed()
    elif kind == 3:
        out["t_ns"] = s.varint()
        z = s.varint() - 1
        out["parent"] = -1 if z < 0 else id_ - (-(z + 1) // 2 if z % 2 else z // 2)
        out["T_p_k"], out["keypoints"] = s.pose(), s.varint()
        if s.at < len(data):
            half, sigma = divmod(s.u8(), 128)
            out["up"] = direction(half, s.signed() / 8191, s.signed() / 8191)
            out["up_rad"] = deviation(sigma)
    elif kind in (6, 16):
        out[{6: "T_l_m", 16: "T_m_k"}[kind]] = s.pose()
        if kind == 16:
            out["batch"] = s.batch()
    elif kind == 7:
        out["metres"] = struct.unpack("<f", s.raw(4))[0]
    elif kind == 8:
        out["since"], out["noise"], n = id_ - s.varint(), s.varint() / 1e6, s.varint()
        c = np.array(s.columns(13, n), float).T
        out["dt_s"], v = c[:, 0] / 10000, c[:, 7:10] / 4096
        out["turn"], out["moved"], out["velocity"] = c[:, 1:4] / 2**14, c[:, 4:7] / 2**13, v
        out["position"] = c[:, 10:] / 2**15 + v * out["dt_s"][:, None] / 2
    elif kind == 9:
        flags = s.u8()
        out["rows_read"], out["good_calibration"] = bool(flags & 1), bool(flags & 2)
        out["rows_px"], out["disparity_px"] = ([s.signed() / 1024 for _ in range(5)] for _ in range(2))
        out["sigma_px"] = s.varint() / 1024 or None
    elif kind == 10:
        out["since"], out["T_k_f"] = s.varint(), s.pose()
        out["sigma_m"], out["sigma_rad"] = deviation(s.u8()), deviation(s.u8())
    elif kind == 11:
        if part:
            out["T_k_s"], out["up_c"] = s.pose(256, 1 << 10), [0.0, -1.0, 0.0]
        else:
            out["up_c"] = direction(s.u8(), s.signed() / 8191, s.signed() / 8191)
        out["azimuth0_rad"], out["azimuth_step_rad"], z = s.signed() / 2**12, s.varint() / 2**18, s.varint() - 1
        out["camera_height_m"] = float("nan") if z < 0 else (-(z + 1) // 2 if z % 2 else z // 2) / 256
        n, m = s.varint(), s.varint()
        rows, out["labels"] = scan(s.raw(len(data) - s.at), n, m)
        step = 2 if part else 1
        out["obstacle_m"] = [r or float("inf") for r in ranges([step * c for c in rows["obstacle"]])]
        out["free_m"] = ranges([step * c for c in rows["free"]])
        out["clear_m"], out["bands"] = ranges(rows["clear"]), rows["bands"]
        out["free_from_m"] = ranges([2 * c for c in rows["from"]])
    elif kind == 12:
        out["T_o_c"], out["stretch"] = s.pose(), s.varint()
        out["up_c"] = direction(s.u8(), s.signed() / 8191, s.signed() / 8191)
        if part:
            out["T_k_s"] = s.pose()
        out["images"] = list(s.raw(len(data) - s.at))
    elif kind == 21:
        scale = struct.unpack("<f", s.raw(4))[0]
        S = np.array(s.pose())
        S[:3, :3] *= scale
        out["S_w_m"] = S
        flags = s.u8() if s.at < len(data) else 0
        e, m = divmod(flags >> 1, 8)
        out["recognised"] = bool(flags & 1)
        out["scale_sigma"] = (8 + m) * 2.0 ** (e - 20) if flags >> 1 else 0.0
        out["batch"] = s.batch()
    elif kind == 23:
        out["submap"] = s.varint()
        out["T_m_k"] = s.pose()
    elif kind == 25:
        out["disparity_px"] = [s.signed() / 1024 for _ in range(5)]
        out["sigma_px"] = s.varint() / 1024 or None
        out["batch"] = s.batch()
    elif kind == 26:
        out["number"], out["members"] = s.varint(), s.varint()
        out["keys"] = int.from_bytes(s.raw(4), "little") if out["members"] else 0
    elif kind == 22:
        out["cell_m"] = s.varint() / 10_000
        out["cells"] = cells(s.raw(len(data) - s.at))
    else:
        n = s.varint()
        names = {
            4: ("index", "u", "v", "inv_depth", "octave", "angle"),
            5: ("index", "u", "v", "inv_depth", "octave"),
            17: ("index", "inv_depth", "du", "dv"),
            24: ("index", "u", "v", "inv_depth", "octave", "angle"),
        }.get(kind, ("index",))
        columns = dict(zip(names, s.columns(len(names), n), strict=True))
        out["index"] = columns["index"]
        for name in ("octave", "angle"):
            if name in columns:
                out[name] = columns[name]
        if "u" in columns:
            out["uv"] = [[u / 16 - 64, v / 16 - 64] for u, v in zip(columns["u"], columns["v"], strict=True)]
        if "du" in columns:
            out["offset"] = [[u / 32, v / 32] for u, v in zip(columns["du"], columns["dv"], strict=True)]
        if "inv_depth" in columns:
            out["inv_depth"] = [inverse_depth(c) for c in columns["inv_depth"]]
        if kind in (4, 24):
            out["descriptor"] = np.frombuffer(s.raw(32 * n), np.uint8).reshape(n, 32).tolist()
        if kind in (5, 18):
            out["point"] = points(s, n)
        if kind == 20:
            out["keyframe_too"] = s.u8()
        if kind == 17:
            out["batch"] = s.batch()
    assert s.at == len(data)
    return out


def varint(value: int) -> bytes:
    out = b""
    while value > 127:
        out += bytes([value % 128 + 128])
        value //= 128
    return out + bytes([value])
