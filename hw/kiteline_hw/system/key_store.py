"""Keys in a file readable by its owner only: per line an agent's number, or `maps`, and 64 hexadecimal digits.

The key of an agent seals its packets; that of `maps` gives the right to change maps. A pairing code is a key in sixteen
letters and digits (Crockford's base 32), for a person to type on the agent; keys are made of it by scrypt (RFC 7914).
"""

import contextlib
import fcntl
import hashlib
import os
import secrets
import stat
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from kiteline_core.ids import MAX_AGENTS
from kiteline_hw.durable_files import sync_folder
from kiteline_hw.ports import LinkError
from kiteline_hw.system.process import user_folder

KEY_BYTES = 32
MAPS = "maps"
_MAX_AGENT = MAX_AGENTS - 1
_HEAD = (
    "# kiteline keys: agent, secret. Give an agent its own line, the base station all lines; show them to nobody.\n"
    "# maps: the right to change maps.\n"
)
_DIGITS = "0123456789ABCDEFGHJKMNPQRSTVWXYZ"
_ALIKE = str.maketrans("OIL", "011")  # letters that are read as digits
_CODE_DIGITS = 16  # 75 random bits, and five that find a slip
_SCRYPT_COST = 1 << 15  # 32 MiB and a tenth of a second a guess


@dataclass(slots=True)
class Keys:
    """The content of a key file. maps: None if there is none."""

    agents: dict[int, bytes] = field(default_factory=dict)
    maps: bytes | None = None


def default_path() -> Path:
    """The default path of the key file. Raises KitelineError if the user has no home."""
    return user_folder("XDG_CONFIG_HOME", "~/.config") / "keys"


def read_keys(path: Path) -> dict[int, bytes]:
    """Keys of agents. Raises LinkError if the file is missing, malformed, or readable by others."""
    return read_file(path).agents


def read_file(path: Path) -> Keys:
    """All keys of a file. Raises LinkError if it is missing, malformed, or readable by others."""
    try:
        text = path.read_text(encoding="ascii")
        mode = path.stat().st_mode
    except (OSError, UnicodeDecodeError) as error:
        raise LinkError(
            f"cannot read keys from {path}: {getattr(error, 'strerror', None) or error}; `kiteline keys --file {path} "
            "pair N` makes the file"
        ) from error
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise LinkError(f"keys in {path} may be read by others (mode {mode & 0o777:o}): chmod 600 {path}")
    keys = Keys()
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#")[0].split()
        if not words:
            continue
        try:
            key = bytes.fromhex(words[1])
            if len(words) != 2 or len(key) != KEY_BYTES:
                raise ValueError
            if words[0] == MAPS and keys.maps is None:
                keys.maps = key
                continue
            agent = int(words[0])
            if not 0 <= agent <= _MAX_AGENT or agent in keys.agents:
                raise ValueError
        except (ValueError, IndexError):
            raise LinkError(
                f"{path}, line {number}: expected an agent's number (0 to {_MAX_AGENT}, each once), or {MAPS}, and "
                f"{2 * KEY_BYTES} hexadecimal digits"
            ) from None
        keys.agents[agent] = key
    return keys


def login_of(agent: int | str, key: bytes) -> dict[str, str]:
    """User and password of whoever has a key, for the connection itself. agent: its number, or `maps`."""
    user = str(agent)
    return {user: hashlib.blake2b(user.encode(), key=key, digest_size=32, person=b"kiteline-login").hexdigest()}


class WatchedKeys:
    """A file of keys that may change while it is used. Raises LinkError.

    held: what it held when it could last be read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._stamp = self._stamp_now()  # before it is read: what changes meanwhile is read again
        self.held = read_file(path)

    def take_change(self) -> bool:
        """Read the file if it was changed, or given to another owner or mode; whether it was. Raises LinkError, once a
        change.
        """
        stamp = self._stamp_now()
        if stamp == self._stamp:
            return False
        self._stamp = stamp
        self.held = read_file(self._path)
        return True

    def _stamp_now(self) -> tuple[int, int, int] | None:
        try:
            status = self._path.stat()
        except OSError:
            return None
        return status.st_ino, status.st_mtime_ns, status.st_ctime_ns


def first_keys(path: Path) -> bool:
    """Make a file with a key for each agent and for maps, unless there is one. Returns whether it was made."""
    with _changing(path):
        if path.exists():
            return False
        agents = {agent: secrets.token_bytes(KEY_BYTES) for agent in range(_MAX_AGENT + 1)}
        _write(path, Keys(agents, secrets.token_bytes(KEY_BYTES)))
        return True


def new_key(path: Path, agent: int, *, replace: bool = False) -> bytes:
    """Create a key for an agent and store it. Raises LinkError if it has one and `replace` is not set."""
    with _changing(path) as keys:
        if agent in keys.agents and not replace:
            raise LinkError(f"agent {agent} has a key in {path} already; --replace makes a new one")
        return _store(path, agent, secrets.token_bytes(KEY_BYTES), keys)


def new_maps_key(path: Path, *, replace: bool = False) -> bytes:
    """Create the key of the right to change maps. Raises LinkError if there is one and `replace` is not set."""
    with _changing(path) as keys:
        if keys.maps is not None and not replace:
            raise LinkError(f"{path} has a key for {MAPS} already; --replace makes a new one")
        keys.maps = secrets.token_bytes(KEY_BYTES)
        _write(path, keys)
        return keys.maps


def new_code() -> str:
    """A new pairing code."""
    digits = "".join(secrets.choice(_DIGITS) for _ in range(_CODE_DIGITS - 1))
    digits += _check_digit(digits)
    return "-".join(digits[i : i + 4] for i in range(0, _CODE_DIGITS, 4))


def pair(path: Path, agent: int, code: str) -> bytes:
    """Store the key of a pairing code as that of an agent, in place of an older one. Raises LinkError."""
    digits = code.upper().replace("-", "").replace(" ", "").translate(_ALIKE)
    if len(digits) != _CODE_DIGITS or set(digits) - set(_DIGITS) or _check_digit(digits[:-1]) != digits[-1]:
        raise LinkError(f"{code[:40]!r} is no pairing code: expected the 16 letters and digits that the base shows")
    key = hashlib.scrypt(
        digits.encode(), salt=f"kiteline-pair {agent}".encode(), n=_SCRYPT_COST, r=8, p=1,
        maxmem=2 * 128 * 8 * _SCRYPT_COST, dklen=KEY_BYTES,
    )  # fmt: skip
    with _changing(path) as keys:
        return _store(path, agent, key, keys)


def _check_digit(digits: str) -> str:
    """Of the digits before it: it finds 31 of 32 slips."""
    return _DIGITS[hashlib.blake2b(digits.encode()).digest()[0] & 31]


def _store(path: Path, agent: int, key: bytes, keys: Keys) -> bytes:
    if not 0 <= agent <= _MAX_AGENT:
        raise LinkError(f"agent number {agent}: expected 0 to {_MAX_AGENT}")
    keys.agents[agent] = key
    _write(path, keys)
    return key


@contextlib.contextmanager
def _changing(path: Path) -> Iterator[Keys]:
    """The keys of a file, none if there is none yet, which no other process changes meanwhile. Raises LinkError."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as error:
        raise _unwritable(path, error) from error
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        yield read_file(path) if path.exists() else Keys()
    finally:
        os.close(folder)


def _unwritable(path: Path, error: OSError) -> LinkError:
    return LinkError(f"cannot write keys to {path}: {error.strerror or error}; name another file")


def _write(path: Path, keys: Keys) -> None:
    """Replace the file atomically; it never exists with another mode or half written, and keeps its owner.

    Raises LinkError.
    """
    lines = [f"{agent} {keys.agents[agent].hex()}\n" for agent in sorted(keys.agents)]
    if keys.maps is not None:
        lines.append(f"{MAPS} {keys.maps.hex()}\n")
    new = path.with_name(path.name + ".new")
    try:
        new.unlink(missing_ok=True)
        fd = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(fd, "w", encoding="ascii") as out:
            out.write(_HEAD + "".join(lines))
            out.flush()
            _keep_owner(path, fd)
            os.fsync(out.fileno())
        os.replace(new, path)
        sync_folder(path.parent)  # agents are paired with these keys from now on
    except OSError as error:
        with contextlib.suppress(OSError):
            new.unlink(missing_ok=True)
        raise _unwritable(path, error) from error


def _keep_owner(path: Path, fd: int) -> None:
    """Give a new file the owner of the one that it replaces: root may change the keys of a service's user."""
    with contextlib.suppress(FileNotFoundError):
        old, new = path.stat(), os.fstat(fd)
        if (old.st_uid, old.st_gid) != (new.st_uid, new.st_gid):
            os.fchown(fd, old.st_uid, old.st_gid)
