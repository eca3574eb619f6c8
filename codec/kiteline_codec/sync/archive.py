"""Values set aside: a few bytes a value stay here, the codes go to a spill file, or stay here packed.

A page holds all values of one id. It is written and read back as a whole. Pure: the spill file is handed in.
"""

import heapq
import struct
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

from kiteline_codec.sync.digest import MODULUS

_ROW = struct.Struct("<BHqIB")  # kind, part, version, bytes of the code, flags
_ACKNOWLEDGED, _SENT, _SEND_PLAIN = 1, 2, 4
_MOST_WRITTEN = 256  # pages in memory whose place in the spill is known: some more than memory holds at once
_SLACK = 64  # outdated entries that a heap may hold beyond twice the pages
PAGE_BYTES = 300  # memory of a page beside its rows, roughly
ROW_BYTES = _ROW.size


class Spill(Protocol):
    """Keeps bytes out of memory for as long as this process lives. Never raises."""

    def put(self, data: bytes) -> int | None:
        """Keep bytes. Returns their position, from 0; None when they cannot be kept."""
        ...

    def get(self, where: int, n_bytes: int) -> bytes | None:
        """The bytes that were put at a position; None when they cannot be read."""
        ...

    def free(self, where: int, n_bytes: int) -> None:
        """Bytes that were put at a position are not read again: the place may serve others."""
        ...


@dataclass(frozen=True, slots=True)
class Row:
    """One value of a page; `acknowledged`, `sent` and `send_plain` as in `Entry`. code: None when it is not kept."""

    kind: int
    part: int
    version: int
    acknowledged: bool
    sent: bool
    send_plain: bool
    size: int
    code: bytes | None


@dataclass(slots=True)
class _Page:
    rows: bytes
    where: int | None  # in the spill
    packed: bytes | None  # the codes, if they are kept here
    n_bytes: int  # of all codes
    hashes: int  # sum of the rows' hashes modulo 2^128
    least_version: int
    unacknowledged_from: int | None  # least version that the peer may lack; None: it holds all
    session: int  # count of the peer's sessions when the page was made: its acknowledgements are for that session


@dataclass(frozen=True, slots=True)
class _Written:
    """Where the codes of a page that was taken back are in the spill. versions: that identify them; none if lost."""

    where: int
    n_bytes: int
    versions: bytes


class Archive:
    """Pages by id. Without a spill, or when it fails, only pages that the peer holds are accepted, without codes."""

    def __init__(self, spill: Spill | None, *, packed: bool = False) -> None:
        """packed: keep the codes of a page here, in one piece: a value then takes little more than its code."""
        self._spill, self._packed = spill, packed
        self._pages: dict[int, _Page] = {}
        self._session = 0
        self._unsent: list[int] = []  # heap of -id of pages with anything to send
        self._versions: list[tuple[int, int]] = []  # heap of (unacknowledged_from, id)
        self._written: OrderedDict[int, _Written] = OrderedDict()  # of pages taken back
        self.values = 0
        self.value_bytes = 0

    def __contains__(self, id_: int) -> bool:
        return id_ in self._pages

    def __iter__(self) -> Iterator[int]:
        return iter(self._pages)

    def __len__(self) -> int:
        return len(self._pages)

    @property
    def resident_bytes(self) -> int:
        """Memory of the pages, roughly."""
        return PAGE_BYTES * len(self._pages) + ROW_BYTES * self.values

    def readable(self, id_: int) -> bool:
        """True if there is a page of this id whose codes are kept."""
        page = self._pages.get(id_)
        return page is not None and (page.where is not None or page.packed is not None)

    def put(self, id_: int, rows: Iterable[Row], hashes: int) -> bool:
        """Store the values of an id. Returns False if the peer may lack some and their codes cannot be kept."""
        rows = sorted(rows, key=lambda r: (r.kind, r.part))
        unacknowledged = [r.version for r in rows if not r.acknowledged]
        where = None if self._spill is None or self._packed else self._write(self._spill, id_, rows)
        if where is None and unacknowledged and not self._packed:
            return False
        codes = b"".join(r.code or b"" for r in rows) if self._packed else None
        packed = b"".join(
            _ROW.pack(
                r.kind, r.part, r.version, r.size,
                r.acknowledged * _ACKNOWLEDGED | r.sent * _SENT | r.send_plain * _SEND_PLAIN,
            )
            for r in rows
        )  # fmt: skip
        least = min(r.version for r in rows)
        n_bytes = sum(r.size for r in rows)
        from_version = min(unacknowledged, default=None)
        self._pages[id_] = _Page(packed, where, codes, n_bytes, hashes, least, from_version, self._session)
        self.values += len(rows)
        self.value_bytes += _size_of(rows)
        if from_version is not None:
            heapq.heappush(self._unsent, -id_)
            heapq.heappush(self._versions, (from_version, id_))
            if max(len(self._unsent), len(self._versions)) > 2 * len(self._pages) + _SLACK:
                self._queue_pages()
        return True

    def _write(self, spill: Spill, id_: int, rows: list[Row]) -> int | None:
        """Write the codes, unless the spill holds these versions already. Returns their position."""
        written = self._written.pop(id_, None)
        if written is not None and written.versions == _versions_of(rows):
            return written.where
        if written is not None:
            spill.free(written.where, written.n_bytes)
        return spill.put(b"".join(r.code or b"" for r in rows))

    def peek(self, id_: int, kind: int, part: int) -> tuple[int, bytes] | None:
        """Version and code of a value of a packed page, which stays as it is; None if the page lacks it."""
        page, at = self._pages[id_], 0
        assert page.packed is not None
        for found, number, version, size, _ in _ROW.iter_unpack(page.rows):
            if found == kind and number == part:
                return version, page.packed[at : at + size]
            at += size
        return None

    def take(self, id_: int) -> list[Row]:
        """Remove a page and return its values. Codes are None if they are not kept or cannot be read."""
        page = self._pages.pop(id_)
        codes = page.packed
        if page.where is not None and self._spill is not None:
            codes = self._spill.get(page.where, page.n_bytes)
        same_session = page.session == self._session
        rows = []
        at = 0
        for kind, part, version, size, flags in _ROW.iter_unpack(page.rows):
            code = None if codes is None else codes[at : at + size]
            at += size
            acknowledged, sent, plain = (
                bool(same_session and flags & bit) for bit in (_ACKNOWLEDGED, _SENT, _SEND_PLAIN)
            )
            rows.append(Row(kind, part, version, acknowledged, sent, plain, size, code))
        self.values -= len(rows)
        self.value_bytes -= _size_of(rows)
        if page.where is not None and self._spill is not None:
            self._written[id_] = _Written(page.where, page.n_bytes, _versions_of(rows) if codes is not None else b"")
            if len(self._written) > _MOST_WRITTEN:
                _, oldest = self._written.popitem(last=False)
                self._spill.free(oldest.where, oldest.n_bytes)
        return rows

    def close(self) -> None:
        """Free what the pages take in the spill; the archive is not used again."""
        if self._spill is not None:
            places = [(page.where, page.n_bytes) for page in self._pages.values() if page.where is not None]
            for where, n_bytes in places + [(page.where, page.n_bytes) for page in self._written.values()]:
                self._spill.free(where, n_bytes)
        self._pages.clear()
        self._written.clear()

    def hashes(self, id_: int) -> int:
        """Sum of the hashes of a page's values."""
        return self._pages[id_].hashes

    def newest_unacknowledged(self) -> int | None:
        """The highest id with anything to send."""
        while self._unsent:
            page = self._pages.get(-self._unsent[0])
            if page is not None and page.unacknowledged_from is not None:
                return -self._unsent[0]
            heapq.heappop(self._unsent)
        return None

    def oldest_unacknowledged(self) -> tuple[int, int] | None:
        """The least version that waits to be sent, and its id."""
        while self._versions:
            version, id_ = self._versions[0]
            page = self._pages.get(id_)
            if page is not None and page.unacknowledged_from == version:
                return version, id_
            heapq.heappop(self._versions)
        return None

    def restart(self) -> tuple[int, int]:
        """Mark all values as unknown to a new session of the peer. Returns how many are lost, and their hashes."""
        self._session += 1
        lost = hashes = 0
        for id_ in [i for i, page in self._pages.items() if page.where is None]:
            hashes = (hashes + self._pages[id_].hashes) % MODULUS
            lost += len(self.take(id_))
        for page in self._pages.values():
            page.unacknowledged_from = page.least_version
        self._queue_pages()
        return lost, hashes

    def _queue_pages(self) -> None:
        """Make the heaps anew of the pages with anything to send."""
        due = [(p.unacknowledged_from, i) for i, p in self._pages.items() if p.unacknowledged_from is not None]
        self._unsent = [-id_ for _, id_ in due]
        self._versions = due
        heapq.heapify(self._unsent)
        heapq.heapify(self._versions)


def _size_of(rows: Iterable[Row]) -> int:
    """Bytes of codes; an empty one counts as one byte."""
    return sum(max(1, r.size) for r in rows)


def _versions_of(rows: Iterable[Row]) -> bytes:
    """Identifies one set of versions of an id's values."""
    return b"".join(struct.pack("<BHq", r.kind, r.part, r.version) for r in rows)
