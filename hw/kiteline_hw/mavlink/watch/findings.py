"""What is found about a flight controller, said once and again when it changes."""

from dataclasses import dataclass
from enum import IntEnum

SHORT_CHARACTERS = 50  # of a STATUSTEXT's text field


class FindingLevel(IntEnum):
    """How bad a finding is; the values of MAV_SEVERITY."""

    ERROR = 3
    WARNING = 4
    INFO = 6


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding. short: for STATUSTEXT, at most 50 characters. remedy: what to do about it, "" if nothing."""

    topic: str
    level: FindingLevel
    text: str
    short: str
    remedy: str = ""

    @property
    def line(self) -> str:
        """The finding and its remedy in one line, for a terminal."""
        return f"{self.text}. {self.remedy}" if self.remedy else self.text


class FindingLog:
    """Collects findings; one whose topic is still in the same state is not repeated."""

    def __init__(self) -> None:
        self._states: dict[str, object] = {}
        self._new: list[Finding] = []

    def say(self, topic: str, state: object, level: FindingLevel, text: str, short: str, remedy: str = "") -> None:
        """Add a finding unless its topic was last said in the same state."""
        if self.state(topic) == state:
            return
        self._states[topic] = state
        self._new.append(Finding(topic, level, text, short[:SHORT_CHARACTERS], remedy))

    def state(self, topic: str) -> object:
        """The state in which a topic was last said; None if it was not."""
        return self._states.get(topic)

    def forget(self, topic: str) -> None:
        """Let a topic be said again in the same state."""
        self._states.pop(topic, None)

    def take(self) -> list[Finding]:
        """The findings since the last call."""
        new, self._new = self._new, []
        return new
