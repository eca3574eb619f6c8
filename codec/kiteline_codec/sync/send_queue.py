"""One own value with what the peer has of it, and the order in which values are sent."""

import heapq
from collections import Counter, deque
from collections.abc import Callable, Collection
from dataclasses import dataclass, field

from kiteline_codec.coding.packing import varint_bytes, zigzag
from kiteline_codec.schema import Key
from kiteline_codec.sync import ranges
from kiteline_codec.transport.packet import Item

Order = tuple[int, ...]

_MIN_FRAGMENT_BYTES = 32  # a smaller one costs more for its header than it carries
_MAX_COMPRESSION = 4  # a residual code is not tried if it would not fit even at this ratio
_MAX_SKIPPED = 8  # values of one priority that are passed over in search of a shorter one for the rest of a packet
_SLACK = 64  # outdated entries that a queue may hold beyond twice the values


@dataclass(slots=True)
class Entry:
    """The newest version of an own value."""

    version: int
    code: bytes | None  # None: removed
    order: Order
    unsent: ranges.Ranges
    acknowledged: ranges.Ranges = ranges.NONE
    sent: bool = False  # any version, to this session of the peer
    queued: Order | None = None  # the order under which it is in the priority queue
    in_oldest: bool = False  # whether it is in the queue by age
    send_plain: bool = False  # a packet with it was lost: the peer may lack what a residual code is predicted from
    residual: bytes | None = None  # its residual code, if there is one
    residual_state: int | None = None  # state of the predictors for which `residual` was made; None: not made
    hashed: int = 0  # its part of the digest
    size: int = field(default=1, init=False)  # extent of `unsent` and `acknowledged`; a removal or no code is one byte

    def __post_init__(self) -> None:
        self.set_code(self.code)

    def set_code(self, code: bytes | None) -> None:
        """Set another code."""
        self.code = code
        self.size = max(1, len(code or b""))

    @property
    def clean(self) -> bool:
        """True if the peer is known to hold it."""
        return bool(self.acknowledged) and self.acknowledged == ((0, self.size),)

    @property
    def idle(self) -> bool:
        """True if it is a value of which nothing is in flight."""
        whole = ((0, self.size),)
        return self.code is not None and (
            self.acknowledged == whole or (self.unsent == whole and not self.acknowledged)
        )


def item_of(
    key: Key, entry: Entry, room: int, empty: int, last_id: int, watermark: int,
    residual: Callable[[], bytes | None] | None,
) -> Item | None:  # fmt: skip
    """The item of a value that fits into `room` bytes, or None. What fits into an `empty` packet is not split.

    residual: makes the residual code.
    """
    version = entry.version
    head = 1 + varint_bytes(zigzag(key.id - last_id)) + varint_bytes(key.part) + varint_bytes(version - watermark - 1)
    code = entry.code
    if code is None:
        return Item(key, version, None, 0, b"") if head <= room else None
    alone = head + varint_bytes(zigzag(key.id)) - varint_bytes(zigzag(key.id - last_id))  # in a packet of its own
    start, stop = entry.unsent[0]
    whole = entry.unsent == ((0, entry.size),)
    fits_alone = whole and alone + varint_bytes(len(code)) + len(code) <= empty  # the rest of a split one goes in parts
    if fits_alone and len(code) > _MAX_COMPRESSION * room:
        return None
    if residual is not None and not entry.send_plain and whole:
        data = residual()
        if data is not None and head + varint_bytes(len(data)) + len(data) <= room:
            return Item(key, version, len(data), 0, data, residual=True)
        if data is not None and alone + varint_bytes(len(data)) + len(data) <= empty:
            return None
    if whole and head + varint_bytes(len(code)) + len(code) <= room:
        return Item(key, version, len(code), 0, code)
    if fits_alone:
        return None
    head += varint_bytes(room) + varint_bytes(start) + varint_bytes(len(code))
    stop = min(stop, start + room - head)
    if stop - start < min(_MIN_FRAGMENT_BYTES, entry.unsent[0][1] - start):
        return None
    return Item(key, version, len(code), start, code[start:stop])


class Skipped:
    """Values that do not fit the rest of a packet. Those of each priority are passed over up to a number: however many
    long ones wait, shorter ones of lower priority fill the packet.
    """

    def __init__(self) -> None:
        self.values: list[tuple[Key, Entry]] = []
        self.priorities: set[int] = set()  # of which too many were passed over
        self._numbers = Counter[int]()

    def add(self, key: Key, entry: Entry) -> None:
        """Pass over a value."""
        self.values.append((key, entry))
        self._numbers[entry.order[0]] += 1
        if self._numbers[entry.order[0]] == _MAX_SKIPPED:
            self.priorities.add(entry.order[0])


class SendQueue:
    """Entries with anything to send, by priority and by age. `entries` is the outbox's own table."""

    def __init__(self, entries: dict[Key, Entry]) -> None:
        self._entries = entries
        self._by_order: dict[int, list[tuple[Order, Key]]] = {}  # heaps by priority, the first number of an order
        self._by_age: deque[Key] = deque()  # so that none starves
        self._versions: list[tuple[int, Key]] = []  # heap of versions that are not acknowledged

    def __len__(self) -> int:
        """Length of the longest queue, outdated entries included."""
        return max(self._ordered, len(self._by_age), len(self._versions))

    @property
    def _ordered(self) -> int:
        return sum(map(len, self._by_order.values()))

    def restart(self) -> None:
        """Queue every entry, as not acknowledged."""
        self._versions = [(e.version, k) for k, e in self._entries.items()]
        heapq.heapify(self._versions)
        self._by_order = {}
        self._by_age = deque()
        for _, key in sorted(self._versions):
            entry = self._entries[key]
            entry.queued, entry.in_oldest = None, False
            self.add(key, entry)

    def note_version(self, key: Key, entry: Entry) -> None:
        """Note a version that is not acknowledged."""
        heapq.heappush(self._versions, (entry.version, key))
        if len(self._versions) > 2 * len(self._entries) + _SLACK:
            self._versions = [(e.version, k) for k, e in self._entries.items() if not e.clean]
            heapq.heapify(self._versions)

    def add(self, key: Key, entry: Entry) -> None:
        """Queue an entry with anything to send, or one whose order has changed."""
        if entry.queued != entry.order:
            entry.queued = entry.order
            heapq.heappush(self._by_order.setdefault(entry.order[0], []), (entry.order, key))
            if self._ordered > 2 * len(self._entries) + _SLACK:
                self._drop_outdated()
        if not entry.in_oldest:
            entry.in_oldest = True
            self._by_age.append(key)
            if len(self._by_age) > 2 * len(self._entries) + _SLACK:
                self._by_age = deque(dict.fromkeys(k for k in self._by_age if k in self._entries))

    def _drop_outdated(self) -> None:
        self._by_order = {}
        for key, entry in self._entries.items():
            if entry.queued is not None:
                self._by_order.setdefault(entry.queued[0], []).append((entry.queued, key))
        for heap in self._by_order.values():
            heapq.heapify(heap)

    def top(self, without: Collection[int] = ()) -> Key | None:
        """The entry that goes first. without: priorities that are left out."""
        for priority in sorted(self._by_order):
            heap = self._by_order[priority]
            while heap and priority not in without:
                order, key = heap[0]
                entry = self._entries.get(key)
                if entry is not None and entry.queued == order:
                    if entry.unsent:
                        return key
                    entry.queued = None
                heapq.heappop(heap)
        return None

    def pop(self, entry: Entry) -> None:
        """Remove an entry that `top` gave."""
        assert entry.queued is not None
        heapq.heappop(self._by_order[entry.queued[0]])
        entry.queued = None

    def oldest(self) -> Key | None:
        """The entry that has waited longest."""
        while self._by_age:
            key = self._by_age[0]
            entry = self._entries.get(key)
            if entry is not None and entry.unsent:
                return key
            if entry is not None:
                entry.in_oldest = False
            self._by_age.popleft()
        return None

    def least_version(self) -> int | None:
        """The least version that is not acknowledged; None when all are."""
        while self._versions:
            version, key = self._versions[0]
            entry = self._entries.get(key)
            if entry is not None and entry.version == version and not entry.clean:
                return version
            heapq.heappop(self._versions)
        return None
