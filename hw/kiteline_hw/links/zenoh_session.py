"""Zenoh sessions that never hang a process: client (drone) or listening peer (base), no discovery.

A process that ends while a session is open hangs for ever if a callback has a Python thread of its own. Therefore
callbacks are `direct`, and every session opened here is closed at the latest when the main thread ends. The interpreter
waits for that: a thread that is inside Zenoh while Python ends makes the process abort.
"""

import contextlib
import json
import os
import re
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, Literal

import zenoh

from kiteline_hw.ports import LinkError

_MAX_SESSIONS = 96  # where anyone may connect: each takes memory. Agents, and programs that ask for maps
_MAX_PAIRED_SESSIONS = 288  # where only the paired may: 256 agents, and those programs
_MOST_MESSAGE_BYTES = 1 << 18  # that a base takes in: four of the longest packets
CLOSE_TIMEOUT_S = 1.5  # s; a frozen peer can stall a close for much longer: then the session is abandoned
_EXIT_TIMEOUT_S = 6.0  # s for sessions that are closed at the end of the process; a busy machine needs seconds
_LEAST_ATTEMPT_MS = 100  # ms of one attempt to connect where hardly any time is left
CONNECT_TIMEOUT_MS = 4000  # ms of one attempt to connect: two round trips with 900 ms of delay each way
_RETRY_S = 0.1  # s between two attempts to connect
_ROUTER = "router/"  # before a locator: a Zenoh router listens there, and both sides connect
_SOURCE_LINE = re.compile(r"\.? at /\S+\.rs:\d+\.?")
_WITHOUT_PORT = re.compile(r"(?P<host>(router/)?(tcp|udp|tls|quic|ws)/(\[[^]]*\]|[^:?#]*)):?(?P<options>([?#].*)?)")
_PROTOCOLS = ("tcp", "udp", "tls", "quic", "ws", "unixsock-stream", "unixpipe", "serial", "vsock")

Role = Literal["client", "base"]


def reason_of(error: zenoh.ZError) -> str:
    """What Zenoh says of an error, without the lines of its own sources."""
    return _SOURCE_LINE.sub("", str(error))


def check_endpoint(endpoint: str) -> None:
    """Raise LinkError for an endpoint without protocol or port, at which Zenoh tries in vain without a word."""
    protocol, slash, address = endpoint.removeprefix(_ROUTER).partition("/")
    if not slash or protocol not in _PROTOCOLS:
        host = address.strip("/") if slash else protocol
        whole = host if host.rpartition(":")[2].isdecimal() else f"{host or 'HOST'}:7447"
        raise LinkError(f"{endpoint!r} is no Zenoh endpoint: write tcp/{whole}")
    found = _WITHOUT_PORT.fullmatch(endpoint)
    if found is not None:
        who = "router" if endpoint.startswith(_ROUTER) else "base"
        whole = f"{found['host']}:7447{found['options']}"
        raise LinkError(f"{endpoint!r} has no port: write {whole}, or the port at which the {who} listens")


def session_config(
    endpoint: str, role: Role, lease_ms: int, access: dict[str, Any] | None = None,
    logins: Mapping[str, str] | None = None, list_of_logins: str = "",
) -> zenoh.Config:  # fmt: skip
    """The configuration of a session. access: what clients may do at a base, whose memory is bounded then, too. logins:
    the user and password of a client; list_of_logins: a file of those without which a base takes no connection.

    Raises LinkError.

    endpoint: a Zenoh locator such as tcp/127.0.0.1:7447 at which the base listens, or router/ and a router's locator.
    The file named by the environment variable ZENOH_CONFIG is read first (certificates, access control).
    """
    try:
        config = zenoh.Config.from_env() if os.environ.get("ZENOH_CONFIG") else zenoh.Config()
    except zenoh.ZError as error:
        raise LinkError(
            f"ZENOH_CONFIG={os.environ['ZENOH_CONFIG']} is no configuration of Zenoh: {reason_of(error)}"
        ) from error
    if endpoint.startswith(_ROUTER):
        endpoint, role = endpoint.removeprefix(_ROUTER), "client"
    options: dict[str, Any] = {
        "mode": "client" if role == "client" else "peer",
        "connect/endpoints": [endpoint] if role == "client" else [],
        "listen/endpoints": [endpoint] if role == "base" else [],
        "connect/timeout_ms": CONNECT_TIMEOUT_MS,
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": lease_ms,
    }
    for user, password in (logins or {}).items() if role == "client" else ():
        options |= {"transport/auth/usrpwd/user": user, "transport/auth/usrpwd/password": password}
    if list_of_logins:
        options["transport/auth/usrpwd/dictionary_file"] = list_of_logins
    if access is not None and role == "base":
        options["transport/link/rx/max_message_size"] = _MOST_MESSAGE_BYTES
        options["transport/unicast/max_sessions"] = _MAX_PAIRED_SESSIONS if list_of_logins else _MAX_SESSIONS
        if config.get_json("access_control/enabled") == "false":  # a ZENOH_CONFIG that has its own is kept
            options["access_control"] = access
    try:
        for name, value in options.items():
            config.insert_json5(name, json.dumps(value))
    except zenoh.ZError as error:
        raise LinkError(f"{endpoint!r} is no Zenoh endpoint ({reason_of(error)}); write tcp/HOST:PORT") from error
    return config


def open_session(
    endpoint: str,
    role: Role,
    *,
    lease_ms: int = 2000,
    access: dict[str, Any] | None = None,
    connect_timeout_s: float = 10.0,
    waited_s: float = 0.0,
    give_up: threading.Event | None = None,
    logins: Mapping[str, str] | None = None,
) -> zenoh.Session:
    """Listen (base) or connect (client, with retries until the timeout or until `give_up` is set). Raises LinkError.

    connect_timeout_s: 0 for a single attempt; waited_s: how much of it is over already.

    logins: user and password of a client, or those without which a base takes no connection. A client that names one is
    refused by a base that asks for none.

    Blocks: never call it in a tracking loop.
    """
    with contextlib.ExitStack() as stack:
        listed = ""
        if logins and role == "base":  # Zenoh reads the file as it opens, and never again
            file = stack.enter_context(tempfile.NamedTemporaryFile("w", prefix="kiteline-", encoding="ascii"))
            file.writelines(f"{user}:{password}\n" for user, password in logins.items())
            file.flush()
            listed = file.name
        config = session_config(endpoint, role, lease_ms, access, logins, listed)
        return _opened(config, endpoint, role, connect_timeout_s, waited_s, give_up)


def _opened(
    config: zenoh.Config, endpoint: str, role: Role, connect_timeout_s: float, waited_s: float,
    give_up: threading.Event | None,
) -> zenoh.Session:  # fmt: skip
    deadline_s = time.monotonic() + connect_timeout_s - waited_s
    while True:
        if connect_timeout_s > 0.0:
            left_ms = max(_LEAST_ATTEMPT_MS, round(1e3 * (deadline_s - time.monotonic())))
            config.insert_json5("connect/timeout_ms", json.dumps(min(CONNECT_TIMEOUT_MS, left_ms)))
        try:
            session = zenoh.open(config)
            break
        except zenoh.ZError as error:
            if role == "base" and not endpoint.startswith(_ROUTER):
                raise LinkError(
                    f"cannot listen on {endpoint} ({reason_of(error)}): is another base station running, and is "
                    "the address one of this machine (tcp/0.0.0.0:PORT listens on all)?"
                ) from error
            if time.monotonic() >= deadline_s or (give_up is not None and give_up.is_set()):
                who = "router" if endpoint.startswith(_ROUTER) else "base station"
                raise LinkError(
                    f"no {who} answers at {endpoint} within {connect_timeout_s:g} s: start it first, and check "
                    "the address and the network"
                ) from error
        if give_up is None:
            time.sleep(_RETRY_S)
        else:
            give_up.wait(_RETRY_S)
    _close_at_exit(session)
    return session


_open: dict[int, zenoh.Session] = {}  # sessions that are not closed yet
_senders: dict[int, Callable[[], None]] = {}  # by owner: ends the owner's thread that sends over a session
_exit_threads: list[threading.Thread] = []  # the two that close everything at the end
_open_lock = threading.Lock()


def _close_at_exit(session: zenoh.Session) -> None:
    with _open_lock:
        _open[id(session)] = session
        if not _exit_threads:
            closed = threading.Event()
            # Two threads, since a close may stall: the daemon closes, and Python waits for the other one.
            _exit_threads.extend(
                (
                    threading.Thread(target=_close_after_main, args=(closed,), name="zenoh-exit", daemon=True),
                    threading.Thread(target=_wait_after_main, args=(closed,), name="zenoh-exit-wait", daemon=False),
                )
            )
            for thread in _exit_threads:
                thread.start()


def stop_at_exit(owner: object, stop: Callable[[], None]) -> None:
    """Call `stop` before sessions are closed at the end of the main thread; it ends the owner's sending thread."""
    with _open_lock:
        _senders[id(owner)] = stop


def no_stop_at_exit(owner: object) -> None:
    """Forget the owner's `stop`: its thread has ended."""
    with _open_lock:
        _senders.pop(id(owner), None)


def _close_after_main(closed: threading.Event) -> None:
    """Close all open sessions when the main thread has ended: atexit handlers run too late for that."""
    threading.main_thread().join()
    for stop in list(_senders.values()):
        stop()
    for session in list(_open.values()):
        _close(session)
    closed.set()


def _wait_after_main(closed: threading.Event) -> None:
    """Keep Python from ending until the sessions are closed, or have taken too long."""
    threading.main_thread().join()
    closed.wait(_EXIT_TIMEOUT_S)


def _close(session: zenoh.Session) -> None:
    with contextlib.suppress(zenoh.ZError):
        session.close()  # type: ignore[no-untyped-call]  # zenoh's stub lacks the return type


def close_session(session: zenoh.Session) -> bool:
    """Close a session within CLOSE_TIMEOUT_S; False if it had to be abandoned. May be called twice."""
    thread = threading.Thread(target=_close, args=(session,), name="zenoh-close", daemon=True)
    try:
        thread.start()
    except RuntimeError:  # Python 3.12 starts no thread once the main one has ended: the thread for the end closes it
        return False
    thread.join(CLOSE_TIMEOUT_S)
    with _open_lock:
        _open.pop(id(session), None)
    return not thread.is_alive()


def direct(callback: Callable[[Any], None], drop: Callable[[], None] | None = None) -> Any:
    """A handler that calls back from Zenoh's own thread, without a Python thread in between."""
    return zenoh.handlers.Callback(callback, drop or (lambda: None), indirect=False)
