"""What the two sides are known to agree on, as two state machines. Any pair that is not in a table is an error.

This side's values at the peer (`OwnValues`)
  state        session     equal       different   voided
  UNHEARD      UNCOMPARED
  UNCOMPARED   UNCOMPARED  EQUAL       VOIDING
  EQUAL        UNCOMPARED  EQUAL       VOIDING
  VOIDING      UNCOMPARED  EQUAL       VOIDING     UNCOMPARED

The peer's values at this side (`PeerValues`)
  state        session     equal       different   voided
  UNCOMPARED   UNCOMPARED  EQUAL       DIFFERENT   UNCOMPARED
  EQUAL        UNCOMPARED  EQUAL       DIFFERENT   EQUAL
  DIFFERENT    UNCOMPARED  DIFFERENT   DIFFERENT   UNCOMPARED

session: a new session of the peer. equal, different: digests were compared. voided: the receiver knows that all
versions up to that comparison are void. Digests differ only after a defect; the writer then sends everything again.
"""

from enum import Enum, auto


class Event(Enum):
    """What moves both machines."""

    SESSION = auto()
    EQUAL = auto()
    DIFFERENT = auto()
    VOIDED = auto()


class OwnState(Enum):
    """Agreement on this side's values."""

    UNHEARD = auto()  # no session of the peer is known: only greetings are sent
    UNCOMPARED = auto()
    EQUAL = auto()
    VOIDING = auto()  # the peer must learn that older versions are void


class PeerState(Enum):
    """Agreement on the peer's values."""

    UNCOMPARED = auto()
    EQUAL = auto()
    DIFFERENT = auto()  # the peer must learn it


OWN_TRANSITIONS = {
    OwnState.UNHEARD: {Event.SESSION: OwnState.UNCOMPARED},
    OwnState.UNCOMPARED: {
        Event.SESSION: OwnState.UNCOMPARED, Event.EQUAL: OwnState.EQUAL, Event.DIFFERENT: OwnState.VOIDING,
    },
    OwnState.EQUAL: {
        Event.SESSION: OwnState.UNCOMPARED, Event.EQUAL: OwnState.EQUAL, Event.DIFFERENT: OwnState.VOIDING,
    },
    OwnState.VOIDING: {
        Event.SESSION: OwnState.UNCOMPARED, Event.EQUAL: OwnState.EQUAL, Event.DIFFERENT: OwnState.VOIDING,
        Event.VOIDED: OwnState.UNCOMPARED,
    },
}  # fmt: skip
PEER_TRANSITIONS = {
    PeerState.UNCOMPARED: {
        Event.SESSION: PeerState.UNCOMPARED, Event.EQUAL: PeerState.EQUAL, Event.DIFFERENT: PeerState.DIFFERENT,
        Event.VOIDED: PeerState.UNCOMPARED,
    },
    PeerState.EQUAL: {
        Event.SESSION: PeerState.UNCOMPARED, Event.EQUAL: PeerState.EQUAL, Event.DIFFERENT: PeerState.DIFFERENT,
        Event.VOIDED: PeerState.EQUAL,
    },
    PeerState.DIFFERENT: {
        Event.SESSION: PeerState.UNCOMPARED, Event.EQUAL: PeerState.DIFFERENT, Event.DIFFERENT: PeerState.DIFFERENT,
        Event.VOIDED: PeerState.UNCOMPARED,
    },
}  # fmt: skip


class OwnValues:
    """Agreement on this side's values: the state, and the versions of the last comparison and of the last void."""

    def __init__(self) -> None:
        self.state = OwnState.UNHEARD
        self.equal_at: int | None = None  # newest version of ours that the peer found equal
        self.void_up_to: int | None = None  # in this state or before: version of ours up to which all is void
        self._void_packet: int | None = None  # number of the first packet that says so

    def new_session(self) -> None:
        """Begin with a new session of the peer, which has compared nothing."""
        self._go(Event.SESSION)
        self.equal_at = None

    def found_equal(self, version: int) -> None:
        """Take in that the peer's copy was equal at a version. While voiding, an older version proves nothing."""
        if self.state is OwnState.VOIDING and self.void_up_to is not None and version < self.void_up_to:
            return
        self._go(Event.EQUAL)
        self.equal_at = version if self.equal_at is None else max(self.equal_at, version)

    def must_void(self, version: int) -> bool:
        """True if a difference that the peer found at a version is not mended yet."""
        return self.void_up_to is None or version > self.void_up_to

    def found_different(self, void_up_to: int, next_packet: int) -> None:
        """Take in that the peer's copy differed, and that all values have new versions now."""
        self._go(Event.DIFFERENT)
        self.equal_at = None
        self.void_up_to, self._void_packet = void_up_to, next_packet

    def acknowledged(self, packet: int) -> None:
        """Take in that the peer received a packet of ours: enough if it said what is void."""
        if self.state is OwnState.VOIDING and self._void_packet is not None and packet >= self._void_packet:
            self._go(Event.VOIDED)

    def _go(self, event: Event) -> None:
        self.state = OWN_TRANSITIONS[self.state][event]


class PeerValues:
    """Agreement on the peer's values: the state, and the versions of the last comparisons."""

    def __init__(self) -> None:
        self.state = PeerState.UNCOMPARED
        self.equal_at: int | None = None  # newest version of the peer that was equal here
        self.different_at: int | None = None  # version that was different here, until the peer voids it
        self._untold: int | None = None  # version that was equal, until a packet says so

    def new_session(self) -> None:
        """Begin with a new session of the peer, of which nothing was compared."""
        self._go(Event.SESSION)
        self.equal_at = self.different_at = self._untold = None

    def found_equal(self, version: int) -> None:
        """Our copy is equal to the peer's values at a version."""
        self._go(Event.EQUAL)
        self.equal_at = self._untold = version

    def take_verdict(self) -> int | None:
        """The version that was found equal, for one packet: should it be lost, the peer sends its digest again."""
        version, self._untold = self._untold, None
        return version

    def found_different(self, version: int) -> bool:
        """Our copy differs from the peer's values at a version. Returns False if that is known already."""
        self._go(Event.DIFFERENT)
        known = self.different_at == version
        self.different_at = version
        return not known

    def voided(self, version: int) -> None:
        """The peer voided its values up to a version."""
        if self.different_at is None or version >= self.different_at:
            self._go(Event.VOIDED)
            self.different_at = None

    def _go(self, event: Event) -> None:
        self.state = PEER_TRANSITIONS[self.state][event]
