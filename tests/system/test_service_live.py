"""Agent and base as systemd runs them: ready in time, stopped within a second, numbers and logs kept."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from kiteline_core.ids import MAX_BOOTS
from kiteline_hw.logs.mcap_log import LEFT, RIG, RIGHT, LogReader, LogWriter
from kiteline_hw.logs.rig_json import rig_from_json
from kiteline_lab.flights.fly import fly
from kiteline_lab.flights.plan import Options
from kiteline_lab.flights.processes import free_endpoint

STOP_S = 1.0  # s from SIGTERM to the end, the log closed

Serve = Callable[..., tuple["subprocess.Popen[bytes]", socket.socket]]


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Serve]:
    """Starts `kiteline …` with the environment of a service; returns it and the socket of its notifications."""
    with contextlib.ExitStack() as stack:

        def begin(*words: object) -> tuple[subprocess.Popen[bytes], socket.socket]:
            told = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
            address = tmp_path / f"notify{time.monotonic_ns()}"
            told.bind(str(address))
            told.settimeout(60.0)
            variables = {"NOTIFY_SOCKET": str(address), "STATE_DIRECTORY": str(tmp_path / "state"),
                         "WATCHDOG_USEC": "5000000", "PYTHONPATH": os.pathsep.join(sys.path)}  # fmt: skip
            program = subprocess.Popen(
                [sys.executable, "-m", "kiteline_cli", *map(str, words)], env={**os.environ, **variables},
                stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
            )  # fmt: skip
            stack.callback(program.stderr.close)  # type: ignore[union-attr]
            stack.callback(program.wait)
            stack.callback(program.kill)
            return program, told

        yield begin


def until(told: socket.socket, word: str) -> list[str]:
    """All notifications up to one that holds a word."""
    lines: list[str] = []
    while not any(word in line for line in lines):
        lines += told.recv(4096).decode().splitlines()
    return lines


def stop_in_s(program: subprocess.Popen[bytes]) -> float:
    program.send_signal(signal.SIGTERM)
    begin_s = time.monotonic()
    program.wait(timeout=20)
    return time.monotonic() - begin_s


@pytest.fixture(scope="module")
def raw_flight(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording stretched to 5 frames a second: long enough to be stopped in its middle."""
    path = tmp_path_factory.mktemp("slow") / "slow.mcap"
    with LogReader(recording) as log, LogWriter(path, {"made": "for tests"}) as out:
        rig, imu = rig_from_json(next(iter(log.messages((RIG,)))).json())
        out.rig(0, rig, imu)
        for k, (left, right) in enumerate(zip(log.messages((LEFT,)), log.messages((RIGHT,)))):
            for topic, message in ((LEFT, left), (RIGHT, right)):
                out.image(topic, k * 200_000_000, message.image(), "left" if topic == LEFT else "right")
    return path


@pytest.mark.alone
def test_an_agent_stops_within_a_second_and_closes_its_log(serve: Serve, raw_flight: Path, tmp_path: Path) -> None:
    program, told = serve("agent", raw_flight, "--log", tmp_path / "logs")
    until(told, "READY=1")
    until(told, "WATCHDOG=1")
    program.send_signal(signal.SIGHUP)  # its terminal closed: no reason to stop
    time.sleep(1.5)
    assert stop_in_s(program) < STOP_S
    assert program.returncode == 0
    (path,) = (tmp_path / "logs" / "agent0").glob("boot*.mcap")
    with LogReader(path) as log:
        assert log.cut is None
        assert sum(1 for _ in log.messages((LEFT,))) >= 3


def test_an_agent_whose_terminal_is_held_flies_on_and_stops(raw_flight: Path, tmp_path: Path) -> None:
    """Ctrl-S holds it until Ctrl-Q; so does a pipe that nobody reads."""
    end, terminal = os.openpty()
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "XDG_STATE_HOME": str(tmp_path)}
    command = [sys.executable, "-m", "kiteline_cli", "agent", str(raw_flight), "--log", str(tmp_path / "logs")]
    with subprocess.Popen(command, env=environment, stdin=subprocess.DEVNULL, stderr=terminal) as program:
        try:
            said = b""
            while b"flying" not in said:
                said += os.read(end, 4096)
            termios.tcflow(terminal, termios.TCOOFF)
            (path,) = (tmp_path / "logs" / "agent0").glob("boot*.live.tum")
            deadline_s = time.monotonic() + 20.0
            while path.read_text().count("\n") < 10:  # which lines follow: a submap is opened, a first pose is found
                assert time.monotonic() < deadline_s
                time.sleep(0.05)
            assert stop_in_s(program) < STOP_S
            assert program.returncode == 0
        finally:
            program.kill()
    for one in (end, terminal):
        os.close(one)


@pytest.mark.usefixtures("forked")
def test_the_number_of_a_start_outlives_the_logs(serve: Serve, recording: Path, tmp_path: Path) -> None:
    logs = tmp_path / "logs" / "agent0"
    found = []
    for _ in range(2):
        program, _ = serve("agent", recording, "--log", tmp_path / "logs")
        program.wait(timeout=100)
        (path,) = logs.glob("boot*.mcap")
        with LogReader(path) as log:
            spec = json.loads(log.metadata["spec"])
        assert path.name == f"boot{spec['order']:05d}.mcap"
        found.append((spec["order"], spec["boot"]))
        for path in logs.iterdir():
            path.unlink()
    assert found[1] == (found[0][0] + 1, (found[0][1] + 1) % MAX_BOOTS)


@pytest.mark.usefixtures("forked")
def test_a_log_is_newer_than_those_before_it_where_the_number_was_lost(
    serve: Serve, recording: Path, tmp_path: Path
) -> None:
    logs = tmp_path / "logs" / "agent0"
    logs.mkdir(parents=True)
    for name in ("boot98765.mcap", "boot98766_2.mcap", "bootlegs.mcap", "boot98767.live.tum"):
        (logs / name).write_bytes(b"")
    program, _ = serve("agent", recording, "--log", tmp_path / "logs")
    program.wait(timeout=100)
    assert (logs / "boot98767.mcap").exists()


@pytest.mark.usefixtures("forked")
def test_a_start_that_fails_takes_no_number(serve: Serve, recording: Path, tmp_path: Path) -> None:
    for words in (("no-such-recording.mcap",), (recording, "--link", "zenoh:tcp/127.0.0.1:7", "--key", "no-key")):
        program, _ = serve("agent", *words)
        assert program.wait(timeout=100) != 0
    assert not (tmp_path / "state" / "agent0").exists()


@pytest.mark.usefixtures("forked")
def test_logs_of_all_starts_stay_within_their_limit(serve: Serve, recording: Path, tmp_path: Path) -> None:
    logs = tmp_path / "logs" / "agent0"
    for _ in range(2):
        program, _ = serve("agent", recording, "--log", tmp_path / "logs", "--log-mib", "1")
        assert program.stderr is not None
        said = program.stderr.read().decode()
        assert said.count("the oldest logs are deleted: --log-mib 1") == 1  # the recording's images are larger
        files = sorted(logs.glob("boot*.mcap"), key=lambda path: path.stat().st_mtime_ns)
        assert "_" in files[-1].name
        assert sum(path.stat().st_size for path in files) < 1.3 * 2**20
        for path in files:
            with LogReader(path) as log:
                assert log.cut is None


@pytest.mark.alone
def test_a_base_is_ready_before_it_imports_and_can_be_stopped_meanwhile(
    serve: Serve, recording: Path, tmp_path: Path
) -> None:
    fly(Options((str(recording),), tmp_path / "out", "local"), quiet=True)
    log = tmp_path / "out" / "base" / "log.mcap"
    words = ("base", "--link", f"zenoh:{free_endpoint()}", "--store", tmp_path / "maps", "--import", *[log] * 40)
    program, told = serve(*words)
    lines = until(told, "STATUS=reading the map")
    assert "READY=1" in lines
    assert lines[-2:] == ["STATUS=reading the map", "WATCHDOG_USEC=3600000000"]
    program.send_signal(signal.SIGHUP)  # its terminal closed: no reason to stop
    time.sleep(0.2)
    assert program.poll() is None
    assert stop_in_s(program) < STOP_S
    assert program.returncode == 0


def test_a_compilation_that_is_stopped_ends(serve: Serve, recording: Path, tmp_path: Path) -> None:
    """Without a cache the first start compiles: it asks for time, and SIGTERM ends it."""
    os.environ["NUMBA_CACHE_DIR"], before = str(tmp_path / "cache"), os.environ.get("NUMBA_CACHE_DIR")
    try:
        program, told = serve("agent", recording)
    finally:
        os.environ.pop("NUMBA_CACHE_DIR")
        if before is not None:
            os.environ["NUMBA_CACHE_DIR"] = before
    until(told, "EXTEND_TIMEOUT_USEC=")
    time.sleep(1.0)
    assert stop_in_s(program) < STOP_S
    assert program.returncode == 0
