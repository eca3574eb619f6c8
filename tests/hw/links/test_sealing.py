"""What is sealed by default, pairing codes, and what a base lets strangers do."""

import stat
import time
from pathlib import Path
from typing import Any, Literal

import pytest
import zenoh

from kiteline_hw.links.sealing import is_loopback, sealing_of
from kiteline_hw.links.zenoh_access import Instances
from kiteline_hw.links.zenoh_link import ZenohHub, ZenohLink
from kiteline_hw.links.zenoh_session import close_session, direct, open_session, session_config
from kiteline_hw.ports import LinkError
from kiteline_hw.system.key_store import (
    MAPS,
    default_path,
    first_keys,
    login_of,
    new_code,
    new_maps_key,
    pair,
    read_file,
    read_keys,
)
from kiteline_hw.system.process import state_folder
from tests.hw.processes import free_endpoint, wait_for

NETWORK, LOOPBACK = "zenoh:tcp/0.0.0.0:7447", "zenoh:tcp/127.0.0.1:7447"


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    return tmp_path


def test_a_base_on_a_network_makes_keys_at_its_first_start_and_says_how_to_pair() -> None:
    first = sealing_of(NETWORK, "base", 0, "", insecure=False)
    assert first.key == str(default_path())
    assert "new keys" in first.lines[0] and "kiteline keys pair" in first.lines[0]
    assert stat.S_IMODE(default_path().stat().st_mode) == 0o600
    keys = read_file(default_path())
    assert len(keys.agents) == 256 and len(set(keys.agents.values())) == 256 and keys.maps is not None
    assert "new keys" not in sealing_of(NETWORK, "base", 0, "", insecure=False).lines[0]
    assert read_file(default_path()) == keys
    # an agent of the same user on the same machine needs no pairing
    assert sealing_of(LOOPBACK, "agent", 7, "", insecure=False).key == str(default_path())


def test_an_agent_on_a_network_is_paired_first() -> None:
    with pytest.raises(LinkError, match="kiteline keys pair 3"):
        sealing_of("zenoh:tcp/10.0.0.1:7447", "agent", 3, "", insecure=False)
    pair(default_path(), 3, new_code())
    assert sealing_of("zenoh:tcp/10.0.0.1:7447", "agent", 3, "", insecure=False).key == str(default_path())


@pytest.mark.parametrize("role", ["agent", "base"])
@pytest.mark.parametrize(
    ("link", "words"),
    [
        ("zenoh:10.0.0.1:7447", "write tcp/10.0.0.1:7447"),
        ("serial:/dev/ttyUSB0", "expected DEVICE:BAUD"),
        ("mavlink:/dev/ttyUSB0:57600", "expected udp:HOST:PORT"),
        ("tcp/10.0.0.1:7447", "expected zenoh:tcp/HOST:PORT"),
    ],
)
def test_an_address_that_cannot_be_opened_is_told_before_keys_are_asked_for(
    link: str, words: str, role: Literal["agent", "base"]
) -> None:
    with pytest.raises(LinkError, match=words):
        sealing_of(link, role, 3, "", insecure=False)
    assert not default_path().exists()


@pytest.mark.parametrize(
    "link", ["serial:/dev/ttyUSB0:57600", "mavlink:udp:127.0.0.1:14550", "zenoh:router/tcp/127.0.0.1:1"]
)
def test_radios_tunnels_and_routers_are_sealed_as_networks_are(link: str) -> None:
    with pytest.raises(LinkError, match="kiteline keys pair 3"):
        sealing_of(link, "agent", 3, "", insecure=False)
    base = sealing_of(link, "base", 0, "", insecure=False)
    assert base.key == str(default_path()) and "kiteline keys pair" in base.lines[0]
    assert sealing_of(link, "agent", 3, "", insecure=False).key == base.key
    loud = sealing_of(link, "agent", 3, "", insecure=True)
    assert loud.key == "" and "NOT SEALED" in loud.lines[0]


@pytest.mark.parametrize("role", ["agent", "base"])
def test_one_machine_and_insecure_links_are_not_sealed_and_it_is_said(role: Any) -> None:
    assert sealing_of("none", role, 0, "", insecure=False) == sealing_of("none", role, 0, "", insecure=True)
    assert sealing_of(LOOPBACK, role, 0, "", insecure=False).key == ""
    assert "this machine" in sealing_of(LOOPBACK, role, 0, "", insecure=False).lines[0]
    loud = sealing_of(NETWORK, role, 0, "", insecure=True)
    assert loud.key == "" and "NOT SEALED" in loud.lines[0]
    assert sealing_of(NETWORK, role, 0, "some.key", insecure=False).key == "some.key"
    with pytest.raises(LinkError, match="choose one"):
        sealing_of(NETWORK, role, 0, "some.key", insecure=True)
    assert not default_path().exists()


@pytest.mark.parametrize(
    ("link", "own"),
    [("zenoh:tcp/127.0.0.1:1", True), ("zenoh:tcp/[::1]:1", True), ("zenoh:udp/localhost:1", True),
     ("zenoh:router/tcp/127.0.0.1:1", False), ("zenoh:tcp/127.0.0.1:1#iface=lo", True),
     ("mavlink:udp:127.0.0.1:1", False), ("zenoh:tcp/0.0.0.0:1", False), ("zenoh:tcp/[::]:1", False),
     ("zenoh:tcp/base.local:1", False), ("zenoh:tcp/127.0.0.1.evil.org:1", False), ("zenoh:tcp/10.0.0.1:1", False)],
)  # fmt: skip
def test_loopback_is_known_by_its_address(link: str, own: bool) -> None:
    assert is_loopback(link) == own


def test_a_code_makes_the_same_key_on_both_sides(tmp_path: Path) -> None:
    code = new_code()
    assert len(code) == 19
    keys = [pair(tmp_path / side, 3, code) for side in ("base", "agent")]
    assert keys[0] == keys[1] == read_keys(tmp_path / "agent")[3]
    assert pair(tmp_path / "typed", 3, code.lower().replace("-", " ").replace("0", "O").replace("1", "l")) == keys[0]
    assert pair(tmp_path / "agent", 4, code) != keys[0]  # of another agent
    assert set(read_keys(tmp_path / "agent")) == {3, 4}
    for wrong in ("", "abc", code + "A", code[:-1] + ("A" if code[-1] != "A" else "B"), "U" * 16):
        with pytest.raises(LinkError, match="is no pairing code"):
            pair(tmp_path / "agent", 3, wrong)


def test_an_empty_variable_is_no_folder(monkeypatch: pytest.MonkeyPatch, home: Path) -> None:
    monkeypatch.setenv("HOME", str(home))
    for name in ("XDG_CONFIG_HOME", "XDG_STATE_HOME"):
        monkeypatch.setenv(name, "")
    assert default_path() == home / ".config/kiteline/keys"
    assert state_folder() == home / ".local/state/kiteline"


def test_the_right_to_change_maps_is_kept_beside_the_keys(tmp_path: Path) -> None:
    path = tmp_path / "keys"
    pair(path, 3, new_code())
    key = new_maps_key(path)
    pair(path, 4, new_code())
    assert read_file(path).maps == key
    with pytest.raises(LinkError, match="--replace"):
        new_maps_key(path)
    assert not first_keys(path)


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


def test_a_base_routes_nothing_between_its_clients(endpoint: str) -> None:
    with ZenohHub(endpoint) as hub, ZenohLink(endpoint, 3) as agent:
        stranger, another = (open_session(endpoint, "client") for _ in range(2))
        heard: list[str] = []
        try:
            subscriptions = [
                stranger.declare_subscriber(key, direct(lambda sample: heard.append(str(sample.key_expr))))
                for key in ("kiteline/1/default/*/up", "other/**")
            ]
            wait_for(lambda: agent.connected and 3 in hub.links())
            received: list[bytes] = []

            def pass_packets() -> bool:
                agent.send(b"from the agent")
                hub.links()[3].send(b"from the base")
                stranger.put("kiteline/1/default/3/down", b"in the base's name")
                another.put("other/x", b"x")
                received.extend(agent.receive())
                return b"from the base" in received and b"from the agent" in hub.links()[3].receive()

            wait_for(pass_packets)
            time.sleep(0.3)
            received += agent.receive()
            assert set(received) == {b"from the base"}
            assert heard == []
            del subscriptions
        finally:
            close_session(stranger)
            close_session(another)


def test_two_agents_with_one_number_are_found_on_both_ends_within_three_seconds(endpoint: str) -> None:
    with ZenohHub(endpoint) as hub, ZenohLink(endpoint, 3) as one:
        wait_for(lambda: one.connected)
        with ZenohLink(endpoint, 3) as other, ZenohLink(endpoint, 4) as third:
            wait_for(lambda: other.connected and third.connected)
            assert hub.doubles() == frozenset()
            wait_for(lambda: hub.doubles() == {3} and one.doubled and other.doubled, 3.0)
            assert not third.doubled
        wait_for(lambda: not hub.doubles())


def test_names_that_strangers_announce_take_little_memory() -> None:
    instances = Instances()
    for i in range(1000):
        instances.note(f"stranger {i}", here=True)
    assert len(instances._since_s) <= 16
    for i in range(1000):
        instances.note(f"stranger {i}", here=False)
    assert not instances._since_s and not instances.several


def test_what_is_too_long_is_dropped_before_it_takes_memory(endpoint: str) -> None:
    with ZenohHub(endpoint) as hub:
        stranger = open_session(endpoint, "client")
        try:
            for _ in range(30):
                stranger.put(
                    "kiteline/1/default/3/up", bytes(100_000), congestion_control=zenoh.CongestionControl.BLOCK
                )
            stranger.put("kiteline/1/default/3/up", b"short")
            wait_for(lambda: 3 in hub.links())
            time.sleep(0.2)
            assert hub.links()[3].receive() == [b"short"]
            assert hub.counters.overrun_packets > 0
            for _ in range(5000):
                stranger.put("kiteline/1/default/3/up", bytes(1000), congestion_control=zenoh.CongestionControl.BLOCK)
            time.sleep(1.0)
            assert sum(map(len, hub.links()[3].receive())) <= 1 << 20
        finally:
            close_session(stranger)


def test_strangers_take_up_no_place_of_a_base_for_paired_agents_alone(endpoint: str) -> None:
    """Anyone may open the 96 sessions of another base, and keep agents out."""
    ours = login_of(3, bytes(32))
    with ZenohHub(endpoint, logins={**ours, **login_of(MAPS, bytes(32))}) as hub:
        config = session_config(endpoint, "client", 2000)
        config.insert_json5("connect/timeout_ms", "300")
        for logins in ({}, {"3": "guessed"}, {"4": ours["3"]}):
            for user, password in logins.items():
                config.insert_json5("transport/auth/usrpwd/user", f'"{user}"')
                config.insert_json5("transport/auth/usrpwd/password", f'"{password}"')
            with pytest.raises(zenoh.ZError):
                zenoh.open(config)
        with ZenohLink(endpoint, 3, logins=ours) as agent, ZenohLink(endpoint, 4, logins=login_of(4, bytes([1]) * 32)):
            wait_for(lambda: agent.connected and hub.alive() == {3}, 20.0)
    with ZenohHub(endpoint) as hub, ZenohLink(endpoint, 3, logins=ours) as agent:  # and one for anyone
        wait_for(lambda: agent.connected and hub.alive() == {3})
