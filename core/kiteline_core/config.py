"""Frozen configuration: nested dataclasses, overridden by a parsed TOML table, written as TOML.

The unit and the reason of a value are in the comment beside its default; a table only replaces values that exist.
"""

import difflib
import json
import math
import re
import tomllib
import types
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from enum import Enum
from typing import Any, Literal, TypeGuard, TypeVar, Union, get_args, get_origin, get_type_hints

from kiteline_core.errors import INPUT_FAULTS, KitelineError

T = TypeVar("T")

_MAX_LENGTH = 1 << 20  # of a file of options: all of them with their comments are a twentieth
_MAX_DEPTH = 16  # of tables in tables; sections are four deep
_MAX_DOTS = 256  # in a name: tomllib takes the square of their number
MOST_BYTES = _MAX_LENGTH + 1  # to be read of a file: `parse` refuses so many, and some files never end (/dev/zero)
ROOTS = frozenset({"agent", "base"})  # tables that a configuration file may have


class ConfigError(KitelineError, ValueError):
    """An unknown key or a value of the wrong type; the text names the key, its section and what is known there."""


class UnknownKeyError(ConfigError):
    """A key that a section does not have. near: the whole name of the key there that is most like it, or empty."""

    def __init__(self, text: str, near: str) -> None:
        super().__init__(text)
        self.near = near


def apply(config: T, table: Mapping[str, object], path: str = "") -> T:
    """A copy of `config` (a frozen dataclass, sections nested) with the values of `table` in place of its own.

    path: name of the section, for error texts. Raises ConfigError for an unknown key, a value of the wrong type, or
    one that the section itself rejects (ValueError of its __post_init__).
    """
    if not is_dataclass(config) or isinstance(config, type):
        raise TypeError(f"a config section is a dataclass instance, not {type(config).__name__}")
    known = {f.name: f for f in fields(config) if f.init}
    hints = get_type_hints(type(config))
    changes: dict[str, object] = {}
    for key, value in table.items():
        if key not in known:
            near = "".join(f"{path}.{like}".strip(".") for like in difflib.get_close_matches(key, known, 1))
            hint = f"did you mean {near}? " if near else ""
            text = f"unknown key {key!r} in {_section(path)}; {hint}known are: {', '.join(sorted(known))}"
            raise UnknownKeyError(text, near)
        old = getattr(config, key)
        inner = f"{path}.{key}" if path else key
        if is_dataclass(old):
            if not isinstance(value, Mapping):
                raise ConfigError(f"[{inner}] is a section: found {_shown(value)}, expected keys and values under it")
            changes[key] = apply(old, value, inner)
        else:
            changes[key] = _convert(value, hints[key], inner)
    try:
        return replace(config, **changes)
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(f"{_section(path)}: {error}") from error


def parse(content: str | bytes, name: str = "") -> dict[str, Any]:
    """The tables of a TOML file, whatever it holds. name: of the file, for error texts. Raises ConfigError."""
    where = f"{name}: " if name else ""
    if len(content) > _MAX_LENGTH:
        raise ConfigError(f"{where}no file of options is longer than {_MAX_LENGTH >> 20} MiB")
    try:
        text = content if isinstance(content, str) else content.decode()
        if any(part.count(".") > _MAX_DOTS for part in re.split(r"[=,{}\n]", text)):
            raise ConfigError(f"{where}no valid TOML: more than {_MAX_DOTS} dots in a name")
        table = tomllib.loads(text)
        _check_depth(table)
    except UnicodeDecodeError as error:
        raise ConfigError(f"{where}not a text file: {error}") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{where}no valid TOML: {error}") from error
    except (ValueError, *INPUT_FAULTS) as error:
        raise ConfigError(f"{where}no valid TOML: tables too deep, or a number too long ({error})") from error
    return table


def _check_depth(table: dict[str, Any]) -> None:
    """Raise ValueError where tables are in tables beyond any section's: dotted names make them as deep as one likes."""
    level: list[Any] = [table]
    for _ in range(_MAX_DEPTH):
        level = [inner for outer in level if isinstance(outer, dict) for inner in outer.values()]
    if any(isinstance(inner, dict) for inner in level):
        raise ValueError(f"more than {_MAX_DEPTH} tables in each other")


def load(config: T, text: str | bytes, root: str, name: str) -> T:
    """`config` with the values of the table [root] of a TOML text, as people write it.

    The text may have the tables [agent] and [base]. name: of the file, for error texts. Raises ConfigError as `apply`
    does, and for a number that is out of range (`in_range`).
    """
    table = parse(text, name)
    if unknown := set(table) - ROOTS:
        raise ConfigError(f"{name}: unknown table {sorted(unknown)}; known are: {', '.join(sorted(ROOTS))}")
    section = table.get(root, {})
    if not isinstance(section, dict):
        raise ConfigError(f"{name}: [{root}] is a section: found {_shown(section)}")
    try:
        return in_range(apply(config, section, root), config, root)
    except ConfigError as error:
        raise ConfigError(f"{name}: {error}") from error


def of_log(config: T, text: str) -> T:
    """`config` with the values that a log holds as TOML. Raises ConfigError if a build with other options wrote it."""
    try:
        return apply(config, parse(text))
    except ConfigError as error:
        raise ConfigError(
            f"another build wrote this log ({error}): replay or import it with that build; the images of an agent's "
            "log can be flown with this one by `kiteline fly LOG`"
        ) from error


def in_range(config: T, default: T, path: str) -> T:
    """`config`, if its numbers are finite and have the signs of those of `default`; else ConfigError.

    0 stands for a positive number only where a section names it in `MAY_BE_ZERO`: what an option counts, divides by or
    weighs with cannot be nothing.
    """
    may_be_zero = getattr(type(config), "MAY_BE_ZERO", ())
    for f in fields(config):  # type: ignore[arg-type]
        value, normal, inner = getattr(config, f.name), getattr(default, f.name), f"{path}.{f.name}"
        if is_dataclass(value):
            in_range(value, normal, inner)
        elif isinstance(value, int | float) and isinstance(normal, int | float) and not isinstance(value, bool):
            if not math.isfinite(value):
                raise ConfigError(f"{inner}: found {_shown(value)}, expected a finite number")
            if value < 0 <= normal:
                raise ConfigError(f"{inner}: found {_shown(value)}, expected a number that is not negative")
            if value == 0 < normal and f.name not in may_be_zero:
                raise ConfigError(f"{inner}: found {_shown(value)}, expected a number above 0")
    return config


def from_json(kind: type[T], text: str) -> T:
    """A flat frozen dataclass from its JSON; lists become tuples. Raises ConfigError for an unknown key."""
    values = {k: tuple(v) if isinstance(v, list) else v for k, v in json.loads(text).items()}
    if unknown := values.keys() - get_type_hints(kind).keys():
        raise ConfigError(f"{kind.__name__} has no {', '.join(sorted(unknown))}")
    return kind(**values)


def describe(config: object) -> str:
    """The TOML text of a config with the values it has now; `apply` of its parse gives the same config."""
    lines: list[str] = []
    _describe(config, "", lines)
    return "\n".join(lines).strip() + "\n"


def _describe(config: object, path: str, lines: list[str]) -> None:
    if not is_dataclass(config) or isinstance(config, type):
        raise TypeError(f"a config section is a dataclass instance, not {type(config).__name__}")
    values = {f.name: getattr(config, f.name) for f in fields(config) if f.init}
    plain = {k: v for k, v in values.items() if not is_dataclass(v)}
    if path and plain:
        lines += ["", f"[{path}]"]
    for key, value in plain.items():
        lines.append(f"# {key} is not set" if value is None else f"{key} = {toml_value(value)}")
    for key, value in values.items():
        if is_dataclass(value):
            _describe(value, f"{path}.{key}" if path else key, lines)


def toml_value(value: object) -> str:
    """A value as TOML writes it. Raises TypeError for one that no option can have."""
    match value:
        case bool():
            return "true" if value else "false"
        case Enum():
            return toml_value(value.value)
        case int() | float():
            return repr(value)
        case str():
            return _quoted(value)
        case tuple() | list():
            return "[" + ", ".join(toml_value(v) for v in value) + "]"
    raise TypeError(f"a config value is a bool, number, string, enum or tuple of them, not {type(value).__name__}")


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c >= " " and c != "\x7f" else f"\\u{ord(c):04x}" for c in escaped) + '"'


def _convert(value: object, hint: Any, path: str) -> object:
    """`value` as the type `hint`, widening int to float and list to tuple; ConfigError when it does not fit."""
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        for option in get_args(hint):
            if option is not type(None):
                try:
                    return _convert(value, option, path)
                except ConfigError:
                    continue
    elif origin is Literal:
        if value in get_args(hint):
            return value
    elif origin is tuple:
        if isinstance(value, list | tuple):
            args = get_args(hint)
            items = (args[0],) * len(value) if len(args) == 2 and args[1] is Ellipsis else args
            if len(items) == len(value):
                return tuple(_convert(v, h, f"{path}[{i}]") for i, (v, h) in enumerate(zip(value, items)))
    elif isinstance(hint, type) and issubclass(hint, Enum):
        if value in [member.value for member in hint]:
            return hint(value)
    elif hint is float:
        if isinstance(value, float) or _is_whole(value):
            return float(value)
    elif hint is int:
        if _is_whole(value):
            return value
    elif isinstance(hint, type) and isinstance(value, hint):
        return value
    raise ConfigError(f"{path}: found {_shown(value)}, expected {type_name(hint)}")


def _is_whole(value: object) -> TypeGuard[int]:
    """True for an integer of 64 bits, as TOML's are; Python reads longer ones, too."""
    return isinstance(value, int) and not isinstance(value, bool) and -(1 << 63) <= value < 1 << 63


def type_name(hint: Any) -> str:
    """What a value of the type `hint` is, in words for people: `a number`, `a list of 3: a text, …`."""
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        return " or ".join(type_name(o) for o in get_args(hint) if o is not type(None))
    if origin is Literal:
        return "one of " + ", ".join(repr(a) for a in get_args(hint))
    if origin is tuple:
        args = get_args(hint)
        if len(args) == 2 and args[1] is Ellipsis:
            return f"a list of {type_name(args[0])}"
        return f"a list of {len(args)}: " + ", ".join(type_name(a) for a in args)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return "one of " + ", ".join(repr(member.value) for member in hint)
    return {float: "a number", int: "a whole number", bool: "true or false", str: "a text"}.get(hint, str(hint))


def _shown(value: object) -> str:
    return f"{value!r} ({type(value).__name__})"


def _section(path: str) -> str:
    return f"section [{path}]" if path else "the top of the file"
