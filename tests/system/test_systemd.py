"""The units pass systemd's own checkers; a missing checker skips only its test."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "systemd"
UNITS = ("kiteline-agent.service", "kiteline-base.service")
WORST_SCORE = {"kiteline-agent.service": 2.0, "kiteline-base.service": 1.6}  # of 10; the agent needs cameras and ports
UDEV_TOKEN = re.compile(r'^[A-Z_]+(\{[^}]+\})?(==|!=|\+=|:=|=)"[^"]*"$')


def tool(name: str) -> str:
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"{name} is not installed here (Debian package systemd)")
    return found


def run(*command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def settings(unit: str) -> dict[str, list[str]]:
    out: dict[str, list[str]] = {}
    for line in (FOLDER / unit).read_text().splitlines():
        if "=" in line and not line.startswith("#"):
            key, _, value = line.partition("=")
            out.setdefault(key, []).append(value)
    return out


@pytest.mark.parametrize("unit", UNITS)
def test_verify_prints_nothing(unit: str) -> None:
    """An unknown key is only a warning to systemd: the text must be empty, the status says too little."""
    done = run(tool("systemd-analyze"), "verify", "--man=no", str(FOLDER / unit))
    assert done.stdout + done.stderr == ""
    assert done.returncode == 0


def test_verify_rejects_a_wrong_key(tmp_path: Path) -> None:
    wrong = tmp_path / UNITS[0]
    wrong.write_text((FOLDER / UNITS[0]).read_text().replace("WatchdogSec=", "WatchdogSecs="))
    done = run(tool("systemd-analyze"), "verify", "--man=no", str(wrong))
    assert "WatchdogSecs" in done.stdout + done.stderr


@pytest.mark.parametrize("unit", UNITS)
def test_exposure_stays_low(unit: str) -> None:
    done = run(tool("systemd-analyze"), "security", "--offline=true", "--no-pager", str(FOLDER / unit))
    score = re.search(r"Overall exposure level for \S+: ([\d.]+)", done.stdout)
    assert score is not None, done.stdout + done.stderr
    assert float(score[1]) <= WORST_SCORE[unit]


@pytest.mark.parametrize("unit", UNITS)
def test_settings_needed_in_flight(unit: str) -> None:
    s = settings(unit)
    assert s["Type"] == ["notify"]
    assert s["Restart"] == ["always"]
    assert s["StartLimitIntervalSec"] == ["0"]  # restarted for ever, not five times
    assert "WatchdogSec" in s
    assert "MemoryDenyWriteExecute" not in s  # numba compiles into memory
    cache = next(w for line in s["Environment"] for w in line.split() if w.startswith("NUMBA_CACHE_DIR="))
    assert cache.startswith(
        f"NUMBA_CACHE_DIR=/var/cache/{s['CacheDirectory'][0]}/"
    )  # else ProtectSystem=strict bars it


@pytest.mark.parametrize("name", ["agent", "base"])
def test_the_sample_settings_set_the_variable_of_the_unit(name: str) -> None:
    exec_start = settings(f"kiteline-{name}.service")["ExecStart"][0]
    variable = exec_start.rsplit("$", 1)[1]
    assert f"\n{variable}=" in (FOLDER / f"{name}.env").read_text()
    assert settings(f"kiteline-{name}.service")["EnvironmentFile"] == [f"/etc/kiteline/{name}.env"]


def test_sysusers_creates_the_user_of_the_units(tmp_path: Path) -> None:
    (tmp_path / "etc").mkdir()
    done = run(tool("systemd-sysusers"), f"--root={tmp_path}", str(FOLDER / "kiteline.sysusers.conf"))
    assert done.returncode == 0, done.stderr
    assert re.search(r"^kiteline:", (tmp_path / "etc" / "passwd").read_text(), re.MULTILINE)
    groups = (tmp_path / "etc" / "group").read_text()
    assert re.search(r"^dialout:.*:kiteline$", groups, re.MULTILINE)
    assert all(settings(unit)["User"] == ["kiteline"] for unit in UNITS)


def test_tmpfiles_creates_the_folders(tmp_path: Path) -> None:
    (tmp_path / "etc").mkdir()
    me, mine = os.getuid(), os.getgid()  # so that the test needs no root
    (tmp_path / "etc" / "passwd").write_text("".join(f"{n}:x:{me}:{mine}::/:/bin/sh\n" for n in ("root", "kiteline")))
    (tmp_path / "etc" / "group").write_text("".join(f"{n}:x:{mine}:\n" for n in ("root", "kiteline")))
    done = run(tool("systemd-tmpfiles"), "--create", f"--root={tmp_path}", str(FOLDER / "kiteline.tmpfiles.conf"))
    assert done.returncode == 0, done.stderr
    for folder in ("etc/kiteline", "var/lib/kiteline", "var/cache/kiteline", "var/log/kiteline"):
        assert (tmp_path / folder).is_dir()


def test_nothing_is_deleted_by_age() -> None:
    """Numbers of starts, keys, maps and logs are not temporary: no line has an age, nor a type that removes."""
    lines = [line.split() for line in (FOLDER / "kiteline.tmpfiles.conf").read_text().splitlines()]
    entries = [words for words in lines if words and not words[0].startswith("#")]
    assert len(entries) == 4
    assert all(words[0] == "d" and words[5] == "-" for words in entries)


@pytest.mark.parametrize("unit", UNITS)
def test_memory_is_limited(unit: str) -> None:
    s = settings(unit)
    assert "MemoryMax" in s
    assert unit != "kiteline-agent.service" or s["MemorySwapMax"] == ["0"]


def test_udev_rules_are_well_formed() -> None:
    """udevadm verify is younger than Debian 12: check the grammar by hand, and that every jump has its label."""
    text = (FOLDER / "60-kiteline.rules").read_text()
    rules = [line for line in text.splitlines() if line and not line.startswith("#")]
    for rule in rules:
        for token in rule.split(", "):
            assert UDEV_TOKEN.match(token), f"{token!r} in {rule!r}"
    assert set(re.findall(r'GOTO="(\w+)"', text)) == set(re.findall(r'LABEL="(\w+)"', text))
    assert 'SYMLINK+="kiteline-fc"' in text
