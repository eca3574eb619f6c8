"""A log and the parts that it goes on in, NAME_1.mcap, NAME_2.mcap…, read as one."""

import glob
import re
from collections.abc import Collection, Iterator
from pathlib import Path

from kiteline_hw.logs.mcap_file import McapFile
from kiteline_hw.logs.mcap_log_read import LogMessage, LogReader
from kiteline_hw.logs.mcap_repair import REPAIRED
from kiteline_hw.ports import SourceError

_NAME = re.compile(r"(.*?)(?:_(\d+))?", re.DOTALL)


class WholeLog(LogReader):
    """Reads a log with its later parts, up to the first that is cut or missing: `cut` says where that is.

    Given a later part, it reads that part alone.
    """

    def __init__(self, path: Path | str) -> None:
        path = Path(path)
        super().__init__(path)
        self.cut = self.cut or self.metadata.get(REPAIRED)
        self._later: list[LogReader] = []
        while self.cut is None and "part" not in self.metadata:
            number = len(self._later) + 1
            part = self._part(path, number)
            if part is None:
                if any(self._part(path, n) for n in numbers_of_parts(path) if n > number):
                    self.cut = f"cut: its part {number} is missing"
                break
            self._later.append(part)
            self.cut = part.cut or part.metadata.get(REPAIRED)
            for topic, count in part.topics.items():
                self.topics[topic] = self.topics.get(topic, 0) + count

    @property
    def files(self) -> list[McapFile]:
        """The files of the parts that are read, in order."""
        return [self.file, *(part.file for part in self._later)]

    def _part(self, path: Path, number: int) -> LogReader | None:
        """A part of this log; None where the file is not there, holds nothing yet, or is another log's."""
        try:
            part = LogReader(path_of_part(path, number))
        except (SourceError, OSError):
            return None
        named = {**self.metadata, "part": str(number)}
        return part if {k: v for k, v in part.metadata.items() if k != REPAIRED} == named else None

    def messages(self, topics: Collection[str] | None = None) -> Iterator[LogMessage]:
        """Messages of the topics (None: all), in the order of writing."""
        yield from super().messages(topics)
        for part in self._later:
            yield from part.messages(topics)


def path_of_part(path: Path, number: int) -> Path:
    """The file in which a log goes on as this part."""
    return path.with_name(f"{path.stem}_{number}{path.suffix}")


def log_and_part(path: Path) -> tuple[str, int]:
    """The log that a file belongs to by its name, without the ending, and its number; 0: it is the first."""
    match = _NAME.fullmatch(path.stem)
    return (match[1], int(match[2] or 0)) if match else (path.stem, 0)


def numbers_of_parts(path: Path) -> list[int]:
    """Numbers of the files beside a log that are named as its later parts."""
    named = (log_and_part(other) for other in path.parent.glob(f"*{glob.escape(path.suffix)}"))
    return sorted(number for log, number in named if log == path.stem and number)
