"""`kiteline install-units` and `kiteline uninstall-units`: agent and base as services of systemd."""

import argparse
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from kiteline_hw.durable_files import write_atomically
from kiteline_lab.units.unit_files import (
    ROLES,
    Place,
    UnitError,
    check_programs,
    installed_files,
    is_ours,
    shipped_folder,
)

USER = "kiteline"  # that the system's services run as; made by sysusers
_TIMEOUT_S = 1800.0  # s that a slow board may take to compile all kernels

Runner = Callable[[Sequence[str]], int]


def run_command(command: Sequence[str]) -> int:
    """Run a command of systemd; its exit status, 127 if it is not there."""
    try:
        return subprocess.run(command, check=False, timeout=_TIMEOUT_S).returncode
    except FileNotFoundError:
        return 127
    except subprocess.TimeoutExpired:
        return 124


def install(place: Place, roles: Sequence[str], programs: Path, force: bool, run: Runner | None) -> list[str]:
    """Write the files and have systemd read them; lines about what was done and what is to do.

    force: replace files that somebody changed. run: None: only write files, as into an image. Raises UnitError.
    """
    files = installed_files(place, roles, programs)
    changed = [str(path) for path in files if path.exists() and not is_ours(path)]
    if changed and not force:
        raise UnitError(
            f"changed by hand, and not replaced: {', '.join(changed)}; keep what you need in a drop-in "
            "(systemctl edit) or move them away; --force replaces them"
        )
    lines = [_write(path, text) for path, text in files.items()]
    if place.user:
        for folder in (place.state, place.cache):
            folder.mkdir(parents=True, exist_ok=True)
    if run is not None:
        lines += _activate(place, programs, run)
    for role in roles:
        settings = place.settings / f"{role}.env"
        if not settings.exists():
            lines.append(f"to do: cp {settings}.example {settings}, and say there what the {role} is to do")
        lines.append(f"to do: {_systemctl(place)} enable --now kiteline-{role}")
    return lines


def _activate(place: Place, programs: Path, run: Runner) -> list[str]:
    """Make the user and the folders, load rules and units, compile the kernels; lines about what failed."""
    commands: list[tuple[str, ...]] = []
    if not place.user:
        commands += [
            ("systemd-sysusers", "/etc/sysusers.d/kiteline.conf"),
            ("systemd-tmpfiles", "--create", "/etc/tmpfiles.d/kiteline.conf"),
            ("udevadm", "control", "--reload"),
            ("udevadm", "trigger", "--subsystem-match=tty"),
        ]
    commands += [(*_systemctl(place).split(), "daemon-reload")]
    lines = []
    for command in commands:
        status = run(command)
        if status != 0:
            missing = f"{command[0]} is not installed here" if status == 127 else f"exit status {status}"
            lines.append(f"failed: {' '.join(command)} ({missing})")
    print("compiling kernels; on a small board this takes minutes", file=sys.stderr, flush=True)
    as_user = () if place.user else ("runuser", "-u", USER, "--")
    variables = (f"NUMBA_CACHE_DIR={place.cache}", "OMP_NUM_THREADS=1")
    warming = (*as_user, "env", *variables, str(programs / "kiteline"), "doctor", "--warm")
    if run(warming) == 0:
        lines.append(f"compiled the kernels, in {place.cache}")
    else:
        lines.append(f"failed: {' '.join(warming)}: the first start compiles what is missing")
    return lines


def uninstall(place: Place, roles: Sequence[str], force: bool, run: Runner | None) -> list[str]:
    """Stop the services and remove what `install` wrote; settings, keys, maps and logs stay. Raises UnitError."""
    files = list(installed_files(place, ROLES, Path("/")))
    kept = [role for role in ROLES if role not in roles and (place.units / f"kiteline-{role}.service").exists()]
    if kept:  # the other service needs what both share
        files = [path for path in files if any(role in path.name for role in roles)]
    present = [path for path in files if path.exists()]
    changed = [str(path) for path in present if not is_ours(path)]
    if changed and not force:
        raise UnitError(f"changed by hand, and not removed: {', '.join(changed)}; --force removes them")
    lines = []
    units = [path.name for path in present if path.suffix == ".service"]
    if run is not None and units and run((*_systemctl(place).split(), "disable", "--now", *units)) != 0:
        lines.append(f"failed: {_systemctl(place)} disable --now {' '.join(units)}")
    for path in present:
        path.unlink()
        lines.append(f"removed {path}")
    if run is not None and present:
        run((*_systemctl(place).split(), "daemon-reload"))
        if not place.user and not kept:
            run(("udevadm", "control", "--reload"))
    stay = [str(path) for path in (place.settings, place.state) if path.exists()]
    if not place.user and (logs := place.path("/var/log/kiteline")).exists():
        stay.append(str(logs))
    if not present:
        lines.append("no units of kiteline are installed here")
    if stay:
        lines.append(f"kept: {', '.join(stay)}" + ("" if place.user else f", the user {USER}"))
    return lines


def _systemctl(place: Place) -> str:
    return "systemctl --user" if place.user else "systemctl"


def _write(path: Path, text: str) -> str:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, text.encode())
    path.chmod(0o644)
    return f"wrote {path}"


def parser(name: str) -> argparse.ArgumentParser:
    """The arguments of `kiteline install-units` and `uninstall-units`."""
    installs = name == "install-units"
    p = argparse.ArgumentParser(
        prog=f"kiteline {name}",
        description="Install agent and base as services of systemd, with their user, folders, udev rules and examples "
        "of their settings, and compile the kernels for them. Nothing is started; settings that exist are not touched."
        if installs
        else "Stop the services and remove what install-units wrote. Settings, keys, maps, logs and the user stay.",
    )
    p.add_argument("roles", metavar="ROLE", nargs="*", help="agent, base (default: both)")
    p.add_argument("--user", action="store_true", help="services of this user, without root; not to fly with")
    p.add_argument("--root", metavar="DIR", type=Path, default=None,
                   help="the file system is here, such as a mounted image: files only, nothing is run")  # fmt: skip
    p.add_argument("--force", action="store_true", help="also files that were changed by hand")
    return p


def _parsed(name: str, argv: list[str]) -> tuple[Place, list[str], bool, Runner | None]:
    p = parser(name)
    a = p.parse_args(argv)
    wrong = [role for role in a.roles if role not in ROLES]
    if wrong:
        p.error(f"no service {wrong[0]!r}: expected {' or '.join(ROLES)}")
    place = Place(a.user, Path("/") if a.root is None else a.root.resolve())
    if not a.user and a.root is None and os.geteuid() != 0:
        raise UnitError(f"services of the system are installed by root: sudo {shutil.which('kiteline') or 'kiteline'} "
                        f"{name}; or take --user")  # fmt: skip
    return place, a.roles or list(ROLES), a.force, run_command if a.root is None else None


def main(argv: list[str]) -> int:
    """Run `kiteline install-units`; exit status 1 if a step failed. Raises UnitError."""
    place, roles, force, run = _parsed("install-units", argv)
    shipped_folder()
    programs = Path(sys.executable).parent
    if run is not None and not place.user:
        check_programs(programs, Path(sys.executable))
    return _report(install(place, roles, programs, force, run))


def main_uninstall(argv: list[str]) -> int:
    """Run `kiteline uninstall-units`; exit status 1 if a step failed. Raises UnitError."""
    place, roles, force, run = _parsed("uninstall-units", argv)
    return _report(uninstall(place, roles, force, run))


def _report(lines: Sequence[str]) -> int:
    for line in lines:
        print(line)
    return 1 if any(line.startswith("failed") for line in lines) else 0
