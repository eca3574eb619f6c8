"""Which values of keyframes are in memory, by last use, and roughly how many bytes they take."""

from collections import OrderedDict

from kiteline_codec.schema import KEYFRAME_KINDS, Key


class ResidentValues:
    """Counts values of keyframes against a limit; its owner decides where values go when it is exceeded."""

    def __init__(self, limit_bytes: int | None, value_bytes: int) -> None:
        """limit_bytes: None for no limit; then nothing is counted. value_bytes: memory of a value beside its code."""
        self._limit_bytes = limit_bytes
        self.bytes = 0
        self._value_bytes = value_bytes
        self._ids: OrderedDict[int, set[Key]] = OrderedDict()  # least recently used first

    @property
    def full(self) -> bool:
        """True if the limit is exceeded."""
        return self._limit_bytes is not None and self.bytes > self._limit_bytes

    @property
    def roomy(self) -> bool:
        """True if a quarter of the limit is free."""
        return self._limit_bytes is None or self.bytes <= self._limit_bytes * 3 // 4

    def ids(self) -> list[int]:
        """The ids of all counted values, least recently used first."""
        return list(self._ids)

    def keys(self, id_: int) -> list[Key]:
        """The counted values of an id, in order."""
        return sorted(self._ids.get(id_, ()))

    def count(self, key: Key, size: int) -> None:
        """Count a value with a code of `size` bytes."""
        if self._limit_bytes is not None and key.kind in KEYFRAME_KINDS:
            self._ids.setdefault(key.id, set()).add(key)
            self._ids.move_to_end(key.id)
            self.bytes += size + self._value_bytes

    def uncount(self, key: Key, size: int) -> None:
        """Stop counting a value; one that was not counted is ignored."""
        keys = self._ids.get(key.id)
        if keys is not None and key in keys:
            self.bytes -= size + self._value_bytes
            keys.discard(key)
            if not keys:
                del self._ids[key.id]

    def evict_first(self, id_: int) -> None:
        """Make an id the least recently used."""
        if id_ in self._ids:
            self._ids.move_to_end(id_, last=False)

    def remove_limit(self) -> None:
        """Count nothing from now on."""
        self._limit_bytes = None
        self.bytes = 0
        self._ids.clear()
