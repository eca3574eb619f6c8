"""Write NAME.job_values.json beside a base's log: fingerprints of its jobs' results that hold no field names.

Runs under the rooms of the revision that recorded the log, as a script: `python job_values.py LOG.mcap...` with their
PYTHONPATH. Earlier versions fed the names of fields to the fingerprint, so that a renamed field changed it.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import sys
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np


def feed(digest: hashlib.blake2b, value: object) -> None:
    """Type, shape and content of every field, in order; as `runtime.flight_log` does it today."""
    if is_dataclass(value):
        for field in fields(value):
            feed(digest, getattr(value, field.name))
    elif isinstance(value, np.ndarray):
        digest.update(f"{value.dtype.str}{value.shape}".encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    else:
        digest.update(repr(value).encode())


def main(logs: list[str]) -> int:
    """Replay each log with the rooms on PYTHONPATH; 1 where a replay differs from its log."""
    flight_log: Any = importlib.import_module("kiteline_basestation.flight_log")
    replay: Any = importlib.import_module("kiteline_lab.replay")
    named: Callable[[Any], str] = flight_log.fingerprint
    status = 0
    for log in logs:
        results: list[str] = []

        def note(done: Any, results: list[str] = results) -> str:
            digest = hashlib.blake2b(digest_size=16)
            feed(digest, done.result)
            results.append(digest.hexdigest())
            return named(done)

        flight_log.fingerprint = note
        status |= replay.main([log, "--verify"])
        path = Path(log)
        path.with_name(path.stem + ".job_values.json").write_text(json.dumps(results))
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
