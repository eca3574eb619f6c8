"""The rig file: what flights found of a rig, as TOML. Read when an agent starts, written while and after it flies."""

import contextlib
import os
from dataclasses import dataclass, field
from pathlib import Path

from kiteline_agent.known_rig import KnownRigConfig
from kiteline_core import config as configuration
from kiteline_core.config import ConfigError
from kiteline_hw.durable_files import write_atomically

_TABLE = "known_rig"
_HEAD = """\
# What kiteline found of a rig beyond its calibration; written by `kiteline agent --rig` and `kiteline rig export`.
# rows_px: by how much the right image is too low; disparity_px: by how much disparities are too large; readout_s: from
# a rolling shutter's first row to the last; imu: the time offset and the axes of its sensors, with deviations. Delete
# this file after repairs. It is not used with another calibration.
"""


@dataclass(frozen=True, slots=True)
class _Content:
    known_rig: KnownRigConfig = field(default_factory=KnownRigConfig)


def text_of(known: KnownRigConfig) -> str:
    """The content of a rig file."""
    return _HEAD + configuration.describe(_Content(known))


def load(path: str) -> KnownRigConfig:
    """What a rig file says; nothing if there is no such file yet. Raises ConfigError for any other content."""
    try:
        with open(path, "rb") as file:
            table = configuration.parse(file.read(configuration.MOST_BYTES))
    except FileNotFoundError:
        return KnownRigConfig()
    except (OSError, ConfigError) as error:
        raise ConfigError(f"{path}: no readable rig file ({error})") from error
    section = table.get(_TABLE)
    if set(table) != {_TABLE} or not isinstance(section, dict):
        raise ConfigError(f"{path}: no rig file: expected the table [{_TABLE}], found {sorted(table) or 'nothing'}")
    try:
        return configuration.apply(KnownRigConfig(), section, _TABLE)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


class RigFile:
    """Keeps a rig file up to date. A write that is cut, also by a loss of power, leaves the old file."""

    def __init__(self, path: str) -> None:
        self._path = Path(path)
        self._written = ""
        self._is_of_another = False  # what the file says was found with another calibration

    def put_aside(self) -> str:
        """Keep what the file says, of another calibration, in a file beside it before it is replaced; a line on it."""
        self._is_of_another = True
        return (
            f"rig: {self._path} was found with another calibration and is not used; what this flight finds replaces "
            f"it, and it is kept as {self._old.name}"
        )

    def save(self, known: KnownRigConfig | None) -> None:
        """Write what is known, if that changed, and wait for the disk. Raises ConfigError if it cannot be written."""
        if known is None or (text := text_of(known)) == self._written:
            return
        try:
            if self._is_of_another:
                with contextlib.suppress(FileNotFoundError):
                    os.replace(self._path, self._old)
                self._is_of_another = False
            write_atomically(self._path, text.encode())
        except OSError as error:
            raise ConfigError(f"{self._path}: cannot write the rig file ({error})") from error
        self._written = text

    @property
    def _old(self) -> Path:
        return self._path.with_name(self._path.name + ".old")
