"""`kiteline doctor` on a computer in a vehicle, and with a modelled flight controller behind a real socket."""

import json
import shutil
import socket
import threading
import time
from pathlib import Path

import pytest

from kiteline_hw.mavlink.codec import MavlinkCodec
from kiteline_hw.mavlink.transport.signing import Signing, StampFile, read_key
from kiteline_hw.sim.autopilot import ModelledAutopilot
from kiteline_hw.system import clock
from kiteline_lab.tools import doctor
from kiteline_lab.tools.checks import vehicle
from kiteline_lab.tools.checks.check import Severity

HURRY = 4  # how much faster than real time a survey's clock runs


class HurriedClock:
    """Real time, but faster: a survey listens for seconds."""

    def now_ns(self) -> int:
        return HURRY * time.monotonic_ns()


@pytest.fixture(autouse=True)
def hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clock, "MonotonicClock", HurriedClock)


def ask(model: ModelledAutopilot, *options: str) -> int:
    """`kiteline doctor` with a model behind a socket; the exit status."""
    over = threading.Event()
    with socket.socket(type=socket.SOCK_DGRAM) as s:
        s.bind(("127.0.0.1", 0))
        s.settimeout(0.002)

        def serve() -> None:
            peer = None
            while not over.is_set():
                try:
                    data, peer = s.recvfrom(2048)
                except TimeoutError:
                    data = b""
                now_ns = HurriedClock().now_ns()
                for answer in model.receive(data, now_ns) + model.poll(now_ns):
                    if peer is not None:
                        s.sendto(answer, peer)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            return doctor.main(["--mavlink", f"udp:127.0.0.1:{s.getsockname()[1]}", *options])
        finally:
            over.set()
            thread.join()


def test_the_flight_controller_is_checked_and_printed_as_json(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor, "CHECKS", ())
    assert ask(ModelledAutopilot("ardupilot", parameters={"VISO_TYPE": 0}), "--json") == 1
    told = json.loads(capsys.readouterr().out)
    assert told["failed"] is True
    by_name = {check["name"]: check for check in told["checks"]}
    assert by_name["VISO_TYPE"]["severity"] == "fail" and by_name["VISO_TYPE"]["remedy"] == "set VISO_TYPE to 3"
    assert "ArduPilot 4.6.3" in by_name["heartbeat"]["text"]
    assert {"streams", "timesync", "forwarding", "radio"} <= set(by_name)


def test_a_controller_that_signs_needs_the_key(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(doctor, "CHECKS", ())
    (tmp_path / "key").write_text("a pass phrase")
    model = ModelledAutopilot("px4", system=4)
    signing = Signing(read_key(tmp_path / "key"), StampFile(tmp_path / "stamp"))
    model.codec = MavlinkCodec(4, 1, signing)
    assert ask(model) == 1
    without = capsys.readouterr().out
    assert "signs its messages, and will refuse ours" in without and "no parameter was told" in without
    assert ask(model, "--mavlink-key", str(tmp_path / "key")) == 0
    assert "9 are as kiteline needs them" in capsys.readouterr().out


def test_power_of_a_raspberry_pi(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    file = tmp_path / "get_throttled"
    monkeypatch.setattr(vehicle, "THROTTLED", (file,))
    assert list(vehicle.check_power()) == []
    for bits, severity, text in (
        ("0", Severity.OK, "no under-voltage"),
        ("50000", Severity.NOTE, "since the start: under-voltage, throttled"),
        ("50005", Severity.FAIL, "now: under-voltage, throttled"),
    ):
        file.write_text(bits + "\n")
        (found,) = vehicle.check_power()
        assert found.severity is severity and text in found.text


def test_temperature(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(vehicle, "THERMAL", tmp_path)
    assert list(vehicle.check_temperature()) == []
    zones = [tmp_path / f"thermal_zone{i}" / "temp" for i in range(3)]
    for zone, text in zip(zones, ("45000", "-273000", "nothing"), strict=True):
        zone.parent.mkdir()
        zone.write_text(text)
    (found,) = vehicle.check_temperature()
    assert found.severity is Severity.OK and found.text == "45 degrees"
    for milli, severity in (("72000", Severity.NOTE), ("83000", Severity.FAIL)):
        zones[1].write_text(milli)
        assert [f.severity for f in vehicle.check_temperature()] == [severity]


def test_disk(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "not" / "there"))
    (found,) = vehicle.check_disk()
    assert str(tmp_path) in found.text
    monkeypatch.setattr(shutil, "disk_usage", lambda place: type("Usage", (), {"free": 100 * 2**20}))
    (found,) = vehicle.check_disk()
    assert found.severity is Severity.FAIL and found.text.startswith("100 MiB free")


def test_time(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(vehicle, "TIMESYNCD", tmp_path)
    monkeypatch.setattr(vehicle, "SYNCHRONISED", tmp_path / "synchronized")
    monkeypatch.setattr(vehicle, "CLOCK_DEVICES", tmp_path / "rtc")
    (found,) = vehicle.check_time()
    assert found.severity is Severity.NOTE and "not synchronised, and there is none" in found.text
    (tmp_path / "synchronized").touch()
    (found,) = vehicle.check_time()
    assert found.severity is Severity.OK
