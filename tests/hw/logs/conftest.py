"""Fixtures of logs."""

import os
from collections.abc import Callable

import pytest

from tests.hw.logs.disks import SmallDisk


@pytest.fixture
def small_disk(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], SmallDisk]:
    def make(room: int) -> SmallDisk:
        disk = SmallDisk(room)
        monkeypatch.setattr(os, "pwrite", disk.pwrite)
        return disk

    return make
