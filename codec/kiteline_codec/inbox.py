"""What one session of the peer wrote, as far as it has arrived."""

from __future__ import annotations

import heapq
from dataclasses import dataclass

from kiteline_codec import ranges
from kiteline_codec.digest import Digest
from kiteline_codec.packet import MASK_BITS, Item
from kiteline_codec.schema import Key

_MASK = (1 << MASK_BITS) - 1


@dataclass(frozen=True, slots=True)
class Update:
    """A value that the peer wrote, or took back (code None)."""

    key: Key
    code: bytes | None


@dataclass(slots=True)
class _Assembly:
    version: int
    data: bytearray
    got: ranges.Ranges


class Inbox:
    """Packet numbers, values, removals and unfinished values of one session of the peer."""

    def __init__(self) -> None:
        self.values: dict[Key, tuple[int, bytes]] = {}
        self.digest = Digest()
        self.value_bytes = 0
        self.assembly_bytes = 0
        self.newest = 0  # highest version seen
        self.watermark = 0  # all versions up to it have arrived, or do not matter any more
        self._removed: dict[Key, int] = {}
        self._removed_order: list[tuple[int, Key]] = []
        self._assemblies: dict[Key, _Assembly] = {}
        self._last = 0
        self._seen = 0  # bit i: packet last - 1 - i has arrived

    @property
    def assembling(self) -> int:
        """How many values have arrived in part."""
        return len(self._assemblies)

    @property
    def tombstones(self) -> int:
        """How many removals are remembered."""
        return len(self._removed)

    def acknowledgement(self) -> tuple[int, int] | None:
        """The last packet number and a mask of those missing before it; None when nothing has arrived."""
        if not self._last:
            return None
        return self._last, ~self._seen & (1 << min(MASK_BITS, self._last - 1)) - 1

    def is_new(self, number: int) -> bool:
        """Whether a packet is neither a repetition nor older than an acknowledgement can tell."""
        behind = self._last - number
        return behind < 0 or (0 < behind <= MASK_BITS and not self._seen >> behind - 1 & 1)

    def mark(self, number: int) -> None:
        """A new packet has been taken in."""
        ahead = number - self._last
        if ahead > MASK_BITS:
            self._last, self._seen = number, 0
        elif ahead > 0:
            self._seen = (self._seen << ahead | (1 << ahead - 1 if self._last else 0)) & _MASK
            self._last = number
        else:
            self._seen |= 1 << -ahead - 1

    def room_for(self, items: list[Item], max_values: int, max_assemblies: int) -> bool:
        """Whether memory for the items is within the limits, in bytes."""
        assemblies, values = self.assembly_bytes, self.value_bytes
        for item in items:
            if item.total is None:
                continue
            values += len(item.data)
            if not item.whole and item.key not in self._assemblies:
                assemblies += item.total
        return values <= max_values and assemblies <= max_assemblies

    def raise_watermark(self, version: int) -> None:
        """The peer knows that all its versions up to this one have arrived: forget removals up to it."""
        if version <= self.watermark:
            return
        self.watermark = version
        while self._removed_order and self._removed_order[0][0] <= version:
            removed, key = heapq.heappop(self._removed_order)
            if self._removed.get(key) == removed:
                del self._removed[key]
        for key in [k for k, a in self._assemblies.items() if a.version <= version]:
            self._drop_assembly(key)

    def reset(self, version: int) -> list[Key]:
        """The peer voids its values up to a version. Returns their keys."""
        void = sorted(k for k, (v, _) in self.values.items() if v <= version)
        for key in void:
            self._drop_value(key)
        self.raise_watermark(version)
        self.newest = max(self.newest, version)
        return void

    def apply(self, item: Item) -> Update | None:
        """Take in an item. Returns what became known by it, if anything."""
        key, version = item.key, item.version
        self.newest = max(self.newest, version)
        held = self.values.get(key)
        known = held[0] if held is not None else max(self._removed.get(key, 0), self.watermark)
        if version <= known:
            return None
        if item.total is None:
            self._drop_assembly(key, version)
            self._drop_value(key)
            self._removed[key] = version
            heapq.heappush(self._removed_order, (version, key))
            return Update(key, None)
        data = item.data if item.whole else self._assemble(item)
        if data is None:
            return None
        self._drop_assembly(key, version)
        self._drop_value(key)
        self._removed.pop(key, None)
        self.values[key] = (version, data)
        self.value_bytes += len(data)
        self.digest.add(key, version, data)
        return Update(key, data)

    def _assemble(self, item: Item) -> bytes | None:
        assert item.total is not None
        part = self._assemblies.get(item.key)
        if part is not None and (part.version > item.version or len(part.data) != item.total):
            if part.version >= item.version:
                return None
            part = None
        if part is None or part.version < item.version:
            self._drop_assembly(item.key)
            part = _Assembly(item.version, bytearray(item.total), ranges.NONE)
            self._assemblies[item.key] = part
            self.assembly_bytes += item.total
        stop = item.offset + len(item.data)
        part.data[item.offset : stop] = item.data
        part.got = ranges.add(part.got, item.offset, stop)
        return bytes(part.data) if part.got == ((0, item.total),) else None

    def _drop_assembly(self, key: Key, up_to: int | None = None) -> None:
        part = self._assemblies.get(key)
        if part is not None and (up_to is None or part.version <= up_to):
            self.assembly_bytes -= len(part.data)
            del self._assemblies[key]

    def _drop_value(self, key: Key) -> None:
        held = self.values.pop(key, None)
        if held is not None:
            self.digest.discard(key, *held)
            self.value_bytes -= len(held[1])
