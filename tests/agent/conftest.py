"""What tests of the agent share: a rendered flight."""

from __future__ import annotations

import pytest

from tests.agent import room_flight as rendered


@pytest.fixture(scope="session")
def room_flight() -> rendered.RoomFlight:
    """A flight through a room, rendered once in each process."""
    return rendered.render()
