"""What tests of the agent share: a rendered flight."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.agent import room_flight as rendered


@pytest.fixture(scope="session")
def room_flight() -> Iterator[rendered.RoomFlight]:
    """A flight through a room, rendered once in each process, which no test changes."""
    flight = rendered.render()
    before = rendered.digest(flight)
    yield flight
    assert rendered.digest(flight) == before
