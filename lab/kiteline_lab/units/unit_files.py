"""The files of a service, as they are installed: where each goes, and what it holds. Reads the files that ship."""

import hashlib
import importlib.metadata
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from kiteline_core.errors import KitelineError

ROLES = ("agent", "base")
_SHIPPED_PROGRAMS = "/opt/kiteline/bin"  # in the shipped units: replaced by the folder of the installed program
_SEAL = "# Installed by `kiteline install-units`; digest "
_UNSEEN = ("/home", "/root", "/run/user")  # hidden from the services by ProtectHome=


class UnitError(KitelineError):
    """Units that cannot be installed or removed. The text says why."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where services live. user: those of one user, else of the system. root: of a file system, such as an image's."""

    user: bool
    root: Path = Path("/")

    def path(self, absolute: str | Path) -> Path:
        """A path of the installed system, as seen from here."""
        return self.root / Path(absolute).relative_to("/")

    @property
    def units(self) -> Path:
        return self._config / "systemd" / "user" if self.user else self.path("/etc/systemd/system")

    @property
    def settings(self) -> Path:
        """Folder of agent.env and base.env."""
        return self._config / "kiteline" if self.user else self.path("/etc/kiteline")

    @property
    def state(self) -> Path:
        return self._home / ".local/state/kiteline" if self.user else self.path("/var/lib/kiteline")

    @property
    def cache(self) -> Path:
        """Folder of compiled kernels: NUMBA_CACHE_DIR of the units."""
        return (self._home / ".cache/kiteline" if self.user else self.path("/var/cache/kiteline")) / "numba"

    @property
    def _home(self) -> Path:
        return self.path(Path.home())

    @property
    def _config(self) -> Path:
        return self._home / ".config"


def shipped_folder() -> Path:
    """The folder `systemd` of a checkout, or where pip put it. Raises UnitError."""
    checkout = Path(__file__).resolve().parents[3] / "systemd"
    if (checkout / "kiteline-agent.service").is_file():
        return checkout
    for file in importlib.metadata.files("kiteline") or ():
        if file.name == "kiteline-agent.service" and file.parent.name == "systemd":
            found = Path(str(file.locate())).resolve()
            if found.is_file():
                return found.parent
    raise UnitError("the units are not part of this installation: install the wheel that `pip wheel --no-deps .` makes")


def installed_files(place: Place, roles: Sequence[str], programs: Path) -> dict[Path, str]:
    """Text of each file by its path. programs: the folder of the `kiteline` command. Raises UnitError."""
    shipped = shipped_folder()
    names: dict[Path, Path] = {}
    for role in roles:
        unit = f"kiteline-{role}.service"
        names[place.units / unit] = shipped / "user" / unit if place.user else shipped / unit
        names[place.settings / f"{role}.env.example"] = shipped / f"{role}.env"
    if not place.user:
        names[place.path("/etc/udev/rules.d/60-kiteline.rules")] = shipped / "60-kiteline.rules"
        names[place.path("/etc/sysusers.d/kiteline.conf")] = shipped / "kiteline.sysusers.conf"
        names[place.path("/etc/tmpfiles.d/kiteline.conf")] = shipped / "kiteline.tmpfiles.conf"
    return {to: sealed(_adapted(source.read_text(), place, programs)) for to, source in names.items()}


def _adapted(text: str, place: Place, programs: Path) -> str:
    """The text with the paths of this installation."""
    text = text.replace(_SHIPPED_PROGRAMS, str(programs))
    if place.user:
        text = re.sub(r"chown kiteline: \S+; ", "", text)
        for system, own in (("/var/lib/kiteline", place.state), ("/var/log/kiteline", place.state / "logs"),
                            ("/etc/kiteline", place.settings)):  # fmt: skip
            text = text.replace(system, "/" + str(own.relative_to(place.root)))
    return text


def sealed(text: str) -> str:
    """The text below a line that shows later whether somebody changed it."""
    return f"{_SEAL}{_digest(text)}\n{text}"


def is_ours(path: Path) -> bool:
    """True if a file is as `install-units` wrote it, of this version or another."""
    try:
        head, _, text = path.read_text().partition("\n")
    except (OSError, UnicodeDecodeError):
        return False
    return head == f"{_SEAL}{_digest(text)}"


def _digest(text: str) -> str:
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def check_programs(programs: Path, interpreter: Path) -> None:
    """Check that a service of the system can run the program. Raises UnitError.

    programs: the folder of the `kiteline` command. interpreter: that runs it.
    """
    if not os.access(programs / "kiteline", os.X_OK):
        raise UnitError(
            f"{programs} holds no `kiteline` command: run install-units from an installation, such as "
            "/opt/kiteline/bin/kiteline install-units"
        )
    for path in (programs, interpreter.resolve()):
        if any(path.is_relative_to(unseen) for unseen in _UNSEEN):
            raise UnitError(
                f"{path} is in a home folder, which services cannot see: install kiteline where they can, with "
                "python3 -m venv /opt/kiteline; /opt/kiteline/bin/pip install ./kiteline-*.whl, "
                "which `pip wheel --no-deps .` makes in a checkout; or take --user"
            )
