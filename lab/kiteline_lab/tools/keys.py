"""`kiteline keys`: make and show the keys that seal packets between agents and base."""

from __future__ import annotations

import argparse
from pathlib import Path

from kiteline_codec.transport.seal import fingerprint
from kiteline_hw.system.key_store import default_path, new_key, read_keys


def parser() -> argparse.ArgumentParser:
    """The arguments of `kiteline keys`."""
    p = argparse.ArgumentParser(
        prog="kiteline keys",
        description="Keys of agents. With --key FILE, agent and base accept only packets sealed with one of them.",
        epilog="Make keys on the base: `kiteline keys new 3`. Copy that agent's line to a file on the agent.",
    )
    p.add_argument("--file", metavar="F", type=Path, default=None, help=f"default: {default_path()}")
    commands = p.add_subparsers(dest="command", required=True)
    new = commands.add_parser("new", help="make a key for an agent")
    new.add_argument("agent", metavar="AGENT", type=int, help="number of the agent, 0 to 63")
    new.add_argument("--replace", action="store_true", help="replace the key it has; the old one is void then")
    show = commands.add_parser("show", help="list agents with the fingerprints of their keys")
    show.add_argument("--secret", metavar="AGENT", type=int, default=None, help="print this agent's line of the file")
    return p


def main(argv: list[str]) -> int:
    """Run `kiteline keys`; the exit status. Raises LinkError."""
    p = parser()
    a = p.parse_args(argv)
    path = a.file or default_path()
    if a.command == "new":
        key = new_key(path, a.agent, replace=a.replace)
        print(f"agent {a.agent}  {fingerprint(key)}  in {path}")
        return 0
    keys = read_keys(path)
    if a.secret is not None:
        if a.secret not in keys:
            p.error(f"agent {a.secret} has no key in {path}; there are: {', '.join(map(str, sorted(keys))) or 'none'}")
        print(f"{a.secret} {keys[a.secret].hex()}")
        return 0
    for agent in sorted(keys):
        print(f"agent {agent}  {fingerprint(keys[agent])}")
    return 0
