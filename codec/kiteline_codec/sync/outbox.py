"""What this side wrote: the newest version of each value, and what of it the peer lacks.

With a limit, keyframes that were not used for long are archived until they are to be sent. If the archive cannot keep
them, old sections of low priority are dropped instead.
"""

from collections.abc import Callable, Collection

from kiteline_codec.coding.packing import Writer
from kiteline_codec.schema import KEYFRAME_KINDS, PREDICTOR_KINDS, RECORD_TYPES, Key
from kiteline_codec.sync import ranges
from kiteline_codec.sync.archive import Archive, Row, Spill
from kiteline_codec.sync.digest import MODULUS, Digest, hash_value
from kiteline_codec.sync.in_flight import Acknowledged, Carried, PacketsInFlight, SentPacket
from kiteline_codec.sync.resident import ResidentValues
from kiteline_codec.sync.round_trip import RoundTrip
from kiteline_codec.sync.send_queue import Entry, Order, SendQueue, Skipped, item_of
from kiteline_codec.transport.packet import write_item

Known = Callable[[Key], tuple[int, bytes] | None]  # version and code of an own value that the peer holds
Compress = Callable[[Key, bytes, Known], bytes | None]  # a residual code, None where there is none

_URGENCY = {kind: int(record.URGENCY) for kind, record in RECORD_TYPES.items()}
_ENTRY_BYTES = 700  # memory of a value beside its code, roughly
_POSES = (1,)  # lower orders, poses and placements, go before the value that has waited longest
_FETCHED_PAGES = 16  # that are taken back at once when nothing else is left to be sent


class Outbox:
    """Values to share, with their versions, in one relation between two sessions after another."""

    def __init__(
        self, order: Callable[[Key], Order], oldest_every: int, compress: Compress | None = None,
        resident_bytes: int | None = None, spill: Spill | None = None,
    ) -> None:  # fmt: skip
        """order: of keys whose values come back from the archive. resident_bytes: memory for values that are not
        archived, roughly; None for no limit. spill: keeps the codes of archived values.
        """
        self._order = order
        self._oldest_every = oldest_every
        self._compress = compress
        self._predictors_state = 0  # counts changes of what the peer is known to hold of the predictors
        self._used_packet = False  # whether a residual code was predicted from values of the same packet
        self.digest = Digest()
        self.newest = 0  # versions number all changes of all values, from 1
        self.pending = 0  # values that the peer is not known to hold
        self.pending_bytes = 0  # of their codes
        self.dropped = 0  # values dropped for want of memory
        self.packets = PacketsInFlight()
        self.archive = Archive(spill)
        self._resident = ResidentValues(resident_bytes, _ENTRY_BYTES)
        self._entries: dict[Key, Entry] = {}
        self._queue = SendQueue(self._entries)

    def __len__(self) -> int:
        return len(self._entries) + self.archive.values

    @property
    def resident_bytes(self) -> int:
        """Memory of values of keyframes, roughly."""
        return self._resident.bytes + self.archive.resident_bytes

    @property
    def clean(self) -> bool:
        """True if the peer is known to hold everything."""
        return not self.pending

    def codes(self) -> dict[Key, bytes]:
        """The newest code of each value that was not removed, as far as they are kept."""
        for id_ in [i for i in self.archive if self.archive.readable(i)]:
            self._fetch(id_)
        return {key: entry.code for key, entry in self._entries.items() if entry.code is not None}

    def arrived(self, key: Key) -> bool:
        """True if the peer is known to hold the newest version of a value, or if there is none."""
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
        """Add a value, or a new version of one; the same code again changes only its order."""
        entry = self._resident_entry(key)
        if entry is not None and entry.code == code:
            entry.order = order
            if entry.unsent:
                self._queue.add(key, entry)
            return
        self._change(key, code, order)
        self._make_room()

    def remove(self, key: Key, *, is_held: bool = False) -> None:
        """Remove a value. The peer need not know if nothing of it was ever sent, nor is held of an earlier session."""
        entry = self._resident_entry(key)
        if is_held or (entry is not None and entry.code is not None and entry.sent):
            self._change(key, None, self._order(key) if entry is None else entry.order)
            return
        if entry is None or entry.code is None:
            return
        self.digest.discard(entry.hashed)
        self.newest += 1
        self._predictors_state += key.kind in PREDICTOR_KINDS
        self.pending -= 1
        self.pending_bytes -= entry.size
        self._resident.uncount(key, entry.size)
        del self._entries[key]

    def _resident_entry(self, key: Key) -> Entry | None:
        """The entry of a key, after its page has left the archive, readable or not."""
        if key.kind in KEYFRAME_KINDS and key.id in self.archive:
            self._fetch(key.id)
        return self._entries.get(key)

    def _change(self, key: Key, code: bytes | None, order: Order) -> None:
        self.newest += 1
        self._predictors_state += key.kind in PREDICTOR_KINDS
        entry = self._entries.get(key)
        if entry is None:
            entry = self._entries[key] = Entry(self.newest, code, order, ranges.NONE)
            self.pending += 1
        else:
            if entry.code is not None:
                self.digest.discard(entry.hashed)
                self._resident.uncount(key, entry.size)
            self.pending += entry.clean
            self.pending_bytes -= 0 if entry.clean else entry.size
            entry.version, entry.order = self.newest, order
            entry.set_code(code)
        entry.acknowledged = ranges.NONE
        entry.unsent = ((0, entry.size),)
        entry.residual = entry.residual_state = None
        self.pending_bytes += entry.size
        if code is not None:
            entry.hashed = hash_value(key, entry.version, code)
            self.digest.add(entry.hashed)
            self._resident.count(key, entry.size)
        self._queue.note_version(key, entry)
        self._queue.add(key, entry)

    def predictors_changed(self) -> None:
        """Make all residual codes anew: what they are predicted from has changed."""
        self._predictors_state += 1

    def restart(self, gone: Callable[[Key], bool] = lambda key: False) -> None:
        """Send all again but what is gone: a new session of the peer holds nothing. Removals are forgotten."""
        for key in [key for key in self._entries if gone(key)]:
            self.remove(key)
        self.predictors_changed()
        self.packets.restart()
        lost, hashes = self.archive.restart()
        self.dropped += lost
        self.digest.discard(hashes)
        self._mark_unsent()
        for entry in self._entries.values():
            entry.sent = entry.send_plain = False

    def renumber(self) -> int:
        """Give every value a new version. Returns the version up to which all is void."""
        for id_ in list(self.archive):
            self._fetch(id_)
        self.newest += 1
        void = self.newest
        self.predictors_changed()
        self.packets.clear()
        self.digest = Digest()
        for key in sorted(k for k, e in self._entries.items() if e.code is not None):
            entry = self._entries[key]
            assert entry.code is not None
            self.newest += 1
            entry.version, entry.residual_state = self.newest, None
            entry.hashed = hash_value(key, entry.version, entry.code)
            self.digest.add(entry.hashed)
        self._mark_unsent()
        return void

    def _mark_unsent(self) -> None:
        """Queue all values, and forget removals."""
        for key in [k for k, e in self._entries.items() if e.code is None]:
            del self._entries[key]
        for entry in self._entries.values():
            entry.unsent, entry.acknowledged = ((0, entry.size),), ranges.NONE
        self.pending = len(self)
        self.pending_bytes = sum(e.size for e in self._entries.values()) + self.archive.value_bytes
        self._queue.restart()

    # ---- memory

    def _make_room(self) -> None:
        """Above the limit, archive the least recently used ids, else drop values of low priority, down to 3/4 of it."""
        if not self._resident.full:
            return
        refused = False
        for id_ in self._resident.ids():
            if self._resident.roomy:
                return
            refused |= not self._to_archive(id_)
        if not (self._resident.full and refused):
            return
        idle = [k for k, e in self._entries.items() if k.kind in KEYFRAME_KINDS and e.idle and not e.clean]
        for key in sorted(idle, key=lambda k: (-self._entries[k].order[0], k.id, -k.part)):
            if self._resident.roomy:
                return
            self.remove(key)
            self.dropped += 1

    def _to_archive(self, id_: int) -> bool:
        """Archive the values of an id, unless some are in flight. Returns False when the archive refuses them."""
        entries = [(key, self._entries[key]) for key in self._resident.keys(id_)]
        if not all(e.idle and e.order == self._order(k) for k, e in entries):
            return True
        rows = [
            Row(k.kind, k.part, e.version, e.clean, e.sent, e.send_plain, len(e.code or b""), e.code)
            for k, e in entries
        ]
        if not self.archive.put(id_, rows, sum(e.hashed for _, e in entries) % MODULUS):
            return False
        for key, entry in entries:
            self._resident.uncount(key, entry.size)
            del self._entries[key]
        return True

    def _fetch(self, id_: int) -> None:
        """Take the values of an id back from the archive. If codes are lost, the values are removed."""
        hashes = self.archive.hashes(id_)
        rows = self.archive.take(id_)
        lost = any(row.code is None for row in rows)
        if lost:
            self.digest.discard(hashes)
            self.dropped += len(rows)
        for row in rows:
            key = Key(row.kind, id_, row.part)
            whole: ranges.Ranges = ((0, max(1, row.size)),)
            if row.code is None or lost:
                self.pending -= not row.acknowledged
                self.pending_bytes -= 0 if row.acknowledged else whole[0][1]
                if row.sent:
                    self._change(key, None, self._order(key))
                continue
            unsent, acknowledged = (ranges.NONE, whole) if row.acknowledged else (whole, ranges.NONE)
            order = self._order(key)
            entry = Entry(row.version, row.code, order, unsent, acknowledged, row.sent, send_plain=row.send_plain)
            entry.hashed = hash_value(key, row.version, row.code)
            self._entries[key] = entry
            self._resident.count(key, entry.size)
            if not row.acknowledged:
                self._queue.note_version(key, entry)
                self._queue.add(key, entry)
        self._resident.evict_first(id_)

    # ---- sending

    def watermark(self) -> int:
        """The version up to which all have arrived, or were replaced or removed."""
        here, archived = self._queue.least_version(), self.archive.oldest_unacknowledged()
        least = self.newest + 1 if archived is None else archived[0]
        return (least if here is None else min(here, least)) - 1

    def urgency(self) -> int | None:
        """How urgent what is sent next is: its priority, or that of its kind's `URGENCY`; None if nothing waits."""
        key = self._top()
        return None if key is None else max(self._entries[key].order[0], _URGENCY.get(key.kind, 0))

    def _top(self, without: Collection[int] = ()) -> Key | None:
        key = self._queue.top(without)
        if key is not None or without or self.archive.newest_unacknowledged() is None:
            return key
        self._make_room()
        for _ in range(_FETCHED_PAGES):
            id_ = self.archive.newest_unacknowledged()
            if id_ is not None:
                self._fetch(id_)
        return self._queue.top()

    def _oldest(self) -> Key | None:
        """The value that has waited longest; what is archived waits longer than what is not."""
        archived = self.archive.oldest_unacknowledged()
        if archived is not None:
            self._make_room()
            self._fetch(archived[1])
            unsent = [k for k in self._resident.keys(archived[1]) if self._entries[k].unsent]
            if unsent:
                return min(unsent)
        return self._queue.oldest()

    def fill(self, out: Writer, limit: int, watermark: int, now_ns: int) -> None:
        """Write the values of highest priority into a packet of at most `limit` bytes, and note it as in flight."""
        self.packets.number += 1
        carried: list[Carried] = []
        whole_here: set[Key] = set()  # values that stand whole in this packet

        def known(key: Key) -> tuple[int, bytes] | None:
            entry = self._find(key)
            if entry is None or entry.code is None:
                return None
            if key in whole_here:
                self._used_packet = True
            elif entry.unsent or not entry.clean:
                return None
            return entry.version, entry.code

        skipped = Skipped()
        empty = limit - len(out)
        last_id = 0
        oldest_due = self.packets.number % self._oldest_every == 0
        while True:
            key, oldest = self._top(skipped.priorities), None
            if oldest_due and (key is None or self._entries[key].order > _POSES):
                oldest_due = False
                oldest = self._oldest()
            key = key if oldest is None else oldest
            if key is None:
                break
            entry = self._entries[key]
            if oldest is None:
                self._queue.pop(entry)
            residual = self._residual_maker(key, entry, known) if self._compress is not None else None
            item = item_of(key, entry, limit - len(out), empty, last_id, watermark, residual)
            if item is None:
                skipped.add(key, entry)
                continue
            write_item(out, item, last_id, watermark)
            last_id = key.id
            start, stop = item.offset, entry.size if item.residual else item.offset + max(1, len(item.data))
            if (start, stop) == (0, entry.size):
                whole_here.add(key)
            carried.append((key, entry.version, start, stop))
            entry.unsent = ranges.cut(entry.unsent, start, stop)
            entry.sent = True
            if entry.unsent:
                skipped.add(key, entry)
        for key, entry in skipped.values:
            self._queue.add(key, entry)
        self.packets.add(now_ns, len(out), carried)

    def _residual_maker(self, key: Key, entry: Entry, known: Known) -> Callable[[], bytes | None]:
        """Returns a function that makes the residual code of a value, or reuses it while the predictors stay."""

        def residual() -> bytes | None:
            assert self._compress is not None
            if entry.residual_state != self._predictors_state:
                self._used_packet = False
                entry.residual = self._compress(key, entry.code or b"", known)
                # Values of this packet are not known to be there in the next one.
                entry.residual_state = None if self._used_packet else self._predictors_state
            return entry.residual

        return residual

    def acknowledge(self, last: int, missing: int) -> Acknowledged | None:
        """Take in an acknowledgement; what those packets carried is with the peer."""
        return self.packets.acknowledge(last, missing, self._arrived)

    def _arrived(self, key: Key, version: int, start: int, stop: int) -> None:
        entry = self._entries.get(key)
        if entry is None or entry.version != version or entry.clean:
            return
        entry.acknowledged = ranges.add(entry.acknowledged, start, stop)
        entry.unsent = ranges.cut(entry.unsent, start, stop)
        if entry.acknowledged == ((0, entry.size),):
            self._predictors_state += key.kind in PREDICTOR_KINDS
            entry.residual = entry.residual_state = None
            self.pending -= 1
            self.pending_bytes -= entry.size
            if entry.code is None:
                del self._entries[key]

    def give_up(self, now_ns: int, round_trip: RoundTrip, overtaken_below: int, *, idle: bool) -> bool:
        """Queue again what packets carried that count as lost; True if any do. idle: nothing waits to be sent."""
        lost = self.packets.give_up_late(now_ns, round_trip, overtaken_below, last=idle)
        for packet in lost:
            self._lose(packet)
        return bool(lost)

    def _lose(self, packet: SentPacket) -> None:
        """Queue again what a packet carried."""
        for key, version, start, stop in packet.carried:
            entry = self._entries.get(key)
            if entry is None or entry.version != version:
                continue
            unsent = ranges.add(entry.unsent, start, stop)
            for a, b in entry.acknowledged:
                unsent = ranges.cut(unsent, a, b)
            entry.unsent, entry.send_plain = unsent, True
            if unsent:
                self._queue.add(key, entry)
