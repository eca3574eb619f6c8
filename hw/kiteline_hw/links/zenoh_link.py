"""Packets over Zenoh: the drone is a client, the base a peer that listens.

Keys below PREFIX: AGENT/up and AGENT/down carry packets, AGENT/alive an agent's liveliness, base the base's.
A Zenoh put may block on a frozen peer, so packets go through a bounded outbox to a thread of their own and are dropped
rather than waited for.
"""

import contextlib
import secrets
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import zenoh

from kiteline_core.ids import MAX_AGENTS
from kiteline_hw.links.ends import LinkOptions
from kiteline_hw.links.queued_link import INBOX_BYTES, MOST_PACKET_BYTES, LinkCounters, QueuedLink
from kiteline_hw.links.zenoh_access import PREFIX, Instances, access_of_base
from kiteline_hw.links.zenoh_session import (
    check_endpoint,
    close_session,
    direct,
    no_stop_at_exit,
    open_session,
    reason_of,
    stop_at_exit,
)
from kiteline_hw.ports import ByteLink, LinkError
from kiteline_hw.system.closing import Closing

_MAX_AGENT = MAX_AGENTS - 1
_NEW_AGENT_S = 0.05  # s until the hub's sender thread notices a new agent
# s within which a live base must have answered. Over UDP, Zenoh's own declarations may be lost for good, those that say
# that there is a base, too: then the session is opened anew. The limit doubles each time: the link may just be slow.
_SILENCE_S = 3.0
_LONGEST_SILENCE_S = 24.0
_INBOXES_BYTES = 8 << 20  # memory for the packets of all agents: strangers may fill the inboxes of 256
_JOIN_S = 0.3  # s for the sender thread to notice the end; it is a daemon and never keeps the process alive
_EXIT_JOIN_S = 2.0  # s for the same at the end of the process, on a busy machine


def _checked_agent(agent: int) -> int:
    if not 0 <= agent <= _MAX_AGENT:
        raise LinkError(f"agent number {agent}: expected 0 to {_MAX_AGENT}")
    return agent


def _publisher(session: zenoh.Session, key: str) -> zenoh.Publisher:
    return session.declare_publisher(
        key, congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.REAL_TIME, express=True
    )


def _guarded(counters: LinkCounters, callback: Callable[[Any], None]) -> Any:
    """A handler that counts what its callback raises; Zenoh would print and swallow it."""

    def call(sample: Any) -> None:
        try:
            callback(sample)
        except Exception:
            counters.callback_errors += 1

    return direct(call)


def _put(link: QueuedLink, publisher: zenoh.Publisher, packet: bytes) -> None:
    try:
        publisher.put(packet)
        link.count_sent(packet)
    except zenoh.ZError:
        link.counters.failed_packets += 1


def _end(thread: threading.Thread, closed: threading.Event, wake: threading.Condition, within_s: float) -> None:
    """Tell a sender thread that its link is closed, and wait for its end."""
    closed.set()
    with wake:
        wake.notify_all()
    thread.join(within_s)


class _PeerLink(QueuedLink):
    """A link whose peer announces itself by a liveliness token."""

    alive = False

    @property
    def connected(self) -> bool:
        """True if the peer is known to be there."""
        return self.alive

    def on_liveliness(self, sample: Any) -> None:
        """Note that the peer came or went."""
        alive = sample.kind == zenoh.SampleKind.PUT
        if alive and not self.alive:
            self.counters.reconnects += 1
        self.alive = alive
        if not alive:
            self.clear_outbox()


def _note_instance(instances: Instances, sample: Any) -> None:
    """Note an agent's token of its own."""
    instances.note(str(sample.key_expr).rsplit("/", 1)[-1], here=sample.kind == zenoh.SampleKind.PUT)


class ZenohLink(_PeerLink):
    """A drone's ByteLink. Connects and reconnects in the background; the constructor does not wait for a base."""

    def __init__(self, endpoint: str, agent: int, *, logins: Mapping[str, str] | None = None) -> None:
        """logins: user and password, for a base that asks for them."""
        super().__init__()
        self._logins, self._by_login = logins, False
        self._agent = _checked_agent(agent)
        self._endpoint = endpoint
        self._closed = threading.Event()
        self._silence_s = _SILENCE_S
        self._loses = endpoint.removeprefix("router/").startswith("udp/")  # declarations, too
        self._session: zenoh.Session | None = None
        self._session_lock = threading.Lock()
        self._declared: list[Any] = []  # Zenoh withdraws a declaration whose object is garbage collected
        self._instance = secrets.token_hex(8)
        self._instances = Instances()
        self._thread = threading.Thread(target=self._run, name="zenoh-send", daemon=True)
        self._thread.start()
        stop_at_exit(self, partial(_end, self._thread, self._closed, self._wake, _EXIT_JOIN_S))

    @property
    def connected(self) -> bool:
        """True if a base is known to listen."""
        return self.alive and not self._closed.is_set()

    @property
    def doubled(self) -> bool:
        """True if another agent has the same number."""
        return self._instances.several

    def _run(self) -> None:
        while not self._closed.is_set():
            session: zenoh.Session | None = None
            with contextlib.suppress(LinkError):
                session = open_session(
                    self._endpoint, "client", connect_timeout_s=0.0, give_up=self._closed,
                    logins=self._logins if self._by_login else None,
                )  # fmt: skip
            if session is None:
                self._by_login = bool(self._logins) and not self._by_login  # bases take the one or the other
                self._closed.wait(0.2)
                continue
            with self._session_lock:
                self._session = session
            try:
                if not self._closed.is_set():
                    self._serve(self._declare(session))
            except zenoh.ZError:
                self.counters.callback_errors += 1
                self._closed.wait(0.2)
            close_session(session)
            self.alive = False  # a last packet may have come in meanwhile

    def _serve(self, publisher: zenoh.Publisher) -> None:
        """Send queued packets until the link is closed, or a base that is alive stays silent.

        Over UDP also until no base has been heard of for as long: what says that there is one may have been lost.
        """
        received_before, last_received_s = self.counters.received_packets, time.monotonic()
        while not self._closed.is_set():
            with self._wake:
                if not self.pending():
                    self._wake.wait(self._silence_s)
                packet = self.next_packet()
            now_s = time.monotonic()
            received = self.counters.received_packets
            if received != received_before:
                self._silence_s = _SILENCE_S
            if received != received_before or not (self.alive or self._loses):
                received_before, last_received_s = received, now_s
            if self._closed.is_set() or (packet is None and self.alive):
                continue
            if now_s - last_received_s >= self._silence_s:
                self._silence_s = min(2.0 * self._silence_s, _LONGEST_SILENCE_S)
                self.alive = False
                self.clear_outbox()
                return
            if packet is not None:
                _put(self, publisher, packet)

    def _declare(self, session: zenoh.Session) -> zenoh.Publisher:
        key = f"{PREFIX}/{self._agent}"
        on_packet = _guarded(self.counters, self._on_packet)
        on_base = _guarded(self.counters, self.on_liveliness)
        self._declared = [
            session.declare_subscriber(f"{key}/down", on_packet),
            session.liveliness().declare_token(f"{key}/alive"),
            session.liveliness().declare_token(f"{key}/alive/{self._instance}"),
            session.liveliness().declare_subscriber(
                f"{key}/alive/*", _guarded(self.counters, partial(_note_instance, self._instances)), history=True
            ),
            session.liveliness().declare_subscriber(f"{PREFIX}/base", on_base, history=True),
        ]
        return _publisher(session, f"{key}/up")

    def _on_packet(self, sample: Any) -> None:
        self.alive = True  # also where what announces the base was lost
        self.deliver(sample.payload.to_bytes())

    def close(self) -> None:
        """Leave, within 2 s whatever the base does. May be called twice."""
        _end(self._thread, self._closed, self._wake, _JOIN_S)
        no_stop_at_exit(self)
        with self._session_lock:
            session = self._session
        if session is not None:
            close_session(session)


class _AgentLink(_PeerLink):
    """The hub's ByteLink to one agent."""

    def __init__(self, wake: threading.Condition, publisher: zenoh.Publisher) -> None:
        super().__init__(wake)
        self.publisher = publisher
        self.instances = Instances()

    def close(self) -> None:
        """Stop sending to this agent; the hub stays open."""
        self.alive = False


class ZenohHub(Closing):
    """The base's end: one ByteLink per agent, made when the agent appears. Raises LinkError if it cannot listen."""

    def __init__(self, endpoint: str, *, logins: Mapping[str, str] | None = None) -> None:
        """logins: users and passwords without which nobody connects; None: anyone may."""
        self._wake = threading.Condition()
        self._lock = threading.Lock()
        self._links: dict[int, _AgentLink] = {}
        self._closed = threading.Event()
        self.counters = LinkCounters()
        self.session = open_session(endpoint, "base", access=access_of_base(), logins=logins)
        on_packet, on_agent = _guarded(self.counters, self._on_packet), _guarded(self.counters, self._on_agent)
        try:
            liveliness = self.session.liveliness()
            self._declared: list[Any] = [
                self.session.declare_subscriber(f"{PREFIX}/*/up", on_packet),
                liveliness.declare_subscriber(f"{PREFIX}/*/alive", on_agent, history=True),
                liveliness.declare_subscriber(
                    f"{PREFIX}/*/alive/*", _guarded(self.counters, self._on_instance), history=True
                ),
                liveliness.declare_token(f"{PREFIX}/base"),
            ]
        except zenoh.ZError as error:
            close_session(self.session)
            raise LinkError(f"cannot set up the hub on {endpoint}: {reason_of(error)}") from error
        self._thread = threading.Thread(target=self._run, name="zenoh-send", daemon=True)
        self._thread.start()
        stop_at_exit(self, partial(_end, self._thread, self._closed, self._wake, _EXIT_JOIN_S))

    def _link(self, key: Any) -> _AgentLink:
        agent = _checked_agent(int(str(key).split("/")[-2]))
        with self._lock:
            link = self._links.get(agent)
            if link is None:
                publisher = _publisher(self.session, f"{PREFIX}/{agent}/down")
                link = self._links[agent] = _AgentLink(self._wake, publisher)
                for each in self._links.values():
                    each.inbox_limit = min(INBOX_BYTES, _INBOXES_BYTES // len(self._links))
            return link

    def _on_packet(self, sample: Any) -> None:
        if len(sample.payload) > MOST_PACKET_BYTES:
            self.counters.overrun_packets += 1
            return
        link = self._link(sample.key_expr)
        link.alive = True
        link.deliver(sample.payload.to_bytes())

    def _on_instance(self, sample: Any) -> None:
        key = str(sample.key_expr)
        _note_instance(self._link(key.rsplit("/", 1)[0]).instances, sample)

    def doubles(self) -> frozenset[int]:
        """Numbers that two agents or more have."""
        with self._lock:
            return frozenset(agent for agent, link in self._links.items() if link.instances.several)

    def _on_agent(self, sample: Any) -> None:
        self._link(sample.key_expr).on_liveliness(sample)

    def _run(self) -> None:
        while not self._closed.is_set():
            with self._lock:
                links = tuple(self._links.values())
            with self._wake:
                if not any(link.pending() for link in links):
                    self._wake.wait(_NEW_AGENT_S)
                work = [(link, link.next_packet()) for link in links]
            for link, packet in work:
                if packet is not None and not self._closed.is_set():
                    _put(link, link.publisher, packet)

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
        _end(self._thread, self._closed, self._wake, _JOIN_S)
        no_stop_at_exit(self)
        close_session(self.session)


def check_address(address: str) -> None:
    """Raise LinkError for an endpoint without protocol or port."""
    check_endpoint(address)


def open_agent_end(address: str, options: LinkOptions) -> ZenohLink:
    """Connect to the base at an endpoint, in the background. Raises LinkError for one that is none."""
    check_endpoint(address)
    return ZenohLink(address, options.agent, logins=options.logins)


def open_base_end(address: str, options: LinkOptions) -> ZenohHub:
    """Listen on an endpoint. Raises LinkError."""
    check_endpoint(address)
    return ZenohHub(address, logins=options.logins)
