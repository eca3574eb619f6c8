"""The status page of a running base; its loop replaces the snapshot, so that no lock is needed."""

from collections.abc import Callable, Sequence
from dataclasses import replace

from kiteline_basestation.station import Station
from kiteline_basestation.web.server import address, serve
from kiteline_basestation.web.snapshot import empty_snapshot, take_snapshot
from kiteline_hw.ports import LinkError

_PERIOD_NS = 400_000_000  # ns between two snapshots: a little less than the page's period


class StatusPage:
    """A served page. where: HOST:PORT. Raises ValueError for a bad address, OSError if it cannot listen."""

    def __init__(self, where: str, now_ns: int) -> None:
        self._started_ns = now_ns
        self._taken_ns = 0
        self._snapshot = empty_snapshot(now_ns)
        self._handle = serve(*address(where), lambda: self._snapshot)

    @property
    def url(self) -> str:
        """The page's URL."""
        return self._handle.url

    def update(self, station: Station, now_ns: int, troubles: Callable[[], Sequence[str]]) -> None:
        """Take a new snapshot if the last one is old enough. troubles: what is wrong with the process, a line each."""
        if now_ns - self._taken_ns >= _PERIOD_NS:
            self._taken_ns = now_ns
            now = take_snapshot(station, now_ns, self._started_ns, self._snapshot)
            self._snapshot = replace(now, troubles=tuple(troubles()))

    def close(self) -> None:
        """Stop serving."""
        self._handle.close()


def open_page(where: str, now_ns: int) -> StatusPage:
    """A page at HOST:PORT. Raises LinkError."""
    try:
        return StatusPage(where, now_ns)
    except ValueError as error:
        raise LinkError(f"--web: {error}") from error
    except OSError as error:
        raise LinkError(
            f"--web {where}: cannot listen there ({error.strerror}): is the port another program's, and is the address "
            "one of this machine? Choose another, such as 0.0.0.0:8081 for all addresses"
        ) from error
