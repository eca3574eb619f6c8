"""Keys of agents in a file readable by its owner only: per line an agent's number and 64 hexadecimal digits."""

from __future__ import annotations

import os
import secrets
import stat
from pathlib import Path

from kiteline_hw.ports import LinkError

KEY_BYTES = 32
_MAX_AGENT = 63
_HEAD = "# kiteline keys: agent, secret. Give an agent its own line, the base station all lines; show them to nobody.\n"


def default_path() -> Path:
    """The default path of the key file."""
    return Path(os.environ.get("XDG_CONFIG_HOME", "~/.config")).expanduser() / "kiteline" / "keys"


def read_keys(path: Path) -> dict[int, bytes]:
    """Keys by agent. Raises LinkError if the file is missing, malformed, or readable by others."""
    try:
        text = path.read_text(encoding="ascii")
        mode = path.stat().st_mode
    except (OSError, UnicodeDecodeError) as error:
        raise LinkError(f"cannot read keys from {path}: {error}; `kiteline keys new` makes one") from error
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise LinkError(f"keys in {path} may be read by others (mode {mode & 0o777:o}): chmod 600 {path}")
    keys: dict[int, bytes] = {}
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#")[0].split()
        if not words:
            continue
        try:
            agent, key = int(words[0]), bytes.fromhex(words[1])
            if len(words) != 2 or not 0 <= agent <= _MAX_AGENT or len(key) != KEY_BYTES or agent in keys:
                raise ValueError
        except (ValueError, IndexError):
            raise LinkError(
                f"{path}, line {number}: expected an agent's number (0 to {_MAX_AGENT}, each once) and "
                f"{2 * KEY_BYTES} hexadecimal digits"
            ) from None
        keys[agent] = key
    return keys


def new_key(path: Path, agent: int, *, replace: bool = False) -> bytes:
    """Create a key for an agent and store it. Raises LinkError if it has one and `replace` is not set."""
    if not 0 <= agent <= _MAX_AGENT:
        raise LinkError(f"agent number {agent}: expected 0 to {_MAX_AGENT}")
    keys = read_keys(path) if path.exists() else {}
    if agent in keys and not replace:
        raise LinkError(f"agent {agent} has a key in {path} already; --replace makes a new one")
    keys[agent] = secrets.token_bytes(KEY_BYTES)
    _write(path, keys)
    return keys[agent]


def _write(path: Path, keys: dict[int, bytes]) -> None:
    """Replace the file atomically; it never exists with another mode or half written."""
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    new = path.with_name(path.name + ".new")
    new.unlink(missing_ok=True)
    fd = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(fd, "w", encoding="ascii") as out:
        out.write(_HEAD + "".join(f"{agent} {keys[agent].hex()}\n" for agent in sorted(keys)))
        out.flush()
        os.fsync(out.fileno())
    os.replace(new, path)
