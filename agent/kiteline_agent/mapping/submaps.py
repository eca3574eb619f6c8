"""Which submap is active, and how many were opened."""

from kiteline_agent.step import Identity
from kiteline_core.ids import MAX_SUBMAPS, SubmapId, submap_id

TRACKED_M, TRACKED_RAD = 0.005, 0.002  # deviations of a tracked frame to its reference keyframe


class Submaps:
    """Ids of the submaps of one flight."""

    def __init__(self, identity: Identity) -> None:
        self._identity = identity
        self._number: int | None = None  # of the active one
        self.opened = 0  # so many, numbered from that of the identity

    @property
    def any(self) -> bool:
        """True if a submap was opened."""
        return self._number is not None

    @property
    def room(self) -> bool:
        """True if ids are left for another one."""
        return self._identity.submap + self.opened < MAX_SUBMAPS

    @property
    def active(self) -> SubmapId:
        """The submap in which the camera is tracked; the first one before it is opened."""
        number = self._identity.submap if self._number is None else self._number
        return submap_id(self._identity.agent, self._identity.boot, number)

    @property
    def first(self) -> SubmapId:
        """The submap in which the flight begins."""
        return submap_id(self._identity.agent, self._identity.boot, self._identity.submap)

    @property
    def in_first(self) -> bool:
        """True if the active submap is the one in which the flight began."""
        return self.active == self.first

    def open_next(self) -> SubmapId:
        """Open another submap, and make it the active one."""
        self._number = self._identity.submap + self.opened
        self.opened += 1
        return self.active

    def return_to(self, submap: SubmapId) -> None:
        """Make an older submap the active one."""
        self._number = submap % MAX_SUBMAPS
