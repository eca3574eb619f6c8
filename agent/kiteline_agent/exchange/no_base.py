"""The channel of an agent that flies without a base: nothing is sent, nothing comes."""

from __future__ import annotations

from collections.abc import Sequence

from kiteline_codec.pacing.profiles import EXACT
from kiteline_codec.schema import Key, LivePose, Record, messages


class NoBaseChannel:
    """A RecordChannel with nobody at the other end."""

    profile = EXACT

    def __init__(self) -> None:
        self.noting = False  # whether `take_noted` will be asked
        self._noted: dict[Key, Record] = {}

    def keyframe_gap_ns(self) -> int:
        """None: there is no link."""
        return 0

    def arrived(self, key: Key) -> bool:
        """Nobody waits for it."""
        return True

    def put(self, record: Record) -> Record:
        """The record as it is: no code has rounded it."""
        if self.noting and not isinstance(record, LivePose):
            self._noted[messages.key(record)] = record
        return record

    def take_noted(self) -> dict[Key, bytes]:
        """The codes of what was put since the last call, live poses left out: for a log, while `noting`."""
        noted, self._noted = self._noted, {}
        return {key: messages.encode(record) for key, record in noted.items()}

    def remove(self, key: Key) -> None:
        """Nothing was shared, so nothing is taken back."""

    def receive(self, packets: Sequence[bytes], now_ns: int) -> list[Record]:
        """Nothing."""
        return []

    def take_removed(self) -> list[Key]:
        """Nothing."""
        return []

    def poll(self, now_ns: int) -> list[bytes]:
        """Nothing."""
        return []
