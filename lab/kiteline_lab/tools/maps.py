"""`kiteline maps list|get|name|merge|split|delete`: query and change the maps of a running base.

`check|repair|backup` work on the folder of a store.
"""

import argparse
import json
import secrets
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from kiteline_codec.transport.signed_question import sign
from kiteline_core.wording import counted
from kiteline_hw.links.zenoh_queries import ask
from kiteline_hw.ports import LinkError
from kiteline_hw.system import process
from kiteline_hw.system.key_store import MAPS, default_path, login_of, read_file

DEFAULT_BASE = "tcp/127.0.0.1:7447"


def parser() -> argparse.ArgumentParser:
    """The arguments of `kiteline maps`."""
    p = argparse.ArgumentParser(
        prog="kiteline maps",
        description="Manage the maps of a running base. MAP is an id (AGENT.BOOT.NUMBER) or a name.",
        epilog="Other programs send the same queries over Zenoh: docs/how-to/manage-maps.md.",
    )
    add_options(p, endpoint=DEFAULT_BASE, key=None, as_json=False)
    anywhere = argparse.ArgumentParser(add_help=False)  # the same after the verb, where they override those before it
    add_options(anywhere, endpoint=argparse.SUPPRESS, key=argparse.SUPPRESS, as_json=argparse.SUPPRESS)
    verbs = p.add_subparsers(dest="verb", required=True, metavar="VERB")
    verbs.add_parser("list", help="all maps", parents=[anywhere])
    one = {
        "get": "one map; with --json the poses of its keyframes too",
        "split": "take a submap out of the map into which it was merged, until `merge` asks for it",
        "delete": "delete a map, for good: `backup` keeps a copy of a store before",
    }
    for verb, what in one.items():
        verbs.add_parser(verb, help=what, parents=[anywhere]).add_argument("map", metavar="MAP")
    name = verbs.add_parser("name", help="give a map a name", parents=[anywhere])
    name.add_argument("map", metavar="MAP")
    name.add_argument("name", metavar="NAME", help='"" removes the name')
    merge = verbs.add_parser(
        "merge", help="merge a map into another, where they overlap or at --at", parents=[anywhere]
    )
    merge.add_argument("map", metavar="MAP")
    merge.add_argument("into", metavar="INTO")
    merge.add_argument("--at", metavar="N", type=float, nargs=16, help="T_into_map, 16 numbers in rows")
    stores = {
        "check": "check every value of a store, also while its base runs",
        "repair": "write a store with faults anew, from what is sound; the old file is kept",
        "backup": "copy a store, also while its base runs",
    }
    for verb, what in stores.items():
        verbs.add_parser(verb, help=what).add_argument("store", metavar="STORE", type=Path)
    verbs.choices["backup"].add_argument("out", metavar="DIR", type=Path, help="a folder without a store")
    return p


def add_options(p: argparse.ArgumentParser, endpoint: str, key: Path | str | None, as_json: bool | str) -> None:
    """Add the options of all questions, with these defaults."""
    p.add_argument(
        "--base", metavar="ENDPOINT", default=endpoint, help=f"where the base listens (default: {DEFAULT_BASE})"
    )
    p.add_argument("--key", metavar="FILE", type=Path, default=key,
                   help=f"keys with the right to change maps (default: {default_path()}, if there is one)")  # fmt: skip
    p.add_argument("--json", action="store_true", default=as_json, help="print the reply as JSON")


def query(a: argparse.Namespace) -> dict[str, Any]:
    """The query's parameters."""
    given = {key: getattr(a, key) for key in ("map", "name", "into") if hasattr(a, key)}
    if getattr(a, "at", None) is not None:
        given["T_into_map"] = a.at
    return given


def table(answer: Mapping[str, Any]) -> str:
    """A reply as text: maps in a table."""
    if "looking" in answer:
        n = int(answer["looking"])
        searched = f"{counted(n, 'keyframe')} {'is' if n == 1 else 'are'} searched for in the other map"
        return f"{searched}; `kiteline maps list` shows one map once a place is found"
    if "deleted" in answer:
        return f"deleted: {' '.join(answer['deleted'])}"
    if not answer.get("maps", [answer]):
        return "no map yet"
    rows = [("map", "name", "agents", "keyframes", "points", "placed", "unit", "submaps")]
    for m in answer.get("maps", [answer]):
        agents, submaps = ",".join(map(str, m["agents"])), " ".join(map(_submap, m["submaps"]))
        placed = "yes" if m["placed"] else "no"
        rows.append(
            (m["id"], m["name"], agents, str(m["keyframes"]), str(m["points"]), placed, m["unit"], submaps)
        )  # fmt: skip
    return "\n".join(columns(rows))


def columns(rows: Sequence[tuple[str, ...]]) -> list[str]:
    """Rows of text as lines, in columns as wide as their widest text."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def _submap(submap: Mapping[str, Any]) -> str:
    """A submap's id, with its scale if that is not 1."""
    return str(submap["id"]) if submap["scale"] == 1.0 else f"{submap['id']} (x{submap['scale']:.4g})"


def _of_store(a: argparse.Namespace) -> int:
    """Check, repair or copy a store; 1 if it has, or had, faults. Raises StoreError."""
    from kiteline_basestation.store import store
    from kiteline_basestation.store.integrity import check

    if a.verb == "check":
        saved = store.read(a.store)
    elif a.verb == "repair":
        saved = store.repair(a.store)
    else:
        saved = store.backup(a.store, a.out)
    checked = check(saved)
    values = sum(len(codes.received) + len(codes.own) for codes in checked.saved.agents.values())
    for fault in checked.faults:
        print(f"{a.store}: {fault}", file=sys.stderr)
    agents, faults = len(checked.saved.agents), len(checked.faults)
    sound = f"{counted(values, 'value')} of {counted(agents, 'agent')} {'is' if values == 1 else 'are'} sound"
    print(f"{a.store}: {sound}, {counted(faults, 'fault')}")
    return 1 if checked.faults else 0


def ask_base(base: str, key_file: Path | None, verb: str, question: str) -> tuple[bool, str, dict[str, Any]]:
    """Ask the base at an endpoint, signed if a file of keys has the right. Whether it succeeded, the answer as text and
    as JSON types. key_file: None: the user's, if there is one. Raises LinkError.
    """
    path = key_file or default_path()
    key = read_file(path).maps if key_file is not None or path.exists() else None
    endpoint = base.removeprefix("zenoh:")

    def ask_once(start: str) -> tuple[bool, str]:
        if key is None:
            return ask(endpoint, "maps", verb, question)
        signed = sign(key, verb, question, int(time.time()), secrets.token_hex(16), start)
        return ask(endpoint, "maps", verb, signed, logins=login_of(MAPS, key))

    with process.told_if_slow(f"waiting for a base at {endpoint}"):
        ok, text = ask_once("")  # where it is signed nothing comes of it: its refusal names the base's start
        answer = _read(endpoint, text)
        start = None if ok or key is None else answer.get("start")
        if isinstance(start, str):
            ok, text = ask_once(start)
            answer = _read(endpoint, text)
    return ok, text, answer


def _read(endpoint: str, text: str) -> dict[str, Any]:
    """An answer as a base gives it. Raises LinkError for anything else."""
    try:
        answer = json.loads(text)
    except (ValueError, RecursionError):
        answer = None
    if not isinstance(answer, dict):
        raise LinkError(
            f"{endpoint} answers {text[:60]!r}, expected JSON of a base: what listens there is another program"
        )
    return answer


def main(argv: list[str]) -> int:
    """Run `kiteline maps`; exit status 1 if the base refused, or a store has faults."""
    a = parser().parse_args(argv)
    if hasattr(a, "store"):
        return _of_store(a)
    ok, text, answer = ask_base(a.base, a.key, a.verb, json.dumps(query(a)))
    try:
        shown = table(answer) if ok else f"kiteline maps: {answer['error']}"
    except (KeyError, TypeError, ValueError, AttributeError):
        raise LinkError(f"{a.base} answers {text[:60]!r}, which is no answer of a base to {a.verb}") from None
    if a.json:
        print(text)
    else:
        print(shown, file=sys.stdout if ok else sys.stderr)
    return 0 if ok else 1
