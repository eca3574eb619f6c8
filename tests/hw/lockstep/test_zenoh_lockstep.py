"""The barrier between processes: every message is answered in order, and errors when either side ends."""

import contextlib
import signal
import threading
import time
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from kiteline_hw.links import zenoh_session
from kiteline_hw.lockstep.agent_end import AgentBarrier
from kiteline_hw.lockstep.messages import Down, Phase, Up
from kiteline_hw.lockstep.zenoh_lockstep import LockstepClient, LockstepServer
from kiteline_hw.ports import LinkError
from tests.hw.processes import free_endpoint, start

AGENT = """
import sys
import threading
from kiteline_hw.links import zenoh_session
from kiteline_hw.lockstep.zenoh_lockstep import LockstepClient
endpoint, agent, ticks = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
with LockstepClient(endpoint, agent) as client:
    for tick in range(ticks):
        answer = client.exchange(b"%d %d " % (agent, tick) + bytes(tick * 1000), 10.0)
        assert answer == b"to %d at %d" % (agent, tick), answer
print("done", flush=True)
"""


def test_two_agents_in_two_processes_stay_in_lock_step() -> None:
    endpoint = free_endpoint()
    agents = [start(AGENT, endpoint, agent, 60) for agent in (1, 2)]  # started before the base listens
    with LockstepServer(endpoint) as server:
        for tick in range(60):
            messages = server.collect({1, 2}, 10.0)
            assert list(messages) == [1, 2]
            for agent, message in messages.items():
                assert message == b"%d %d " % (agent, tick) + bytes(tick * 1000)
                server.answer(agent, b"to %d at %d" % (agent, tick))
        for process in agents:
            out, err = process.communicate(timeout=10)
            assert out == "done\n", err
        assert server.callback_errors == 0


def test_a_killed_agent_is_named() -> None:
    endpoint = free_endpoint()
    process = start(AGENT, endpoint, 5, 1000)
    with LockstepServer(endpoint) as server:
        server.answer(5, b"to 5 at 0") if server.collect({5}, 10.0) else None
        server.collect({5}, 10.0)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        time.sleep(0.3)
        with pytest.raises(LinkError, match="agent 5 has ended"):
            server.answer(5, b"to 5 at 1")
        began = time.monotonic()
        with pytest.raises(LinkError, match="agent 5 ended"):
            server.collect({5}, 10.0)
        assert time.monotonic() - began < 3.0


BASE = """
import sys
import time
from kiteline_hw.links import zenoh_session
from kiteline_hw.lockstep.zenoh_lockstep import LockstepServer
with LockstepServer(sys.argv[1]) as server:
    for _ in range(3):
        server.answer(1, server.collect({1}, 10.0)[1])
    server.collect({1}, 10.0)
    print("collected", flush=True)
    time.sleep(30)
"""


def test_a_killed_base_is_noticed_at_once() -> None:
    endpoint = free_endpoint()
    process = start(BASE, endpoint)
    with LockstepClient(endpoint, 1) as client:
        for tick in range(3):
            assert client.exchange(b"%d" % tick, 10.0) == b"%d" % tick

        def kill() -> None:
            assert process.stdout.readline() == "collected\n"
            process.kill()

        thread = threading.Thread(target=kill)
        thread.start()
        began = time.monotonic()
        with pytest.raises(LinkError, match="ended, or the link to it broke"):
            client.exchange(b"3", 30.0)
        assert time.monotonic() - began < 5.0
        thread.join()
        process.communicate()


def test_errors_when_nobody_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    endpoint = free_endpoint()
    with monkeypatch.context() as patch:
        patch.setattr(zenoh_session, "CONNECT_TIMEOUT_MS", 200)
        with pytest.raises(LinkError, match="no base station answers"):
            LockstepClient(endpoint, 1, connect_timeout_s=0.3)
    with LockstepServer(endpoint) as server:
        with pytest.raises(LinkError, match="no message from agent 1, 2 within"):
            server.collect({2, 1}, 0.05)
        with LockstepClient(endpoint, 1) as client, pytest.raises(LinkError, match="did not answer message 1"):
            client.exchange(b"", 0.3)
        with pytest.raises(LinkError, match="cannot listen"):
            LockstepServer(endpoint)
    with pytest.raises(LinkError, match="no Zenoh endpoint"):
        LockstepServer("127.0.0.1:7447")


def test_two_processes_with_one_agent_number_are_refused() -> None:
    endpoint = free_endpoint()
    with (
        LockstepServer(endpoint),
        LockstepClient(endpoint, 4),
        LockstepClient(endpoint, 4) as second,
        pytest.raises(LinkError, match="flown by another process"),
    ):
        second.exchange(b"", 5.0)


def test_close_is_quick_with_a_frozen_base() -> None:
    endpoint = free_endpoint()
    process = start(BASE, endpoint)
    client = LockstepClient(endpoint, 1)
    try:
        assert client.exchange(b"0", 10.0) == b"0"
        process.send_signal(signal.SIGSTOP)
        with pytest.raises(LinkError, match="did not answer"):
            client.exchange(bytes(3_000_000), 0.3)
        began = time.monotonic()
        client.close()
        assert time.monotonic() - began < 2.0
    finally:
        process.kill()
        process.communicate()


class _NoParent:
    def send_event(self, event: str, **values: Any) -> None:
        raise AssertionError(f"{event} {values}")


def test_an_agent_waits_minutes_for_a_base_to_start(monkeypatch: pytest.MonkeyPatch) -> None:
    endpoint = free_endpoint()
    open_zenoh, passed_s, servers = zenoh.open, [0.0], []

    def refused_once(config: zenoh.Config) -> zenoh.Session:
        if not passed_s[0]:
            passed_s[0] = 120.0
            monkeypatch.setattr(zenoh, "open", open_zenoh)
            servers.append(LockstepServer(endpoint))
            raise zenoh.ZError("nobody listens")
        return open_zenoh(config)

    clock = SimpleNamespace(monotonic=lambda: time.monotonic() + passed_s[0], sleep=lambda _: None)
    monkeypatch.setattr(zenoh_session, "time", clock)
    monkeypatch.setattr(zenoh, "open", refused_once)
    barrier = AgentBarrier(endpoint, 3, _NoParent())  # type: ignore[arg-type]
    assert not barrier.lost
    barrier.close()
    servers[0].close()


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
