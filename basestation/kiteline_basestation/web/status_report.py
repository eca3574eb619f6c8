"""The numbers of the status page for `kiteline status`, which needs no page to be served."""

from __future__ import annotations

from typing import Any

from kiteline_basestation.station import Station
from kiteline_basestation.web.messages import status
from kiteline_basestation.web.snapshot import empty_snapshot, take_snapshot


class StatusReport:
    """Reports of a station. started_ns: when the base began, on the clock of its steps."""

    def __init__(self, station: Station, started_ns: int) -> None:
        self._station = station
        self._started_ns = started_ns
        self._snapshot = empty_snapshot(started_ns)  # points are gathered again only when the map has grown

    def at(self, now_ns: int) -> dict[str, Any]:
        """The page's texts and numbers now, as JSON types, without rates."""
        self._snapshot = take_snapshot(self._station, now_ns, self._started_ns, self._snapshot)
        return status(self._snapshot)
