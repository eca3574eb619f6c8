"""What an agent in flight tells its user of the link: another agent with its number, a serial line that is gone."""

from kiteline_agent.runtime.live import _BaseEnd
from kiteline_agent.runtime.options import AgentOptions
from kiteline_codec.transport.seal_watch import Trouble, notice
from tests.handed_link import HandedLink

S = 1_000_000_000


class End(HandedLink):
    """A link that knows whether another agent has its number."""

    doubled = False


def test_another_agent_with_this_number_is_told_once_with_the_mend() -> None:
    end = End()
    base = _BaseEnd(AgentOptions(source="", folder="", agent=3), end, None, None)
    assert base.lines(0) == []
    end.doubled = True
    assert base.lines(0) == ["another agent has number 3 too: give each its own --agent N"]
    assert base.lines(0) == []


def test_what_the_link_tells_is_told_once() -> None:
    end = End()
    base = _BaseEnd(AgentOptions(source="", folder="", agent=3), end, None, None)
    end.messages = ["the line is gone"]
    assert base.lines(0) == ["the line is gone"]
    assert base.lines(0) == []


def test_a_base_that_does_not_answer_is_named_once_and_so_is_its_return() -> None:
    end = End()
    base = _BaseEnd(AgentOptions(source="", folder="", link="zenoh:tcp/10.0.0.1:7447"), end, None, None)
    assert [base.lines(t * S) for t in (0, 2)] == [[], []]
    (line,) = base.lines(3 * S)
    assert "no base answers at zenoh:tcp/10.0.0.1:7447" in line and "--paired-only" in line
    assert base.lines(60 * S) == []
    end.inbox = [b"a packet"]
    assert base.receive() == [b"a packet"]
    assert base.lines(61 * S) == ["the base answers"]
    assert [base.lines(t * S) for t in (62, 70)] == [[], []]
    assert "no base answers" in base.lines(71 * S)[0]


def test_a_flight_without_a_link_awaits_no_base() -> None:
    base = _BaseEnd(AgentOptions(source="", folder="", link="none"), End(), None, None)
    assert [base.lines(t * S) for t in (0, 60)] == [[], []]


def test_a_base_that_is_not_understood_does_answer() -> None:
    end = End()
    base = _BaseEnd(AgentOptions(source="", folder="", link="zenoh:tcp/10.0.0.1:7447"), end, None, None)
    base.lines(0)
    end.inbox = [notice(Trouble.UNSEALED)]
    assert base.receive() == []
    assert "seals" in base.lines(1 * S)[0]
    assert base.lines(10 * S) == []
