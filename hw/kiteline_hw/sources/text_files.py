"""Text files of data sets: tables, the flat YAML of sensors, times in seconds, TUM trajectories."""

import re
from collections.abc import Iterator
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_hw.ports import SourceError

Yaml = dict[str, str | list[float]]

_MOST_BYTES = 1 << 28  # of a table: hours of samples
_MOST_YAML_BYTES = 1 << 16  # sensor files have a few kB
_MOST_NS, _MOST_DIGITS = 9 * 10**18, 18  # of a time: as many as fit 64 bits
_FINER = ((10**18, 1), (10**15, 1_000))  # least time since 1970 (2001) in ns and in us; ns in the unit
_NO_LIST = frozenset("[:")
_KEY = re.compile(r"[A-Za-z_][\w./-]*")


def read_text(path: Path, what: str, most_bytes: int = _MOST_BYTES) -> str:
    """The content of a text file of at most `most_bytes`. what: for the error message. Raises SourceError."""
    try:
        with path.open("rb") as file:
            data = file.read(most_bytes + 1)
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}; expected {what}") from error
    if len(data) > most_bytes:
        raise SourceError(f"{path}: more than {most_bytes} bytes; expected {what}")
    return data.decode("utf-8", "replace")


def listed_file(folder: Path, name: str, listing: Path) -> Path:
    """The file in a folder that a listing names. Raises SourceError if the name leads out of the folder."""
    if not name or "\0" in name or Path(name).is_absolute() or ".." in Path(name).parts:
        raise SourceError(f"{listing}: {name[:60]!r} is no file in {folder}")
    return folder / name


def nanoseconds(text: str) -> int:
    """A time in whole ns, below 2^63; zeros may follow after a decimal point. Raises ValueError."""
    whole, _, rest = text.partition(".")
    if not (whole.isascii() and whole.isdecimal() and len(whole) <= 19 and int(whole) < 1 << 63) or rest.strip("0"):
        raise ValueError(f"{text[:40]!r} is no time in nanoseconds")
    return int(whole)


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
    """Exact nanoseconds of decimal seconds ("1305031102.175304", "1.04e-1"); of ns or us since 1970, which are too
    large for seconds (ORB-SLAM3 writes ns for EuRoC's flights). Raises ValueError.
    """
    try:
        value = Decimal(text)
    except InvalidOperation as error:
        raise ValueError(f"{text[:40]!r} is no time in seconds") from error
    if value.is_finite() and value.adjusted() <= _MOST_DIGITS:
        unit_ns = next((unit for least, unit in _FINER if value >= least), 1_000_000_000)
        if abs(value) * unit_ns <= _MOST_NS:
            return int((value * unit_ns).to_integral_value())
    raise ValueError(f"{text[:40]!r} is no time in seconds")


def read_yaml(path: Path, what: str) -> Yaml:
    """The subset of YAML that sensor files use: `key: scalar`, `key: [list]` over several lines, one nesting level.

    Nested keys are joined by dots ("T_BS.data"). OpenCV's `%YAML:1.0` head and `!!tags`, which YAML readers reject, are
    skipped. Raises SourceError.
    """
    lines = [line.split("#", 1)[0].rstrip() for line in read_text(path, what, _MOST_YAML_BYTES).splitlines()]
    out: Yaml = {}
    parent = ""
    for i, line in enumerate(lines):
        head, colon, rest = line.partition(":")
        key, value = head.strip(" \t"), rest.strip(" \t")
        if not colon or not _KEY.fullmatch(key):
            continue
        if value.startswith("!!"):
            _, _, value = value.partition(" ")
            value = value.strip(" \t")
        if value.startswith("["):
            value = " ".join(_list_lines(value, lines, i + 1))
            if value.find("]") != len(value) - 1:
                continue
        elif "[" in value:
            continue
        indent = line[0] in " \t"
        if not indent and not value:
            parent = key
            continue
        if not indent:
            parent = ""
        name = f"{parent}.{key}" if parent else key
        if value.startswith("["):
            try:
                out[name] = [float(cell) for cell in value[1:-1].split(",") if cell.strip()]
            except ValueError as error:
                raise SourceError(f"{path}: {key} holds something else than numbers ({str(error)[:80]})") from error
        else:
            out[name] = value.strip("\"'")
    return out


def _list_lines(first: str, lines: list[str], at: int) -> list[str]:
    """The lines of a list, up to its end or to what cannot stand in one."""
    out = [first]
    while "]" not in out[-1] and at < len(lines) and not _NO_LIST.intersection(lines[at]):
        out.append(lines[at])
        at += 1
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
        raise SourceError(f"{path}: expected {key}: a number, found {'nothing' if value is None else repr(value)}")
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
