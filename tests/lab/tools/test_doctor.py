"""The checks of kiteline doctor: this machine, a computer in a vehicle, and a flight controller."""

import importlib
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
from kiteline_hw.system import clock, kernel_cache, key_store
from kiteline_lab.tools import doctor
from kiteline_lab.tools.checks import keys, vehicle
from kiteline_lab.tools.checks.check import DoctorCheck, Severity


def test_every_plain_dependency_is_checked() -> None:
    """The list in the code and the one that pip reads must not drift apart."""
    import re
    import tomllib

    project = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text())["project"]

    def names(specs: list[str]) -> set[str]:
        return {re.split(r"[<>=!~\[ ]", s)[0] for s in specs}

    assert set(doctor.PLAIN) == names(project["dependencies"])
    for extra, packages in doctor.EXTRAS.items():
        assert set(packages) == names(project["optional-dependencies"][extra])


@pytest.mark.parametrize("module", doctor.WARMING)
def test_every_room_that_has_kernels_is_warmed(module: str) -> None:
    assert callable(importlib.import_module(module).warm)


def test_this_machine_can_run_the_tests_so_python_and_packages_are_fine() -> None:
    assert [f.severity for f in doctor.check_python()] == [Severity.OK]
    assert next(iter(doctor.check_packages())).severity is Severity.OK


def test_a_package_that_does_not_load_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(doctor.PLAIN, "numpy", "no_such_module_here")
    found = next(iter(doctor.check_packages()))
    assert found.severity is Severity.FAIL
    assert "numpy (No module named 'no_such_module_here')" in found.text
    assert found.remedy == "pip install --force-reinstall numpy"  # no registry has kiteline itself


def test_the_cache_folder_must_be_writable(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    (empty,) = doctor.check_kernel_cache()
    assert empty.severity is Severity.NOTE and empty.remedy == "kiteline doctor --warm"
    (tmp_path / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "below"))  # nobody may write there, root included
    found = next(iter(doctor.check_kernel_cache()))
    assert found.severity is Severity.FAIL
    assert "NUMBA_CACHE_DIR" in found.remedy


def test_a_filled_cache_is_told_from_one_of_another_version(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    name = "kiteline_core.geometry.se3"  # any module
    line = kernel_cache._line(name, kernel_cache._versions())
    record = tmp_path / "some" / "kiteline-compiled"
    record.parent.mkdir()
    record.write_text(f"{line}\nkiteline_core.that_is_gone 1 2 3\n")
    (filled,) = doctor.check_kernel_cache()
    assert filled.severity is Severity.OK and "kernels are compiled" in filled.text
    record.write_text(line.replace(line.split()[1], "1") + "\n")
    (other,) = doctor.check_kernel_cache()
    assert other.severity is Severity.NOTE


def test_keys_that_others_may_read_fail_with_the_mend(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.setattr(keys, "OF_SERVICES", ())
    (none,) = keys.check_keys()
    assert none.severity is Severity.NOTE and "kiteline keys pair" in none.remedy
    key_store.pair(key_store.default_path(), 3, key_store.new_code())
    (good,) = keys.check_keys()
    assert good.severity is Severity.OK and good.text.endswith("of agent 3")
    key_store.default_path().chmod(0o640)
    (bad,) = keys.check_keys()
    assert bad.severity is Severity.FAIL and "chmod 600" in bad.text
    assert keys.check_keys in doctor.CHECKS


def test_serial_ports_are_found_by_pattern(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(doctor, "SERIAL_PORTS", (str(tmp_path / "ttyUSB*"),))
    assert [f.severity for f in doctor.check_serial()] == [Severity.NOTE]
    (tmp_path / "ttyUSB0").touch()
    found = list(doctor.check_serial())
    assert found[0] == DoctorCheck(Severity.OK, "serial", str(tmp_path / "ttyUSB0"))
    assert "doctor --mavlink" in found[1].remedy


def test_exit_status_is_1_if_a_check_fails(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def good() -> list[DoctorCheck]:
        return [DoctorCheck(Severity.OK, "one", "fine")]

    def bad() -> list[DoctorCheck]:
        return [DoctorCheck(Severity.FAIL, "two", "broken", "mend it so")]

    def breaks() -> list[DoctorCheck]:
        raise RuntimeError("odd machine")

    monkeypatch.setattr(doctor, "CHECKS", (good, breaks))
    assert doctor.main([]) == 0
    assert "could not be checked: odd machine" in capsys.readouterr().out
    monkeypatch.setattr(doctor, "CHECKS", (good, bad))
    assert doctor.main([]) == 1
    assert "-> mend it so" in capsys.readouterr().out


def test_zenoh_opens_on_this_machine() -> None:
    assert [f.severity for f in doctor.check_zenoh()] == [Severity.OK]


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
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "ttyUSB0").touch()
    monkeypatch.setattr(doctor, "SERIAL_PORTS", (str(tmp_path / "ttyUSB*"),))
    monkeypatch.setattr(doctor, "CHECKS", (doctor.check_serial,))
    assert ask(ModelledAutopilot("ardupilot", parameters={"VISO_TYPE": 0}), "--json") == 1
    told = json.loads(capsys.readouterr().out)
    assert told["failed"] is True
    by_name = {check["name"]: check for check in told["checks"]}
    assert by_name["VISO_TYPE"]["severity"] == "fail" and by_name["VISO_TYPE"]["remedy"] == "set VISO_TYPE to 3"
    assert "ArduPilot 4.6.3" in by_name["heartbeat"]["text"]
    assert {"serial", "streams", "timesync", "forwarding", "radio"} <= set(by_name)
    assert "flight controller" not in by_name  # "not asked here"


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


def test_a_port_that_is_missing_is_not_said_to_be_tried_again(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(doctor, "CHECKS", ())
    assert doctor.main(["--mavlink", f"serial:{tmp_path / 'none'}:921600"]) == 1
    told = capsys.readouterr().out
    assert "the device is missing" in told and "group dialout" in told and "tried" not in told


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
