"""Limits what the logs of all starts take on disk: the oldest go first, those of the flight under way last."""

import os
import re
import threading
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

_PARTS = 8  # files that the limit is cut into: an eighth of it at most goes at once
_LEAST_PART_BYTES = 64 << 20  # bytes of a file on a disk with little room left
_RESERVE_BYTES = 256 << 20  # bytes that logs leave free on their disk, for maps and numbers of starts
_NAME = re.compile(r"(\d+)(?:_(\d+))?")  # after the stem: number of the start, number of the part
_MOST_START = 1 << 48  # numbers of starts are lower


class _Log(NamedTuple):
    """A log of the folder. Its fields are in the order in which logs are compared: the oldest is the least."""

    in_flight: bool  # of the start that is being written
    start: int  # -1: the name has no such number
    part: int
    changed_ns: int  # decides only without numbers: a computer without a battery may begin with an old time
    path: Path
    size: int


class LogBudget:
    """Keeps the logs `STEM*.mcap` of a folder within a limit, and within what the disk has. Touches nothing else there.

    The oldest log is that with the lowest number of start, then of part, in its name. The trajectories of a start,
    `STEM<number>.*.tum`, count as well, and are deleted with the last part of its log.
    part_bytes: size at which a log goes on in another file. deleted: files so far. Never raises: a file that cannot be
    deleted counts as used.
    """

    def __init__(self, folder: Path, stem: str, cap_bytes: int, reserve_bytes: int = _RESERVE_BYTES) -> None:
        """cap_bytes: of all logs. reserve_bytes: bytes of the disk to be left free, where others leave them."""
        self.deleted = 0
        self.part_bytes = max(1, cap_bytes // _PARTS)
        self._least_part_bytes = min(self.part_bytes, _LEAST_PART_BYTES)
        self._folder, self._stem = folder, stem
        self._cap_bytes, self._reserve_bytes = cap_bytes, reserve_bytes
        self._deleting: threading.Thread | None = None

    def make_room(self, writing: Path | None = None) -> None:
        """Delete the oldest logs until there is room for another part. writing: the newest one, which stays.

        So does the part that is created to follow it.
        """
        logs = self._logs(writing)
        part = 0 if writing is None else _numbers(writing, self._stem)[1]
        lines = self._trajectories()
        parts = Counter(log.start for log in logs)
        used = sum(log.size for log in logs) + sum(size for of_start in lines.values() for _, size in of_start)
        room = min(self._cap_bytes, used + self._free_bytes() - self._reserve_bytes)
        self.part_bytes = max(self._least_part_bytes, room // _PARTS)
        allowed = room - self.part_bytes
        for log in logs:
            if used <= allowed:
                break
            if log.path == writing or (log.in_flight and log.part > part):
                continue
            try:
                log.path.unlink()
            except OSError:
                continue
            used -= log.size
            self.deleted += 1
            parts[log.start] -= 1
            for path, size in lines.get(log.start, []) if not parts[log.start] else []:
                with suppress(OSError):
                    path.unlink()
                    used -= size

    def make_room_beside(self, writing: Path) -> None:
        """The same in a thread, for a loop that cannot wait for a disk; nothing if the last one still deletes."""
        if self._deleting is None or not self._deleting.is_alive():
            self._deleting = threading.Thread(target=self.make_room, args=(writing,), name="log-budget", daemon=True)
            self._deleting.start()

    def _logs(self, writing: Path | None) -> list[_Log]:
        """All logs, the oldest first, those of the start that is being written last."""
        flown = -1 if writing is None else _numbers(writing, self._stem)[0]
        found = []
        for path in self._folder.glob(f"{self._stem}*.mcap"):
            if path.stem.removeprefix(self._stem).replace("_", "").isdecimal():
                try:
                    status = path.stat()
                except OSError:
                    continue
                start, part = _numbers(path, self._stem)
                in_flight = start == flown and start >= 0
                found.append(_Log(in_flight, start, part, status.st_mtime_ns, path, status.st_size))
        return sorted(found)

    def _trajectories(self) -> dict[int, list[tuple[Path, int]]]:
        """Path and size of each trajectory, by the number of its start."""
        found: dict[int, list[tuple[Path, int]]] = {}
        for path in self._folder.glob(f"{self._stem}*.*.tum"):
            number = path.name.partition(".")[0].removeprefix(self._stem)
            if number.isdecimal():
                with suppress(OSError):
                    found.setdefault(int(number), []).append((path, path.stat().st_size))
        return found

    def _free_bytes(self) -> int:
        try:
            disk = os.statvfs(self._folder)
        except OSError:
            return self._cap_bytes + self._reserve_bytes
        return disk.f_bavail * disk.f_frsize


def newest_start(folder: Path, stem: str) -> int:
    """The highest number of a start in the names `STEM<number>*.mcap` of a folder; 0 without any. Never raises."""
    starts = (_numbers(path, stem)[0] for path in folder.glob(f"{stem}*.mcap"))
    return max((start for start in starts if 0 <= start < _MOST_START), default=0)


def _numbers(path: Path, stem: str) -> tuple[int, int]:
    """Numbers of start and part in a log's name; (-1, 0) if it has none."""
    match = _NAME.fullmatch(path.stem.removeprefix(stem))
    return (int(match[1]), int(match[2] or 0)) if match else (-1, 0)
