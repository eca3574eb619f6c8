"""The last pose sent, in a file: an agent that is restarted in flight goes on from it."""

import contextlib
import json
import os
from collections.abc import Callable
from pathlib import Path

from kiteline_hw.durable_files import in_thread
from kiteline_hw.mavlink.start_frame import LastPose

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
_OLDEST_NS = 60_000_000_000  # ns after which a flight counts as over
_EVERY_NS = 500_000_000  # ns between two writes


def boot_id() -> str:
    """Identity of the computer's start: monotonic clocks of different ones do not compare."""
    try:
        return _BOOT_ID.read_text(encoding="ascii").strip()
    except OSError:
        return ""


class PoseMemory:
    """Keeps the last pose in a file. Files that cannot be written or read count as none.

    The disk is written beside the messages: a card that stalls must not hold up heartbeats and inertial samples.
    """

    def __init__(self, path: Path, beside: Callable[[Callable[[], None]], None] = in_thread) -> None:
        """beside: does a piece of work without waiting for it."""
        self._path, self._beside = path, beside
        self._writing = False
        self._boot = boot_id()
        self._written_ns: int | None = None

    def load(self, now_ns: int) -> LastPose | None:
        """The last pose, if it was sent less than a minute ago."""
        try:
            stored = json.loads(self._path.read_text(encoding="utf-8"))
            x, y, z = (float(v) for v in stored["position_m"])
            age_ns = now_ns - int(stored["t_ns"])
            last = LastPose((x, y, z), float(stored["heading_rad"]), bool(stored["armed"]))
            boot = stored["boot"]
        except (OSError, ValueError, KeyError, TypeError):
            return None
        return last if boot == self._boot and 0 <= age_ns < _OLDEST_NS else None

    def save(self, last: LastPose | None, now_ns: int) -> None:
        """Have the last pose written, at most twice a second, and not while the one before is being written."""
        if last is None or (self._written_ns is not None and now_ns - self._written_ns < _EVERY_NS) or self._writing:
            return
        self._written_ns, self._writing = now_ns, True
        content = {
            "boot": self._boot, "t_ns": now_ns, "position_m": last.position_m, "heading_rad": last.heading_rad,
            "armed": last.armed,
        }  # fmt: skip
        self._beside(lambda: self._write(json.dumps(content)))

    def _write(self, text: str) -> None:
        part = self._path.with_name(f".{self._path.name}.part")
        try:
            with contextlib.suppress(OSError):
                self._path.parent.mkdir(parents=True, exist_ok=True)
                part.write_text(text, encoding="utf-8")
                os.replace(part, self._path)
        finally:
            self._writing = False
