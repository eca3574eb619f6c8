"""Child processes of one flight: started, read line by line, and ended with it."""

import contextlib
import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

_TERM_WAIT_S = 3.0  # s after SIGTERM until a child is killed
_STDERR_LINES = 12


@dataclass(frozen=True, slots=True)
class Event:
    """A line of JSON from a child, or its end (kind "exit", values {"code": …})."""

    child: str
    kind: str
    values: Mapping[str, Any]


@dataclass(slots=True)
class Child:
    """A child process; plain_lines: its output that is no event."""

    name: str
    process: subprocess.Popen[str]
    stderr: Path
    reader: threading.Thread | None = None
    plain_lines: list[str] = field(default_factory=list)

    def stderr_tail(self) -> str:
        """The end of what the child wrote to stderr."""
        try:
            lines = self.stderr.read_text(errors="replace").strip().splitlines()
        except OSError:
            lines = []
        return "\n".join(lines[-_STDERR_LINES:])


def ended_by(code: int) -> str:
    """An exit status in words."""
    if code < 0:
        with contextlib.suppress(ValueError):
            return f"was ended by {signal.Signals(-code).name}"
    return f"ended with status {code}"


class ChildProcesses:
    """Child processes; leaving the `with` block ends those that still run."""

    def __init__(self) -> None:
        self.processes: dict[str, Child] = {}
        self._events: queue.SimpleQueue[Event] = queue.SimpleQueue()

    def start(self, name: str, module: str, spec: Mapping[str, Any], folder: Path) -> Child:
        """Run `python -m module --spec JSON`; what it writes to stdout (lines of JSON) becomes events."""
        folder.mkdir(parents=True, exist_ok=True)
        environment = dict(os.environ)
        environment["PYTHONPATH"] = os.pathsep.join(entry for entry in sys.path if entry)
        for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
            environment.setdefault(variable, "1")
        stderr = folder / "stderr.log"
        with stderr.open("w") as errors:
            process = subprocess.Popen(
                [sys.executable, "-m", module, "--spec", json.dumps(spec)],
                stdin=subprocess.PIPE,  # held open: a child ends when it closes, that is, with this process
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                env=environment,
                start_new_session=True,  # Ctrl-C reaches this process alone, which ends the children in order
            )
        child = Child(name, process, stderr)
        self.processes[name] = child
        child.reader = threading.Thread(target=self._read, args=(child,), name=f"read-{name}", daemon=True)
        child.reader.start()
        return child

    def _read(self, child: Child) -> None:
        assert child.process.stdout is not None
        for line in child.process.stdout:
            try:
                values = json.loads(line)
                self._events.put(Event(child.name, values.pop("event"), values))
            except (ValueError, KeyError, AttributeError):
                child.plain_lines.append(line.rstrip())
        self._events.put(Event(child.name, "exit", {"code": child.process.wait()}))

    def next_event(self, timeout_s: float) -> Event | None:
        """The next event of any child; None when none came in time."""
        try:
            return self._events.get(timeout=timeout_s)
        except queue.Empty:
            return None

    def send_line(self, name: str, line: str) -> None:
        """Write a line to a child's stdin."""
        pipe = self.processes[name].process.stdin
        if pipe is not None:
            with contextlib.suppress(OSError, ValueError):
                pipe.write(line + "\n")
                pipe.flush()

    def terminate(self, name: str) -> None:
        """Send SIGTERM: a child then closes its log and ends."""
        with contextlib.suppress(ProcessLookupError):
            self.processes[name].process.terminate()

    def running(self) -> list[str]:
        """Names of the children that have not ended."""
        return [name for name, child in self.processes.items() if child.process.poll() is None]

    def close(self) -> None:
        """End every child: first by SIGTERM, then for good."""
        alive = [child for child in self.processes.values() if child.process.poll() is None]
        for child in alive:
            with contextlib.suppress(ProcessLookupError):
                child.process.terminate()
        deadline_s = time.monotonic() + _TERM_WAIT_S
        for child in alive:
            try:
                child.process.wait(max(0.0, deadline_s - time.monotonic()))
            except subprocess.TimeoutExpired:
                child.process.kill()
                child.process.wait()
        for child in self.processes.values():
            if child.reader is not None:
                child.reader.join()
            for pipe in (child.process.stdin, child.process.stdout):
                if pipe is not None:
                    with contextlib.suppress(OSError):
                        pipe.close()
            if child.stderr.exists() and child.stderr.stat().st_size == 0:
                child.stderr.unlink()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
