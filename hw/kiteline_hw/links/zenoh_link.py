"""Packets over Zenoh: the drone is a client, the base a peer that listens.

Keys: kiteline/1/GROUP/AGENT/up and /down carry packets, /alive an agent's liveliness, kiteline/1/GROUP/base the base's.
A put may stall its caller on a frozen peer, so packets go through a bounded outbox to a thread of their own, and are
dropped rather than waited for.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any, Self

import zenoh

from kiteline_hw.links.packet_lane import LinkCounters, PacketLane
from kiteline_hw.links.zenoh_session import close_session, direct, open_session
from kiteline_hw.ports import ByteLink, LinkError

_MAX_AGENT = 63  # agent numbers have six bits
_NEW_AGENT_S = 0.05  # s in which the hub's sender learns of a new agent
# s in which a base answers. Over UDP, Zenoh's own declarations may get lost for good: then the session is opened anew,
# with twice the patience each time, for the link may just be slow.
_DEAF_S = 3.0
_LONGEST_DEAF_S = 24.0
_JOIN_S = 0.3  # s for the sender thread to notice the end; it is a daemon and never keeps the process


def _prefix(group: str) -> str:
    if not group or any(c in group for c in "/*$#? "):
        raise LinkError(f"group name {group!r} must be one word without any of / * $ # ?")
    return f"kiteline/1/{group}"


def _publisher(session: zenoh.Session, key: str) -> zenoh.Publisher:
    return session.declare_publisher(
        key, congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.REAL_TIME, express=True
    )


def _guarded(counters: LinkCounters, callback: Callable[[Any], None]) -> Any:
    """Zenoh prints and swallows what a callback raises: count it instead."""

    def call(sample: Any) -> None:
        try:
            callback(sample)
        except Exception:
            counters.callback_errors += 1

    return direct(call)


class ZenohLink:
    """A drone's ByteLink. Connects and connects again in the background; the constructor does not wait for a base."""

    def __init__(self, endpoint: str, agent: int, *, group: str = "default") -> None:
        if not 0 <= agent <= _MAX_AGENT:
            raise LinkError(f"agent number {agent}: expected 0 to {_MAX_AGENT}")
        self._endpoint = endpoint
        self._prefix = _prefix(group)
        self._agent = agent
        self._wake = threading.Condition()
        self._lane = PacketLane(self._wake)
        self._closed = threading.Event()
        self._base_alive = False
        self._deaf_s = _DEAF_S
        self._session: zenoh.Session | None = None
        self._session_lock = threading.Lock()
        self._keep: list[Any] = []
        self._thread = threading.Thread(target=self._run, name="zenoh-send", daemon=True)
        self._thread.start()

    @property
    def counters(self) -> LinkCounters:
        """What passed and what was lost."""
        return self._lane.counters

    @property
    def connected(self) -> bool:
        """Whether a base is known to listen."""
        return self._base_alive

    def send(self, packet: bytes) -> bool:
        """Queue one packet; False when no base listens or the outbox is full. Never blocks."""
        if not self._base_alive or self._closed.is_set():
            self._lane.counters.refused_packets += 1
            return False
        return self._lane.offer(packet)

    def receive(self) -> list[bytes]:
        """All packets that came in since the last call. Never blocks."""
        return self._lane.take()

    def _run(self) -> None:
        while not self._closed.is_set():
            session: zenoh.Session | None = None
            with contextlib.suppress(LinkError):
                session = open_session(self._endpoint, "client", connect_timeout_s=0.0, give_up=self._closed)
            if session is None:
                self._closed.wait(0.2)
                continue
            with self._session_lock:
                self._session = session
            try:
                if not self._closed.is_set():
                    self._serve(self._declare(session))
            except zenoh.ZError:
                self._lane.counters.callback_errors += 1
                self._closed.wait(0.2)
            close_session(session)

    def _serve(self, publisher: zenoh.Publisher) -> None:
        """Send what is queued until the end, or until nothing has come from a base that is said to listen."""
        heard, heard_s = self._lane.counters.received_packets, time.monotonic()
        while not self._closed.is_set():
            with self._wake:
                if not self._lane.pending():
                    self._wake.wait(self._deaf_s)
                packet = self._lane.next_out()
            now_s = time.monotonic()
            received = self._lane.counters.received_packets
            if received != heard or not self._base_alive:
                self._deaf_s = _DEAF_S if received != heard else self._deaf_s
                heard, heard_s = received, now_s
            if packet is None or self._closed.is_set():
                continue
            if now_s - heard_s > self._deaf_s:
                self._deaf_s = min(2.0 * self._deaf_s, _LONGEST_DEAF_S)
                self._base_alive = False
                self._lane.drop_out()
                return
            try:
                publisher.put(packet)
                self._lane.count_sent(packet)
            except zenoh.ZError:
                self._lane.counters.failed_packets += 1

    def _declare(self, session: zenoh.Session) -> zenoh.Publisher:
        base = f"{self._prefix}/{self._agent}"
        counters = self._lane.counters
        self._keep = [
            session.declare_subscriber(
                f"{base}/down", _guarded(counters, lambda sample: self._lane.deliver(sample.payload.to_bytes()))
            ),
            session.liveliness().declare_token(f"{base}/alive"),
            session.liveliness().declare_subscriber(
                f"{self._prefix}/base", _guarded(counters, self._on_base), history=True
            ),
        ]
        return _publisher(session, f"{base}/up")

    def _on_base(self, sample: Any) -> None:
        alive = sample.kind == zenoh.SampleKind.PUT
        if alive and not self._base_alive:
            self._lane.counters.reconnects += 1
        self._base_alive = alive
        if not alive:
            self._lane.drop_out()

    def close(self) -> None:
        """Leave, within 2 s whatever the base does. May be called twice."""
        self._closed.set()
        with self._wake:
            self._wake.notify_all()
        self._thread.join(_JOIN_S)
        with self._session_lock:
            session = self._session
        if session is not None:
            close_session(session)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class _AgentLink:
    """The hub's ByteLink to one agent."""

    def __init__(self, lane: PacketLane, publisher: zenoh.Publisher) -> None:
        self.lane = lane
        self.publisher = publisher
        self.alive = False

    @property
    def counters(self) -> LinkCounters:
        """What passed and what was lost."""
        return self.lane.counters

    def send(self, packet: bytes) -> bool:
        """Queue one packet; False when the agent is away or the outbox is full. Never blocks."""
        if not self.alive:
            self.lane.counters.refused_packets += 1
            return False
        return self.lane.offer(packet)

    def receive(self) -> list[bytes]:
        """All packets that came in since the last call. Never blocks."""
        return self.lane.take()

    def close(self) -> None:
        """Stop sending to this agent; the hub stays."""
        self.alive = False


class ZenohHub:
    """The base's end: one ByteLink per agent, made as agents appear. Raises LinkError when it cannot listen."""

    def __init__(self, endpoint: str, *, group: str = "default") -> None:
        prefix = _prefix(group)
        self._prefix = prefix
        self._wake = threading.Condition()
        self._lock = threading.Lock()
        self._links: dict[int, _AgentLink] = {}
        self._closed = threading.Event()
        self.counters = LinkCounters()
        self.session = self._session = open_session(endpoint, "base")
        try:
            liveliness = self._session.liveliness()
            self._keep: list[Any] = [
                self._session.declare_subscriber(f"{prefix}/*/up", _guarded(self.counters, self._on_packet)),
                liveliness.declare_subscriber(
                    f"{prefix}/*/alive", _guarded(self.counters, self._on_agent), history=True
                ),
                liveliness.declare_token(f"{prefix}/base"),
            ]
        except zenoh.ZError as error:
            close_session(self._session)
            raise LinkError(f"cannot set up the hub on {endpoint}: {error}") from error
        self._thread = threading.Thread(target=self._run, name="zenoh-send", daemon=True)
        self._thread.start()

    def _link(self, key: Any) -> _AgentLink:
        agent = int(str(key).split("/")[-2])
        if not 0 <= agent <= _MAX_AGENT:
            raise LinkError(f"agent number {agent}: expected 0 to {_MAX_AGENT}")
        with self._lock:
            link = self._links.get(agent)
            if link is None:
                publisher = _publisher(self._session, f"{self._prefix}/{agent}/down")
                link = self._links[agent] = _AgentLink(PacketLane(self._wake), publisher)
            return link

    def _on_packet(self, sample: Any) -> None:
        link = self._link(sample.key_expr)
        link.alive = True
        link.lane.deliver(sample.payload.to_bytes())

    def _on_agent(self, sample: Any) -> None:
        link = self._link(sample.key_expr)
        alive = sample.kind == zenoh.SampleKind.PUT
        if alive and not link.alive:
            link.counters.reconnects += 1
        link.alive = alive
        if not alive:
            link.lane.drop_out()

    def _run(self) -> None:
        while not self._closed.is_set():
            with self._lock:
                links = tuple(self._links.values())
            with self._wake:
                if not any(link.lane.pending() for link in links):
                    self._wake.wait(_NEW_AGENT_S)
                work = [(link, link.lane.next_out()) for link in links]
            for link, packet in work:
                if packet is None or self._closed.is_set():
                    continue
                try:
                    link.publisher.put(packet)
                    link.lane.count_sent(packet)
                except zenoh.ZError:
                    link.counters.failed_packets += 1

    def links(self) -> Mapping[int, ByteLink]:
        """The links of all agents that have appeared so far, by agent number."""
        with self._lock:
            return dict(sorted(self._links.items()))

    def alive(self) -> frozenset[int]:
        """The agents whose process is reachable now."""
        with self._lock:
            return frozenset(agent for agent, link in self._links.items() if link.alive)

    def close(self) -> None:
        """Stop listening, within 2 s whatever the agents do. May be called twice."""
        self._closed.set()
        with self._wake:
            self._wake.notify_all()
        self._thread.join(_JOIN_S)
        close_session(self._session)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
