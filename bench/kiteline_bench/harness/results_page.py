"""The results file: a summary on top, below it one section a benchmark; running one replaces its section only."""

import importlib
import os
import platform
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from kiteline_bench.harness.bars import Bar

_HEAD = (
    "# Results\n\nMade by `kiteline bench`; each section says which command made it and on which machine. "
    "A bar that is not met says so.\n"
)
SUMMARY = "Summary"
# of the summary: section, beginning of the bar's name
HEADLINES = (
    ("First flight", "room_flight: ATE live"),
    ("First flight", "room_flight: ATE base"),
    ("First flight", "bytes a keyframe"),
    ("First flight", "replay --verify"),
    ("The onboard agent: accuracy and cost", "room_flight: CPU a frame, mean"),
    ("The onboard agent: accuracy and cost", "room_flight: resident memory"),
    ("The onboard agent: half an hour", "soak, 30 minutes, link down"),
    ("The thin link", "wifi: bytes a keyframe"),
    ("The thin link", "radio: bytes a keyframe"),
    ("The thin link", "radio: ATE base over that of wifi"),
    ("The base's mapper: a street, a loop", "KITTI 06 in the street: ATE base"),
    ("The base's mapper: a hall, two agents", "MH_01 and MH_03 as two agents: joint ATE"),
    ("The base's store", "final ATE of killed flights"),
    ("Consistent poses", "NEES of"),
)


def machine() -> str:
    """This machine and the libraries that compute, in one line, without a date."""
    model = platform.machine()
    try:
        found = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
        model = found.group(1).strip() if found else model
    except OSError:
        pass
    packages = ", ".join(f"{name} {importlib.import_module(name).__version__}" for name in ("numpy", "numba", "cv2"))
    return f"{model}, {os.cpu_count()} cores, {platform.system()}, Python {platform.python_version()}, {packages}"


def section(name: str, title: str, bars: Sequence[Bar], more: Sequence[str] = ()) -> str:
    """The Markdown of one benchmark."""
    met = sum(bar.met for bar in bars)
    lines = [
        f"## {title}", "", f"`kiteline bench {name}` on {machine()}.", "", f"{met} of {len(bars)} bars met.", "",
        "| bar | wanted | measured | met |", "|---|---|---|---|",
    ]  # fmt: skip
    lines += [f"| {bar.name} | {bar.wanted} | {bar.measured} | {'yes' if bar.met else '**no**'} |" for bar in bars]
    for text in more:
        lines += ["", text]
    return "\n".join(lines) + "\n"


def replace_section(text: str, title: str, new: str) -> str:
    """The results file with one section replaced, or added at the end, and its summary made anew."""
    parts = _sections(text)
    parts[title] = new.rstrip() + "\n"
    parts.pop(SUMMARY, None)
    return "\n".join([_HEAD, _summary(parts), *parts.values()])


def _sections(text: str) -> dict[str, str]:
    """Sections by title, in their order; a heading inside of a section is deeper than theirs."""
    found = re.findall(r"^## (.+)\n((?:.*\n?)*?)(?=^## |\Z)", text, re.MULTILINE)
    return {title: f"## {title}\n{body.rstrip()}\n" for title, body in found}


def _summary(parts: Mapping[str, str]) -> str:
    """Bars met by section, and the figures that people ask for first."""
    lines = [f"## {SUMMARY}", "", "| section | command | bars met |", "|---|---|---|"]
    for title, body in parts.items():
        command = re.search(r"^`(kiteline bench [^`]*)`", body, re.MULTILINE)
        met = re.search(r"^(\d+) of (\d+) bars met\.", body, re.MULTILINE)
        if met:
            count = f"{met[1]} of {met[2]}" if met[1] == met[2] else f"**{met[1]} of {met[2]}**"
            lines.append(f"| {title} | {f'`{command[1]}`' if command else ''} | {count} |")
    figures = []
    for wanted_title, begin in HEADLINES:
        body = next((body for title, body in parts.items() if title.startswith(wanted_title)), "")
        row = re.search(rf"^\| ({re.escape(begin)}[^|]*) \| ([^|]*) \| ([^|]*) \|", body, re.MULTILINE)
        if row:
            figures.append(f"| {row[1]} | {row[3]} | {row[2]} |")
    if figures:
        lines += ["", "| figure | measured | wanted |", "|---|---|---|", *figures]
    return "\n".join(lines) + "\n"
