"""Every option of agent and base, with its unit and reason, read from the config dataclasses and their comments."""

import ast
import inspect
import io
import re
import textwrap
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from typing import Any, get_type_hints

from kiteline_agent.config import AgentConfig
from kiteline_basestation.config import BaseConfig
from kiteline_core.config import toml_value, type_name

ROOTS = {"agent": AgentConfig(), "base": BaseConfig()}

# Units by the end of an option's name, longest first.
_SUFFIXES = (
    ("_rad_s2", "rad/s²"), ("_m_s2", "m/s²"), ("_rad_s", "rad/s"), ("_m_s", "m/s"), ("_rad_m", "rad/m"),
    ("_per_m", "per m"),
    ("_bytes", "bytes"), ("_cells", "cells"), ("_keyframes", "keyframes"), ("_frames", "frames"), ("_percent", "%"),
    ("_deg", "deg"), ("_rad", "rad"), ("_hz", "Hz"), ("_ms", "ms"), ("_ns", "ns"), ("_px", "px"), ("_m", "m"),
    ("_s", "s"),
)  # fmt: skip
_LEADING_UNIT = re.compile(r"^(m/s\^?2?|rad/s|px|m|s|rad|ms|Hz|keyframes|frames|points)(?=[;,:]|$)[;,:]? ?")


@dataclass(frozen=True, slots=True)
class Option:
    """One option. name: dotted, with `agent` or `base` first. unit: empty where it has none."""

    name: str
    default: object
    type: str
    unit: str
    reason: str

    @property
    def section(self) -> str:
        """The dotted name of its section."""
        return self.name.rpartition(".")[0]

    @property
    def key(self) -> str:
        """Its name within the section."""
        return self.name.rpartition(".")[2]


@dataclass(frozen=True, slots=True)
class Section:
    """One section: a frozen dataclass with at least one option. purpose: first sentences of its docstring."""

    name: str
    purpose: str
    options: tuple[Option, ...]


@cache
def sections() -> tuple[Section, ...]:
    """All sections of agent and base that hold options, in the order of their definition."""
    return tuple(section for root, config in ROOTS.items() for section in _sections(config, root))


def _sections(config: Any, path: str) -> Iterator[Section]:
    cls = type(config)
    comments, hints = _comments(cls), get_type_hints(cls)
    nested, options = [], []
    for field in (f for f in fields(cls) if f.init):
        value = getattr(config, field.name)
        if is_dataclass(value):
            nested.append((value, f"{path}.{field.name}"))
            continue
        unit, reason = _unit_and_reason(field.name, comments.get(field.name, ""))
        reason = re.sub(r"\b(True|False)\b", lambda word: word[0].lower(), reason)  # as TOML has them
        options.append(Option(f"{path}.{field.name}", value, type_name(hints[field.name]), unit, reason))
    if options:
        yield Section(path, " ".join((inspect.getdoc(cls) or "").split("\n\n")[0].split()), tuple(options))
    for value, name in nested:
        yield from _sections(value, name)


def _comments(cls: type) -> dict[str, str]:
    """The comment of each field: behind it, and on the lines of comment alone that follow."""
    source = textwrap.dedent(inspect.getsource(cls))
    body = ast.parse(source).body[0]
    assert isinstance(body, ast.ClassDef)
    at_line = {
        token.start[0]: token.string.lstrip("# ")
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    }
    found: dict[str, str] = {}
    for node in body.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            line = node.end_lineno or node.lineno
            parts = [at_line[n] for n in range(node.lineno, line) if n in at_line]  # a long one is in brackets
            while line in at_line:
                parts.append(at_line[line])
                line += 1
                if line <= len(source.splitlines()) and not source.splitlines()[line - 1].lstrip().startswith("#"):
                    break
            found[node.target.id] = " ".join(parts)
    return found


def _unit_and_reason(name: str, comment: str) -> tuple[str, str]:
    leading = _LEADING_UNIT.match(comment)
    by_name = next((unit for suffix, unit in _SUFFIXES if f"_{name}".endswith(suffix)), "")
    if leading and by_name in ("", leading[1]):
        return by_name or leading[1], comment[leading.end() :]
    unit = by_name or ("px" if comment.startswith("px ") else "")
    return unit, comment.removeprefix(f"{unit} ") if unit else comment


def as_toml() -> str:
    """All options with their defaults as TOML; unit and reason are comments."""
    lines = ["# Every option of kiteline's agent and base with its default. Delete what you do not change."]
    for section in sections():
        lines += ["", f"# {section.purpose}", f"[{section.name}]"]
        for o in section.options:
            about = " ".join(filter(None, [f"[{o.unit}]" if o.unit else "", o.reason]))
            value = f"# {o.key} is not set" if o.default is None else f"{o.key} = {toml_value(o.default)}"
            lines.append(f"{value}  # {about}" if about else value)
    return "\n".join(lines) + "\n"


def as_markdown() -> str:
    """The reference page: a table for each section."""
    lines = [
        "# Configuration",
        "",
        "Made by `kiteline config --markdown`. Give a TOML file with any of these sections to `kiteline agent` or",
        "`kiteline base` with `--config`. `kiteline config` prints all options as such a file;",
        "`kiteline config --check FILE` says what is wrong with one.",
    ]
    for section in sections():
        lines += [
            "",
            f"## [{section.name}]",
            "",
            section.purpose,
            "",
            "| option | default | unit | |",
            "|---|---|---|---|",
        ]
        for o in section.options:
            value = "not set" if o.default is None else f"`{toml_value(o.default)}`"
            lines.append(f"| `{o.key}` | {value} | {o.unit} | {_cell(o.reason)} |")
    return "\n".join(lines) + "\n"


def _cell(text: str) -> str:
    """Text for a table's cell: without marks that Markdown would take for its own."""
    return re.sub(r"([|<>*_\[\]])", r"\\\1", text)
