"""The processes of one flight on this machine: started, listened to, and never left behind.

with Crew() as crew:
    crew.start("base", "kiteline_basestation", spec, folder)
    for event in crew.events(): ...
"""

from __future__ import annotations

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

_TERM_WAIT_S = 3.0  # s that a child has to close its log and session before it is killed
_STDERR_LINES = 12  # of a dead child's last words


@dataclass(frozen=True, slots=True)
class Event:
    """What a child said, or that it ended (kind "exit", values {"code": …})."""

    child: str
    kind: str
    values: Mapping[str, Any]


@dataclass(slots=True)
class Child:
    """A running process of the flight."""

    name: str
    process: subprocess.Popen[str]
    stderr: Path
    listener: threading.Thread | None = None
    plain_lines: list[str] = field(default_factory=list)

    def last_words(self) -> str:
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


class Crew:
    """Child processes; leaving the `with` block ends those that still run."""

    def __init__(self) -> None:
        self.children: dict[str, Child] = {}
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
                stdin=subprocess.PIPE,  # held open: a child ends when it closes, that is, when we are gone
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                env=environment,
                start_new_session=True,  # Ctrl-C reaches us alone; we end the children in order
            )
        child = Child(name, process, stderr)
        self.children[name] = child
        child.listener = threading.Thread(target=self._listen, args=(child,), name=f"listen-{name}", daemon=True)
        child.listener.start()
        return child

    def _listen(self, child: Child) -> None:
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

    def say(self, name: str, word: str) -> None:
        """Write a line to a child's stdin."""
        pipe = self.children[name].process.stdin
        if pipe is not None:
            with contextlib.suppress(OSError, ValueError):
                pipe.write(word + "\n")
                pipe.flush()

    def ask_to_end(self, name: str) -> None:
        """Tell a child to end in its own way."""
        with contextlib.suppress(ProcessLookupError):
            self.children[name].process.terminate()

    def running(self) -> list[str]:
        """Names of the children that have not ended."""
        return [name for name, child in self.children.items() if child.process.poll() is None]

    def close(self) -> None:
        """End every child: first by SIGTERM, then for good."""
        alive = [child for child in self.children.values() if child.process.poll() is None]
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
        for child in self.children.values():
            if child.listener is not None:
                child.listener.join()
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
