"""What this side wrote: the newest version of each value, what of it the peer lacks, and what is on its way."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from kiteline_codec import ranges
from kiteline_codec.digest import Digest
from kiteline_codec.packet import MASK_BITS, Item, write_item
from kiteline_codec.packing import Writer, varint_bytes, zigzag
from kiteline_codec.schema import Key

Order = tuple[int, ...]
Known = Callable[[Key], tuple[int, bytes] | None]  # version and code of a value of ours that the peer holds
Shrink = Callable[[Key, bytes, Known], bytes | None]  # a shorter form of a code, None where there is none

_MIN_FRAGMENT_BYTES = 32  # a smaller one costs more for its header than it carries
_MAX_SKIPPED = 8  # values too long for the rest of a packet that are passed over in search of a shorter one
_MOST_SHRUNK = 4  # times a tight form may be shorter than its code: none is tried where even that would not fit
_MAX_LATE = 2 * MASK_BITS  # packets taken for lost that are remembered in case their acknowledgement comes late
_SLACK = 64  # outdated entries that a queue may hold beyond twice the values


@dataclass(slots=True)
class _Entry:
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

    @property
    def size(self) -> int:
        """Extent of `todo` and `acked`; a removal and an empty value count as one byte."""
        return max(1, len(self.code or b""))

    @property
    def clean(self) -> bool:
        return self.acked == ((0, self.size),)


@dataclass(slots=True)
class Flight:
    """A packet on its way: (key, version, first byte, last byte + 1) of what it carries."""

    sent_ns: int
    n_bytes: int
    carried: list[tuple[Key, int, int, int]]
    lost: bool = False


class Outbox:
    """Values to share, with their versions, in one relation between two sessions after another."""

    def __init__(
        self, packet_bytes: int, oldest_every: int, shrink: Shrink | None = None, basis: frozenset[int] = frozenset()
    ) -> None:
        """basis: kinds of values that tight forms build upon."""
        self._shrink = shrink
        self._basis = basis
        self._leant = False  # whether a tight form was built upon values of the same packet
        self._known_state = 0  # counts changes of what of the basis the peer is known to hold
        self.digest = Digest()
        self.newest = 0  # versions number all changes of all values
        self.pending = 0  # values that the peer is not known to hold
        self.pending_bytes = 0  # of their codes
        self.in_flight = 0
        self.lost = 0
        self.acked_bytes = 0  # of packets with values
        self._oldest_every = oldest_every
        self._entries: dict[Key, _Entry] = {}
        self._queue: list[tuple[Order, Key]] = []  # heap: most valuable first
        self._oldest: deque[Key] = deque()  # by the time since which they wait, so that none starves
        self._versions: list[tuple[int, Key]] = []  # heap of versions not known to have arrived
        self._flights: dict[int, Flight] = {}  # by packet number, in order
        self._number = 0

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def clean(self) -> bool:
        """Whether the peer is known to hold everything."""
        return not self.pending

    @property
    def next_number(self) -> int:
        """The number of the next packet."""
        return self._number + 1

    def live(self) -> int:
        """How many values there are, removals not counted."""
        return sum(e.code is not None for e in self._entries.values())

    def codes(self) -> dict[Key, bytes]:
        """The newest code of each value that was not removed, by key."""
        return {key: entry.code for key, entry in self._entries.items() if entry.code is not None}

    def put(self, key: Key, code: bytes, order: Order) -> None:
        """A new value, or a new version of one; the same code again changes nothing but its order."""
        entry = self._entries.get(key)
        if entry is not None and entry.code == code:
            entry.order = order
            if entry.todo:
                self._enqueue(key, entry)
            return
        self._change(key, code, order)

    def remove(self, key: Key) -> None:
        """Take a value back. One of which nothing was ever sent is forgotten without a word."""
        entry = self._entries.get(key)
        if entry is None or entry.code is None:
            return
        if entry.sent:
            self._change(key, None, entry.order)
            return
        self.digest.discard(key, entry.version, entry.code)
        self.newest += 1
        self._known_state += key.kind in self._basis
        self.pending -= 1
        self.pending_bytes -= entry.size
        del self._entries[key]

    def _change(self, key: Key, code: bytes | None, order: Order) -> None:
        self.newest += 1
        entry = self._entries.get(key)
        self._known_state += key.kind in self._basis
        if entry is None:
            entry = self._entries[key] = _Entry(self.newest, code, order, ranges.NONE)
            self.pending += 1
        else:
            if entry.code is not None:
                self.digest.discard(key, entry.version, entry.code)
            self.pending += entry.clean
            self.pending_bytes -= 0 if entry.clean else entry.size
            entry.version, entry.code, entry.order = self.newest, code, order
        entry.form_of = -1
        entry.acked = ranges.NONE
        entry.todo = ((0, entry.size),)
        self.pending_bytes += entry.size
        if code is not None:
            self.digest.add(key, entry.version, code)
        heapq.heappush(self._versions, (entry.version, key))
        if len(self._versions) > 2 * len(self._entries) + _SLACK:
            self._versions = [(e.version, k) for k, e in self._entries.items() if not e.clean]
            heapq.heapify(self._versions)
        self._enqueue(key, entry)

    def _enqueue(self, key: Key, entry: _Entry) -> None:
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
                order = dict.fromkeys(k for k in self._oldest if k in self._entries)
                self._oldest = deque(order)

    def watermark(self) -> int:
        """All versions up to this one have arrived, or were replaced or taken back since."""
        heap = self._versions
        while heap:
            version, key = heap[0]
            entry = self._entries.get(key)
            if entry is not None and entry.version == version and not entry.clean:
                return version - 1
            heapq.heappop(heap)
        return self.newest

    def held(self, key: Key) -> tuple[int, bytes] | None:
        """Version and code of a value, None when there is none."""
        entry = self._entries.get(key)
        return None if entry is None or entry.code is None else (entry.version, entry.code)

    def basis_changed(self) -> None:
        """What tight forms build upon is another now: forms that were made are made anew."""
        self._known_state += 1

    def restart(self) -> None:
        """A new session of the peer holds nothing: everything is to be sent, removals are moot."""
        self.basis_changed()
        self._flights.clear()
        self._number = self.in_flight = 0
        self._entries = {k: e for k, e in self._entries.items() if e.code is not None}
        for key in sorted(self._entries):
            entry = self._entries[key]
            entry.todo, entry.acked = ((0, entry.size),), ranges.NONE
            entry.sent = entry.plain = False
        self._requeue()

    def renumber(self) -> int:
        """Give every value a new version. Returns the version up to which all is void."""
        self.newest += 1
        void = self.newest
        self.basis_changed()
        self._flights.clear()
        self.in_flight = 0
        self._entries = {k: e for k, e in self._entries.items() if e.code is not None}
        self.digest = Digest()
        for key in sorted(self._entries):
            entry = self._entries[key]
            assert entry.code is not None
            self.newest += 1
            entry.version = self.newest
            entry.todo, entry.acked = ((0, entry.size),), ranges.NONE
            self.digest.add(key, entry.version, entry.code)
        self._requeue()
        return void

    def _requeue(self) -> None:
        self.pending = len(self._entries)
        self.pending_bytes = sum(e.size for e in self._entries.values())
        self._versions = [(e.version, k) for k, e in self._entries.items()]
        heapq.heapify(self._versions)
        self._queue = []
        self._oldest = deque()
        for version, key in sorted(self._versions):
            entry = self._entries[key]
            assert entry.version == version
            entry.queued, entry.waiting = None, False
            self._enqueue(key, entry)

    def window_open(self, packets: int) -> bool:
        """Whether another packet may leave: few are on their way, and the first can still be acknowledged."""
        if self.in_flight >= packets:
            return False
        oldest = next((n for n, f in self._flights.items() if not f.lost), None)
        return oldest is None or self._number + 1 - oldest <= MASK_BITS

    def has_work(self) -> bool:
        """Whether any value waits to be sent."""
        return self._top() is not None

    def _top(self) -> Key | None:
        while self._queue:
            order, key = self._queue[0]
            entry = self._entries.get(key)
            if entry is not None and entry.queued == order:
                if entry.todo:
                    return key
                entry.queued = None
            heapq.heappop(self._queue)
        return None

    def _oldest_key(self) -> Key | None:
        while self._oldest:
            key = self._oldest[0]
            entry = self._entries.get(key)
            if entry is not None and entry.todo:
                return key
            if entry is not None:
                entry.waiting = False
            self._oldest.popleft()
        return None

    def fill(self, out: Writer, limit: int, watermark: int, now_ns: int) -> None:
        """Write the most valuable values into a packet until it holds `limit` bytes, and note it as on its way."""
        self._number += 1
        carried: list[tuple[Key, int, int, int]] = []
        along: set[Key] = set()  # carried whole by this packet
        self._leant = False

        def known(key: Key) -> tuple[int, bytes] | None:
            entry = self._entries.get(key)
            if entry is None or entry.code is None:
                return None
            if key in along:
                self._leant = True
            elif entry.todo or not entry.clean:
                return None
            return entry.version, entry.code

        skipped: list[tuple[Key, _Entry]] = []
        empty = limit - len(out)
        last_id = 0
        oldest = self._oldest_key() if self._number % self._oldest_every == 0 else None
        while len(skipped) < _MAX_SKIPPED:
            key = oldest if oldest is not None else self._top()
            if key is None:
                break
            entry = self._entries[key]
            if oldest is None:
                heapq.heappop(self._queue)
                entry.queued = None
            oldest = None
            item = self._item(key, entry, limit - len(out), empty, last_id, watermark, known)
            if item is None:
                skipped.append((key, entry))
                continue
            write_item(out, item, last_id, watermark)
            last_id = key.id
            start, stop = item.offset, entry.size if item.tight else item.offset + max(1, len(item.data))
            if (start, stop) == (0, entry.size):
                along.add(key)
            carried.append((key, entry.version, start, stop))
            entry.todo = ranges.cut(entry.todo, start, stop)
            entry.sent = True
            if entry.todo:
                skipped.append((key, entry))
        for key, entry in skipped:
            self._enqueue(key, entry)
        self._flights[self._number] = Flight(now_ns, len(out), carried)
        self.in_flight += 1

    def _item(
        self, key: Key, entry: _Entry, room: int, empty: int, last_id: int, watermark: int, known: Known
    ) -> Item | None:  # fmt: skip
        """What of a value fits into `room` bytes, or None. What fits a packet of its own, `empty`, is not split."""
        version = entry.version
        head = (
            1 + varint_bytes(zigzag(key.id - last_id)) + varint_bytes(key.part) + varint_bytes(version - watermark - 1)
        )
        if entry.code is None:
            return Item(key, version, None, 0, b"") if head <= room else None
        code = entry.code
        alone = head + varint_bytes(zigzag(key.id)) - varint_bytes(zigzag(key.id - last_id))  # in a packet of its own
        start, stop = entry.todo[0]
        fits_alone = alone + varint_bytes(len(code)) + len(code) <= empty
        if fits_alone and len(code) > _MOST_SHRUNK * room:
            return None
        if self._shrink is not None and not entry.plain and entry.todo == ((0, entry.size),):
            tight = self._form(key, entry, code, known)
            if tight is not None and head + varint_bytes(len(tight)) + len(tight) <= room:
                return Item(key, version, len(tight), 0, tight, tight=True)
            if tight is not None and alone + varint_bytes(len(tight)) + len(tight) <= empty:
                return None
        if entry.todo == ((0, entry.size),) and head + varint_bytes(len(code)) + len(code) <= room:
            return Item(key, version, len(code), 0, code)
        if fits_alone:
            return None
        head += varint_bytes(room) + varint_bytes(start) + varint_bytes(len(code))
        stop = min(stop, start + room - head)
        if stop - start < min(_MIN_FRAGMENT_BYTES, entry.todo[0][1] - start):
            return None
        return Item(key, version, len(code), start, code[start:stop])

    def _form(self, key: Key, entry: _Entry, code: bytes, known: Known) -> bytes | None:
        """The tight form of a value; the one that was made before, while what the peer is known to hold stands."""
        assert self._shrink is not None
        if entry.form_of != self._known_state:
            self._leant = False
            entry.form = self._shrink(key, code, known)
            entry.form_of = -1 if self._leant else self._known_state  # values of one packet are not known in the next
        return entry.form

    def acknowledge(self, last: int, missing: int) -> tuple[int, int]:
        """The peer has packet `last`, and those of the 64 before it whose bit in `missing` is not set.

        Of the packets that were waited for and are told of first now, returns when the oldest was sent, so that a
        round trip is not taken for shorter than it is, and the number of the newest; (0, 0) where there are none.
        """
        if last > self._number:
            return 0, 0
        oldest_ns = newest = 0
        for number in list(self._flights):
            behind = last - number
            if behind < 0:
                break
            if behind > MASK_BITS or (behind and missing >> (behind - 1) & 1):
                continue
            flight = self._flights.pop(number)
            self.acked_bytes += flight.n_bytes
            if not flight.lost:
                self.in_flight -= 1
                if not newest:
                    oldest_ns = flight.sent_ns
                newest = number
            for key, version, start, stop in flight.carried:
                self._arrived(key, version, start, stop)
        return oldest_ns, newest

    def _arrived(self, key: Key, version: int, start: int, stop: int) -> None:
        entry = self._entries.get(key)
        if entry is None or entry.version != version or entry.clean:
            return
        entry.acked = ranges.add(entry.acked, start, stop)
        entry.todo = ranges.cut(entry.todo, start, stop)
        if entry.acked == ((0, entry.size),):
            self._known_state += key.kind in self._basis
            self.pending -= 1
            self.pending_bytes -= entry.size
            if entry.code is None:
                del self._entries[key]

    def give_up(self, sent_ns: int, before: int = 1 << 62) -> bool:
        """Packets sent before a time, numbered below `before`, are taken for lost. Returns whether there were any."""
        late = []
        for number, flight in self._flights.items():
            if number >= before or flight.sent_ns >= sent_ns:
                break
            if not flight.lost:
                late.append(flight)
        for flight in late:
            self._lose(flight)
        if late:
            self._forget()
        return bool(late)

    def _lose(self, flight: Flight) -> None:
        flight.lost = True
        self.lost += 1
        self.in_flight -= 1
        for key, version, start, stop in flight.carried:
            entry = self._entries.get(key)
            if entry is None or entry.version != version:
                continue
            todo = ranges.add(entry.todo, start, stop)
            for a, b in entry.acked:
                todo = ranges.cut(todo, a, b)
            entry.todo = todo
            entry.plain = True
            if todo:
                self._enqueue(key, entry)

    def _forget(self) -> None:
        old = [n for n, f in self._flights.items() if f.lost]
        for n in old[: max(0, len(old) - _MAX_LATE)]:
            del self._flights[n]
