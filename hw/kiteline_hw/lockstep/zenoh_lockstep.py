"""The barrier of a lock-step flight over Zenoh: each agent sends one message a tick and waits for the answer.

Reliable and ordered. Messages are published to each other, which costs half of a query. They are numbered: an agent
repeats one that nobody may have received yet, and a repeated one gets the same answer. Liveliness tokens tell each side
at once when the other's process ends.
"""

import queue
import struct
import threading
import time
from dataclasses import dataclass
from typing import Any

import zenoh

from kiteline_hw.links.zenoh_access import PREFIX
from kiteline_hw.links.zenoh_session import close_session, direct, open_session, reason_of
from kiteline_hw.ports import LinkError
from kiteline_hw.system.closing import Closing

_LEASE_MS = 10_000  # ms; a dead process is noticed by its socket at once, and a busy one must not count as dead
_RETRY_S = 0.05  # s between two looks for a base that is not there yet
_REPEAT_S = (0.1, 2.0)  # s after which a message is repeated: before the first answer, and later
_HEADER = struct.Struct("<IB")  # number of the message, and of an answer its kind
_ANSWER, _REFUSAL = 0, 1
_PREFIX = f"{PREFIX}/lockstep"


class LockstepClient(Closing):
    """The agent's side. Raises LinkError if no base appears in time."""

    def __init__(self, endpoint: str, agent: int, *, connect_timeout_s: float = 20.0) -> None:
        self._endpoint = endpoint
        self._agent = agent
        self._number = 0
        self._answered_once = False
        self._base_alive = threading.Event()
        self._events: queue.SimpleQueue[tuple[str, int, bytes]] = queue.SimpleQueue()
        self._session = open_session(endpoint, "client", lease_ms=_LEASE_MS, connect_timeout_s=connect_timeout_s)
        try:
            session_id = self._session.zid()
            down, up = f"{_PREFIX}/down/{agent}/{session_id}", f"{_PREFIX}/up/{agent}/{session_id}"
            self._subscriber = self._session.declare_subscriber(down, direct(self._on_answer))
            self._publisher = _publisher(self._session, up)
            liveliness = self._session.liveliness()
            self._token = liveliness.declare_token(f"{_PREFIX}/agent/{agent}/{session_id}")
            self._watch = liveliness.declare_subscriber(f"{_PREFIX}/base", direct(self._on_base), history=True)
        except zenoh.ZError as error:
            close_session(self._session)
            raise LinkError(f"the link to {endpoint} broke while it was set up ({reason_of(error)})") from error

    def _on_base(self, sample: Any) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            self._base_alive.set()
        else:
            self._base_alive.clear()
            self._events.put(("gone", 0, b""))

    def _on_answer(self, sample: Any) -> None:
        raw = sample.payload.to_bytes()
        if len(raw) >= _HEADER.size:
            number, kind = _HEADER.unpack_from(raw)
            self._events.put(("refused" if kind == _REFUSAL else "answer", number, raw[_HEADER.size :]))

    def exchange(self, message: bytes, timeout_s: float) -> bytes:
        """Send this tick's message and wait for the base's answer.

        Raises LinkError if the base ends, refuses or does not answer in time.
        """
        deadline_s = time.monotonic() + timeout_s
        self._number += 1
        repeat_s = 0.0  # when the message is due to be sent
        while (left_s := deadline_s - time.monotonic()) > 0.0:
            if time.monotonic() >= repeat_s:
                if self._answered_once and not self._base_alive.is_set():
                    raise LinkError(self._lost_base_text())
                if not self._base_alive.wait(min(left_s, _RETRY_S)):
                    continue
                try:
                    self._publisher.put(_HEADER.pack(self._number, _ANSWER) + message)
                except zenoh.ZError as error:
                    raise LinkError(
                        f"the link to the base station at {self._endpoint} broke: {reason_of(error)}"
                    ) from error
                repeat_s = time.monotonic() + _REPEAT_S[self._answered_once]
            try:
                wait_s = min(deadline_s, repeat_s) - time.monotonic()
                kind, number, body = self._events.get(timeout=max(wait_s, 0.0))
            except queue.Empty:
                continue
            if kind == "gone" and not self._base_alive.is_set():
                raise LinkError(self._lost_base_text())
            if number != self._number:
                continue
            if kind == "answer":
                self._answered_once = True
                return body
            if kind == "refused":
                raise LinkError(f"the base station at {self._endpoint} refused: {body.decode(errors='replace')}")
        raise LinkError(
            f"the base station at {self._endpoint} did not answer message {self._number} of agent {self._agent} within "
            f"{timeout_s:g} s"
        )

    def _lost_base_text(self) -> str:
        return (
            f"the base station at {self._endpoint} ended, or the link to it broke, before it answered message "
            f"{self._number} of agent {self._agent}"
        )

    def close(self) -> None:
        """Disconnect, within 2 s whatever the base does."""
        close_session(self._session)


@dataclass(slots=True)
class _Message:
    session: str
    number: int
    body: bytes
    collected: bool = False


class LockstepServer(Closing):
    """The base's side. Raises LinkError if it cannot listen."""

    def __init__(self, endpoint: str) -> None:
        self._endpoint = endpoint
        self._changed = threading.Condition()
        self._alive: dict[int, set[str]] = {}
        self._lost: set[int] = set()
        self._open: dict[int, _Message] = {}
        self._answered: dict[int, tuple[str, int, bytes]] = {}
        self._publishers: dict[int, tuple[str, zenoh.Publisher]] = {}  # and the session that each sends to
        self._sending = threading.Lock()
        self.callback_errors = 0
        self._session = open_session(endpoint, "base", lease_ms=_LEASE_MS)
        try:
            liveliness = self._session.liveliness()
            self._watch = liveliness.declare_subscriber(f"{_PREFIX}/agent/*/*", direct(self._on_agent), history=True)
            self._subscriber = self._session.declare_subscriber(f"{_PREFIX}/up/*/*", direct(self._on_message))
            self._token = liveliness.declare_token(f"{_PREFIX}/base")
        except zenoh.ZError as error:
            close_session(self._session)
            raise LinkError(f"cannot set up the lock-step barrier on {endpoint}: {reason_of(error)}") from error

    def _on_agent(self, sample: Any) -> None:
        try:
            agent, session = _parse_key(sample.key_expr)
            with self._changed:
                sessions = self._alive.setdefault(agent, set())
                if sample.kind == zenoh.SampleKind.PUT:
                    sessions.add(session)
                    self._lost.discard(agent)
                else:
                    sessions.discard(session)
                    if not sessions:
                        self._lost.add(agent)
                        self._open.pop(agent, None)
                self._changed.notify_all()
        except Exception:
            self.callback_errors += 1

    def _on_message(self, sample: Any) -> None:
        try:
            agent, session = _parse_key(sample.key_expr)
            raw = sample.payload.to_bytes()
            if len(raw) < _HEADER.size:
                return
            number = _HEADER.unpack_from(raw)[0]
            answer: bytes | None = None
            with self._changed:
                others = self._alive.get(agent, set()) - {session}
                answered = self._answered.get(agent)
                before = self._open.get(agent)
                if others:
                    text = f"agent number {agent} is flown by another process; give each agent its own --agent"
                    answer = _HEADER.pack(number, _REFUSAL) + text.encode()
                elif answered is not None and answered[:2] == (session, number):
                    answer = _HEADER.pack(number, _ANSWER) + answered[2]
                elif before is None or (before.session, before.number) != (session, number):
                    self._open[agent] = _Message(session, number, raw[_HEADER.size :])
                    self._lost.discard(agent)
                    self._changed.notify_all()
            if answer is not None:
                self._send(agent, session, answer)
        except Exception:
            self.callback_errors += 1

    def _send(self, agent: int, session: str, message: bytes) -> None:
        """Send to an agent's process, also from Zenoh's own thread."""
        with self._sending:
            kept = self._publishers.get(agent)
            if kept is None or kept[0] != session:
                key = f"{_PREFIX}/down/{agent}/{session}"
                kept = self._publishers[agent] = session, _publisher(self._session, key)
            kept[1].put(message)

    def collect(self, expected: set[int], timeout_s: float) -> dict[int, bytes]:
        """Wait for a new message of every expected agent; the messages by agent, in order of agent.

        Raises LinkError if one of them ends or stays silent.
        """
        deadline_s = time.monotonic() + timeout_s
        with self._changed:
            while True:
                ready = {agent for agent, opened in self._open.items() if not opened.collected}
                if expected <= ready:
                    for agent in expected:
                        self._open[agent].collected = True
                    return {agent: self._open[agent].body for agent in sorted(expected)}
                lost = sorted(expected & self._lost)
                if lost:
                    raise LinkError(f"agent {_names(lost)} ended, or the link broke, in the middle of a flight")
                left_s = deadline_s - time.monotonic()
                if left_s <= 0.0:
                    missing = _names(sorted(expected - ready))
                    raise LinkError(f"no message from agent {missing} within {timeout_s:g} s on {self._endpoint}")
                self._changed.wait(left_s)

    def answer(self, agent: int, message: bytes) -> None:
        """Answer the collected message of an agent. Raises LinkError if there is none, or the agent has ended."""
        with self._changed:
            opened = self._open.get(agent)
            if opened is None or not opened.collected:
                why = "has ended" if agent in self._lost else "has no collected message to answer"
                raise LinkError(f"agent {agent} {why}")
            del self._open[agent]
            self._answered[agent] = (opened.session, opened.number, message)
        try:
            self._send(agent, opened.session, _HEADER.pack(opened.number, _ANSWER) + message)
        except zenoh.ZError as error:
            raise LinkError(f"the answer to agent {agent} could not be sent: {reason_of(error)}") from error

    def lost(self) -> set[int]:
        """Agents that have appeared and ended."""
        with self._changed:
            return set(self._lost)

    def close(self) -> None:
        """Stop listening, within 2 s whatever the agents do."""
        close_session(self._session)


def _parse_key(key: Any) -> tuple[int, str]:
    """Agent number and session id at the end of a key."""
    parts = str(key).split("/")
    return int(parts[-2]), parts[-1]


def _publisher(session: zenoh.Session, key: str) -> zenoh.Publisher:
    return session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK, express=True)


def _names(agents: list[int]) -> str:
    return ", ".join(str(agent) for agent in agents)
