"""Agent and base as users start them: real clocks, systemd, signals, kills and restarts."""

import contextlib
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from urllib.request import urlopen

import pytest

from kiteline_basestation.store.checksums import StoreError
from kiteline_basestation.store.integrity import check
from kiteline_basestation.store.store import FILE, read
from kiteline_bench.harness.contract import check_contract
from kiteline_cli.main import main as kiteline
from kiteline_codec.schema import KeyframeHeader, record_log
from kiteline_core.frame import EncodedImage
from kiteline_core.ids import MAX_BOOTS, AgentId
from kiteline_hw.logs.mcap_log import LEFT, RIG, RIGHT, LogReader, LogWriter, read_frame
from kiteline_hw.logs.rig_json import rig_from_json
from kiteline_hw.system.key_store import new_key
from kiteline_hw.system.start_numbers import numbers_in
from kiteline_lab.flights.fly import fly
from kiteline_lab.flights.plan import Options
from kiteline_lab.flights.processes import free_endpoint
from kiteline_lab.replay.replay import main as replay

STOP_S = 2.0  # s in which a program told to stop has to be gone

Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Starts `kiteline …`; whatever still runs at the end is killed."""
    running: list[subprocess.Popen[str]] = []

    def begin(*words: object, **variables: str) -> subprocess.Popen[str]:
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(sys.path),
            "XDG_STATE_HOME": str(tmp_path),
            **variables,
        }
        program = subprocess.Popen(
            [sys.executable, "-m", "kiteline_cli", *map(str, words)],
            env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        running.append(program)
        return program

    yield begin
    for program in running:
        if program.poll() is None:
            program.kill()
        program.communicate()


def wait_for(what: str, ready: Callable[[], bool], timeout_s: float = 20.0) -> None:
    deadline_s = time.monotonic() + timeout_s
    while not ready():
        assert time.monotonic() < deadline_s, f"waited in vain for {what}"
        time.sleep(0.02)


def stop(program: subprocess.Popen[str], how: signal.Signals = signal.SIGTERM) -> str:
    """Ask a program to stop; it ends well and soon. Returns what it wrote to stderr."""
    program.send_signal(how)
    begin_s = time.monotonic()
    _, errors = program.communicate(timeout=10.0)
    assert time.monotonic() - begin_s < STOP_S
    assert program.returncode == 0, errors
    assert "Traceback" not in errors
    return errors


@pytest.mark.usefixtures("forked")
def test_flying_in_real_time(recording: Path, tmp_path: Path) -> None:
    slow = tmp_path / "slow.mcap"
    stretched(recording, slow, 4)  # meanwhile the base's workers load their modules, on the same cores
    begin_s = time.monotonic()
    report, outcome = fly(Options((str(slow),), tmp_path, realtime=True), quiet=True)
    assert time.monotonic() - begin_s > 5.8  # frames are paced by their stamps
    agent = report["agents"][0]
    assert agent["tracked"] + agent["dropped"] == 30
    assert agent["tracked"] >= 20
    assert report["base"]["digest_equal"] is True
    assert report["base"]["keyframes"] == agent["keyframes"]
    assert check_contract(tmp_path) == []
    assert not outcome.failed
    for half in ("agent0", "base"):
        assert replay([str(tmp_path / half / "log.mcap"), "--verify"]) == 0


def test_agent_and_base_meet_and_a_killed_base_resumes(recording: Path, tmp_path: Path, start: Start) -> None:
    endpoint, port = free_endpoint(), free_endpoint().rpartition(":")[2]
    store = tmp_path / "store" / FILE
    words = ("--workers", 1, "--link", f"zenoh:{endpoint}", "--store", store.parent, "--web", f"127.0.0.1:{port}")
    base = start("base", *words, "--log", tmp_path / "log")

    def seen() -> dict[str, int]:
        try:
            with urlopen(f"http://127.0.0.1:{port}/status.json", timeout=1.0) as page:
                agents = json.load(page)["agents"]
        except OSError:
            return {}
        return {n["label"]: n["value"] for n in agents[0]["counts"]} if agents else {}

    agent = start("agent", recording, "--link", f"zenoh:{endpoint}", "--log", tmp_path / "log")
    assert agent.wait(60.0) == 0  # a recording ends by itself, once the base has it all
    wait_for("the store", lambda: 3 <= heads(store) == seen().get("Keyframes"))
    keyframes = heads(store)
    base.kill()
    base.wait()
    again = start("base", *words, "--log", tmp_path / "log")
    wait_for("the next base to show what the last one knew", lambda: seen().get("Keyframes", 0) == keyframes)
    stop(again)
    logs = sorted((tmp_path / "log").glob("session*.mcap"))
    assert len(logs) == 2
    for log in logs:
        assert replay([str(log), "--verify"]) == 0
    assert heads(store) == keyframes  # a base that heard nothing forgets nothing


def heads(store: Path) -> int:
    """How many keyframes a store holds; none before it has its tables."""
    try:
        return sum(key.kind == KeyframeHeader.KIND for codes in read(store).agents.values() for key in codes.received)
    except StoreError:
        return 0


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGINT])
def test_a_base_without_agents_stops_on_a_signal(tmp_path: Path, start: Start, how: signal.Signals) -> None:
    base = start("base", "--link", f"zenoh:{free_endpoint()}", "--web", "127.0.0.1:0")
    assert base.stderr is not None
    assert base.stderr.readline().startswith("loading the base")
    assert "http://127.0.0.1" in base.stderr.readline()
    stop(base, how)


@pytest.mark.usefixtures("forked")
def test_the_tracking_loop_notifies_systemd_and_boots_are_counted(
    recording: Path, tmp_path: Path, start: Start
) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.settimeout(20.0)
        boots = []
        for _ in range(2):
            agent = start("agent", recording, "--log", tmp_path / "log", NOTIFY_SOCKET=str(tmp_path / "notify"))
            while (told := systemd.recv(64)).startswith((b"EXTEND_TIMEOUT_USEC=", b"STATUS=")):
                pass  # kernels are being compiled
            assert told == b"READY=1"
            assert systemd.recv(64) == b"WATCHDOG=1"
            said = stop(agent)
            assert said.startswith("flying ") and "over:" in said and "Traceback" not in said
            drain(systemd)
            newest = max((tmp_path / "log" / "agent0").glob("boot*.mcap"))
            with LogReader(newest) as log:
                boots.append(json.loads(log.metadata["spec"])["boot"])
                assert log.cut is None
        assert boots[1] == (boots[0] + 1) % MAX_BOOTS


def drain(s: socket.socket) -> None:
    """Throw away what has come in."""
    s.setblocking(False)
    with contextlib.suppress(BlockingIOError):
        while True:
            s.recv(64)
    s.settimeout(20.0)


@pytest.mark.usefixtures("forked")
def test_poses_go_to_a_flight_controller(recording: Path, start: Start) -> None:
    from kiteline_hw.sim.flight_controller import FlightController, UdpFlightController

    model = FlightController("ardupilot")
    with UdpFlightController(model) as controller:
        agent = start("agent", recording, "--mavlink", f"udp:127.0.0.1:{controller.port}")
        assert agent.wait(30.0) == 0
    assert len(model.accepted) >= 3  # of 30 frames: an agent on a busy machine drops most
    assert not model.dropped


@pytest.mark.usefixtures("forked")
def test_a_user_error_ends_in_one_line(recording: Path, tmp_path: Path, start: Start) -> None:
    config, source = tmp_path / "config.toml", str(recording)
    config.write_text("[agent]\nspeed = 3\n")
    cases = {
        ("agent", "nowhere.mcap"): "no such file",
        ("agent", source, "--link", "pigeon:1"): "unknown link",
        ("agent", source, "--mavlink", "udp:nowhere"): "flight controller",
        ("agent", source, "--config", str(config)): "unknown key",
        ("base", "--link", "zenoh:tcp/256.0.0.1:1"): "listen",
        ("base", "--link", "none", "--web", "here"): "address",
    }
    for words, told in cases.items():
        program = start(*words)
        _, error = program.communicate(timeout=60.0)
        assert program.returncode == 2, words
        assert re.fullmatch(r"(loading the base[^\n]*\n)?kiteline: error: [^\n]+\n", error), (words, error)
        assert told in error, words


@pytest.mark.usefixtures("forked")
def test_a_second_base_takes_over_with_a_copy_of_the_store_or_with_none(
    recording: Path, tmp_path: Path, start: Start
) -> None:
    """The agent goes on; what the new base has at the end is all that the agent has said, whatever it began with."""
    endpoint = free_endpoint()
    words = ("--link", f"zenoh:{endpoint}")
    slow = tmp_path / "slow.mcap"
    stretched(recording, slow, 4)
    for how in ("copy", "none"):
        first, second = tmp_path / how / "first", tmp_path / how / "second"
        base = start("base", *words, "--workers", 1, "--store", first, XDG_STATE_HOME=str(tmp_path / how / "one"))
        agent = start("agent", slow, *words, "--log", tmp_path / how / "log")
        wait_for("the first base to keep something", lambda first=first: heads(first / FILE) >= 2)  # type: ignore[misc]
        base.kill()
        base.wait()
        if how == "copy":
            shutil.copytree(first, second)
        held = heads(first / FILE)
        # Another machine: it knows nothing of the sessions of the first.
        again = start("base", *words, "--workers", 1, "--store", second, XDG_STATE_HOME=str(tmp_path / how / "two"))
        assert agent.wait(40.0) == 0
        (path,) = (tmp_path / how / "log" / "agent0").glob("boot*.mcap")
        with LogReader(path) as log:
            said = {record_log.read_record(m.blob())[1] for m in log.messages((record_log.TOPIC,))}
        made = sum(key.kind == KeyframeHeader.KIND for key in said)
        wait_for("all keyframes", lambda second=second, made=made: heads(second / FILE) == made)  # type: ignore[misc]
        stop(again)
        assert made > held >= 2
        kept = read(second)
        assert said <= kept.agents[AgentId(0)].received.keys()
        assert not check(kept).faults


def stretched(source: Path, out: Path, times: int) -> None:
    """The same recording, slower."""
    with LogReader(source) as log, LogWriter(out, {"made": "for tests"}) as writer:
        rig, imu = rig_from_json(next(log.messages((RIG,))).json())
        images: dict[int, list[EncodedImage]] = {}
        for message in log.messages((LEFT, RIGHT)):
            images.setdefault(message.t_ns, []).append(message.image())
        begin_ns = min(images)
        writer.rig(begin_ns, rig, imu)
        for t_ns, pair in sorted(images.items()):
            frame = read_frame(pair, begin_ns + times * (t_ns - begin_ns))
            writer.frame(frame)


@pytest.mark.usefixtures("forked")
def test_an_agent_whose_state_was_lost_is_heard_by_a_base_that_knows_later_starts(
    recording: Path, tmp_path: Path, start: Start
) -> None:
    keys, endpoint = tmp_path / "keys", free_endpoint()
    new_key(keys, 0)
    words = ("--link", f"zenoh:{endpoint}", "--key", keys)
    start("base", *words, "--workers", 1, "--store", tmp_path / "store")
    states = [tmp_path / "kept", tmp_path / "lost"]
    folders = [state / "kiteline" / "agent0" for state in states]
    numbers_in(folders[0]).next(1 << 20)
    held = 0
    for state in states:
        agent = start("agent", recording, *words, XDG_STATE_HOME=str(state))
        _, said = agent.communicate(timeout=60.0)
        assert agent.returncode == 0, said
        assert ("the base knows a later start" in said) == (state == states[1]), said
        wait_for("its keyframes", lambda held=held: heads(tmp_path / "store" / FILE) >= held + 3)  # type: ignore[misc]
        held = heads(tmp_path / "store" / FILE)
    assert numbers_in(folders[1]).next().order > numbers_in(folders[0]).next().order


@pytest.mark.usefixtures("forked")
def test_a_base_imports_logs_and_manages_maps(
    recording: Path, tmp_path: Path, start: Start, capsys: pytest.CaptureFixture[str]
) -> None:
    agent = start("agent", recording, "--log", tmp_path / "log")  # without a link
    assert agent.wait(30.0) == 0
    (log,) = (tmp_path / "log" / "agent0").glob("boot*.mcap")
    with LogReader(log) as read_log:
        spec = json.loads(read_log.metadata["spec"])
        name = f"0.{spec['boot']}.{spec['submap']}"
    endpoint = free_endpoint()
    words = ("--workers", 1, "--link", f"zenoh:{endpoint}", "--store", tmp_path / "store", "--log", tmp_path / "log")
    base = start("base", *words, "--import", log)

    def ask(*verb: str) -> tuple[int, str, str]:
        capsys.readouterr()
        status = kiteline(["maps", "--base", endpoint, *verb])
        return status, *capsys.readouterr()

    wait_for("the store", lambda: heads(tmp_path / "store" / FILE) >= 3)
    status, out, _ = ask("--json", "list")
    assert status == 0
    (told,) = json.loads(out)["maps"]
    assert (told["id"], told["placed"]) == (name, True)
    assert told["keyframes"] == heads(tmp_path / "store" / FILE)
    assert told["points"] > 50
    capsys.readouterr()
    assert kiteline(["status", "--base", endpoint, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["store"] == {"folder": str(tmp_path / "store"), "up_to_date": True}
    assert report["agents"][0]["counts"][0] == {"label": "Keyframes", "value": told["keyframes"], "unit": ""}
    assert ask("name", name, "wall")[0] == 0
    status, _, errors = ask("split", "wall")
    assert status == 1
    assert errors == f"kiteline maps: {name} was not merged into another map: there is nothing to be undone\n"
    stop(base)
    base = start("base", *words)
    status, out, _ = ask("list")
    assert status == 0
    assert "wall" in out
    assert ask("delete", "wall")[0] == 0
    stop(base)
    assert heads(tmp_path / "store" / FILE) == 0
    logs = sorted((tmp_path / "log").glob("session*.mcap"))
    assert len(logs) == 2
    for path in logs:
        assert replay([str(path), "--verify"]) == 0
    # The first base's log is a finished map as well.
    base = start("base", "--workers", 1, "--link", f"zenoh:{endpoint}", "--import", logs[0])
    status, out, _ = ask("--json", "list")
    assert json.loads(out)["maps"][0]["keyframes"] == told["keyframes"]
    stop(base)
