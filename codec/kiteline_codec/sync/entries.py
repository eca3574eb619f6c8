"""One value of ours as the outbox knows it, what of it goes into a packet, and the order in which values wait."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from kiteline_codec.coding.packing import varint_bytes, zigzag
from kiteline_codec.schema import Key
from kiteline_codec.sync import ranges
from kiteline_codec.transport.packet import Item

Order = tuple[int, ...]

_MIN_FRAGMENT_BYTES = 32  # a smaller one costs more for its header than it carries
_MOST_SHRUNK = 4  # times a tight form may be shorter than its code: none is tried where even that would not fit
_SLACK = 64  # outdated entries that a queue may hold beyond twice the values


@dataclass(slots=True)
class Entry:
    """The newest version of a value."""

    version: int
    code: bytes | None  # None: removed
    order: Order
    todo: ranges.Ranges  # bytes to be sent
    acked: ranges.Ranges = ranges.NONE
    sent: bool = False  # whether any version was ever sent to this session of the peer
    queued: Order | None = None  # the order under which it waits in the queue
    waiting: bool = False  # whether it waits among the oldest
    plain: bool = False  # a packet with it was lost: the peer may lack what a tight form builds upon
    form: bytes | None = None  # its tight form, where there is one
    form_of: int = -1  # the state of what the peer is known to hold in which `form` was made; -1: not made
    hashed: int = 0  # its part of the digest

    @property
    def size(self) -> int:
        """Extent of `todo` and `acked`; a removal and an empty value count as one byte."""
        return max(1, len(self.code or b""))

    @property
    def clean(self) -> bool:
        """Whether the peer is known to hold it."""
        return self.acked == ((0, self.size),)

    @property
    def still(self) -> bool:
        """Whether it is a value of which nothing is on its way."""
        whole = ((0, self.size),)
        return self.code is not None and (self.acked == whole or (self.todo == whole and not self.acked))


def item_of(
    key: Key, entry: Entry, room: int, empty: int, last_id: int, watermark: int, form: Callable[[], bytes | None] | None
) -> Item | None:
    """What of a value fits into `room` bytes, or None. What fits a packet of its own, `empty`, is not split.

    form: makes the tight form.
    """
    version = entry.version
    head = 1 + varint_bytes(zigzag(key.id - last_id)) + varint_bytes(key.part) + varint_bytes(version - watermark - 1)
    code = entry.code
    if code is None:
        return Item(key, version, None, 0, b"") if head <= room else None
    alone = head + varint_bytes(zigzag(key.id)) - varint_bytes(zigzag(key.id - last_id))  # in a packet of its own
    start, stop = entry.todo[0]
    fits_alone = alone + varint_bytes(len(code)) + len(code) <= empty
    if fits_alone and len(code) > _MOST_SHRUNK * room:
        return None
    whole = entry.todo == ((0, entry.size),)
    if form is not None and not entry.plain and whole:
        tight = form()
        if tight is not None and head + varint_bytes(len(tight)) + len(tight) <= room:
            return Item(key, version, len(tight), 0, tight, tight=True)
        if tight is not None and alone + varint_bytes(len(tight)) + len(tight) <= empty:
            return None
    if whole and head + varint_bytes(len(code)) + len(code) <= room:
        return Item(key, version, len(code), 0, code)
    if fits_alone:
        return None
    head += varint_bytes(room) + varint_bytes(start) + varint_bytes(len(code))
    stop = min(stop, start + room - head)
    if stop - start < min(_MIN_FRAGMENT_BYTES, entry.todo[0][1] - start):
        return None
    return Item(key, version, len(code), start, code[start:stop])


class Waiting:
    """The order in which entries are sent. `entries` is the outbox's own table."""

    def __init__(self, entries: dict[Key, Entry]) -> None:
        self._entries = entries
        self._queue: list[tuple[Order, Key]] = []  # heap: most valuable first
        self._oldest: deque[Key] = deque()  # by the time since which they wait, so that none starves
        self._versions: list[tuple[int, Key]] = []  # heap of versions not known to have arrived

    def __len__(self) -> int:
        """Of the longest of the queues, outdated entries included."""
        return max(len(self._queue), len(self._oldest), len(self._versions))

    def restart(self) -> None:
        """Every entry waits, and counts as not having arrived."""
        self._versions = [(e.version, k) for k, e in self._entries.items()]
        heapq.heapify(self._versions)
        self._queue = []
        self._oldest = deque()
        for _, key in sorted(self._versions):
            entry = self._entries[key]
            entry.queued, entry.waiting = None, False
            self.add(key, entry)

    def note_version(self, key: Key, entry: Entry) -> None:
        """A version that has not arrived."""
        heapq.heappush(self._versions, (entry.version, key))
        if len(self._versions) > 2 * len(self._entries) + _SLACK:
            self._versions = [(e.version, k) for k, e in self._entries.items() if not e.clean]
            heapq.heapify(self._versions)

    def add(self, key: Key, entry: Entry) -> None:
        """An entry with anything to send, or one whose order has changed."""
        if entry.queued != entry.order:
            entry.queued = entry.order
            heapq.heappush(self._queue, (entry.order, key))
            if len(self._queue) > 2 * len(self._entries) + _SLACK:
                self._queue = [(e.queued, k) for k, e in self._entries.items() if e.queued is not None]
                heapq.heapify(self._queue)
        if not entry.waiting:
            entry.waiting = True
            self._oldest.append(key)
            if len(self._oldest) > 2 * len(self._entries) + _SLACK:
                self._oldest = deque(dict.fromkeys(k for k in self._oldest if k in self._entries))

    def top(self) -> Key | None:
        """The most valuable value that waits."""
        while self._queue:
            order, key = self._queue[0]
            entry = self._entries.get(key)
            if entry is not None and entry.queued == order:
                if entry.todo:
                    return key
                entry.queued = None
            heapq.heappop(self._queue)
        return None

    def pop(self, entry: Entry) -> None:
        """The top leaves the queue."""
        heapq.heappop(self._queue)
        entry.queued = None

    def oldest(self) -> Key | None:
        """The value that has waited longest."""
        while self._oldest:
            key = self._oldest[0]
            entry = self._entries.get(key)
            if entry is not None and entry.todo:
                return key
            if entry is not None:
                entry.waiting = False
            self._oldest.popleft()
        return None

    def least_version(self) -> int | None:
        """The least version that has not arrived; None when all have."""
        while self._versions:
            version, key = self._versions[0]
            entry = self._entries.get(key)
            if entry is not None and entry.version == version and not entry.clean:
                return version
            heapq.heappop(self._versions)
        return None
