"""Images of which the base makes scans, while they are under way to it."""

from kiteline_codec.channel import RecordChannel
from kiteline_codec.schema import Key, ScanImages

_UNDER_WAY = 4  # 100 kB; while they have not arrived, the agent makes its scans by itself


class SentImages:
    """Shares images, a few at a time, and takes them out of the shared values once they have arrived."""

    def __init__(self, channel: RecordChannel) -> None:
        self._channel = channel
        self._under_way: list[Key] = []

    def put(self, record: ScanImages) -> None:
        """Share images."""
        self._channel.put(record)
        self._under_way.append(record.key())

    def remove_arrived(self) -> None:
        """Remove those that the base is known to have."""
        arrived = [key for key in self._under_way if self._channel.arrived(key)]
        for key in arrived:
            self._channel.remove(key)
            self._under_way.remove(key)

    @property
    def has_room(self) -> bool:
        """True if the link is wide, and carries what was put before."""
        return not self._channel.profile.thin and len(self._under_way) < _UNDER_WAY
