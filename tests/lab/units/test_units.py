"""`kiteline install-units`: what it writes, what it refuses, and that nothing of the user's is removed."""

import re
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

import pytest

from kiteline_agent.runtime.options import parser as agent_parser
from kiteline_basestation.runtime.options import parser as base_parser
from kiteline_hw.cameras.live_options import parse
from kiteline_lab.units import install as units
from kiteline_lab.units.unit_files import Place, UnitError, check_programs, is_ours

PROGRAMS = Path("/srv/kiteline/bin")
SYSTEM = {
    "etc/systemd/system/kiteline-agent.service", "etc/systemd/system/kiteline-base.service",
    "etc/kiteline/agent.env.example", "etc/kiteline/base.env.example", "etc/udev/rules.d/60-kiteline.rules",
    "etc/sysusers.d/kiteline.conf", "etc/tmpfiles.d/kiteline.conf",
}  # fmt: skip


def files_below(root: Path) -> set[str]:
    return {str(path.relative_to(root)) for path in root.rglob("*") if path.is_file()}


class Commands:
    """Stands for systemd's commands: keeps what was run."""

    def __init__(self, **status: int) -> None:
        self.run: list[str] = []
        self._status = status

    def __call__(self, command: Sequence[str]) -> int:
        self.run.append(" ".join(command))
        return self._status.get(command[0].replace("-", "_"), 0)


def test_install_writes_the_files_with_the_path_of_the_program(tmp_path: Path) -> None:
    place, commands = Place(False, tmp_path), Commands()
    lines = units.install(place, ["agent", "base"], PROGRAMS, False, commands)
    assert files_below(tmp_path) == SYSTEM
    for name in ("agent", "base"):
        unit = (place.units / f"kiteline-{name}.service").read_text()
        assert "Environment=PATH=/srv/kiteline/bin:" in unit
        assert "/opt/kiteline" not in unit
    assert commands.run.index("systemd-sysusers /etc/sysusers.d/kiteline.conf") < commands.run.index(
        "systemd-tmpfiles --create /etc/tmpfiles.d/kiteline.conf"
    )
    warming = commands.run[-1]
    assert warming.startswith("runuser -u kiteline -- env NUMBA_CACHE_DIR=")
    assert warming.endswith("/srv/kiteline/bin/kiteline doctor --warm")
    assert any(line.startswith("to do: systemctl enable --now kiteline-agent") for line in lines)


def test_compiled_kernels_are_where_the_unit_looks_for_them() -> None:
    shipped = (Path(__file__).parents[3] / "systemd" / "kiteline-agent.service").read_text()
    assert f"NUMBA_CACHE_DIR={Place(False).cache} " in shipped


def test_installing_again_changes_nothing_and_settings_stay(tmp_path: Path) -> None:
    place = Place(False, tmp_path)
    units.install(place, ["agent"], PROGRAMS, False, None)
    settings = place.settings / "agent.env"
    settings.write_text("KITELINE_AGENT=flight.mcap\n")
    before = {name: (tmp_path / name).read_bytes() for name in files_below(tmp_path)}
    lines = units.install(place, ["agent"], PROGRAMS, False, None)
    assert {name: (tmp_path / name).read_bytes() for name in files_below(tmp_path)} == before
    assert not any("cp " in line for line in lines)


def test_a_unit_that_was_changed_by_hand_is_replaced_only_by_force(tmp_path: Path) -> None:
    place = Place(False, tmp_path)
    units.install(place, ["agent"], PROGRAMS, False, None)
    unit = place.units / "kiteline-agent.service"
    unit.write_text(unit.read_text().replace("Nice=-10", "Nice=-5"))
    for act in (
        lambda: units.install(place, ["agent"], PROGRAMS, False, None),
        lambda: units.uninstall(place, ["agent"], False, None),
    ):
        with pytest.raises(UnitError, match=r"changed by hand.*kiteline-agent\.service.*--force"):
            act()
    assert "Nice=-5" in unit.read_text()
    units.install(place, ["agent"], PROGRAMS, True, None)
    assert is_ours(unit)


def test_uninstall_removes_what_was_installed_and_nothing_else(tmp_path: Path) -> None:
    place, commands = Place(False, tmp_path), Commands()
    units.install(place, ["agent", "base"], PROGRAMS, False, None)
    own = {"etc/kiteline/agent.env", "etc/kiteline/agent.key", "var/lib/kiteline/agent0/boot",
           "var/log/kiteline/agent0/boot00001.mcap"}  # fmt: skip
    for name in own:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("1\n")
    lines = units.uninstall(place, ["agent", "base"], False, commands)
    assert files_below(tmp_path) == own
    assert commands.run[0] == "systemctl disable --now kiteline-agent.service kiteline-base.service"
    assert any(line.startswith("kept: ") and "/var/lib/kiteline" in line for line in lines)
    assert "no units of kiteline are installed here" in units.uninstall(place, ["agent"], False, commands)


def test_one_service_leaves_what_the_other_needs(tmp_path: Path) -> None:
    place = Place(False, tmp_path)
    units.install(place, ["agent", "base"], PROGRAMS, False, None)
    units.uninstall(place, ["agent"], False, None)
    assert files_below(tmp_path) == {name for name in SYSTEM if "agent" not in name}


def test_a_step_that_fails_is_told_and_the_others_are_done(tmp_path: Path) -> None:
    commands = Commands(udevadm=127, runuser=1)
    lines = units.install(Place(False, tmp_path), ["agent"], PROGRAMS, False, commands)
    failed = [line for line in lines if line.startswith("failed")]
    assert failed[0] == "failed: udevadm control --reload (udevadm is not installed here)"
    assert failed[-1].endswith("the first start compiles what is missing")
    assert "systemctl daemon-reload" in commands.run
    assert files_below(tmp_path) > {"etc/systemd/system/kiteline-agent.service"}


def test_a_users_units_name_the_users_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/ann")
    place, commands = Place(True, tmp_path), Commands()
    units.install(place, ["agent", "base"], PROGRAMS, False, commands)
    settings = "home/ann/.config/kiteline"
    assert files_below(tmp_path) == {
        "home/ann/.config/systemd/user/kiteline-agent.service", "home/ann/.config/systemd/user/kiteline-base.service",
        f"{settings}/agent.env.example", f"{settings}/base.env.example",
    }  # fmt: skip
    text = (tmp_path / settings / "agent.env.example").read_text()
    assert "--key /home/ann/.config/kiteline/agent.key --rig /home/ann/.local/state/kiteline/rig.toml" in text
    assert "chown" not in text
    assert commands.run[0] == "systemctl --user daemon-reload"
    assert commands.run[1].startswith("env NUMBA_CACHE_DIR=")
    assert not any(word in "".join(commands.run) for word in ("sysusers", "udevadm", "runuser"))


@pytest.mark.parametrize("role", ["agent", "base"])
def test_users_units_pass_systemds_checker(role: str, tmp_path: Path) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed here (Debian package systemd)")
    units.install(Place(True, tmp_path), [role], PROGRAMS, False, None)
    (unit,) = tmp_path.rglob("kiteline-*.service")
    command = ["systemd-analyze", "--user", "verify", "--man=no", str(unit)]
    with tempfile.TemporaryDirectory(dir="/tmp") as runtime:  # short: other units have sockets in it
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False,
                              env={"PATH": "/usr/bin:/bin", "XDG_RUNTIME_DIR": runtime})  # fmt: skip
    assert done.stdout + done.stderr == ""


def test_a_program_in_a_home_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "kiteline").write_text("#!/bin/sh\n")
    with pytest.raises(UnitError, match="holds no `kiteline` command"):
        check_programs(tmp_path, Path("/usr/bin/python3"))
    (tmp_path / "kiteline").chmod(0o755)
    check_programs(tmp_path, Path("/usr/bin/env"))
    with pytest.raises(UnitError, match=r"services cannot see.*/opt/kiteline.*pip wheel"):
        check_programs(tmp_path, Path("/home/ann/.venv/bin/python"))


def test_a_role_that_does_not_exist_is_named(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    with pytest.raises(SystemExit):
        units.main(["agnet", "--root", str(tmp_path)])
    assert "no service 'agnet': expected agent or base" in capsys.readouterr().err


def test_files_go_into_a_mounted_image(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert units.main(["--root", str(tmp_path)]) == 0
    assert files_below(tmp_path) == SYSTEM
    assert units.main_uninstall(["--root", str(tmp_path)]) == 0
    assert files_below(tmp_path) == set()
    assert "removed" in capsys.readouterr().out


@pytest.mark.parametrize("role", ["agent", "base"])
def test_the_sample_settings_are_arguments_of_the_program(role: str) -> None:
    text = (Path(__file__).parents[3] / "systemd" / f"{role}.env").read_text()
    (line,) = (line for line in text.splitlines() if line.startswith("KITELINE_"))
    assert not re.search(r"[\"'$\\]", line)  # systemd would take them out
    words = line.partition("=")[2].split()
    a = (agent_parser() if role == "agent" else base_parser()).parse_args(words)
    assert a.key.startswith("/etc/kiteline/")
    assert a.log_mib > 0
    if role == "agent":
        scheme, _, argument = a.source.partition(":")
        assert scheme == "v4l2"
        parse(scheme, argument)
    else:
        assert a.store.startswith("/var/lib/kiteline/")
        assert a.maps  # a sealed link answers no `kiteline maps`
