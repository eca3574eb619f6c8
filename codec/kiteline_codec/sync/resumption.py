"""Session resumption: values of earlier sessions that a side still holds are not sent again.

After a restart of either side, each lists short checksums of what it holds of the peer, under `SUMMARY_KIND`. The peer
then sends a checksum in place of such a code, and removes what does not hold any more. See SPEC.md, "Session
resumption".
"""

import contextlib
from collections.abc import Callable, Mapping, Sequence
from struct import pack
from zlib import crc32

from kiteline_codec.coding.packing import Reader, WireError, Writer
from kiteline_codec.residuals.predictors import Held
from kiteline_codec.residuals.residual_coding import ResidualCoder
from kiteline_codec.schema import AGENT_KINDS, KEYFRAME_KINDS, Key, SubmapPlacement
from kiteline_codec.schema.owners import submap_of
from kiteline_codec.transport.packet import MAX_KIND, Item
from kiteline_core.ids import SEQUENCE_BITS, SUBMAP_BITS

SUMMARY_KIND = MAX_KIND  # of the values that hold the checksums; no record has it
REFERENCE_BYTES = 4
_MIN_CODE_BYTES = 16  # shorter codes are sent as they are
_STANDING_KINDS = frozenset({SubmapPlacement.KIND})  # listed whatever their length: they hold until they are removed
_VALUES_PER_PART = 60  # fit a packet of a thin link in a few pieces
_MAX_PARTS = 1 << 16
MOST_LISTED = 1 << 17  # values that are remembered of what a peer lists: 25 MB
_MOST_STANDING = 1 << 10  # of these, placements, which are looked at in each step; the newest are listed first
_SHORT_CHECKSUM = 0xFFFFFF
_FROM_AGENT = KEYFRAME_KINDS & AGENT_KINDS
MAX_SESSION = 1 << 56
_MOST_OVERTAKEN = 3  # times: two sides with one number would overtake each other for ever
_BOOT_PART_BITS = 6  # of an agent's session: the lowest bits of its boot


def agent_session(order: int, boot: int) -> int:
    """The session of an agent's start. order: of its starts, from 1. boot: of the ids that it makes."""
    return order << _BOOT_PART_BITS | boot & (1 << _BOOT_PART_BITS) - 1


def later_session(session: int, known: int) -> int:
    """A session above one that the peer knows, for the same boot."""
    return agent_session((known >> _BOOT_PART_BITS) + 1, session)


class Overtaking:
    """Sessions above those that the peer knows, where the number that this side kept was lost."""

    def __init__(self) -> None:
        self._left = _MOST_OVERTAKEN

    def above(self, session: int, known: int) -> int | None:
        """A session that the peer takes: this one, or one above what it knows; None after a few times."""
        if known <= session:
            return session
        if not self._left or known >= MAX_SESSION >> 1:
            return None
        self._left -= 1
        return later_session(session, known)


def order_of(session: int) -> int:
    """The order of an agent's start."""
    return session >> _BOOT_PART_BITS


def summaries(values: Mapping[Key, bytes], session: int) -> dict[Key, bytes]:
    """Summaries of the values held of earlier sessions for a session of the peer: placements, then newest ids first.

    Of an agent's keyframes only those of its present boot, as far as its session tells: it holds no others.
    """
    listed = {key for key, code in values.items() if len(code) >= _MIN_CODE_BYTES or key.kind in _STANDING_KINDS}
    keys = [key for key in listed if key.kind != SUMMARY_KIND]
    keys = [key for key in keys if key.kind not in _FROM_AGENT or is_of_start(key.id, session)]
    keys.sort(key=lambda key: (key.kind not in _STANDING_KINDS, -key.id, key.kind, key.part))
    out: dict[Key, bytes] = {}
    for part, begin in enumerate(range(0, min(len(keys), _MAX_PARTS * _VALUES_PER_PART), _VALUES_PER_PART)):
        writer, last_id = Writer(), 0
        for key in keys[begin : begin + _VALUES_PER_PART]:
            writer.signed(key.id - last_id)
            last_id = key.id
            writer.u8(key.kind)
            writer.varint(key.part)
            writer.raw((crc32(values[key]) & _SHORT_CHECKSUM).to_bytes(3, "little"))
        out[Key(SUMMARY_KIND, 0, part)] = writer.bytes()
    return out


def outlived(is_gone: Callable[[Key], bool], session: int) -> Callable[[Key], bool]:
    """Whether a new session of the peer need not have an own value: one that is gone and not of its boot, or a summary
    for the session before. What is gone of its boot it may hold, and has to be told.
    """

    def of_other_boot(key: Key) -> bool:
        submap = submap_of(key)
        return submap is not None and not is_of_start(submap << SEQUENCE_BITS, session)

    return lambda key: key.kind == SUMMARY_KIND or (is_gone(key) and of_other_boot(key))


def is_of_start(keyframe: int, session: int) -> bool:
    """True if a keyframe is of the boot of an agent's session, as far as its few bits tell."""
    return (keyframe >> SEQUENCE_BITS + SUBMAP_BITS ^ session) & (1 << _BOOT_PART_BITS) - 1 == 0


def read_summary(code: bytes) -> dict[Key, int]:
    """The short checksums of a summary, by key. Raises WireError."""
    source, last_id = Reader(code), 0
    out: dict[Key, int] = {}
    while source.left:
        if len(out) == _VALUES_PER_PART:
            raise WireError(f"a summary lists at most {_VALUES_PER_PART} values")
        last_id += source.signed(1 << 62)
        key = Key(source.u8(), last_id, source.varint(0xFFFF))
        if not 0 <= last_id < 1 << 62 or key.kind >= SUMMARY_KIND:
            raise WireError(f"{key} cannot be resumed")
        out[key] = int.from_bytes(source.raw(3), "little")
    return out


class Resumable:
    """What the peer holds of earlier sessions of this side, by its summaries.

    standing: keys of placements that this session has neither replaced nor removed.
    """

    def __init__(self) -> None:
        self._checksums: dict[Key, int] = {}
        self.standing: dict[Key, None] = {}

    def clear(self) -> None:
        """Forget all as another session of the peer begins."""
        self._checksums.clear()
        self.standing.clear()

    def take(self, code: bytes) -> bool:
        """Take in a summary; one that cannot be read is ignored. Returns True if values may have a reference now."""
        with contextlib.suppress(WireError):
            summary = read_summary(code)
            if len(self._checksums) + len(summary) <= MOST_LISTED:
                self._checksums.update(summary)
                standing = [key for key in summary if key.kind in _STANDING_KINDS]
                self.standing |= dict.fromkeys(standing[: _MOST_STANDING - len(self.standing)])
                return True
        return False

    def replaced(self, key: Key) -> None:
        """Note that a value of this session stands in place of an earlier one."""
        self.standing.pop(key, None)

    def removed(self, key: Key) -> bool:
        """Note that a value is removed. Returns True if the peer holds it, or something in its place."""
        self.standing.pop(key, None)
        return self._checksums.pop(key, None) is not None

    def reference_to(self, key: Key, code: bytes) -> bytes | None:
        """The checksum to send in place of a code that the peer holds; None if it does not."""
        held = self._checksums.get(key)
        if held is None:
            return None
        checksum = crc32(code)
        return pack("<I", checksum) if held == checksum & _SHORT_CHECKSUM else None


def resolve(reference: bytes, code: bytes | None) -> bytes:
    """The code that a reference means. Raises WireError if another one, or none, is held."""
    if code is None or pack("<I", crc32(code)) != reference:
        raise WireError("a reference to a code of an earlier session, which is not held here")
    return code


def expand_items(items: Sequence[Item], coder: ResidualCoder, held: Held, earlier: Mapping[Key, bytes]) -> list[Item]:
    """Replace references and residual codes of a packet by codes. Raises WireError if what they need is not held.

    held: version and code of values that both sides hold. earlier: codes of earlier sessions of the peer.
    """
    out: list[Item] = []
    in_packet: dict[Key, tuple[int, bytes]] = {}

    def known(key: Key) -> tuple[int, bytes] | None:
        return in_packet.get(key) or held(key)

    for item in items:
        if item.residual:
            if len(item.data) == REFERENCE_BYTES:
                code = resolve(item.data, earlier.get(item.key) or (known(item.key) or (0, None))[1])
            else:
                code = coder.expand(item.key, item.data, known)
            item = Item(item.key, item.version, len(code), item.offset, code)
        if item.whole:
            in_packet[item.key] = item.version, item.data
        out.append(item)
    return out
