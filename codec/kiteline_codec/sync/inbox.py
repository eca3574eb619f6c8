"""What one session of the peer wrote, as far as it has arrived.

With a limit, values of keyframes that were not used for long are archived until they are needed: in a spill, else
packed.
"""

import heapq
from dataclasses import dataclass

from kiteline_codec.schema import KEYFRAME_KINDS, Key
from kiteline_codec.sync import ranges
from kiteline_codec.sync.archive import Archive, Row, Spill
from kiteline_codec.sync.digest import MODULUS, Digest, hash_value
from kiteline_codec.sync.resident import ResidentValues
from kiteline_codec.transport.packet import MASK_BITS, Item
from kiteline_codec.transport.sequence_window import SequenceWindow

VALUE_BYTES = 350  # memory of a value beside its code, roughly; of a removal or of a value that came in part, too
_MOST_PIECES = 256  # gaps in a value that comes in part: a link has 64 packets in flight


@dataclass(frozen=True, slots=True)
class Update:
    """A value that the peer wrote, or removed (code None)."""

    key: Key
    code: bytes | None


@dataclass(slots=True)
class _Assembly:
    version: int
    data: bytearray
    received: ranges.Ranges


class Inbox:
    """Packet numbers, values, removals and unfinished values of one session of the peer."""

    def __init__(self, resident_bytes: int | None = None, spill: Spill | None = None) -> None:
        """resident_bytes: memory for values of keyframes that are at hand, roughly; None: all are."""
        self._values: dict[Key, tuple[int, bytes]] = {}
        self._hashed: dict[Key, int] = {}  # parts of the digest, of values that were not archived since they came
        self._packed = spill is None  # archived values stay in memory, where one can be read by itself
        self._archive = Archive(spill, packed=self._packed)
        self._resident = ResidentValues(resident_bytes, VALUE_BYTES)
        self.digest = Digest()
        self.value_bytes = 0  # of codes
        self.assembly_bytes = 0  # of values that have arrived in part, with what they take beside their bytes
        self.newest = 0  # highest version seen; versions count from 1
        self.watermark = 0  # all versions up to it have arrived, or do not matter any more
        self._removed: dict[Key, int] = {}
        self._removed_order: list[tuple[int, Key]] = []
        self._assemblies: dict[Key, _Assembly] = {}
        self.packets = SequenceWindow(MASK_BITS)

    def __len__(self) -> int:
        return len(self._values) + self._archive.values

    def held(self, key: Key) -> tuple[int, bytes] | None:
        """Version and code of a value, None when there is none."""
        value = self._values.get(key)
        if value is not None or not self._is_archived(key):
            return value
        return self._archive.peek(key.id, key.kind, key.part) if self._packed else self._fetched(key)

    def _is_archived(self, key: Key) -> bool:
        """True if the values of the key's id are in the archive: all of them, or none."""
        return key.kind in KEYFRAME_KINDS and key.id in self._archive

    def _fetched(self, key: Key) -> tuple[int, bytes] | None:
        """Version and code of a value, which is not in the archive then."""
        value = self._values.get(key)
        if value is None and self._is_archived(key):
            self._fetch(key.id)
            self._make_room(key.id)
            return self._values.get(key)
        return value

    def codes(self) -> dict[Key, bytes]:
        """The codes of all values."""
        self._fetch_all()
        out = {key: code for key, (_, code) in self._values.items()}
        self._make_room()
        return out

    @property
    def resident_bytes(self) -> int:
        """Memory of values of keyframes, roughly; 0 if it is not limited."""
        return self._resident.bytes + self._archive.resident_bytes

    @property
    def assembling(self) -> int:
        """The number of values that have arrived in part."""
        return len(self._assemblies)

    def acknowledgement(self) -> tuple[int, int] | None:
        """The last packet number and a mask of those missing before it; None when nothing has arrived."""
        last = self.packets.highest
        return None if last is None else (last, self.packets.missing())

    @property
    def held_bytes(self) -> int:
        """Memory of values and removals, roughly; where values are archived, that of their codes in the archive too."""
        return self.value_bytes + VALUE_BYTES * (len(self) + len(self._removed_order))

    def room_for(self, items: list[Item], max_values: int, max_assemblies: int) -> bool:
        """True if memory for the items is within the limits, in bytes."""
        assemblies, values = self.assembly_bytes, self.held_bytes
        begun: dict[Key, tuple[int, int]] = {}  # version and length of values that this packet begins
        for item in items:
            values += VALUE_BYTES
            if item.total is None:
                continue
            values += len(item.data)
            if item.whole:
                continue
            part = self._assemblies.get(item.key)
            known = begun.get(item.key) or (None if part is None else (part.version, len(part.data)))
            if known != (item.version, item.total):
                begun[item.key] = item.version, item.total
                assemblies += item.total + VALUE_BYTES
        return values <= max_values and assemblies <= max_assemblies

    def raise_watermark(self, version: int) -> None:
        """Note that all versions up to `version` have arrived, and drop the tombstones up to it."""
        if version <= self.watermark:
            return
        self.watermark = version
        while self._removed_order and self._removed_order[0][0] <= version:
            removed, key = heapq.heappop(self._removed_order)
            if self._removed.get(key) == removed:
                del self._removed[key]
        for key in [k for k, a in self._assemblies.items() if a.version <= version]:
            self._drop_assembly(key)

    def void(self, version: int) -> list[Key]:
        """Drop all values up to a version. Returns their keys."""
        self._fetch_all()
        void = sorted(k for k, (v, _) in self._values.items() if v <= version)
        for key in void:
            self._drop_value(key)
        self.raise_watermark(version)
        self.newest = max(self.newest, version)
        return void

    def apply(self, item: Item) -> Update | None:
        """Take in an item. Returns the value that changed, if any."""
        key, version = item.key, item.version
        self.newest = max(self.newest, version)
        held = self._fetched(key)
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
        self._values[key] = (version, data)
        self.value_bytes += len(data)
        hashed = self._hashed[key] = hash_value(key, version, data)
        self.digest.add(hashed)
        self._resident.count(key, len(data))
        self._make_room(key.id)
        return Update(key, data)

    def _assemble(self, item: Item) -> bytes | None:
        """Take in a fragment. Returns the code once it is complete."""
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
            self.assembly_bytes += item.total + VALUE_BYTES
        if len(part.received) >= _MOST_PIECES:
            self._drop_assembly(item.key)
            return None
        stop = item.offset + len(item.data)
        part.data[item.offset : stop] = item.data
        part.received = ranges.add(part.received, item.offset, stop)
        return bytes(part.data) if part.received == ((0, item.total),) else None

    def _drop_assembly(self, key: Key, up_to: int | None = None) -> None:
        part = self._assemblies.get(key)
        if part is not None and (up_to is None or part.version <= up_to):
            self.assembly_bytes -= len(part.data) + VALUE_BYTES
            del self._assemblies[key]

    def _drop_value(self, key: Key) -> None:
        held = self._values.pop(key, None)
        if held is not None:
            hashed = self._hashed.pop(key, None)
            self.digest.discard(hash_value(key, *held) if hashed is None else hashed)
            self.value_bytes -= len(held[1])
            self._resident.uncount(key, len(held[1]))

    # ---- memory

    def _make_room(self, needed: int | None = None) -> None:
        """Above the limit, archive the least recently used ids, down to 3/4 of it; never the id needed now."""
        if not self._resident.full:
            return
        for id_ in self._resident.ids():
            if self._resident.roomy or (id_ != needed and not self._to_archive(id_)):
                return

    def _to_archive(self, id_: int) -> bool:
        """Archive the values of an id. If the spill fails, all values stay in memory from now on: returns False."""
        keys = self._resident.keys(id_)
        rows, hashes = [], 0
        for key in keys:
            version, code = self._values[key]
            rows.append(Row(key.kind, key.part, version, True, True, False, len(code), code))
            hashes += hash_value(key, version, code)
        self._archive.put(id_, rows, hashes % MODULUS)
        if not self._archive.readable(id_):
            self._archive.take(id_)
            self._resident.remove_limit()
            return False
        for key in keys:
            self._resident.uncount(key, len(self._values.pop(key)[1]))
            self._hashed.pop(key, None)
        return True

    def close(self) -> None:
        """Free what archived values take in the spill; nothing is read or taken in after that."""
        self._archive.close()

    def _fetch_all(self) -> None:
        for id_ in list(self._archive):
            self._fetch(id_)

    def _fetch(self, id_: int) -> None:
        """Take the values of an id back into memory. If they are lost, digests differ, and the peer sends again."""
        hashes = self._archive.hashes(id_)
        rows = self._archive.take(id_)
        if any(row.code is None for row in rows):
            self.digest.discard(hashes)
            self.value_bytes -= sum(row.size for row in rows)
            return
        for row in rows:
            key, code = Key(row.kind, id_, row.part), row.code or b""
            self._values[key] = row.version, code
            self._resident.count(key, len(code))
