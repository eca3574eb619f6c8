"""Entries of a YAML file that know where they are, so that each error names file, key and what was expected."""

import re
import reprlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from kiteline_core.arrays import F64
from kiteline_core.errors import INPUT_FAULTS
from kiteline_hw.calibration.checks import checked_rigid
from kiteline_hw.ports import SourceError

_MOST_BYTES = 1 << 16  # calibration files are a few kB
_MOST_NESTED = 16  # brackets in brackets: calibrations have two; a YAML reader takes time by the square of them
_MOST_ROWS = 1000  # of a matrix
_MOST_PX = 100_000  # of an image's side
_FILE_STORAGE = "%YAML:"  # begins a file of OpenCV's, which takes `key:value` without a space, as YAML does not
_TIGHT_KEY = re.compile(r"^(\s*[A-Za-z_][\w.]*:)(?=\S)")


@dataclass(frozen=True, slots=True)
class Node:
    """An entry of a YAML file: a text, a list or a table of them. key: its path in the file, "" for the whole."""

    path: Path
    key: str
    value: object

    def error(self, expected: str) -> SourceError:
        """The error that this entry is not what was expected."""
        found = (
            "nothing" if self.value in (None, "") else reprlib.repr(self.value)
        )  # aliases make long texts of short files
        return SourceError(f"{self.path}: expected {self.key or 'the file'} to be {expected}, found {found[:80]}")

    @property
    def keys(self) -> frozenset[str]:
        """The keys of a table; none of anything else."""
        return frozenset(str(k) for k in self.value) if isinstance(self.value, dict) else frozenset()

    def get(self, key: str) -> "Node":
        """The entry of a table under a key; its value is None if there is none."""
        if self.value is not None and not isinstance(self.value, dict):
            raise self.error("a table of keys and values")
        table = self.value or {}
        return Node(self.path, f"{self.key}.{key}" if self.key else key, table.get(key))

    def text(self) -> str:
        """A text."""
        if not isinstance(self.value, str):
            raise self.error("a text")
        return self.value

    def number(self, expected: str = "a number") -> float:
        """A finite number."""
        number = _number(self.value)
        if not np.isfinite(number):
            raise self.error(expected)
        return number

    def positive(self, expected: str) -> float:
        """A finite number above zero."""
        number = self.number(expected)
        if number <= 0.0:
            raise self.error(expected)
        return number

    def pixels(self) -> int:
        """A side of an image in px."""
        number = self.number("a whole number of px")
        if number != round(number) or not 0 < number <= _MOST_PX:
            raise self.error("a whole number of px")
        return round(number)

    def numbers(self, counts: Sequence[int], expected: str) -> list[float]:
        """A list of finite numbers, as many as one of `counts` says; any number if it is empty."""
        if not isinstance(self.value, list) or (counts and len(self.value) not in counts):
            raise self.error(expected)
        values = [_number(v) for v in self.value]
        if not np.isfinite(values).all():
            raise self.error(f"{expected}, all finite")
        return values

    def size(self) -> tuple[int, int]:
        """A list of width and height of an image in px."""
        if not isinstance(self.value, list) or len(self.value) != 2:
            raise self.error("width and height in px")
        width, height = (Node(self.path, self.key, side).pixels() for side in self.value)
        return width, height

    def rows(self, rows: int, columns: int) -> F64:
        """A matrix written as a list of rows."""
        expected = f"{rows} rows of {columns} numbers"
        if not isinstance(self.value, list) or len(self.value) != rows:
            raise self.error(expected)
        return np.array([Node(self.path, self.key, row).numbers((columns,), expected) for row in self.value])

    def pose(self) -> F64:
        """A rigid motion (4,4) written as a list of rows."""
        return checked_rigid(self.rows(4, 4), f"{self.path}: {self.key}")

    def matrix(self, shape: tuple[int, int] | None, expected: str) -> F64:
        """A matrix written as a table of rows, cols and data. shape: None for any.

        OpenCV 5 writes an array of one dimension with `sizes` in place of rows and cols: it is a column.
        """
        if "sizes" in self.keys:
            rows, columns = (round(v) for v in [*self.get("sizes").numbers((1, 2), "one or two sizes"), 1.0][:2])
        else:
            rows, columns = (round(self.get(key).number(f"the number of {key}")) for key in ("rows", "cols"))
        if not (0 <= rows <= _MOST_ROWS and 0 <= columns <= _MOST_ROWS):
            raise self.error(expected)
        if shape is not None and (rows, columns) != shape:
            raise self.error(expected)
        values = self.get("data").numbers((rows * columns,), expected)
        return np.array(values).reshape(rows, columns) if values else np.zeros((0, 0))


def read_nodes(path: Path) -> Node:
    """The whole of a YAML file, OpenCV's FileStorage included. Raises SourceError."""
    try:
        with path.open("rb") as file:
            data = file.read(_MOST_BYTES + 1)
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}; expected a calibration file") from error
    if len(data) > _MOST_BYTES:
        raise SourceError(f"{path}: more than {_MOST_BYTES} bytes: expected a calibration file, which is far smaller")
    lines = data.decode("utf-8-sig", "replace").splitlines()
    if lines and lines[0].startswith(_FILE_STORAGE):
        lines = [_TIGHT_KEY.sub(r"\1 ", line) for line in lines]
    # OpenCV's head "%YAML:1.0" is no YAML.
    text = "\n".join("" if line.startswith("%") else line for line in lines)
    if _nested(text) > _MOST_NESTED:
        raise SourceError(f"{path}: lists nested more than {_MOST_NESTED} deep: expected a calibration file")
    try:
        value = yaml.load(text, Loader=yaml.BaseLoader)  # all scalars stay texts, tags are ignored
    except (yaml.YAMLError, ValueError, TypeError, *INPUT_FAULTS) as error:
        raise SourceError(f"{path}: no YAML: {' '.join(str(error).split())[:200]}") from error
    if not isinstance(value, dict):
        raise SourceError(f"{path}: expected a calibration file in YAML: keys with values")
    return Node(path, "", value)


def _nested(text: str) -> int:
    """How deep brackets stand in brackets, at most; those in texts count as well."""
    most = depth = 0
    for bracket in re.findall(r"[][{}]", text):
        depth = depth + 1 if bracket in "[{" else max(0, depth - 1)
        most = max(most, depth)
    return most


def _number(value: object) -> float:
    try:
        return float(value) if isinstance(value, str) and "_" not in value else float("nan")
    except ValueError:
        return float("nan")
