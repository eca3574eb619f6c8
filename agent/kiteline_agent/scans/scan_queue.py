"""Scans that wait for room on the link."""

from kiteline_codec.channel import RecordChannel
from kiteline_codec.schema import Key, KeyframeScan, Record, messages

_UNDER_WAY = 4  # later scans that are sent before the first of them is known to have arrived
_WAITING = 1024  # scans kept while the link has no room, as codes: 0.3 MB


class ScanQueue:
    """Shares the first scans of a keyframe at once, later ones newest first, while those before arrive.

    So these never fill a link that is short of bytes. When too many wait, the oldest are dropped.
    """

    def __init__(self, channel: RecordChannel) -> None:
        self._channel = channel
        self._under_way: list[Key] = []
        self._waiting: dict[Key, bytes] = {}  # codes, the newest at the end
        self.any_put = False  # so far

    def __len__(self) -> int:
        """Number of waiting scans."""
        return len(self._waiting)

    def put(self, record: KeyframeScan) -> None:
        """Share a scan, in place of one that waits under the same key."""
        self.any_put = True
        if record.part < KeyframeScan.FIRST_PARTS:
            self._channel.put(record)
            return
        key = record.key()
        self._waiting.pop(key, None)
        self._note_arrived()
        if len(self._under_way) < _UNDER_WAY:
            self._send(key, record)
            return
        self._waiting[key] = messages.encode(record)
        if len(self._waiting) > _WAITING:
            del self._waiting[next(iter(self._waiting))]

    def share(self) -> None:
        """Share what waits, as far as there is room."""
        if not self._waiting:
            return
        self._note_arrived()
        while self._waiting and len(self._under_way) < _UNDER_WAY:
            key, code = self._waiting.popitem()
            self._send(key, messages.decode(key, code))

    def _note_arrived(self) -> None:
        self._under_way = [key for key in self._under_way if not self._channel.arrived(key)]

    def _send(self, key: Key, record: Record) -> None:
        self._channel.put(record)
        self._under_way.append(key)
