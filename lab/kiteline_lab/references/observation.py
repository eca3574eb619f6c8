"""What a replay computed, in the form in which it is kept: facts, and a row for each frame or step."""

import hashlib
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True, slots=True)
class Row:
    """One frame or step. state: a word. numbers: nan where there is none. digests: one for each stage."""

    number: int
    t_s: float
    state: str
    numbers: tuple[float, ...]
    digests: tuple[str, ...]


@dataclass(slots=True)
class Half:
    """An agent or the base. facts: in the order of the file. stages: in the order of the data."""

    name: str
    unit: str  # what a row is: frame or step
    columns: tuple[str, ...]
    stages: tuple[str, ...]
    facts: dict[str, str] = field(default_factory=dict)
    rows: list[Row] = field(default_factory=list)


@dataclass(slots=True)
class Observation:
    """All halves of a kept flight. machine: libraries and CPU kernels that computed it."""

    name: str
    about: str
    machine: str
    halves: list[Half] = field(default_factory=list)


def digest(values: Iterable[object]) -> str:
    """Six hexadecimal digits of the exact values: arrays, bytes, numbers, words."""
    made = hashlib.blake2b(digest_size=3)
    for value in values:
        if isinstance(value, np.ndarray):
            made.update(f"{value.dtype.str}{value.shape}".encode() + np.ascontiguousarray(value).tobytes())
        elif isinstance(value, bytes):
            made.update(value)
        else:
            made.update(repr(value).encode())
        made.update(b"|")
    return made.hexdigest()


def add_digests(half: Half) -> None:
    """Add to the facts a digest of each stage over all rows."""
    for k, stage in enumerate(half.stages):
        half.facts[f"digest of {stage}"] = digest(row.digests[k] for row in half.rows)


DECIMALS = {"m": 6, "rad": 6, "bytes": 0, "": 0}


def unit_of(column: str) -> str:
    """m, rad, bytes, or "" for a count."""
    end = column.rpartition("_")[2]
    return end if end in DECIMALS else ""


def rounded(value: float, column: str) -> str:
    """A number as the file has it."""
    if math.isnan(value):
        return "-"
    text = f"{value:.{DECIMALS[unit_of(column)]}f}"
    return text.removeprefix("-") if not text.strip("-0.") else text


def to_text(found: Observation) -> str:
    """The text of a file."""
    lines = [f"{found.name}: {found.about}", f"made with: {found.machine}"]
    for half in found.halves:
        lines += ["", f"[{half.name}]", *(f"{name}: {value}" for name, value in half.facts.items()), ""]
        table = [[half.unit, "t_s", "state", *half.columns, *half.stages]]
        for row in half.rows:
            numbers = [rounded(value, column) for value, column in zip(row.numbers, half.columns, strict=True)]
            table.append([str(row.number), f"{row.t_s:.3f}", row.state, *numbers, *row.digests])
        lines += _aligned(table)
    return "\n".join(lines) + "\n"


def from_text(text: str) -> Observation:
    """Read such a text. Raises ValueError."""
    lines = text.splitlines()
    name, _, about = lines[0].partition(": ")
    made = Observation(name, about, lines[1].removeprefix("made with: "))
    half: Half | None = None
    for line in filter(None, lines[2:]):
        if line.startswith("["):
            half = Half(line.strip("[]"), "", (), ())
            made.halves.append(half)
        elif half is None:
            raise ValueError(f"{line!r} before the first [half]")
        elif ": " in line:
            key, _, value = line.partition(": ")
            half.facts[key] = value
        elif not half.unit:
            half.unit, _, _, *names = line.split()
            count = len([key for key in half.facts if key.startswith("digest of ")])
            half.columns, half.stages = tuple(names[: len(names) - count]), tuple(names[len(names) - count :])
        else:
            half.rows.append(_row(line.split(), len(half.columns)))
    return made


def _row(words: Sequence[str], columns: int) -> Row:
    numbers = tuple(math.nan if word == "-" else float(word) for word in words[3 : 3 + columns])
    return Row(int(words[0]), float(words[1]), words[2], numbers, tuple(words[3 + columns :]))


def _aligned(table: list[list[str]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    return ["  ".join(word.rjust(width) for word, width in zip(row, widths, strict=True)) for row in table]
