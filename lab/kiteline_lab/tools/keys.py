"""`kiteline keys`: pair agents with a base; make and show the keys that seal packets between them."""

import argparse
from pathlib import Path

from kiteline_codec.transport.seal import fingerprint
from kiteline_core.ids import MAX_AGENTS
from kiteline_hw.system.key_store import (
    MAPS,
    default_path,
    first_keys,
    new_code,
    new_key,
    new_maps_key,
    pair,
    read_file,
)


def parser() -> argparse.ArgumentParser:
    """The arguments of `kiteline keys`."""
    p = argparse.ArgumentParser(
        prog="kiteline keys",
        description="Keys of agents: base and agent accept only packets sealed with one of them.",
        epilog="`kiteline keys pair 3` at the base shows a code; type it at agent 3: `kiteline keys pair 3 CODE`.",
    )
    p.add_argument("--file", metavar="F", type=Path, default=None, help=f"default: {default_path()}")
    anywhere = argparse.ArgumentParser(add_help=False)  # the same after the command
    anywhere.add_argument(
        "--file", metavar="F", type=Path, default=argparse.SUPPRESS, help=f"default: {default_path()}"
    )
    commands = p.add_subparsers(dest="command", required=True)
    paired = commands.add_parser(
        "pair", help="pair an agent with a base: without CODE at the base, with it there", parents=[anywhere]
    )
    paired.add_argument("agent", metavar="AGENT", help=f"number of the agent, 0 to {MAX_AGENTS - 1}")
    paired.add_argument("code", metavar="CODE", nargs="?", default="", help="as the base shows it")
    new = commands.add_parser(
        "new", help="make a key for an agent, or for the right to change maps", parents=[anywhere]
    )
    new.add_argument("agent", metavar="AGENT", help=f"number of the agent, 0 to {MAX_AGENTS - 1}, or {MAPS}")
    new.add_argument("--replace", action="store_true", help="replace the key it has; the old one is void then")
    show = commands.add_parser("show", help="list agents with the fingerprints of their keys", parents=[anywhere])
    show.add_argument("--secret", metavar="AGENT", default=None, help="print this agent's line of the file")
    return p


def main(argv: list[str]) -> int:
    """Run `kiteline keys`; the exit status. Raises LinkError."""
    p = parser()
    a = p.parse_args(argv)
    path = a.file or default_path()
    if a.command == "pair":
        _pair(path, _agent(p, a.agent), a.code)
        return 0
    if a.command == "new":
        if a.agent == MAPS:
            key = new_maps_key(path, replace=a.replace)
        else:
            key = new_key(path, _agent(p, a.agent), replace=a.replace)
        print(f"{_name(a.agent)}  {fingerprint(key)}  in {path}")
        return 0
    keys = read_file(path)
    named = {str(agent): keys.agents[agent] for agent in sorted(keys.agents)}
    if keys.maps is not None:
        named[MAPS] = keys.maps
    if a.secret is not None:
        if a.secret not in named:
            p.error(f"{_name(a.secret)} has no key in {path}; there are: {', '.join(named) or 'none'}")
        print(f"{a.secret} {named[a.secret].hex()}")
        return 0
    for name, key in named.items():
        print(f"{_name(name)}  {fingerprint(key)}")
    return 0


def _pair(path: Path, agent: int, code: str) -> None:
    """Store the key of a code, or of a new code that is shown: then this is the base, whose file has all keys."""
    shown = code or new_code()
    if not code:
        first_keys(path)
    key = pair(path, agent, shown)
    print(f"agent {agent}  {fingerprint(key)}  in {path}")
    if not code:
        print(f"at agent {agent}: kiteline keys pair {agent} {shown}")
        print("show the code to nobody else; a base that runs takes the new key within a second")
        print('one that said "not sealed" has to be started again: it seals once there are keys')


def _agent(p: argparse.ArgumentParser, text: str) -> int:
    if not (text.isascii() and text.isdecimal() and len(text) < 5 and int(text) < MAX_AGENTS):
        p.error(f"{text[:20]!r} is no agent's number, 0 to {MAX_AGENTS - 1}, and not {MAPS}")
    return int(text)


def _name(text: str) -> str:
    return text if text == MAPS else f"agent {text}"
