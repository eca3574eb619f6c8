"""The barrier of a lock-step flight over Zenoh queries: each agent sends one message a tick and waits for the answer.

Reliable and ordered. The agent's query carries its message; the base collects the queries of all agents and replies to
each. Queries are numbered, so that a repeated one gets the same reply. Liveliness tokens tell each side at once when
the other's process ends.
"""

from __future__ import annotations

import contextlib
import queue
import struct
import threading
import time
from dataclasses import dataclass
from typing import Any

import zenoh

from kiteline_hw.links.zenoh_session import close_session, direct, open_session
from kiteline_hw.ports import LinkError
from kiteline_hw.system.closing import Closing

_LEASE_MS = 10_000  # ms; a dead process is noticed by its socket at once, and a busy one must not count as dead
_RETRY_S = 0.05  # s between two queries while the base is not there yet
_HEADER = struct.Struct("<I")  # number of the query


def _prefix(group: str) -> str:
    return f"kiteline/1/{group}/lockstep"


class LockstepClient(Closing):
    """The agent's side. Raises LinkError if no base appears in time."""

    def __init__(self, endpoint: str, agent: int, *, group: str = "default", connect_timeout_s: float = 20.0) -> None:
        self._endpoint = endpoint
        self._agent = agent
        self._number = 0
        self._answered_once = False
        self._base_alive = threading.Event()
        self._events: queue.SimpleQueue[tuple[str, int, bytes]] = queue.SimpleQueue()
        self._session = open_session(endpoint, "client", lease_ms=_LEASE_MS, connect_timeout_s=connect_timeout_s)
        try:
            prefix = _prefix(group)
            session_id = self._session.zid()
            self._key = f"{prefix}/tick/{agent}/{session_id}"
            liveliness = self._session.liveliness()
            self._token = liveliness.declare_token(f"{prefix}/agent/{agent}/{session_id}")
            self._watch = liveliness.declare_subscriber(f"{prefix}/base", direct(self._on_base), history=True)
        except zenoh.ZError as error:
            close_session(self._session)
            raise LinkError(f"the link to {endpoint} broke while it was set up ({error})") from error

    def _on_base(self, sample: Any) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            self._base_alive.set()
        else:
            self._base_alive.clear()
            self._events.put(("gone", 0, b""))

    def _query(self, number: int, message: bytes, timeout_s: float) -> None:
        def on_reply(reply: Any) -> None:
            if reply.ok is not None:
                self._events.put(("answer", number, reply.ok.payload.to_bytes()))
            elif reply.err is not None:
                self._events.put(("refused", number, reply.err.payload.to_bytes()))

        self._session.get(
            self._key,
            direct(on_reply, lambda: self._events.put(("end", number, b""))),
            payload=_HEADER.pack(number) + message,
            timeout=timeout_s + 1.0,
            target=zenoh.QueryTarget.BEST_MATCHING,
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=zenoh.CongestionControl.BLOCK,
            express=True,
        )

    def exchange(self, message: bytes, timeout_s: float) -> bytes:
        """Send this tick's message and wait for the base's answer.

        Raises LinkError if the base ends, refuses or does not answer in time.
        """
        deadline_s = time.monotonic() + timeout_s
        self._number += 1
        waiting = False
        while (left_s := deadline_s - time.monotonic()) > 0.0:
            if not waiting:
                if self._answered_once and not self._base_alive.is_set():
                    raise LinkError(self._lost_base_text())
                if not self._base_alive.wait(min(left_s, _RETRY_S)):
                    continue
                try:
                    self._query(self._number, message, left_s)
                except zenoh.ZError as error:
                    raise LinkError(f"the link to the base station at {self._endpoint} broke: {error}") from error
                waiting = True
            try:
                kind, number, body = self._events.get(timeout=left_s)
            except queue.Empty:
                break
            if kind == "gone" and not self._base_alive.is_set():
                raise LinkError(self._lost_base_text())
            if number != self._number:
                continue
            if kind == "answer":
                self._answered_once = True
                return body
            if kind == "refused":
                raise LinkError(f"the base station at {self._endpoint} refused: {body.decode(errors='replace')}")
            if kind == "end":  # nobody received the query: the base is starting or ending
                waiting = False
                time.sleep(min(_RETRY_S, max(0.0, deadline_s - time.monotonic())))
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
class _Query:
    session: str
    number: int
    message: bytes
    query: Any
    collected: bool = False


class LockstepServer(Closing):
    """The base's side. Raises LinkError if it cannot listen."""

    def __init__(self, endpoint: str, *, group: str = "default") -> None:
        self._endpoint = endpoint
        self._changed = threading.Condition()
        self._alive: dict[int, set[str]] = {}
        self._lost: set[int] = set()
        self._open: dict[int, _Query] = {}
        self._answered: dict[int, tuple[str, int, bytes]] = {}
        self.callback_errors = 0
        self._session = open_session(endpoint, "base", lease_ms=_LEASE_MS)
        try:
            prefix = _prefix(group)
            liveliness = self._session.liveliness()
            self._watch = liveliness.declare_subscriber(f"{prefix}/agent/*/*", direct(self._on_agent), history=True)
            self._queryable = self._session.declare_queryable(
                f"{prefix}/tick/*/*", direct(self._on_query), complete=True
            )
            self._token = liveliness.declare_token(f"{prefix}/base")
        except zenoh.ZError as error:
            close_session(self._session)
            raise LinkError(f"cannot set up the lock-step barrier on {endpoint}: {error}") from error

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

    def _on_query(self, query: Any) -> None:
        try:
            agent, session = _parse_key(query.key_expr)
            raw = query.payload.to_bytes() if query.payload is not None else b""
            if len(raw) < _HEADER.size:
                _refuse(query, "an empty question")
                return
            (number,) = _HEADER.unpack_from(raw)
            with self._changed:
                others = self._alive.get(agent, set()) - {session}
                answered = self._answered.get(agent)
                if others:
                    _refuse(query, f"agent number {agent} is flown by another process; give each agent its own --agent")
                elif answered is not None and answered[:2] == (session, number):
                    _reply(query, answered[2])
                else:
                    before = self._open.get(agent)
                    repeated = before is not None and (before.session, before.number) == (session, number)
                    collected = before is not None and repeated and before.collected
                    self._open[agent] = _Query(session, number, raw[_HEADER.size :], query, collected)
                    self._lost.discard(agent)
                    self._changed.notify_all()
        except Exception:
            self.callback_errors += 1

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
                    return {agent: self._open[agent].message for agent in sorted(expected)}
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
            _reply(opened.query, message)
        except zenoh.ZError as error:
            raise LinkError(f"the answer to agent {agent} could not be sent: {error}") from error

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


def _reply(query: Any, message: bytes) -> None:
    with query:
        query.reply(query.key_expr, message, express=True)


def _refuse(query: Any, reason: str) -> None:
    with contextlib.suppress(zenoh.ZError), query:
        query.reply_err(reason.encode())


def _names(agents: list[int]) -> str:
    return ", ".join(str(agent) for agent in agents)
