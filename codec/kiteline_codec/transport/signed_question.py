"""Questions to a base, signed by who has the right to change maps. Pure: time and random bytes are handed in.

A signed question is a JSON object: `signed`, the question; `start`, what this start of the base drew; `t_s`, Unix time
in s; `nonce`; `tag`, BLAKE2b of verb and all of these under the key. Each is taken once, only near its time, and by no
other start of the base. A question with another `start` is refused with an error that names the right one.
"""

import hmac
import json
from collections.abc import Callable
from hashlib import blake2b
from typing import Any

from kiteline_codec.coding.packing import WireError
from kiteline_core.errors import INPUT_FAULTS

_NEAR_S = 300  # by which the clocks of two machines may differ
_REMEMBERED = 10_000  # nonces; more questions within their time are refused
_TAG_BYTES = 16


class OtherStartError(WireError):
    """A question to another start of the base. start: of this one."""

    def __init__(self, start: str) -> None:
        super().__init__("the question names no start of this base, or an earlier one: sign it with this `start`")
        self.start = start


def sign(key: bytes, verb: str, text: str, t_s: int, nonce: str, start: str) -> str:
    """The signed question. nonce: random, never used again. start: that of the base, which its refusal names."""
    tag = _tag(key, verb, text, t_s, nonce, start)
    return json.dumps({"signed": text, "start": start, "t_s": t_s, "nonce": nonce, "tag": tag})


def unsigned(text: str) -> str:
    """The question in a signed one, unchecked; the text itself if it is not signed."""
    given = _signed(text)
    question = None if given is None else given["signed"]
    return question if isinstance(question, str) else text


def _signed(text: str) -> dict[str, Any] | None:
    """The object of a signed question; None for any other text."""
    try:
        given = json.loads(text or "{}")
    except (ValueError, *INPUT_FAULTS):
        return None
    return given if isinstance(given, dict) and "signed" in given else None


def _tag(key: bytes, verb: str, text: str, t_s: int, nonce: str, start: str) -> str:
    signed = json.dumps([verb, text, t_s, nonce, start]).encode()
    return blake2b(signed, key=key, digest_size=_TAG_BYTES, person=b"kiteline-maps").hexdigest()


class QuestionGuard:
    """Lets questions pass that are signed with the key."""

    def __init__(self, key: Callable[[], bytes | None], start: str) -> None:
        """key: that of the right, now; None if nobody has it. start: drawn at this start of the base."""
        self._key, self._start = key, start
        self._taken: dict[str, int] = {}  # nonces, and when they may be forgotten
        self._after_s = 0  # no question up to this time is taken: those whose nonces were forgotten are older

    def open(self, verb: str, text: str, now_s: int) -> str | None:
        """The question in a signed one; None for one that is not signed. Raises WireError for a wrong one,
        OtherStartError.
        """
        given = _signed(text)
        if given is None:
            return None
        question, t_s, nonce, tag = (given.get(name) for name in ("signed", "t_s", "nonce", "tag"))
        if not (isinstance(question, str) and isinstance(nonce, str) and isinstance(tag, str) and type(t_s) is int):
            raise WireError("a signed question has a text, a start, a time, a nonce and a tag")
        if given.get("start") != self._start:
            raise OtherStartError(self._start)
        key = self._key()
        if key is None:
            raise WireError("nobody has the right to change this base's maps: `kiteline keys new maps` there gives it")
        expected = _tag(key, verb, question, t_s, nonce, self._start)
        if not hmac.compare_digest(expected.encode(), tag.encode(errors="replace")):
            raise WireError(
                "the question is signed with another key than this base's for maps: `kiteline maps --key FILE`, with "
                "the file of its keys"
            )
        for old in [nonce for nonce, until_s in self._taken.items() if until_s < now_s]:
            self._after_s = max(self._after_s, self._taken.pop(old) - _NEAR_S)
        if abs(now_s - t_s) > _NEAR_S:
            raise WireError(f"the question is of {t_s - now_s:+d} s from now: set the clocks of both machines")
        if t_s <= self._after_s:
            raise WireError(
                "the base's clock was set back, and the question may have been asked before: restart the base"
            )
        if nonce in self._taken or len(self._taken) >= _REMEMBERED:
            raise WireError("the question was asked before, or too many were asked")
        self._taken[nonce] = now_s + 2 * _NEAR_S
        return question
