"""Messages of the barrier: round trips, and errors on any other bytes."""

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_hw.lockstep.messages import Down, Phase, Up
from kiteline_hw.ports import LinkError

times = st.integers(0, 2**62)
packets = st.lists(st.binary(max_size=40), max_size=5).map(tuple)


@given(times | st.none(), st.booleans(), st.booleans(), packets)
def test_up_round_trip(next_ns: int | None, quiet: bool, equal: bool, sent: tuple[bytes, ...]) -> None:
    up = Up(next_ns, quiet, equal, sent)
    assert Up.decode(up.encode()) == up


@given(times, st.sampled_from(Phase), packets)
def test_down_round_trip(now_ns: int, phase: Phase, sent: tuple[bytes, ...]) -> None:
    down = Down(now_ns, phase, sent)
    assert Down.decode(down.encode()) == down


@given(st.binary(max_size=60))
def test_any_bytes_are_a_message_or_a_link_error(noise: bytes) -> None:
    for kind in (Up, Down):
        with contextlib.suppress(LinkError):
            kind.decode(noise)


def test_cut_and_padded_messages_are_refused() -> None:
    message = Up(None, True, False, (b"abc", b"")).encode()
    for wrong in (message[:-1], message + b"x", b""):
        with pytest.raises(LinkError):
            Up.decode(wrong)
    with pytest.raises(LinkError, match="phase"):
        Down.decode(Down(0, Phase.FLY, ()).encode()[:8] + b"\x09\0\0\0\0")
