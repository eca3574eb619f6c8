"""What tests of the agent share: a rendered flight."""

from collections.abc import Iterator

import pytest

from tests.agent import room_flight as rendered
from tests.made_once import made_once


@pytest.fixture(scope="session")
def room_flight(tmp_path_factory: pytest.TempPathFactory) -> Iterator[rendered.RoomFlight]:
    """A flight through a room, rendered once in a run of the tests, which no test changes."""
    flight = made_once(tmp_path_factory, "room_flight", rendered.render)
    before = rendered.digest(flight)
    yield flight
    assert rendered.digest(flight) == before
