"""What this side wrote: the newest version of each value, what of it the peer lacks, and what is on its way.

Memory is bounded where a bound is given: keyframes that were not touched for long go to the archive, and come back when
they are to be sent. Where it cannot keep them, the least valuable of the old sections are given up instead.
"""

from __future__ import annotations

from collections.abc import Callable

from kiteline_codec.coding.packing import Writer
from kiteline_codec.schema import KEYFRAME_KINDS, Key
from kiteline_codec.sync import ranges
from kiteline_codec.sync.archive import Archive, Row, Spill
from kiteline_codec.sync.digest import MODULUS, Digest, hash_value
from kiteline_codec.sync.entries import Entry, Order, Waiting, item_of
from kiteline_codec.sync.flights import Carried, Flight, Flights
from kiteline_codec.sync.resident import Resident
from kiteline_codec.transport.packet import write_item

Known = Callable[[Key], tuple[int, bytes] | None]  # version and code of a value of ours that the peer holds
Shrink = Callable[[Key, bytes, Known], bytes | None]  # a shorter form of a code, None where there is none

_MAX_SKIPPED = 8  # values too long for the rest of a packet that are passed over in search of a shorter one
_ENTRY_BYTES = 700  # of memory that a value takes beside its code, about
_FIRST = (1,)  # orders below it, poses and placements, go before what has waited longest
_FETCHED = 16  # pages that are taken back at once when nothing else is left to be sent


class Outbox:
    """Values to share, with their versions, in one relation between two sessions after another."""

    def __init__(
        self,
        order: Callable[[Key], Order],
        oldest_every: int,
        shrink: Shrink | None = None,
        basis: frozenset[int] = frozenset(),
        resident_bytes: int = 0,
        spill: Spill | None = None,
    ) -> None:
        """order: of keys whose values come back from the archive. basis: kinds of values that tight forms build upon.
        resident_bytes: of memory for values that are not archived, about; 0: any number. spill: where codes of archived
        values go.
        """
        self._order = order
        self._oldest_every = oldest_every
        self._shrink = shrink
        self._basis = basis
        self._known_state = 0  # counts changes of what of the basis the peer is known to hold
        self._leant = False  # whether a tight form was built upon values of the same packet
        self.digest = Digest()
        self.newest = 0  # versions number all changes of all values
        self.pending = 0  # values that the peer is not known to hold
        self.pending_bytes = 0  # of their codes
        self.dropped = 0  # values given up for want of memory
        self.flights = Flights()
        self.archive = Archive(spill)
        self._resident = Resident(resident_bytes, KEYFRAME_KINDS, _ENTRY_BYTES)
        self._entries: dict[Key, Entry] = {}
        self._waiting = Waiting(self._entries)

    def __len__(self) -> int:
        return len(self._entries) + self.archive.values

    @property
    def resident_bytes(self) -> int:
        """Memory that values of keyframes take, about."""
        return self._resident.bytes + self.archive.resident_bytes

    @property
    def clean(self) -> bool:
        """Whether the peer is known to hold everything."""
        return not self.pending

    def codes(self) -> dict[Key, bytes]:
        """The newest code of each value that was not removed, as far as they are kept."""
        for id_ in [i for i in self.archive if self.archive.readable(i)]:
            self._fetch(id_)
        return {key: entry.code for key, entry in self._entries.items() if entry.code is not None}

    def arrived(self, key: Key) -> bool:
        """Whether the peer is known to hold the newest version of a value, or that there is none."""
        entry = self._entries.get(key)
        return entry is None or entry.clean

    def held(self, key: Key) -> tuple[int, bytes] | None:
        """Version and code of a value, None when there is none."""
        entry = self._find(key)
        return None if entry is None or entry.code is None else (entry.version, entry.code)

    def _find(self, key: Key) -> Entry | None:
        """The entry of a key, out of the archive if need be."""
        entry = self._entries.get(key)
        if entry is None and key.kind in KEYFRAME_KINDS and self.archive.readable(key.id):
            self._fetch(key.id)
            entry = self._entries.get(key)
        return entry

    # ---- changes

    def put(self, key: Key, code: bytes, order: Order) -> None:
        """A new value, or a new version of one; the same code again changes nothing but its order."""
        if key.kind in KEYFRAME_KINDS and key.id in self.archive:
            self._fetch(key.id)
        entry = self._entries.get(key)
        if entry is not None and entry.code == code:
            entry.order = order
            if entry.todo:
                self._waiting.add(key, entry)
            return
        self._change(key, code, order)
        self._make_room()

    def remove(self, key: Key) -> None:
        """Take a value back. One of which nothing was ever sent is forgotten without a word."""
        if key.kind in KEYFRAME_KINDS and key.id in self.archive:
            self._fetch(key.id)
        entry = self._entries.get(key)
        if entry is None or entry.code is None:
            return
        if entry.sent:
            self._change(key, None, entry.order)
            return
        self.digest.leave(entry.hashed)
        self.newest += 1
        self._known_state += key.kind in self._basis
        self.pending -= 1
        self.pending_bytes -= entry.size
        self._resident.uncount(key, entry.size)
        del self._entries[key]

    def _change(self, key: Key, code: bytes | None, order: Order) -> None:
        self.newest += 1
        self._known_state += key.kind in self._basis
        entry = self._entries.get(key)
        if entry is None:
            entry = self._entries[key] = Entry(self.newest, code, order, ranges.NONE)
            self.pending += 1
        else:
            if entry.code is not None:
                self.digest.leave(entry.hashed)
                self._resident.uncount(key, entry.size)
            self.pending += entry.clean
            self.pending_bytes -= 0 if entry.clean else entry.size
            entry.version, entry.code, entry.order = self.newest, code, order
        entry.acked = ranges.NONE
        entry.todo = ((0, entry.size),)
        entry.form, entry.form_of = None, -1
        self.pending_bytes += entry.size
        if code is not None:
            entry.hashed = hash_value(key, entry.version, code)
            self.digest.join(entry.hashed)
            self._resident.count(key, entry.size)
        self._waiting.note_version(key, entry)
        self._waiting.add(key, entry)

    def basis_changed(self) -> None:
        """What tight forms build upon is another now: forms that were made are made anew."""
        self._known_state += 1

    def restart(self) -> None:
        """A new session of the peer holds nothing: everything is to be sent, removals are moot."""
        self.basis_changed()
        self.flights.restart()
        lost, hashes = self.archive.restart()
        self.dropped += lost
        self.digest.leave(hashes)
        self._begin_anew()
        for entry in self._entries.values():
            entry.sent = entry.plain = False

    def renumber(self) -> int:
        """Give every value a new version. Returns the version up to which all is void."""
        for id_ in list(self.archive):
            self._fetch(id_)
        self.newest += 1
        void = self.newest
        self.basis_changed()
        self.flights.clear()
        self.digest = Digest()
        for key in sorted(k for k, e in self._entries.items() if e.code is not None):
            entry = self._entries[key]
            assert entry.code is not None
            self.newest += 1
            entry.version, entry.form_of = self.newest, -1
            entry.hashed = hash_value(key, entry.version, entry.code)
            self.digest.join(entry.hashed)
        self._begin_anew()
        return void

    def _begin_anew(self) -> None:
        """All values are to be sent, and removals are moot."""
        for key in [k for k, e in self._entries.items() if e.code is None]:
            del self._entries[key]
        for entry in self._entries.values():
            entry.todo, entry.acked = ((0, entry.size),), ranges.NONE
        self.pending = len(self)
        self.pending_bytes = sum(e.size for e in self._entries.values()) + self.archive.value_bytes
        self._waiting.restart()

    # ---- memory

    def _make_room(self) -> None:
        """Beyond the bound, archive what was not touched for long, else give up what is worth least, down to 3/4."""
        if not self._resident.full:
            return
        refused = False
        for id_ in self._resident.ids():
            if self._resident.roomy:
                return
            refused |= not self._archive(id_)
        if not (self._resident.full and refused):
            return
        idle = [k for k, e in self._entries.items() if k.kind in KEYFRAME_KINDS and e.still and not e.clean]
        for key in sorted(idle, key=lambda k: (-self._entries[k].order[0], k.id, -k.part)):
            if self._resident.roomy:
                return
            self.remove(key)
            self.dropped += 1

    def _archive(self, id_: int) -> bool:
        """Move the values of an id to the archive, if nothing of them is on its way. Returns False when refused."""
        entries = [(key, self._entries[key]) for key in self._resident.keys(id_)]
        if not all(e.still and e.order == self._order(k) for k, e in entries):
            return True
        rows = [
            Row(k.kind, k.part, e.version, e.clean, e.sent, e.plain, len(e.code or b""), e.code) for k, e in entries
        ]
        if not self.archive.put(id_, rows, sum(e.hashed for _, e in entries) % MODULUS):
            return False
        for key, entry in entries:
            self._resident.uncount(key, entry.size)
            del self._entries[key]
        return True

    def _fetch(self, id_: int) -> None:
        """Take the values of an id back from the archive. Where codes are lost, the peer is to forget them too."""
        hashes = self.archive.hashes(id_)
        rows = self.archive.take(id_)
        lost = any(row.code is None for row in rows)
        if lost:
            self.digest.leave(hashes)
            self.dropped += len(rows)
        for row in rows:
            key = Key(row.kind, id_, row.part)
            whole: ranges.Ranges = ((0, max(1, row.size)),)
            if row.code is None or lost:
                self.pending -= not row.clean
                self.pending_bytes -= 0 if row.clean else whole[0][1]
                if row.sent:
                    self._change(key, None, self._order(key))
                continue
            todo, acked = (ranges.NONE, whole) if row.clean else (whole, ranges.NONE)
            entry = Entry(row.version, row.code, self._order(key), todo, acked, row.sent, plain=row.plain)
            entry.hashed = hash_value(key, row.version, row.code)
            self._entries[key] = entry
            self._resident.count(key, entry.size)
            if not row.clean:
                self._waiting.note_version(key, entry)
                self._waiting.add(key, entry)
        self._resident.goes_first(id_)

    # ---- sending

    def watermark(self) -> int:
        """All versions up to this one have arrived, or were replaced or taken back since."""
        here, there = self._waiting.least_version(), self.archive.oldest_dirty()
        least = self.newest + 1 if there is None else there[0]
        return (least if here is None else min(here, least)) - 1

    def has_work(self) -> bool:
        """Whether any value waits to be sent."""
        return self._top() is not None

    def _top(self) -> Key | None:
        key = self._waiting.top()
        if key is not None or self.archive.newest_dirty() is None:
            return key
        self._make_room()
        for _ in range(_FETCHED):
            id_ = self.archive.newest_dirty()
            if id_ is not None:
                self._fetch(id_)
        return self._waiting.top()

    def _oldest(self) -> Key | None:
        """The value that has waited longest, or one of the archive: what went there waits longer than what is here."""
        there = self.archive.oldest_dirty()
        if there is not None:
            self._make_room()
            self._fetch(there[1])
            idle = [k for k in self._resident.keys(there[1]) if self._entries[k].todo]
            if idle:
                return min(idle)
        return self._waiting.oldest()

    def fill(self, out: Writer, limit: int, watermark: int, now_ns: int) -> None:
        """Write the most valuable values into a packet until it holds `limit` bytes, and note it as on its way."""
        self.flights.number += 1
        carried: list[Carried] = []
        along: set[Key] = set()  # carried whole by this packet

        def known(key: Key) -> tuple[int, bytes] | None:
            entry = self._find(key)
            if entry is None or entry.code is None:
                return None
            if key in along:
                self._leant = True
            elif entry.todo or not entry.clean:
                return None
            return entry.version, entry.code

        skipped: list[tuple[Key, Entry]] = []
        empty = limit - len(out)
        last_id = 0
        turn_of_oldest = self.flights.number % self._oldest_every == 0
        while len(skipped) < _MAX_SKIPPED:
            key, oldest = self._top(), None
            if turn_of_oldest and (key is None or self._entries[key].order > _FIRST):
                turn_of_oldest = False
                oldest = self._oldest()
            key = key if oldest is None else oldest
            if key is None:
                break
            entry = self._entries[key]
            if oldest is None:
                self._waiting.pop(entry)
            form = self._former(key, entry, known) if self._shrink is not None else None
            item = item_of(key, entry, limit - len(out), empty, last_id, watermark, form)
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
            self._waiting.add(key, entry)
        self.flights.add(now_ns, len(out), carried)

    def _former(self, key: Key, entry: Entry, known: Known) -> Callable[[], bytes | None]:
        """Gives the tight form of a value; the one made before, while what the peer is known to hold stands."""

        def form() -> bytes | None:
            assert self._shrink is not None
            if entry.form_of != self._known_state:
                self._leant = False
                entry.form = self._shrink(key, entry.code or b"", known)
                entry.form_of = -1 if self._leant else self._known_state  # a packet's values are not known in the next
            return entry.form

        return form

    def acknowledge(self, last: int, missing: int) -> tuple[int, int]:
        """What `Flights.acknowledge` says; what those packets carried is with the peer."""
        return self.flights.acknowledge(last, missing, self._arrived)

    def _arrived(self, key: Key, version: int, start: int, stop: int) -> None:
        entry = self._entries.get(key)
        if entry is None or entry.version != version or entry.clean:
            return
        entry.acked = ranges.add(entry.acked, start, stop)
        entry.todo = ranges.cut(entry.todo, start, stop)
        if entry.acked == ((0, entry.size),):
            self._known_state += key.kind in self._basis
            entry.form, entry.form_of = None, -1
            self.pending -= 1
            self.pending_bytes -= entry.size
            if entry.code is None:
                del self._entries[key]

    def give_up(self, sent_ns: int, before: int = 1 << 62) -> bool:
        """Packets sent before a time, numbered below `before`, are taken for lost. Returns whether there were any."""
        late = self.flights.give_up(sent_ns, before)
        for flight in late:
            self._lose(flight)
        return bool(late)

    def _lose(self, flight: Flight) -> None:
        """What a packet carried is to be sent again."""
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
                self._waiting.add(key, entry)
