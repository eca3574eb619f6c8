"""Questions of other programs to a base: who may ask what, and on which endpoint."""

import contextlib
import json
import secrets
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from kiteline_basestation.management import READING, Answer, Command
from kiteline_basestation.runtime.options import BaseOptions
from kiteline_codec.schema import WireError
from kiteline_codec.transport.signed_question import OtherStartError, QuestionGuard, unsigned
from kiteline_hw.links.sealing import is_loopback
from kiteline_hw.links.zenoh_link import ZenohHub
from kiteline_hw.links.zenoh_queries import QueryServer
from kiteline_hw.ports import LinkHub

_MEND = (
    "this base takes {what} only with the right to change maps: `kiteline maps --key FILE`, with the file of its keys "
    "or one with its line `maps` (`kiteline keys new maps` makes one)"
)


_STATUS = "status"  # the verb that is answered here: it is no input of the station
_READING = READING | {_STATUS}


class Questions:
    """Answers `kiteline maps` and `kiteline status` on --maps, else on the agents' link if that is Zenoh.

    Without keys anyone may ask; with them a change needs a signature, and reading does too, except on a --maps endpoint
    of this machine.
    """

    def __init__(
        self, options: BaseOptions, hub: LinkHub, stack: contextlib.ExitStack, status: Callable[[], dict[str, Any]],
        maps_key: Callable[[], bytes | None], logins: Mapping[str, str] | None = None,
    ) -> None:  # fmt: skip
        """status: the answer to `kiteline status` now. maps_key: that of the right to change maps, now. logins: users
        and passwords without which nobody connects. Raises LinkError.
        """
        self._status = status
        self._server: QueryServer | None = None
        self._reading_free = bool(options.maps) and is_loopback(f"zenoh:{options.maps.removeprefix('zenoh:')}")
        if options.maps:
            endpoint = options.maps.removeprefix("zenoh:")
            self._server = QueryServer("maps", endpoint=endpoint, logins=None if self._reading_free else logins)
        elif isinstance(hub, ZenohHub):
            self._server = QueryServer("maps", session=hub.session)
        if self._server is not None:
            stack.callback(self._server.close)
        self._guard = QuestionGuard(maps_key, secrets.token_hex(16)) if options.key else None

    def commands(self) -> list[Command]:
        """The questions that may be asked, since the last call; others are answered here."""
        if self._server is None:
            return []
        out = []
        for asked in self._server.questions():
            try:
                text = self._opened(asked.verb, asked.text)
            except WireError as error:
                start = {"start": error.start} if isinstance(error, OtherStartError) else {}
                self._server.answer(asked.number, False, json.dumps({"error": str(error), **start}))
                continue
            if asked.verb == _STATUS:
                self._server.answer(asked.number, True, json.dumps(self._status()))
            else:
                out.append(Command(asked.number, asked.verb, text))
        return out

    def answer(self, answers: Sequence[Answer]) -> None:
        """Send answers."""
        for answer in answers:
            if self._server is not None:
                self._server.answer(answer.id, answer.ok, answer.text)

    def _opened(self, verb: str, text: str) -> str:
        if self._guard is None:
            return unsigned(text)
        question = self._guard.open(verb, text, int(time.time()))
        if question is not None:
            return question
        if verb in _READING and self._reading_free:
            return text
        raise WireError(_MEND.format(what="questions" if verb in _READING else "changes"))
