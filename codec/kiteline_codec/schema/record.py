"""What all records have in common: a kind, a key and a code. Each record is one module beside this one.

Arrays are structures of arrays, one row a keypoint. The keypoints of a keyframe share one index space [0, n); each is
a new landmark, which has a descriptor and is named by its index, or the observation of a landmark of another keyframe.
Pixels are those of the rectified left camera. Inverse depth is along the optical axis (z), in 1/m; 0 means unknown.
"""

from collections.abc import Callable
from enum import Enum, IntEnum
from typing import Any, ClassVar, NamedTuple, Protocol, Self, TypeVar

from kiteline_codec.coding.packing import Reader, WireError, Writer

MAX_AGENT_ID = (1 << 8) - 1
MAX_SUBMAP_ID = (1 << 36) - 1
MAX_KEYFRAME_ID = (1 << 52) - 1  # as laid out in kiteline_core.ids
MAX_TILE_ID = (1 << 48) - 1
MAX_PARTS = 1 << 8
FIRST_BASE_KIND = 16  # the agent writes the kinds below, the base the others


class Key(NamedTuple):
    """The name of a value. A tuple, because keys are hashed often."""

    kind: int
    id: int  # keyframe, submap or agent id; a tile's packed column and row
    part: int = 0


class IdOf(Enum):
    """What the id in a record's key names: the record's field, and the largest id."""

    AGENT = "agent", MAX_AGENT_ID
    SUBMAP = "submap", MAX_SUBMAP_ID
    KEYFRAME = "keyframe", MAX_KEYFRAME_ID  # of the agent's own map: archived, restored and deleted with the keyframe
    CACHED_KEYFRAME = "keyframe", MAX_KEYFRAME_ID, "cached"  # of a map cache: made anew by each base process
    PASSING_KEYFRAME = "keyframe", MAX_KEYFRAME_ID, "passing"  # of what is used up at arrival: removed then, not stored
    TILE = "tile", MAX_TILE_ID

    def __init__(self, field: str, max_id: int, _sort: str = "") -> None:
        self.field = field  # the record's field that holds the id
        self.max_id = max_id


class Priority(IntEnum):
    """The order of sending, first to last; within one priority the newest keyframe goes first."""

    POSE = 0  # live pose, and what a pose cannot be read without
    CORRECTION = 1
    KEYFRAME = 2
    LANDMARKS = 3
    OBSERVATIONS = 4  # after the landmarks, from which the next keyframe's observations are predicted
    REST = 5  # what improves a map that can already be used
    GRID = 6


class FieldCodec(Protocol):
    """The code of one field of a record, or of several."""

    def write(self, out: Writer, record: Any) -> None:
        """Append the fields, quantised. Raises ValueError for values that have no code."""
        ...

    def read(self, source: Reader, values: dict[str, Any]) -> dict[str, Any]:
        """The fields by name. values: the fields read before. Raises WireError."""
        ...


class Field:
    """The code of one field: write(out, value) and read(source), as FieldCodec has them for records."""

    def __init__(self, name: str, write: Callable[[Writer, Any], object], read: Callable[[Reader], Any]) -> None:
        self._name, self._write, self._read = name, write, read

    def write(self, out: Writer, record: Any) -> None:
        """Append the field."""
        self._write(out, getattr(record, self._name))

    def read(self, source: Reader, values: dict[str, Any]) -> dict[str, Any]:
        """The field by name."""
        return {self._name: self._read(source)}


def read_flag(source: Reader) -> int:
    """0 or 1. Raises WireError."""
    flag = source.u8()
    if flag > 1:
        raise WireError(f"a flag is 0 or 1, found {flag}")
    return flag


class Record:
    """A value that one side writes and the other holds; a later record of the same key replaces it."""

    __slots__ = ()
    KIND: ClassVar[int]  # number on the wire, 1 to 62
    ID: ClassVar[IdOf]
    PRIORITY: ClassVar[Priority]
    URGENCY: ClassVar[Priority] = Priority.POSE  # at most this urgent, whatever its priority: GRID waits for others
    PARTS: ClassVar[int] = 1  # how many records may share an id; with more than one there is a field `part`
    FIRST_PARTS: ClassVar[int] = 1  # parts that go at PRIORITY; the others wait until REST
    PREDICTS: ClassVar[bool] = False  # whether residual codes are predicted from it
    CODE: ClassVar[tuple[FieldCodec, ...]]  # all but the key, in order; needed where `write` and `read` are not defined

    @classmethod
    def written_by_agent(cls) -> bool:
        """True for records of the agent, False for those of the base."""
        return cls.KIND < FIRST_BASE_KIND

    def key(self) -> Key:
        """The name under which the record is shared."""
        return Key(self.KIND, int(getattr(self, self.ID.field)), int(self.part) if self.PARTS > 1 else 0)  # type: ignore[attr-defined]

    def write(self, out: Writer) -> None:
        """Append all but the key, quantised. Raises ValueError for values that have no code."""
        for codec in self.CODE:
            codec.write(out, self)

    @classmethod
    def read(cls, source: Reader, key: Key) -> Self:
        """The record of a key and a code. Raises WireError."""
        values: dict[str, Any] = {}
        for codec in cls.CODE:
            values |= codec.read(source, values)
        values[cls.ID.field] = key.id
        if cls.PARTS > 1:
            values["part"] = key.part
        return cls(**values)


RECORD_TYPES: dict[int, type[Record]] = {}  # by kind; complete once kiteline_codec.schema is imported
_Type = TypeVar("_Type", bound=type[Record])


def register(record_type: _Type) -> _Type:
    """Enter a record type into `RECORD_TYPES`. Raises ValueError when its number is taken or out of range."""
    if record_type.KIND in RECORD_TYPES or not 0 < record_type.KIND < 63:
        raise ValueError(f"{record_type.__name__}: kind {record_type.KIND} is taken or not within 1..62")
    RECORD_TYPES[record_type.KIND] = record_type
    return record_type


def kinds_keyed_by(what: IdOf) -> frozenset[int]:
    """The kinds whose id names a thing."""
    return frozenset(kind for kind, record_type in RECORD_TYPES.items() if record_type.ID is what)
