"""Values that wait out of memory: of each keyframe a few bytes a value here, its codes where they can be read back.

A page holds the values of one id. It is written whole when its keyframe has not been touched for long, and taken back
whole when one of its values is asked for. Pure: where codes are kept is handed in.
"""

from __future__ import annotations

import heapq
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

from kiteline_codec.sync.digest import MODULUS

_ROW = struct.Struct("<BHqIB")  # kind, part, version, bytes of the code, state
_CLEAN, _SENT, _PLAIN = 1, 2, 4
_NOWHERE = -1
PAGE_BYTES = 300  # of memory that a page takes beside its rows, about
ROW_BYTES = _ROW.size


class Spill(Protocol):
    """Keeps bytes out of memory for as long as this process lives. Never raises."""

    def put(self, data: bytes) -> int | None:
        """Keep bytes. Returns where, as a number from 0; None when they cannot be kept."""
        ...

    def get(self, where: int, n_bytes: int) -> bytes | None:
        """The bytes that were put there; None when they cannot be read."""
        ...


@dataclass(frozen=True, slots=True)
class Row:
    """One value of a page. clean: the peer is known to hold it. sent: some version was sent. plain: a packet was lost.
    code: None when it is kept nowhere.
    """

    kind: int
    part: int
    version: int
    clean: bool
    sent: bool
    plain: bool
    size: int
    code: bytes | None


@dataclass(slots=True)
class _Page:
    rows: bytes
    where: int
    n_bytes: int  # of all codes
    hashes: int  # sum of the rows' hashes modulo 2^128
    first: int  # least version
    dirty_from: int  # least version that the peer is not known to hold, 0: it holds all
    session: int  # of the peer, counted here: what was clean for an earlier one is not for this one


class Archive:
    """Pages by id. spill: where codes go; without one, or where it fails, only pages that the peer holds are taken."""

    def __init__(self, spill: Spill | None) -> None:
        self._spill = spill
        self._pages: dict[int, _Page] = {}
        self._session = 0
        self._newest: list[int] = []  # heap of -id of pages with anything to send
        self._versions: list[tuple[int, int]] = []  # heap of (dirty_from, id)
        self._written: dict[int, tuple[int, bytes]] = {}  # where the codes of taken pages stand, and their versions
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
        """Memory that pages take, about."""
        return PAGE_BYTES * len(self._pages) + ROW_BYTES * self.values

    def readable(self, id_: int) -> bool:
        """Whether there is a page whose codes are kept."""
        page = self._pages.get(id_)
        return page is not None and page.where != _NOWHERE

    def put(self, id_: int, rows: Iterable[Row], hashes: int) -> bool:
        """Take over the values of an id. Returns False where codes that the peer lacks cannot be kept."""
        rows = sorted(rows, key=lambda r: (r.kind, r.part))
        dirty = [r.version for r in rows if not r.clean]
        where = None if self._spill is None else self._write(self._spill, id_, rows)
        if where is None:
            if dirty:
                return False
            where = _NOWHERE
        packed = b"".join(
            _ROW.pack(r.kind, r.part, r.version, r.size, r.clean * _CLEAN | r.sent * _SENT | r.plain * _PLAIN)
            for r in rows
        )
        first = min(r.version for r in rows)
        n_bytes = sum(r.size for r in rows)
        self._pages[id_] = _Page(packed, where, n_bytes, hashes, first, min(dirty, default=0), self._session)
        self.values += len(rows)
        self.value_bytes += _extent(rows)
        if dirty:
            heapq.heappush(self._newest, -id_)
            heapq.heappush(self._versions, (min(dirty), id_))
        return True

    def _write(self, spill: Spill, id_: int, rows: list[Row]) -> int | None:
        versions = _versions_of(rows)
        where, before = self._written.pop(id_, (_NOWHERE, b""))
        if before == versions:
            return where
        return spill.put(b"".join(r.code or b"" for r in rows))

    def take(self, id_: int) -> list[Row]:
        """A page's values, which leave the archive. Codes are None where they are kept nowhere or cannot be read."""
        page = self._pages.pop(id_)
        codes = None
        if page.where != _NOWHERE and self._spill is not None:
            codes = self._spill.get(page.where, page.n_bytes)
        ours = page.session == self._session
        rows = []
        at = 0
        for kind, part, version, size, state in _ROW.iter_unpack(page.rows):
            code = None if codes is None else codes[at : at + size]
            at += size
            clean, sent, plain = (bool(ours and state & bit) for bit in (_CLEAN, _SENT, _PLAIN))
            rows.append(Row(kind, part, version, clean, sent, plain, size, code))
        self.values -= len(rows)
        self.value_bytes -= _extent(rows)
        if codes is not None:
            self._written[id_] = page.where, _versions_of(rows)
        return rows

    def hashes(self, id_: int) -> int:
        """Sum of the hashes of a page's values."""
        return self._pages[id_].hashes

    def newest_dirty(self) -> int | None:
        """The highest id of which anything waits to be sent."""
        while self._newest:
            page = self._pages.get(-self._newest[0])
            if page is not None and page.dirty_from:
                return -self._newest[0]
            heapq.heappop(self._newest)
        return None

    def oldest_dirty(self) -> tuple[int, int] | None:
        """The least version that waits to be sent, and its id."""
        while self._versions:
            version, id_ = self._versions[0]
            page = self._pages.get(id_)
            if page is not None and page.dirty_from == version:
                return version, id_
            heapq.heappop(self._versions)
        return None

    def restart(self) -> tuple[int, int]:
        """The peer began anew and holds nothing. Returns how many values are thereby lost, and their hashes."""
        self._session += 1
        lost = hashes = 0
        for id_ in [i for i, page in self._pages.items() if page.where == _NOWHERE]:
            hashes = (hashes + self._pages[id_].hashes) % MODULUS
            lost += len(self.take(id_))
        for page in self._pages.values():
            page.dirty_from = page.first
        self._newest = [-id_ for id_ in self._pages]
        self._versions = [(page.first, id_) for id_, page in self._pages.items()]
        heapq.heapify(self._newest)
        heapq.heapify(self._versions)
        return lost, hashes


def _extent(rows: Iterable[Row]) -> int:
    """Bytes of codes; an empty one counts as one byte."""
    return sum(max(1, r.size) for r in rows)


def _versions_of(rows: Iterable[Row]) -> bytes:
    """Tells one set of codes of an id from another."""
    return b"".join(struct.pack("<BHq", r.kind, r.part, r.version) for r in rows)
