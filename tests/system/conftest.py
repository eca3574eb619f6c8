"""What tests of whole programs share."""

import subprocess
from collections.abc import Iterator

import pytest

from tests import forked_programs


@pytest.fixture(scope="session")
def _origin() -> Iterator[None]:
    yield
    forked_programs.end()


@pytest.fixture
def forked(_origin: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fork programs from a process that has all loaded: for tests of what they do, not of how they start."""
    monkeypatch.setattr(subprocess, "Popen", forked_programs.ForkedProgram)
