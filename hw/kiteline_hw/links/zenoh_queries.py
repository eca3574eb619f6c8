"""Requests of other programs over Zenoh: a server that queues them until the loop polls it, and a client.

Key: kiteline/1/default/SERVICE/VERB. The request is the payload, or else the selector's parameters; the reply or the
error reply is a text.
"""

import contextlib
import json
import queue
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import zenoh

from kiteline_hw.links.zenoh_access import PREFIX, access_of_base
from kiteline_hw.links.zenoh_session import check_endpoint, close_session, direct, open_session, reason_of
from kiteline_hw.ports import LinkError

_TIMEOUT_S = 10.0  # s in which a request must be answered
_RETRY_S = 0.1  # s between two requests that nobody answered
_MAX_WAITING = 64  # requests in the queue; more are refused
_MOST_BYTES = 1 << 16  # of a request


@dataclass(frozen=True, slots=True)
class Question:
    """One request. number: identifies it in `answer`. verb: the last part of its key. text: JSON."""

    number: int
    verb: str
    text: str


class QueryServer:
    """Receives requests on a session, or on one of its own that listens on an endpoint. Raises LinkError."""

    def __init__(
        self, service: str, session: zenoh.Session | None = None, endpoint: str = "",
        logins: Mapping[str, str] | None = None,
    ) -> None:  # fmt: skip
        """logins: users and passwords without which nobody connects to the endpoint; None: anyone may."""
        access = access_of_base()
        self._own_session = open_session(endpoint, "base", access=access, logins=logins) if session is None else None
        self._arrived: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._open: dict[int, Any] = {}
        self._number = 0
        used = self._own_session if session is None else session
        assert used is not None
        try:
            self._queryable = used.declare_queryable(f"{PREFIX}/{service}/*", direct(self._on_query), complete=True)
        except zenoh.ZError as error:
            self.close()
            raise LinkError(f"cannot answer questions on {PREFIX}/{service}: {reason_of(error)}") from error

    def _on_query(self, query: Any) -> None:
        with contextlib.suppress(Exception):  # one bad question must not end the service
            given = query.payload
            if (0 if given is None else len(given)) + len(str(query.parameters)) > _MOST_BYTES:
                _reply(query, False, json.dumps({"error": f"a question has at most {_MOST_BYTES} bytes"}))
            elif self._arrived.qsize() >= _MAX_WAITING:
                _reply(query, False, json.dumps({"error": "too many questions wait; ask again"}))
            else:
                self._arrived.put(query)

    def questions(self) -> list[Question]:
        """The requests that came in since the last call. Never blocks."""
        out: list[Question] = []
        while True:
            try:
                query = self._arrived.get_nowait()
            except queue.Empty:
                return out
            self._number += 1
            self._open[self._number] = query
            raw = query.payload.to_bytes() if query.payload is not None else b""
            text = raw.decode(errors="replace") or _as_json(str(query.parameters))
            out.append(Question(self._number, str(query.key_expr).rsplit("/", 1)[-1], text))

    def answer(self, number: int, ok: bool, text: str) -> None:
        """Answer a request, whose client may be gone."""
        query = self._open.pop(number, None)
        if query is not None:
            _reply(query, ok, text)

    def close(self) -> None:
        """Receive no more requests."""
        if self._own_session is not None:
            close_session(self._own_session)


def _as_json(parameters: str) -> str:
    """Selector parameters, name=value;name=value, as a JSON object of strings."""
    pairs = [pair.partition("=") for pair in parameters.split(";") if pair]
    return json.dumps({name: value for name, _, value in pairs})


def _reply(query: Any, ok: bool, text: str) -> None:
    with contextlib.suppress(zenoh.ZError), query:
        if ok:
            query.reply(query.key_expr, text.encode(), encoding=zenoh.Encoding.APPLICATION_JSON)
        else:
            query.reply_err(text.encode(), encoding=zenoh.Encoding.APPLICATION_JSON)


def ask(
    endpoint: str, service: str, verb: str, text: str, logins: Mapping[str, str] | None = None
) -> tuple[bool, str]:  # fmt: skip
    """Send a request, again until it is answered. Returns whether it succeeded, and the answer. Raises LinkError.

    logins: user and password, for a base that asks for them.
    """
    check_endpoint(endpoint)
    begin_s = time.monotonic()
    deadline_s = begin_s + _TIMEOUT_S
    try:
        session = open_session(endpoint, "client", connect_timeout_s=0.0 if logins else _TIMEOUT_S)
    except LinkError:
        if not logins:
            raise
        waited_s = time.monotonic() - begin_s
        session = open_session(endpoint, "client", connect_timeout_s=_TIMEOUT_S, waited_s=waited_s, logins=logins)
    try:
        while (left_s := deadline_s - time.monotonic()) > 0.0:
            replies: queue.SimpleQueue[tuple[bool, str] | None] = queue.SimpleQueue()
            session.get(
                f"{PREFIX}/{service}/{verb}", direct(partial(_on_reply, replies), partial(replies.put, None)),
                payload=text.encode(), encoding=zenoh.Encoding.APPLICATION_JSON, timeout=left_s,
            )  # fmt: skip
            with contextlib.suppress(queue.Empty):
                first = replies.get(timeout=left_s + 1.0)
                if first is not None:
                    return first
            time.sleep(_RETRY_S)  # a base that is just starting listens already, but still reads its store
        raise LinkError(f"no base at {endpoint} answers {service}/{verb}: is it one that serves its maps there?")
    except zenoh.ZError as error:
        raise LinkError(f"the link to {endpoint} broke: {reason_of(error)}") from error
    finally:
        close_session(session)


def _on_reply(replies: queue.SimpleQueue[tuple[bool, str] | None], reply: Any) -> None:
    if reply.ok is not None:
        replies.put((True, reply.ok.payload.to_bytes().decode(errors="replace")))
    elif reply.err is not None:
        replies.put((False, reply.err.payload.to_bytes().decode(errors="replace")))
