"""The channel of an agent without a base: nothing is sent or received."""

from collections.abc import Sequence

from kiteline_codec.pacing.profiles import EXACT
from kiteline_codec.schema import Key, LivePose, Record, messages


class NoBaseChannel:
    """A RecordChannel without another end; can collect what was put for a log."""

    profile = EXACT

    def __init__(self) -> None:
        self.noting = False  # collect records for `take_noted`
        self._noted: dict[Key, Record] = {}

    def keyframe_gap_ns(self) -> int:
        """0: there is no link."""
        return 0

    def rate_bytes_s(self) -> int | None:
        """None: there is no link."""
        return None

    def arrived(self, key: Key) -> bool:
        """True: nothing waits for an acknowledgement."""
        return True

    def put(self, record: Record) -> Record:
        """The record itself, not quantised."""
        if self.noting and not isinstance(record, LivePose):
            self._noted[messages.key(record)] = record
        return record

    def take_noted(self) -> dict[Key, bytes]:
        """Codes of the records put since the last call but for live poses, while `noting`."""
        noted, self._noted = self._noted, {}
        return {key: messages.encode(record) for key, record in noted.items()}

    def remove(self, key: Key) -> None:
        """Do nothing: nothing was shared."""

    def receive(self, packets: Sequence[bytes], now_ns: int) -> list[Record]:
        """No records: no base sends any."""
        return []

    def take_removed(self) -> list[Key]:
        """No keys: no base removes records."""
        return []

    def poll(self, now_ns: int) -> list[bytes]:
        """No packets: no base receives any."""
        return []
