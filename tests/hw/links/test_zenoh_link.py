"""Zenoh links: reconnect with either side, never block the caller, never keep a process from ending."""

import json
import re
import signal
import time
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh

from kiteline_hw.links import zenoh_queries, zenoh_session
from kiteline_hw.links.open import open_link
from kiteline_hw.links.queued_link import INBOX_PACKETS, OUTBOX_PACKETS, QueuedLink
from kiteline_hw.links.zenoh_link import ZenohHub, ZenohLink
from kiteline_hw.links.zenoh_queries import ask
from kiteline_hw.links.zenoh_session import check_endpoint, open_session
from kiteline_hw.ports import LinkError
from tests.hw.processes import free_endpoint, start, wait_for


def test_two_agents_and_a_base_that_starts_late_and_restarts() -> None:
    endpoint = free_endpoint()
    with ZenohLink(endpoint, 1) as one, ZenohLink(endpoint, 2) as two:
        assert not one.send(b"nobody listens")
        for life in range(2):
            with ZenohHub(endpoint) as hub:
                wait_for(lambda: one.connected and two.connected and hub.alive() == {1, 2})
                assert one.send(b"up one %d" % life) and two.send(b"up two %d" % life)
                links = hub.links()
                assert list(links) == [1, 2]
                received: dict[int, list[bytes]] = {1: [], 2: []}

                def collect() -> bool:
                    for agent, link in links.items():  # noqa: B023
                        received[agent] += link.receive()  # noqa: B023
                    return all(received.values())  # noqa: B023

                wait_for(collect)
                assert received == {1: [b"up one %d" % life], 2: [b"up two %d" % life]}
                assert links[2].send(b"down two %d" % life)
                down: list[bytes] = []
                wait_for(lambda: down.extend(two.receive()) or down)  # type: ignore[func-returns-value]  # noqa: B023
                assert down == [b"down two %d" % life]
                assert one.receive() == []
            wait_for(lambda: not one.connected and not two.connected)
        assert one.counters.reconnects == 2
        assert one.counters.sent_packets == 2 and one.counters.callback_errors == 0


def test_a_base_whose_token_was_lost_over_udp_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Zenoh repeats no declaration that UDP lost."""
    monkeypatch.setattr("kiteline_hw.links.zenoh_link._SILENCE_S", 0.3)
    endpoint = free_endpoint().replace("tcp/", "udp/")
    lost: list[Any] = []

    class FirstTokenLost(ZenohLink):
        def on_liveliness(self, sample: Any) -> None:
            if lost:
                super().on_liveliness(sample)
            lost.append(sample)

    with ZenohHub(endpoint) as hub, FirstTokenLost(endpoint, 3) as link:
        wait_for(lambda: lost)
        assert not link.connected
        wait_for(lambda: link.connected and hub.alive() == {3})
        assert link.send(b"up")
        wait_for(lambda: hub.links()[3].receive() == [b"up"])


def test_a_base_whose_packets_arrive_is_there_though_its_token_was_lost() -> None:
    class TokenLost(ZenohLink):
        def on_liveliness(self, sample: Any) -> None:
            pass

    endpoint = free_endpoint()
    with ZenohHub(endpoint) as hub, TokenLost(endpoint, 3) as link:
        wait_for(lambda: hub.alive() == {3})
        assert not link.connected
        wait_for(lambda: hub.links()[3].send(b"down") and link.receive())
        assert link.connected and link.send(b"up")
        wait_for(lambda: hub.links()[3].receive() == [b"up"])


def test_an_agent_that_leaves_is_noticed_and_its_link_stays() -> None:
    endpoint = free_endpoint()
    with ZenohHub(endpoint) as hub:
        with ZenohLink(endpoint, 7):
            wait_for(lambda: hub.alive() == {7})
        wait_for(lambda: hub.alive() == frozenset())
        assert not hub.links()[7].send(b"nobody")
        with ZenohLink(endpoint, 7) as again:
            wait_for(lambda: hub.alive() == {7} and again.connected)
            assert hub.links()[7].send(b"welcome back")
            wait_for(lambda: again.receive() == [b"welcome back"])


def test_through_a_router(monkeypatch: pytest.MonkeyPatch) -> None:
    locator = free_endpoint()
    config = zenoh.Config()
    options = {"mode": '"router"', "listen/endpoints": f'["{locator}"]', "scouting/multicast/enabled": "false"}
    for name, value in options.items():
        config.insert_json5(name, value)
    with monkeypatch.context() as patch:
        patch.setattr(zenoh_session, "CONNECT_TIMEOUT_MS", 200)
        with pytest.raises(LinkError, match="no router answers"):
            open_session(f"router/{locator}", "base", connect_timeout_s=0.2)
    with zenoh.open(config), ZenohHub(f"router/{locator}") as hub, ZenohLink(f"router/{locator}", 4) as link:
        wait_for(lambda: link.connected and hub.alive() == {4})
        assert link.send(b"up") and hub.links()[4].send(b"down")
        wait_for(lambda: hub.links()[4].receive() == [b"up"])
        wait_for(lambda: link.receive() == [b"down"])


def test_a_question_to_an_endpoint_without_protocol_says_what_to_write() -> None:
    with pytest.raises(LinkError, match=r"write tcp/10\.0\.0\.1:7447$"):
        ask("10.0.0.1:7447", "maps", "list", "{}")


@pytest.mark.parametrize("logins", [None, {"maps": "secret"}])
def test_a_question_waits_as_long_for_a_base_as_it_says(
    monkeypatch: pytest.MonkeyPatch, logins: dict[str, str] | None
) -> None:
    clock_s = 100.0

    def refused(config: zenoh.Config) -> zenoh.Session:
        nonlocal clock_s
        clock_s += json.loads(config.get_json("connect/timeout_ms")) / 1000.0
        raise zenoh.ZError("nobody listens")

    def sleep(seconds: float) -> None:
        nonlocal clock_s
        clock_s += seconds

    monkeypatch.setattr(zenoh, "open", refused)
    for module in (zenoh_queries, zenoh_session):  # alone: threads of other tests sleep, too
        monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: clock_s, sleep=sleep))
    with pytest.raises(LinkError, match=r"no base station answers .* within 10 s"):
        ask(free_endpoint(), "maps", "list", "{}", logins)
    assert 110.0 <= clock_s < 110.5


@pytest.mark.alone
def test_packets_stay_in_order_and_whole() -> None:
    """A link drops packets where a machine is busy, and endpoints send again: but it changes none and swaps none."""
    endpoint = free_endpoint()
    packets = [bytes([i % 251]) * (1 + 37 * i) for i in range(200)]  # no two are equal
    with ZenohHub(endpoint) as hub, ZenohLink(endpoint, 3) as link:
        wait_for(lambda: link.connected and hub.alive())
        received: list[bytes] = []
        for begin in range(0, len(packets), 5):
            wanted = len(received) + 5
            for packet in packets[begin : begin + 5]:
                assert link.send(packet)
            deadline_s = time.monotonic() + 1.0
            while len(received) < wanted and time.monotonic() < deadline_s:
                received.extend(hub.links()[3].receive())
                time.sleep(0.001)
        numbers = [packets.index(packet) for packet in received]
        assert numbers == sorted(set(numbers))
        assert len(received) >= 0.9 * len(packets)


def test_a_callback_that_raises_is_counted() -> None:
    endpoint = free_endpoint()
    with ZenohHub(endpoint) as hub, ZenohLink(endpoint, 3) as link:
        wait_for(lambda: link.connected and hub.alive())

        def broken(packet: bytes) -> None:
            raise RuntimeError(packet)

        link.deliver = broken  # type: ignore[method-assign]
        hub.links()[3].send(b"x")
        wait_for(lambda: link.counters.callback_errors == 1)


class AlwaysConnected(QueuedLink):
    connected = True  # type: ignore[assignment]


def test_queues_stay_bounded() -> None:
    link = AlwaysConnected()
    for i in range(INBOX_PACKETS + 50):
        link.deliver(b"%d" % i)
    assert link.receive() == [b"%d" % i for i in range(50, INBOX_PACKETS + 50)]  # the newest are kept
    assert link.counters.overrun_packets == 50 and link.receive() == []
    assert [link.send(b"%d" % i) for i in range(OUTBOX_PACKETS + 1)] == [True] * OUTBOX_PACKETS + [False]
    assert link.next_packet() == b"0" and link.pending()
    link.clear_outbox()
    assert link.next_packet() is None and link.counters.failed_packets == OUTBOX_PACKETS - 1


BASE = """
import sys, time
from kiteline_hw.links.zenoh_link import ZenohHub
hub = ZenohHub(sys.argv[1])
print("up", flush=True)
time.sleep(30)
"""


def test_a_frozen_base_never_blocks_the_sender_nor_close() -> None:
    endpoint = free_endpoint()
    base = start(BASE, endpoint)
    try:
        link = ZenohLink(endpoint, 1)
        wait_for(lambda: link.connected)
        base.send_signal(signal.SIGSTOP)
        longest_s, refused, packet = 0.0, 0, bytes(100_000)
        end_s = time.monotonic() + 0.7
        while time.monotonic() < end_s:
            began = time.monotonic()
            refused += not link.send(packet)
            time.sleep(0.0002)
            longest_s = max(longest_s, time.monotonic() - began)
        assert longest_s < 0.1
        assert link.counters.sent_packets + refused > 100
        wait_for(lambda: not link.connected, 5.0)  # the lease ran out
        began = time.monotonic()
        link.close()
        link.close()
        assert time.monotonic() - began < 2.0
    finally:
        base.kill()
        base.communicate()


AGENT = """
import atexit, signal, sys, threading, time
from kiteline_hw.system.process import StopSignal
from kiteline_hw.links.zenoh_link import ZenohHub, ZenohLink
from kiteline_hw.links.zenoh_session import open_session
way = sys.argv[2]
if way == "handler":
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(0))
if way == "flag":
    stop = StopSignal()
link = ZenohLink(sys.argv[1], 1)
hub = ZenohHub(sys.argv[3])
atexit.register(lambda: print(*(thread.name for thread in threading.enumerate()), flush=True))
while not link.connected:
    time.sleep(0.01)
print("connected", flush=True)
if way == "end":
    sys.exit(0)
if way == "raise":
    raise RuntimeError("on purpose")
while not (way == "flag" and stop.wait(0.05)):
    link.send(b"x")
    link.receive()
    time.sleep(0.01)
"""


@pytest.mark.parametrize(
    ("way", "status"), [("end", 0), ("raise", 1), ("default", -signal.SIGTERM), ("handler", 0), ("flag", 0)]
)
def test_a_process_with_an_open_link_ends(way: str, status: int) -> None:
    endpoint = free_endpoint()
    with ZenohHub(endpoint) as hub:
        process = start(AGENT, endpoint, way, free_endpoint())
        try:
            assert process.stdout.readline() == "connected\n"
            wait_for(lambda: hub.alive() == {1})
            for i in range(100):
                hub.links()[1].send(b"%d" % i)  # callbacks are running while the process ends
            if way not in ("end", "raise"):
                process.send_signal(signal.SIGTERM)
            running, _ = process.communicate(timeout=5)
            assert process.returncode == status
            # Python aborts if it ends while a thread is inside Zenoh.
            assert running.split() == ([] if way == "default" else ["MainThread"])
            wait_for(lambda: hub.alive() == frozenset())
        finally:
            process.kill()
            process.communicate()


def test_an_endpoint_that_is_taken_is_told_without_lines_of_zenohs_sources() -> None:
    endpoint = free_endpoint()
    with ZenohHub(endpoint), pytest.raises(LinkError, match="Address already in use") as caught:
        ZenohHub(endpoint)
    assert ".rs" not in str(caught.value)


@pytest.mark.parametrize(
    "endpoint", ["tcp/[fe80::1%eth0]:7447", "udp/224.0.0.1:7447#iface=eth0", "router/tls/host:7447?rel=1",
                 "unixsock-stream//tmp/kiteline", "serial//dev/ttyS0#baudrate=9600", "vsock/-1:1234"],
)  # fmt: skip
def test_endpoints_with_a_port_and_those_that_have_none_are_taken(endpoint: str) -> None:
    check_endpoint(endpoint)


@pytest.mark.parametrize(
    ("endpoint", "right"),
    [("192.168.1.5:7447", "tcp/192.168.1.5:7447"), ("192.168.1.5", "tcp/192.168.1.5:7447"),
     ("tcp://10.0.0.1:7448", "tcp/10.0.0.1:7448"), ("tpc/10.0.0.1:7448", "tcp/10.0.0.1:7448"), ("", "tcp/HOST:7447")],
)  # fmt: skip
def test_an_endpoint_that_zenoh_would_try_in_vain_is_refused(endpoint: str, right: str) -> None:
    with pytest.raises(LinkError, match=f"write {re.escape(right)}$"):
        open_link(f"zenoh:{endpoint}" if endpoint else "zenoh:router/", "agent")


def test_bad_numbers() -> None:
    with pytest.raises(LinkError, match="expected 0 to 255"):
        ZenohLink("tcp/127.0.0.1:1", 256)
