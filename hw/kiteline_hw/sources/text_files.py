"""Text files of data sets: tables, the flat YAML of sensors, times in seconds, TUM trajectories."""

from __future__ import annotations

import re
from collections.abc import Iterator
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kiteline_core.geometry import se3
from kiteline_hw.ports import SourceError

F64 = NDArray[np.float64]
Yaml = dict[str, str | list[float]]


def read_text(path: Path, what: str) -> str:
    """The content of a small text file. what: for the error message. Raises SourceError."""
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}; expected {what}") from error


def read_rows(path: Path, what: str, separator: str | None = None) -> Iterator[list[str]]:
    """The cells of each line that is neither empty nor a comment. Raises SourceError."""
    for line in read_text(path, what).splitlines():
        line = line.strip()
        if line and not line.startswith("#"):
            yield [cell.strip() for cell in line.split(separator)]


def row_values(cells: list[str], path: Path, count: int) -> F64:
    """A row of `count` finite numbers. Raises SourceError."""
    try:
        values = np.array([float(cell) for cell in cells])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        raise SourceError(f"{path}: expected {count} numbers a row, found {' '.join(cells)[:60]!r}")
    return values


def seconds_to_ns(text: str) -> int:
    """Exact nanoseconds of decimal seconds ("1305031102.175304", "1.04e-1"). Raises ValueError."""
    try:
        value = Decimal(text)
    except InvalidOperation as error:
        raise ValueError(f"{text!r} is no time in seconds") from error
    if not value.is_finite():
        raise ValueError(f"{text!r} is no time in seconds")
    return int((value * 1_000_000_000).to_integral_value())


def read_yaml(path: Path, what: str) -> Yaml:
    """The subset of YAML that sensor files use: `key: scalar`, `key: [list]` over several lines, one nesting level.

    Nested keys are joined by dots ("T_BS.data"). OpenCV's `%YAML:1.0` head and `!!tags`, which YAML readers reject, are
    skipped. Raises SourceError.
    """
    text = "\n".join(line.split("#", 1)[0].rstrip() for line in read_text(path, what).splitlines())
    out: Yaml = {}
    parent = ""
    pattern = re.compile(r"^([ \t]*)([A-Za-z_][\w./-]*)[ \t]*:[ \t]*(?:!!\S+)?[ \t]*(\[[^\]]*\]|[^\n\[]*)$", re.M)
    for match in pattern.finditer(text):
        indent, key, value = match.group(1), match.group(2), match.group(3).strip()
        if not indent and not value:
            parent = key
            continue
        if not indent:
            parent = ""
        name = f"{parent}.{key}" if parent else key
        if value.startswith("["):
            try:
                out[name] = [float(cell) for cell in value[1:-1].replace("\n", " ").split(",") if cell.strip()]
            except ValueError as error:
                raise SourceError(f"{path}: {key} holds something else than numbers ({error})") from error
        else:
            out[name] = value.strip("\"'")
    return out


def yaml_number(table: Yaml, key: str, path: Path, default: float | None = None) -> float:
    """The finite number under a key, or the default. Raises SourceError."""
    value = table.get(key)
    if value is None and default is not None:
        return default
    try:
        number = float(value) if isinstance(value, str) else float("nan")
    except ValueError:
        number = float("nan")
    if not np.isfinite(number):
        raise SourceError(f"{path}: expected {key}: a number, found {'nothing' if value is None else value!r}")
    return number


def read_tum_poses(path: Path) -> list[tuple[int, F64]]:
    """Poses (t_ns, (4,4)) of a file with lines `t x y z qx qy qz qw`, t in seconds. Raises SourceError."""
    poses: list[tuple[int, F64]] = []
    for cells in read_rows(path, "a trajectory, t x y z qx qy qz qw a line"):
        try:
            value = np.array([float(cell) for cell in cells[1:8]])
            if len(value) != 7 or not np.isfinite(value).all() or not value[3:].any():
                raise ValueError("8 finite numbers a line expected")
            poses.append((seconds_to_ns(cells[0]), pose_from_tum(value)))
        except ValueError as error:
            raise SourceError(f"{path}: {' '.join(cells)[:60]!r}: {error}") from error
    return poses


def pose_from_tum(value: F64) -> F64:
    """T (4,4) of x y z qx qy qz qw."""
    return se3.from_quaternion(value[[6, 3, 4, 5]], value[:3])
