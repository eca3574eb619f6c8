"""What a base opens and seals: its options, and keys that change while it runs."""

import contextlib
import os
from pathlib import Path
from typing import Any

import pytest

from kiteline_basestation.__main__ import main
from kiteline_basestation.runtime import options, questions
from kiteline_basestation.runtime.options import MOST_WORKERS, BaseOptions
from kiteline_basestation.runtime.seals import BaseSeals, logins_of
from kiteline_codec.transport.seal import Direction, Sealer, Suite
from kiteline_hw.links.ends import LinkOptions, OneLinkHub
from kiteline_hw.links.no_link import open_base_end
from kiteline_hw.links.zenoh_link import ZenohHub
from kiteline_hw.ports import LinkError
from kiteline_hw.system import key_store
from kiteline_hw.system.key_store import new_code, new_maps_key, pair, read_keys
from tests.handed_link import HandedLink

SECOND_NS = 1_000_000_000


class Base:
    """Seals of a base that serves agent 3 with a file of keys."""

    def __init__(self, path: Path) -> None:
        self.path, self.wire, self.now_ns = path, HandedLink(), 0
        options = BaseOptions(folder="", key=str(path), link="zenoh:tcp/127.0.0.1:1", session=7)
        self.seals = BaseSeals(options, OneLinkHub(self.wire, 3))

    def agent(self) -> Sealer:
        return Sealer(read_keys(self.path)[3], 3, 5, Direction.UP, Suite.ENCRYPTED)

    def takes(self, packet: bytes) -> bool:
        self.wire.inbox = [packet]
        link = self.seals.hub.links().get(3)
        return link is not None and link.receive() != []

    def lines(self) -> list[str]:
        self.now_ns += 2 * SECOND_NS
        return self.seals.lines(self.now_ns)


@pytest.fixture
def base(tmp_path: Path) -> Base:
    pair(tmp_path / "keys", 3, new_code())
    return Base(tmp_path / "keys")


def test_what_the_link_tells_is_told_once(base: Base) -> None:
    base.wire.messages = ["the line is gone"]
    assert base.lines() == ["the line is gone"]
    assert base.lines() == []


class DoubledHub(ZenohHub):
    """A hub of which two agents have one number from now on."""

    def __init__(self) -> None:
        self.found: frozenset[int] = frozenset()

    def doubles(self) -> frozenset[int]:
        return self.found

    def take_messages(self) -> list[str]:
        return []

    def close(self) -> None:
        """Nothing is open."""


def test_two_agents_with_one_number_are_told_soon_after_the_hub_knows() -> None:
    """The hub needs 2.2 s to be sure, of the three within which they are to be named."""
    hub = DoubledHub()
    seals = BaseSeals(BaseOptions(folder="", link="zenoh:tcp/127.0.0.1:1"), hub)
    assert seals.lines(10 * SECOND_NS) == []
    hub.found = frozenset({3})
    assert seals.lines(10 * SECOND_NS + SECOND_NS // 4) == ["two agents have number 3: give each its own --agent N"]
    assert seals.lines(20 * SECOND_NS) == []


def test_a_key_that_is_replaced_or_removed_opens_nothing_more(base: Base) -> None:
    old = base.agent()
    assert base.takes(old.seal(b"1"))
    pair(base.path, 3, new_code())
    assert base.lines() == ["new key for agent 3"]
    assert not base.takes(old.seal(b"2"))
    new = base.agent()
    assert base.takes(new.seal(b"3"))
    base.path.write_text("# none\n")
    assert base.lines()[-1] == "no key any more for agent 3"
    assert not base.takes(new.seal(b"4"))


def test_a_file_that_cannot_be_read_yet_is_taken_once_it_can(base: Base) -> None:
    pair(base.path, 3, new_code())
    base.path.chmod(0o644)
    assert "chmod 600" in base.lines()[0]
    assert base.lines() == []
    base.path.chmod(0o600)  # its content and time of writing stay
    assert base.lines() == ["new key for agent 3"]
    assert base.takes(base.agent().seal(b"1"))


def test_the_right_to_change_maps_is_taken_while_the_base_runs(base: Base) -> None:
    assert base.seals.maps_key is None
    key = new_maps_key(base.path)
    assert base.lines() == []
    assert base.seals.maps_key == key


@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files away")
def test_a_file_of_keys_keeps_its_owner(base: Base) -> None:
    os.chown(base.path, 1234, 1235)
    key_store.pair(base.path, 4, new_code())
    status = base.path.stat()
    assert (status.st_uid, status.st_gid, status.st_mode & 0o777) == (1234, 1235, 0o600)


def test_a_base_for_paired_agents_alone_refuses_what_would_open_it_to_anyone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "keys"
    path.write_text("# nobody yet\n")
    path.chmod(0o600)
    with pytest.raises(LinkError, match="nobody has a key"):
        logins_of(path)
    new_maps_key(path)
    assert list(logins_of(path)) == [key_store.MAPS]
    with pytest.raises(SystemExit):
        main(["--paired-only", "--key", str(path), "--link", "zenoh:router/tcp/127.0.0.1:7447"])
    assert "router" in capsys.readouterr().err


@pytest.mark.parametrize("workers", [str(MOST_WORKERS + 1), "-1", "two", "9" * 5000])
def test_a_number_of_workers_that_no_machine_bears_is_refused(workers: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        options.parser().parse_args(["--workers", workers])
    assert f"expected 0 to {MOST_WORKERS}" in capsys.readouterr().err


@pytest.mark.parametrize("given", [["--down-bytes", "-1"], ["--log-mib", "-4"]])
def test_negative_limits_are_refused(given: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(given)
    assert f"{': '.join(given)}: expected 0" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("endpoint", "guarded"), [("tcp/0.0.0.0:7448", True), ("zenoh:tcp/10.0.0.4:7448", True), ("tcp/127.0.0.1:1", False)]
)
def test_an_open_endpoint_for_maps_takes_connections_of_the_paired_only(
    endpoint: str, guarded: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[dict[str, Any]] = []

    class Server:
        def __init__(self, service: str, **given: Any) -> None:
            opened.append(given)

        def close(self) -> None: ...

    monkeypatch.setattr(questions, "QueryServer", Server)
    with contextlib.ExitStack() as stack:
        questions.Questions(
            BaseOptions("", maps=endpoint),
            open_base_end("", LinkOptions()),
            stack,
            dict,
            lambda: None,
            {"maps": "secret"},
        )  # fmt: skip
    assert opened[0]["logins"] == ({"maps": "secret"} if guarded else None)
