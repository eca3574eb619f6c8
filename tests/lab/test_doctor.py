import importlib
from pathlib import Path

import pytest

from kiteline_hw.system import key_store
from kiteline_lab.tools import doctor
from kiteline_lab.tools.checks import keys
from kiteline_lab.tools.checks.check import DoctorCheck, Severity


def test_every_plain_dependency_is_checked() -> None:
    """The list in the code and the one that pip reads must not drift apart."""
    import re
    import tomllib

    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]

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


def test_the_cache_folder_must_be_writable(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    assert [f.severity for f in doctor.check_kernel_cache()] == [Severity.OK]
    (tmp_path / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "below"))  # nobody may write there, root included
    found = next(iter(doctor.check_kernel_cache()))
    assert found.severity is Severity.FAIL
    assert "NUMBA_CACHE_DIR" in found.remedy


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
