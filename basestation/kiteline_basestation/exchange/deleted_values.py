"""Own values of deleted maps: removed once the agent has everything, so that they take no memory of either side."""

from collections.abc import Collection

from kiteline_codec.channel import CodedChannel
from kiteline_codec.schema import KEYFRAME_KINDS, Key
from kiteline_codec.schema.owners import submap_of
from kiteline_core.ids import SubmapId

_AT_ONCE = 50  # removals in a step: a few hundred bytes


class DeletedValues:
    """The values of keyframes of deleted submaps that one agent's channel still shares."""

    def __init__(self) -> None:
        self._seen = 0  # submaps that had been deleted at the last look
        self._keys: list[Key] = []  # the next one last

    def remove_some(self, channel: CodedChannel, deleted: Collection[SubmapId]) -> None:
        """Remove some of them, if the agent has all values: that a keyframe is culled has to reach it first.

        deleted: all that ever were.
        """
        if self._seen < len(deleted):
            self._seen = len(deleted)
            keys = channel.own_values()
            self._keys = sorted((k for k in keys if k.kind in KEYFRAME_KINDS and submap_of(k) in deleted), reverse=True)
        if self._keys and not channel.endpoint.backlog_bytes:
            for key in self._keys[-_AT_ONCE:]:
                channel.remove(key)
            del self._keys[-_AT_ONCE:]
