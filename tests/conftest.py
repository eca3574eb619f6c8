"""What all tests share: one thread, a reproducible hypothesis in CI, and where the recordings lie."""

from __future__ import annotations

import os
from pathlib import Path

for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")  # before numpy is loaded: results and timings do not depend on the machine

import cv2
import pytest
from hypothesis import HealthCheck, settings

ROOT = Path(__file__).resolve().parent.parent
IN_CI = os.environ.get("CI", "").lower() in ("1", "true")

cv2.setNumThreads(1)
settings.register_profile("default", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("ci", parent=settings.get_profile("default"), derandomize=True, database=None)
settings.load_profile("ci" if IN_CI else "default")


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of recordings: KITELINE_DATA, else ../shared/data beside the repository.

    Skips where there is none, but fails in CI: a check that silently runs nothing proves nothing.
    """
    named = os.environ.get("KITELINE_DATA")
    folder = Path(named) if named else ROOT.parent / "shared" / "data"
    if folder.is_dir():
        return folder
    text = f"no recordings at {folder}: set KITELINE_DATA to the folder that holds them"
    if IN_CI:
        pytest.fail(text)
    pytest.skip(text)
