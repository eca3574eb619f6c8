"""What an agent in flight tells its user of the link: another agent with its number, a serial line that is gone."""

from kiteline_agent.runtime.live import _BaseEnd
from kiteline_agent.runtime.options import AgentOptions


class End:
    """A ByteLink that tells what it is told to."""

    def __init__(self) -> None:
        self.doubled = False
        self.messages: list[str] = []

    def take_messages(self) -> list[str]:
        messages, self.messages = self.messages, []
        return messages

    def send(self, packet: bytes) -> bool:
        return True

    def receive(self) -> list[bytes]:
        return []

    def close(self) -> None:
        """Nothing to close."""


def test_another_agent_with_this_number_is_told_once_with_the_mend() -> None:
    end = End()
    base = _BaseEnd(AgentOptions(source="", folder="", agent=3), end, None, None)
    assert base.lines() == []
    end.doubled = True
    assert base.lines() == ["another agent has number 3 too: give each its own --agent N"]
    assert base.lines() == []


def test_what_the_link_tells_is_told_once() -> None:
    end = End()
    base = _BaseEnd(AgentOptions(source="", folder="", agent=3), end, None, None)
    end.messages = ["the line is gone"]
    assert base.lines() == ["the line is gone"]
    assert base.lines() == []
