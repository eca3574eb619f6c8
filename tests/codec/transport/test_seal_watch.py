"""Ends that do not understand each other say why, on both sides, after a few packets."""

import pytest

from kiteline_codec.coding.packing import WireError
from kiteline_codec.sync.config import SyncConfig
from kiteline_codec.sync.endpoint import Endpoint
from kiteline_codec.transport import signed_question
from kiteline_codec.transport.packet import PROTOCOL_VERSION
from kiteline_codec.transport.seal import Direction, Opener, Sealer, Suite
from kiteline_codec.transport.seal_watch import SealWatch, Trouble, notice, read_notice
from kiteline_codec.transport.signed_question import OtherStartError, QuestionGuard, sign, unsigned

AGENT = PROTOCOL_VERSION  # whose seals begin with the byte that unsealed packets begin with
OURS, OTHER = bytes(32), bytes([1]) * 32


def packet() -> bytes:
    out = Endpoint(SyncConfig(), 3).poll(0)
    assert out is not None
    return out


class End:
    """One end: with a key or without."""

    def __init__(self, side: Direction, key: bytes | None, boot: int = 4, suite: Suite = Suite.ENCRYPTED) -> None:
        other = Direction.DOWN if side == Direction.UP else Direction.UP
        self.sealer = None if key is None else Sealer(key, AGENT, boot, side, suite)
        self.opener = None if key is None else Opener({AGENT: key}, other)
        self.watch = SealWatch(side, self.opener)

    def packet(self) -> bytes:
        return packet() if self.sealer is None else self.sealer.seal(packet())


def exchange(agent: End, base: End, packets: int = 4) -> tuple[int, list[str], list[str]]:
    """Send packets up, and what the base answers down. Returns how many arrived, and what both say."""
    arrived = 0
    for _ in range(packets):
        opened, answer = base.watch.take(AGENT, agent.packet())
        arrived += opened is not None
        if answer is not None:
            assert len(answer) == 10
            agent.watch.take(AGENT, answer)
    return arrived, agent.watch.lines(), base.watch.lines()


@pytest.mark.parametrize("suite", list(Suite))
@pytest.mark.parametrize(
    ("agent_key", "base_key", "at_agent", "at_base"),
    [
        (None, OURS, "the base seals its packets, and this agent has no key", f"agent {AGENT} sends without seals"),
        (OURS, None, "the base sends without seals", f"agent {AGENT} seals its packets, and this base has no keys"),
        (OTHER, OURS, "the base has another key", f"agent {AGENT} has another key"),
    ],
)
def test_seals_on_one_side_and_other_keys_are_named_on_both(
    suite: Suite, agent_key: bytes | None, base_key: bytes | None, at_agent: str, at_base: str
) -> None:
    agent, base = End(Direction.UP, agent_key, suite=suite), End(Direction.DOWN, base_key, suite=suite)
    arrived, agent_lines, base_lines = exchange(agent, base)
    assert arrived == 0
    assert len(agent_lines) == len(base_lines) == 1
    assert at_agent in agent_lines[0] and at_base in base_lines[0]
    assert exchange(agent, base, 200)[1:] == ([], [])  # once is enough


@pytest.mark.parametrize(("key", "trouble"), [(OURS, Trouble.UNSEALED), (None, Trouble.SEALED)])
def test_a_notice_that_is_the_answer_to_another_sender_is_not_said_of_this_end(
    key: bytes | None, trouble: Trouble
) -> None:
    """Two agents of one number: the one with the key was told that it has none."""
    for side, words in ((Direction.UP, "give each its own --agent N"), (Direction.DOWN, "another base")):
        end = End(side, key)
        end.watch.take(AGENT, notice(trouble))
        (line,) = end.watch.lines()
        assert words in line and "key" not in line


@pytest.mark.parametrize("key", [None, OURS])
def test_ends_that_understand_each_other_say_nothing(key: bytes | None) -> None:
    agent, base = End(Direction.UP, key), End(Direction.DOWN, key)
    assert exchange(agent, base, 50) == (50, [], [])


def test_an_earlier_boot_is_named_on_both_sides_and_a_repeated_packet_is_not() -> None:
    base = End(Direction.DOWN, OURS)
    later, earlier = End(Direction.UP, OURS, boot=9), End(Direction.UP, OURS, boot=8)
    again = later.packet()
    for _ in range(5):
        base.watch.take(AGENT, again)
    assert base.watch.lines() == []
    arrived, agent_lines, base_lines = exchange(earlier, base)
    assert arrived == 0
    assert f"a later start of agent {AGENT}" in agent_lines[0] and f"two agents {AGENT}" in base_lines[0]


def test_few_answers_go_to_a_flood() -> None:
    base = End(Direction.DOWN, OURS)
    answers = [base.watch.take(AGENT, packet())[1] for _ in range(1000)]
    assert 0 < sum(a is not None for a in answers) < 100


def test_a_stranger_among_sound_packets_is_said_once_and_a_trouble_that_comes_again_is_said_again() -> None:
    agent, base = End(Direction.UP, OURS), End(Direction.DOWN, OURS)
    for _ in range(300):
        assert base.watch.take(AGENT, agent.packet())[0] is not None
        base.watch.take(AGENT, packet())
        base.watch.take(AGENT, notice(Trouble.OTHER_KEY))
    assert len(base.watch.lines()) == 2
    exchange(agent, base, 1000)
    base.watch.take(AGENT, packet())
    assert len(base.watch.lines()) == 1


def test_damaged_packets_reach_the_endpoint_that_counts_them() -> None:
    base = End(Direction.DOWN, None)
    damaged = bytearray(packet())
    damaged[0] = 0x6B
    assert base.watch.take(AGENT, bytes(damaged)) == ((AGENT, bytes(damaged)), None)


def test_notices_are_read_exactly() -> None:
    for trouble in Trouble:
        assert read_notice(notice(trouble)) is trouble
    for other in (b"", notice(Trouble.SEALED) + b"x", b"\0kiteline\0", b"\0kiteline\xff", packet()):
        assert read_notice(other) is None


def test_a_key_can_be_changed_while_packets_arrive() -> None:
    base, agent = End(Direction.DOWN, OTHER), End(Direction.UP, OURS)
    assert exchange(agent, base)[0] == 0
    base.opener.set_key(AGENT, OURS)
    assert exchange(agent, base)[0] == 4


def test_questions_need_the_key_and_are_taken_once() -> None:
    guard = QuestionGuard(lambda: OURS, "a")
    text = sign(OURS, "delete", '{"map": "0.0.0"}', 1000, "n1", "a")
    assert guard.open("delete", text, 1010) == '{"map": "0.0.0"}'
    for verb, again, now_s in (
        ("delete", text, 1011),  # asked before
        ("merge", sign(OURS, "delete", "{}", 1000, "n2", "a"), 1000),  # another verb
        ("delete", sign(OTHER, "delete", "{}", 1000, "n3", "a"), 1000),
        ("delete", sign(OURS, "delete", "{}", 1000, "n4", "a"), 2000),  # too late
        ("delete", '{"signed": 1}', 1000),
        ("delete", text.replace('"start": "a"', '"start": "b"'), 1000),
        ("delete", '{"signed": "{}", "start": "a", "t_s": 1e999, "nonce": "a", "tag": "\ud800"}', 1000),
    ):
        with pytest.raises(WireError):
            guard.open(verb, again, now_s)
    assert guard.open("delete", '{"map": "0.0.0"}', 1000) is None
    assert guard.open("delete", "[" * 1000, 1000) is None
    with pytest.raises(WireError, match="keys new maps"):
        QuestionGuard(lambda: None, "a").open("delete", text, 1000)
    assert unsigned(text) == '{"map": "0.0.0"}' and unsigned("[" * 1000) == "[" * 1000


def test_a_question_is_not_taken_by_another_start_of_the_base() -> None:
    text = sign(OURS, "delete", '{"map": "0.0.0"}', 1000, "n1", "first")
    assert QuestionGuard(lambda: OURS, "first").open("delete", text, 1010) is not None
    with pytest.raises(OtherStartError) as refused:
        QuestionGuard(lambda: OURS, "second").open("delete", text, 1020)
    assert refused.value.start == "second"
    moved = text.replace('"start": "first"', '"start": "second"')
    with pytest.raises(WireError, match="another key"):
        QuestionGuard(lambda: OURS, "second").open("delete", moved, 1020)


def test_a_clock_that_is_set_back_brings_no_question_back() -> None:
    guard = QuestionGuard(lambda: OURS, "a")
    early = [sign(OURS, "delete", "{}", 1000, "n1", "a"), sign(OURS, "delete", "{}", 1300, "n2", "a")]
    assert [guard.open("delete", text, 1000) for text in early] == ["{}", "{}"]
    for n, now_s in enumerate(range(1601, 4000, 150)):  # those before are forgotten in turn
        assert guard.open("delete", sign(OURS, "delete", "{}", now_s - 300, f"m{n}", "a"), now_s) == "{}"
    for text in early:
        with pytest.raises(WireError, match="set back"):
            guard.open("delete", text, 1010)


def test_questions_of_a_clock_that_was_ahead_are_forgotten_like_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signed_question, "_REMEMBERED", 5)
    guard = QuestionGuard(lambda: OURS, "a")
    assert guard.open("list", sign(OURS, "list", "{}", 10**6, "ahead", "a"), 10**6) == "{}"
    for now_s in range(1000, 9000, 400):
        assert guard.open("list", sign(OURS, "list", "{}", now_s, f"{now_s}", "a"), now_s) == "{}"


@pytest.mark.parametrize("agent", [0, 5, 63, 255])
def test_a_packet_of_a_line_names_its_agent(agent: int) -> None:
    base = SealWatch(Direction.DOWN, Opener({agent: OURS}, Direction.UP))
    opened, _ = base.take(None, Sealer(OURS, agent, 4, Direction.UP, Suite.TAGGED).seal(packet()))
    assert opened[0] == agent
    other = Sealer(OTHER, agent, 5, Direction.UP, Suite.TAGGED)
    for _ in range(4):
        base.take(None, other.seal(packet()))
    assert [f"agent {agent} has another key" in line for line in base.lines()] == [True]


@pytest.mark.parametrize("suite", list(Suite))
@pytest.mark.parametrize("agent", [0, 62, 63, 64, 255])
def test_a_base_without_keys_names_every_agent_that_seals(agent: int, suite: Suite) -> None:
    base, sealer = SealWatch(Direction.DOWN, None), Sealer(OURS, agent, 4, Direction.UP, suite)
    assert all(base.take(agent, sealer.seal(packet()))[0] is None for _ in range(4))
    assert [f"agent {agent} seals its packets" in line for line in base.lines()] == [True]
