"""Times of ROS's messages on our monotonic clock: each topic keeps to one clock, and topics of one clock to one offset.

Drivers on this computer stamp by its wall clock. Another computer, a recording that is played and a simulation have
clocks of their own. Their stamps are shifted by one offset, so that images and inertial samples still fit each other.
"""

import threading
import time

_OLDEST_NS = 1_000_000_000  # ns; stamps older than this are of another clock
_AHEAD_NS = 1_000_000  # ns into the future, by which readings of two clocks may be uncertain
_ALIKE_NS = 300_000_000  # ns; two topics of one clock differ by no more in their delays
_CHANGED_NS = 1_000_000_000  # ns of stamps that do not fit, after which a topic's clock is chosen anew
_DRIFT = 2e-4  # s/s between another clock and ours, at most
_AT_ONCE_NS = 20_000  # ns between two readings of a clock without a pause between them
_READINGS = 5  # of both clocks, at most


class WallClock:
    """This computer's wall clock."""

    def fits(self, stamp_ns: int, now_ns: int) -> bool:
        """True if a topic that sends this stamp now may be stamped by this clock."""
        return -_OLDEST_NS <= self.to_ours(stamp_ns, now_ns) - now_ns <= _AHEAD_NS

    def to_ours(self, stamp_ns: int, now_ns: int) -> int:
        """The time of a stamp on the monotonic clock."""
        return stamp_ns - wall_less_monotonic_ns()


class OtherClock:
    """Any other clock. Messages arrive late, never early: the least delay of all its topics counts as 0."""

    def __init__(self, stamp_ns: int, now_ns: int) -> None:
        self._offset_ns = now_ns - stamp_ns  # our clock less this one, at the least delay seen
        self._last_ns = now_ns

    def fits(self, stamp_ns: int, now_ns: int) -> bool:
        """True if a topic that sends this stamp now may be stamped by this clock."""
        return abs(stamp_ns + self._offset_ns - now_ns) <= _ALIKE_NS

    def to_ours(self, stamp_ns: int, now_ns: int) -> int:
        """The time of a stamp on the monotonic clock, of a message that arrived now."""
        if abs(stamp_ns + self._offset_ns - now_ns) <= _OLDEST_NS:  # a wrong stamp must not move the offset
            drifted_ns = self._offset_ns + round(_DRIFT * (now_ns - self._last_ns))
            self._offset_ns, self._last_ns = min(now_ns - stamp_ns, drifted_ns), now_ns
        return stamp_ns + self._offset_ns


class TopicClock:
    """The clock of one topic."""

    def __init__(self, clocks: "TopicClocks", name: str) -> None:
        """name: how messages begin, such as "camera /image tells no capture times"."""
        self._clocks, self._name = clocks, name
        self._misfit_ns: int | None = None  # arrival of the first of the stamps that do not fit
        self._told = False
        self.clock: WallClock | OtherClock | None = None  # chosen by the first stamp

    def to_ours(self, stamp_ns: int, now_ns: int) -> int:
        """The time of a message that arrived now, on the monotonic clock. stamp_ns: 0 if it has none."""
        with self._clocks.lock:
            if stamp_ns == 0:
                self._tell("its stamps are 0", "Messages count from their arrival: let its driver set header.stamp")
                return now_ns
            t_ns = self._choose(stamp_ns, now_ns) if self.clock is None else self.clock.to_ours(stamp_ns, now_ns)
            if -_OLDEST_NS <= t_ns - now_ns <= _AHEAD_NS:
                self._misfit_ns = None
            elif self._misfit_ns is None:
                self._misfit_ns = now_ns
            elif now_ns - self._misfit_ns >= _CHANGED_NS:
                t_ns, self._misfit_ns = self._choose(stamp_ns, now_ns), None
            return min(t_ns, now_ns)

    def _choose(self, stamp_ns: int, now_ns: int) -> int:
        """Choose the clock by a stamp; its time on the monotonic clock."""
        known: list[WallClock | OtherClock] = [self._clocks.wall, *self._clocks.others()]
        fitting = [clock for clock in known if clock.fits(stamp_ns, now_ns)]
        self.clock = fitting[0] if fitting else OtherClock(stamp_ns, now_ns)
        if self.clock is not self._clocks.wall:
            ahead_s = (self._clocks.wall.to_ours(stamp_ns, now_ns) - now_ns) / 1e9
            self._tell(
                f"its stamps are {abs(ahead_s):.3f} s {'ahead' if ahead_s > 0.0 else 'behind'}",
                "They are shifted so that the least delay is 0: synchronise the clocks of the computers (chrony); "
                "a recording is better flown from its file",
            )
        return self.clock.to_ours(stamp_ns, now_ns)

    def _tell(self, why: str, mend: str) -> None:
        if not self._told:
            self._told = True
            self._clocks.messages.append(f"{self._name} on this computer's clock ({why}). {mend}")


class TopicClocks:
    """The clocks of a source's topics. The topics may be used by several threads."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.wall = WallClock()
        self.messages: list[str] = []
        self._topics: list[TopicClock] = []

    def topic(self, name: str) -> TopicClock:
        """A further topic. name: as of TopicClock."""
        self._topics.append(TopicClock(self, name))
        return self._topics[-1]

    def others(self) -> list[OtherClock]:
        """The clocks of the topics that are not stamped by the wall clock."""
        return [topic.clock for topic in self._topics if isinstance(topic.clock, OtherClock)]

    def take_messages(self) -> list[str]:
        """Messages to the user since the last call."""
        with self.lock:
            messages, self.messages = self.messages, []
        return messages


def wall_less_monotonic_ns() -> int:
    """Difference of the two clocks. A thread that waits for its turn between two readings would add the wait."""
    least_ns, difference_ns = 2**63, 0
    for _ in range(_READINGS):
        before_ns, wall_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        if after_ns - before_ns < least_ns:
            least_ns, difference_ns = after_ns - before_ns, wall_ns - (before_ns + after_ns) // 2
        if least_ns < _AT_ONCE_NS:
            break
    return difference_ns
