"""What the peer wrote, in its present session and in earlier ones, and the memory that this claims."""

from collections.abc import Callable, Collection, Mapping, Sequence

from kiteline_codec.schema import Key
from kiteline_codec.sync.archive import Spill
from kiteline_codec.sync.config import SyncConfig
from kiteline_codec.sync.inbox import VALUE_BYTES, Inbox, Update
from kiteline_codec.sync.resumption import SUMMARY_KIND
from kiteline_codec.transport.packet import Item

_FOR_WAITING = 2, 16 << 20  # part of the memory that is for claims of values that waited, but no more than these bytes
_FOR_OTHERS = 4, 8 << 20  # of that, for values that claim nothing, or are not used yet
_TRIED_NS = 200_000_000  # between two looks at those that wait

IsOfUse = Callable[[Key, bytes, Collection[Key]], bool]


class Claims:
    """Memory that values of the peer claim where they are used until that is deleted: removing a value frees nothing.

    earned: bytes that the peer may claim because what it sent was of use. What does not fit waits, and is used oldest
    first: after a long flight out of reach the newest keyframes come first, and hang on all before them.
    is_of_use: whether what the value under a key hangs on is in use, or among these keys.
    """

    def __init__(self, claimed_bytes: Callable[[Key, bytes], int]) -> None:
        """claimed_bytes: of a code under a key."""
        self._claimed_bytes = claimed_bytes
        self.is_of_use: IsOfUse = lambda key, code, also: True
        self.bytes = self.earned = 0
        self._waiting: set[Key] = set()
        self._tried_ns = 0  # when those that wait were tried

    def allowed_bytes(self, config: SyncConfig) -> int:
        """Memory for all that the peer wrote and claims."""
        if config.unused_inbox_bytes is None:
            return config.max_inbox_bytes
        return min(config.max_inbox_bytes, config.unused_inbox_bytes + self.earned)

    def waits(self, key: Key) -> bool:
        """True if the value under a key does not fit yet."""
        return key in self._waiting

    def resume(self, key: Key, code: bytes) -> None:
        """Count a value that was here before the start."""
        claimed = self._claimed_bytes(key, code)
        self.bytes += claimed
        self.earned += claimed + len(code) + VALUE_BYTES

    def fit(self, key: Key, code: bytes, limit: int) -> bool:
        """Count a value unless all claims would then be above their share of the limit: then it waits."""
        claimed = self._claimed_bytes(key, code)
        if claimed and self.bytes + claimed > _without(limit, _FOR_WAITING):
            self._waiting.add(key)
            return False
        self._waiting.discard(key)
        self.bytes += claimed
        return True

    def due(self, code_of: Callable[[Key], bytes | None], limit: int, now_ns: int) -> list[Update]:
        """Those that waited, are of use and fit now: they are counted. code_of: of a key; None: it was removed."""
        if not self._waiting or now_ns - self._tried_ns < _TRIED_NS:
            return []
        self._tried_ns = now_ns
        due: dict[Key, Update] = {}
        for key in sorted(self._waiting, key=lambda key: (key.id, key)):
            code = code_of(key)
            if code is None:
                self._waiting.discard(key)
                continue
            claimed = self._claimed_bytes(key, code)
            if self.bytes + claimed > _without(limit, _FOR_OTHERS):
                break
            if self.is_of_use(key, code, due):
                self.bytes += claimed
                due[key] = Update(key, code)
        self._waiting.difference_update(due)
        return list(due.values())

    def release(self, key: Key, code: bytes) -> None:
        """Count a value no more: where it was used, it is deleted. What it had earned goes with it."""
        if key in self._waiting:
            self._waiting.discard(key)
            return
        claimed = self._claimed_bytes(key, code)
        self.bytes = max(0, self.bytes - claimed)
        self.earned = max(0, self.earned - claimed - len(code) - VALUE_BYTES)


def _without(limit: int, reserved: tuple[int, int]) -> int:
    """A limit less a part of it, which is at most so many bytes."""
    part, most = reserved
    return limit - min(limit // part, most)


class EarlierValues:
    """What earlier sessions of the peer wrote and its present one has not replaced, and the memory that it takes.

    is_gone: whether nobody needs a value any more; such values end with the session that wrote them. compared: whether
    all that the present session had to say has come: of what is still here, it has said nothing.
    """

    def __init__(self, claims: Claims) -> None:
        self.is_gone: Callable[[Key], bool] = lambda key: False
        self.codes: dict[Key, bytes] = {}
        self.bytes = 0
        self.compared = self._ended = False
        self._claims = claims

    def take_ended(self) -> list[Key]:
        """Once a session, when it was compared: the keys of all that is here. Codes stay: a value may refer to them."""
        if not self.compared or self._ended:
            return []
        self._ended = True
        return sorted(self.codes)

    def keep(self, values: Mapping[Key, bytes]) -> None:
        """Add values as a new session begins, and drop those that are gone."""
        self.compared = self._ended = False
        for key in [key for key in self.codes if key in values or self.is_gone(key)]:
            if key not in values:
                self._claims.release(key, self.codes[key])
            self.drop(key)
        for key, code in values.items():
            if self.is_gone(key):
                self._claims.release(key, code)
                continue
            self.codes[key] = code
            self.bytes += len(code) + VALUE_BYTES

    def resume(self, values: Mapping[Key, bytes]) -> None:
        """Add values that were here before the start."""
        for key, code in values.items():
            self._claims.resume(key, code)
        self.keep(values)

    def drop(self, key: Key) -> None:
        """Remove a value, if it is here."""
        code = self.codes.pop(key, None)
        if code is not None:
            self.bytes -= len(code) + VALUE_BYTES


class Received:
    """What the peer wrote.

    present: of its present session. earlier: of earlier ones. claims: memory beyond both, where values are used.
    """

    def __init__(self, config: SyncConfig, spill: Spill | None, claimed_bytes: Callable[[Key, bytes], int]) -> None:
        """spill: keeps values of keyframes beyond `resident_inbox_bytes`. claimed_bytes: of a code under a key."""
        self._config, self._spill = config, spill
        self.present = Inbox(config.resident_inbox_bytes, spill)
        self.claims = Claims(claimed_bytes)
        self.earlier = EarlierValues(self.claims)

    def begin_session(self) -> None:
        """Begin with a new session of the peer; what the last one wrote stays readable."""
        self.earlier.keep(self.codes())
        self.present.close()
        self.present = Inbox(self._config.resident_inbox_bytes, self._spill)

    def codes(self) -> dict[Key, bytes]:
        """The codes of all values of the present session."""
        return {key: code for key, code in self.present.codes().items() if key.kind != SUMMARY_KIND}

    def value(self, key: Key) -> bytes | None:
        """The code of a value of the present session, else of an earlier one; None if there is none."""
        held = self.present.held(key)
        return self.earlier.codes.get(key) if held is None else held[1]

    def room_for(self, items: list[Item]) -> bool:
        """True if there is memory for the items."""
        room = self._room_bytes + self.present.held_bytes - self.claims.bytes
        return self.present.room_for(items, room, self._config.max_assembly_bytes)

    def take(self, items: Sequence[Item]) -> tuple[list[Update], list[Update]]:
        """Take in the items of a packet. Returns what changed, and of that the values that may be used now."""
        changed, usable = [], []
        for item in items:
            was_held = self.present.held(item.key) is not None
            update = self.present.apply(item)
            if update is None:
                continue
            changed.append(update)
            if update.key.kind == SUMMARY_KIND:
                continue
            counted = (was_held or item.key in self.earlier.codes) and not self.claims.waits(item.key)
            self.earlier.drop(item.key)
            if update.code is None or counted or self.claims.fit(item.key, update.code, self._room_bytes):
                usable.append(update)
        return changed, usable

    def due(self, now_ns: int) -> list[Update]:
        """Values that waited for memory and may be used now."""
        return self.claims.due(self.value, self._room_bytes, now_ns)

    @property
    def _room_bytes(self) -> int:
        """Memory for all that the present session wrote and the peer claims."""
        return self.claims.allowed_bytes(self._config) - self.earlier.bytes - self.present.held_bytes
