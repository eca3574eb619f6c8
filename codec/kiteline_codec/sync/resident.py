"""Which values of keyframes stand in memory, the longest untouched first, and how much of it they take, about."""

from __future__ import annotations

from collections import OrderedDict

from kiteline_codec.schema import Key


class Resident:
    """The books of a bounded table: it says when there is too much, its owner says where that goes."""

    def __init__(self, limit_bytes: int, kinds: frozenset[int], value_bytes: int) -> None:
        """limit_bytes: of memory, 0: any number. kinds: of values that count. value_bytes: what one takes beside its
        code.
        """
        self.limit_bytes = limit_bytes
        self.bytes = 0
        self._kinds = kinds
        self._value_bytes = value_bytes
        self._ids: OrderedDict[int, set[Key]] = OrderedDict()

    @property
    def full(self) -> bool:
        """Whether the bound is passed."""
        return bool(self.limit_bytes) and self.bytes > self.limit_bytes

    @property
    def roomy(self) -> bool:
        """Whether a quarter of what is allowed is free."""
        return self.bytes <= self.limit_bytes * 3 // 4

    def ids(self) -> list[int]:
        """The ids of all that counts, the longest untouched first."""
        return list(self._ids)

    def keys(self, id_: int) -> list[Key]:
        """The values of an id, in order."""
        return sorted(self._ids.get(id_, ()))

    def count(self, key: Key, size: int) -> None:
        """A value with a code of so many bytes is here."""
        if self.limit_bytes and key.kind in self._kinds:
            self._ids.setdefault(key.id, set()).add(key)
            self._ids.move_to_end(key.id)
            self.bytes += size + self._value_bytes

    def uncount(self, key: Key, size: int) -> None:
        """It is not here any more; one that did not count is ignored."""
        keys = self._ids.get(key.id)
        if keys is not None and key in keys:
            self.bytes -= size + self._value_bytes
            keys.discard(key)
            if not keys:
                del self._ids[key.id]

    def goes_first(self, id_: int) -> None:
        """Of all ids, this one is to leave first."""
        if id_ in self._ids:
            self._ids.move_to_end(id_, last=False)

    def unbound(self) -> None:
        """Nothing counts from now on."""
        self.limit_bytes = self.bytes = 0
        self._ids.clear()
