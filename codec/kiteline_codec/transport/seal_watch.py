"""Why the two ends of a link do not understand each other, in words: seals on one side only, other keys, old boots.

An end that must refuse packets tells the other so in a notice of ten bytes (SPEC.md, "Notices"). Notices are not sealed
and change nothing but what users read.
"""

from enum import IntEnum
from zlib import crc32

from kiteline_codec.transport.packet import CRC_BYTES
from kiteline_codec.transport.seal import EARLIER_BOOT, Direction, Opener, Suite, read_head

_MAGIC = b"\0kiteline"
_REPLY_EVERY = 32  # refused packets for one notice
_SURE = 3  # refused packets in a row before it is said: one may be damaged
_WELL = 500  # sound packets in a row after which a trouble is over, and is said anew if it comes again


class Trouble(IntEnum):
    """What is wrong with the sender of a packet, as its receiver sees it."""

    UNSEALED = 1  # the receiver takes sealed packets only
    OTHER_KEY = 2  # it has another key, or none for this agent
    SEALED = 3  # it knows no keys
    EARLIER_BOOT = 4  # a later start of this sender was seen


_AT_BASE = {
    Trouble.UNSEALED: "agent {n} sends without seals: run `kiteline keys pair {n}` here, and at the agent the command "
    "that it shows",
    Trouble.OTHER_KEY: "agent {n} has another key than this base: run `kiteline keys pair {n}` here, and at the agent "
    "the command that it shows",
    Trouble.SEALED: "agent {n} seals its packets, and this base has no keys: start it again, without --insecure "
    "or with --key FILE",
    Trouble.EARLIER_BOOT: "agent {n} comes with an earlier start than was seen: are there two agents {n} (--agent N), "
    "or was its state folder lost or copied? It is refused",
}
_AT_AGENT = {
    Trouble.UNSEALED: "the base sends without seals: start it again, without --insecure, or this agent with it",
    Trouble.OTHER_KEY: "the base has another key: run `kiteline keys pair {n}` there, and here the command that it "
    "shows",
    Trouble.SEALED: "the base seals its packets, and this agent has no key: run `kiteline keys pair {n}` there, and "
    "here the command that it shows",
    Trouble.EARLIER_BOOT: "the base comes with an earlier session than was seen: are there two bases, or was its state "
    "folder lost?",
}  # fmt: skip
_TOLD_AT_BASE = {
    Trouble.UNSEALED: _AT_BASE[Trouble.SEALED],
    Trouble.OTHER_KEY: _AT_BASE[Trouble.OTHER_KEY],
    Trouble.SEALED: _AT_BASE[Trouble.UNSEALED],
    Trouble.EARLIER_BOOT: "agent {n} has seen a later session of a base than this one: are there two bases?",
}
_TOLD_AT_AGENT = {
    Trouble.UNSEALED: _AT_AGENT[Trouble.SEALED],
    Trouble.OTHER_KEY: _AT_AGENT[Trouble.OTHER_KEY],
    Trouble.SEALED: _AT_AGENT[Trouble.UNSEALED],
    Trouble.EARLIER_BOOT: "the base has seen a later start of agent {n} and refuses this one: are there two agents {n} "
    "(--agent N), or was the state folder lost or copied?",
}
# A notice that does not fit how this end sends is the answer to another sender, with its number.
_OTHER_BASE = "agent {n} hears another base, with other seals than this one: stop one of the two"
_OTHER_AGENT = "the base hears another agent {n}, with other seals than this one: give each its own --agent N"


def notice(trouble: Trouble) -> bytes:
    """The notice to send to a peer with this trouble."""
    return _MAGIC + bytes((trouble,))


def read_notice(packet: bytes) -> Trouble | None:
    """What a notice says of this end; None for anything else."""
    if len(packet) != len(_MAGIC) + 1 or not packet.startswith(_MAGIC):
        return None
    return Trouble(packet[-1]) if packet[-1] in {t.value for t in Trouble} else None


def is_plain(packet: bytes) -> bool:
    """True for a packet without a seal."""
    return len(packet) >= CRC_BYTES + 4 and crc32(packet[:-CRC_BYTES]).to_bytes(CRC_BYTES, "little") == packet[-4:]


def named_agent(packet: bytes) -> int:
    """The agent that a packet of a thin link names; 0 where it names none."""
    head = read_head(packet)
    return 0 if head is None or head[0] is not Suite.TAGGED else head[2]


class SealWatch:
    """Looks at what an end receives, and finds words for what it refuses. Pure."""

    def __init__(self, side: Direction, opener: Opener | None) -> None:
        """side: of this end: DOWN for a base. opener: None where packets are not sealed."""
        self._at_base = side == Direction.DOWN
        self._opener = opener
        self._refused: dict[int, int] = {}  # in a row, by agent
        self._sound: dict[int, int] = {}  # the same of packets that opened
        self._said: set[tuple[int, str]] = set()
        self._lines: list[str] = []

    def take(self, agent: int | None, packet: bytes) -> tuple[tuple[int, bytes] | None, bytes | None]:
        """Open a packet of an agent's link: its agent and content, or None; and a notice to be sent back, or None.

        agent: None on a line, where a packet itself says whose it is.
        """
        agent = named_agent(packet) if agent is None else agent
        told = read_notice(packet)
        if told is not None:
            self._sound[agent] = 0
            self._say(agent, self._words_of(told))
            return None, None
        trouble: Trouble | None
        if self._opener is None:
            if is_plain(packet) or not self._looks_sealed(agent, packet):
                self._refused.pop(agent, None)
                return (agent, packet), None  # damaged ones are the endpoint's
            trouble = Trouble.SEALED
        else:
            opened = self._opener.open(packet)
            if opened is not None:
                self._refused.pop(opened[0], None)
                sound = self._sound[opened[0]] = self._sound.get(opened[0], 0) + 1
                if sound == _WELL:  # not at once: a stranger's packets among sound ones would fill the terminal
                    self._said = {said for said in self._said if said[0] != opened[0]}
                return opened, None
            trouble = self._trouble(packet)
        if trouble is None:
            return None, None
        self._sound[agent] = 0
        count = self._refused[agent] = self._refused.get(agent, 0) + 1
        if count >= _SURE or trouble is Trouble.UNSEALED:
            self._say(agent, (_AT_BASE if self._at_base else _AT_AGENT)[trouble])
        return None, notice(trouble) if count % _REPLY_EVERY in (1, _SURE) else None

    def is_familiar(self, agent: int, packet: bytes) -> bool:
        """True if a packet looks like those of an agent that was heard; False costs it a place among strangers'."""
        return self._opener is None or self._opener.is_familiar(agent, packet)

    def lines(self) -> list[str]:
        """What is new since the last call."""
        lines, self._lines = self._lines, []
        return lines

    def _words_of(self, told: Trouble) -> str:
        """What a notice means here."""
        impossible = Trouble.SEALED if self._opener is None else Trouble.UNSEALED
        if told is impossible:
            return _OTHER_BASE if self._at_base else _OTHER_AGENT
        return (_TOLD_AT_BASE if self._at_base else _TOLD_AT_AGENT)[told]

    def _looks_sealed(self, agent: int, packet: bytes) -> bool:
        """True if a packet begins as the peer's sealed ones do."""
        head = read_head(packet)
        return head is not None and head[1:] == (Direction.UP if self._at_base else Direction.DOWN, agent)

    def _trouble(self, packet: bytes) -> Trouble | None:
        assert self._opener is not None
        if is_plain(packet):
            return Trouble.UNSEALED
        why = self._opener.refusal
        if why == EARLIER_BOOT:
            return Trouble.EARLIER_BOOT
        return Trouble.OTHER_KEY if why in ("unknown", "forged") else None

    def _say(self, agent: int, text: str) -> None:
        text = text.format(n=agent)
        if (agent, text) not in self._said:
            self._said.add((agent, text))
            self._lines.append(text)
