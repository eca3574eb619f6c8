"""`kiteline config`: print, explain and check the options of agent and base."""

import argparse
import difflib
import re
import sys
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kiteline_core.config import MOST_BYTES, ConfigError, UnknownKeyError, apply, in_range, parse, toml_value
from kiteline_lab.tools.options import ROOTS, Option, as_markdown, as_toml, sections


@dataclass(frozen=True, slots=True)
class Problem:
    """What is wrong with one value of a file. line: counted from 1, None where it was not found."""

    line: int | None
    text: str


def main(argv: list[str]) -> int:
    """Run the command; 2 where a file has problems or nothing has the name. Raises ConfigError."""
    p = argparse.ArgumentParser(
        prog="kiteline config",
        description="Print every option of agent and base with its default, unit and reason, as TOML.",
    )
    how = p.add_mutually_exclusive_group()
    how.add_argument("--explain", metavar="NAME", help="one option or section, by its dotted name or a part of it")
    how.add_argument("--check", metavar="FILE", type=Path, help="say what is wrong with a TOML file, line by line")
    how.add_argument("--changed", metavar="FILE", type=Path, help="what a TOML file changes, beside the defaults")
    how.add_argument("--markdown", action="store_true", help="the reference page of the documentation")
    a = p.parse_args(argv)
    if a.explain:
        return _explain(a.explain)
    if a.check or a.changed:
        problems = check(_read(a.check or a.changed))
        for problem in problems:
            where = f"line {problem.line}: " if problem.line else ""
            print(f"{a.check or a.changed}: {where}{problem.text}", file=sys.stderr)
        if problems:
            return 2
        print("\n".join(changed(_read(a.changed))) if a.changed else f"{a.check}: no problem found")
        return 0
    print(as_markdown() if a.markdown else as_toml(), end="")
    return 0


def check(text: str) -> list[Problem]:
    """Everything wrong with a configuration, by the same rules by which agent and base load it."""
    try:
        table = parse(text)
    except ConfigError as error:
        at = re.search(r"line (\d+)", str(error))
        return [Problem(int(at[1]) if at else None, str(error))]
    problems, known = [], _options()
    for root in (r for r in table if r not in ROOTS):
        what = f"unknown table [{root}]; known are: {', '.join(ROOTS)}"
        problems.append(Problem(_line_of(text, root), what))
    for root in (r for r in ROOTS if r in table and not isinstance(table[r], dict)):
        what = f"[{root}] is a section: expected keys and values under it"
        problems.append(Problem(_line_of(text, root), what))
    for name, value in _leaves({root: table[root] for root in ROOTS if isinstance(table.get(root), dict)}):
        root, _, rest = name.partition(".")
        try:
            in_range(apply(ROOTS[root], _nested(rest, value) if rest else value, root), ROOTS[root], root)
        except ConfigError as error:
            told = name in known or (isinstance(error, UnknownKeyError) and error.near)
            hint = "" if told else _near(name)
            problems.append(Problem(_line_of(text, name), f"{error}{hint}"))
    return problems


def changed(text: str) -> list[str]:
    """The options of a configuration that differ from their defaults, as TOML. Raises ConfigError."""
    defaults = _options()
    lines = []
    for name, value in _leaves(tomllib.loads(text)):
        option = defaults.get(name)  # None: an empty section
        if option and value not in (option.default, _plain(option.default)):
            unit = f" {option.unit}" if option.unit else ""
            lines.append(f"{name} = {toml_value(value)}  # default {_shown(option)}{unit}")
    return lines


def _explain(name: str) -> int:
    """Print all options, or the section, that a name or a part of one means."""
    options = _options()
    exact = [o for n, o in options.items() if n == name or n.endswith(f".{name}")]
    by_section = [o for o in options.values() if o.section == name or o.section.endswith(f".{name}")]
    found = exact or by_section or [o for n, o in options.items() if name in n]
    if not found:
        hint = _near(name) or "; `kiteline config` prints all"
        print(f"kiteline config: no option is called {name!r}{hint}", file=sys.stderr)
        return 2
    purposes = {s.name: s.purpose for s in sections()}
    for i, o in enumerate(found):
        if i == 0 or found[i - 1].section != o.section:
            print(f"[{o.section}]  {purposes[o.section]}")
        unit = f" {o.unit}" if o.unit else ""
        print(f"  {o.key} = {_shown(o)}{unit}  ({o.type})")
        if o.reason:
            print(f"      {o.reason}")
    return 0


def _options() -> dict[str, Option]:
    return {o.name: o for section in sections() for o in section.options}


def _shown(option: Option) -> str:
    return "not set" if option.default is None else toml_value(option.default)


def _plain(value: object) -> object:
    """A default as TOML would give it."""
    return tomllib.loads(f"value = {toml_value(value)}")["value"] if value is not None else None


def _read(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return file.read(MOST_BYTES).decode()
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not a text file: {error}") from error


def _leaves(table: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted name and value of everything that is set; an empty section has none."""
    for key, value in table.items():
        name = f"{path}.{key}" if path else key
        if isinstance(value, dict) and value:
            yield from _leaves(value, name)
        else:
            yield name, value


def _nested(name: str, value: Any) -> dict[str, Any]:
    for key in reversed(name.split(".")):
        value = {key: value}
    return dict(value)


def _line_of(text: str, name: str) -> int | None:
    """Line of the TOML text that sets a dotted name, or else of the section nearest to it."""
    section, nearest = "", None
    for number, line in enumerate(text.splitlines(), 1):
        bare = re.sub(r"[\s\"']", "", line.split("#")[0])
        if bare.startswith("["):
            section = bare.strip("[]")
            nearest = number if name == section or name.startswith(f"{section}.") else nearest
            if section.startswith(f"{name}."):
                return number
        elif "=" in bare:
            full = f"{section}.{bare.split('=')[0]}".strip(".")
            if name == full or name.startswith(f"{full}."):
                return number
    return nearest


def _near(name: str) -> str:
    """`; did you mean …?`, where some option or section has a name like this one."""
    names = [*_options(), *(s.name for s in sections())]
    near = difflib.get_close_matches(name, names, 1, 0.85)
    if not near:
        by_key = {n.rpartition(".")[2]: n for n in reversed(names)}
        near = [by_key[k] for k in difflib.get_close_matches(name.rpartition(".")[2], by_key, 1, 0.75)]
    return f"; did you mean {near[0]}?" if near else ""
