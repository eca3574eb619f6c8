"""Load, memory and temperature of this computer, from /proc and /sys."""

from dataclasses import dataclass
from pathlib import Path

_PROC = Path("/proc")


@dataclass(frozen=True, slots=True)
class Computer:
    """cpu_percent: of each core since the last reading. None: unknown."""

    uptime_ms: int
    cpu_percent: tuple[int, ...]
    ram_mib: int | None
    ram_total_mib: int | None
    temperature_c: int | None


class ComputerReader:
    """Reads the state of this computer."""

    def __init__(self) -> None:
        self._before: dict[str, tuple[int, int]] = {}  # idle and all ticks by core

    def read(self) -> Computer:
        """The state now. What cannot be read is unknown."""
        total, free = self._memory_kib("MemTotal"), self._memory_kib("MemAvailable")
        used = None if total is None or free is None else (total - free) // 1024
        uptime = self._text(_PROC / "uptime").split()
        return Computer(
            round(float(uptime[0]) * 1000) if uptime else 0,
            self._load(),
            used,
            None if total is None else total // 1024,
            self._hottest(),
        )

    def _load(self) -> tuple[int, ...]:
        out = []
        for line in self._text(_PROC / "stat").splitlines():
            name, *ticks = line.split()
            if not (name.startswith("cpu") and name != "cpu") or len(ticks) < 5:
                continue
            now = int(ticks[3]) + int(ticks[4]), sum(map(int, ticks[:8]))
            idle, all_ticks = (b - a for a, b in zip(self._before.get(name, (0, 0)), now, strict=True))
            self._before[name] = now
            out.append(round(100.0 * (1.0 - idle / all_ticks)) if all_ticks > 0 else 0)
        return tuple(out)

    def _memory_kib(self, key: str) -> int | None:
        for line in self._text(_PROC / "meminfo").splitlines():
            if line.startswith(f"{key}:"):
                return int(line.split()[1])
        return None

    def _hottest(self) -> int | None:
        texts = [self._text(path).strip() for path in Path("/sys").glob("class/thermal/thermal_zone*/temp")]
        degrees = [int(text) // 1000 for text in texts if text.lstrip("-").isdecimal()]
        return max(degrees, default=None)

    @staticmethod
    def _text(path: Path) -> str:
        try:
            return path.read_text(encoding="ascii")
        except (OSError, UnicodeDecodeError):
            return ""
