"""`kiteline maps`."""

from __future__ import annotations

SUMMARY = "manage the maps of a running base: list, get, name, merge, split, delete"
EXAMPLES = (
    "kiteline maps list",
    "kiteline maps name 0.3.0 hangar",
    "kiteline maps merge 1.1.0 hangar",
)


def run(argv: list[str]) -> int | None:
    """Run the command with the arguments after `kiteline maps`; the exit status."""
    from kiteline_lab.tools.maps import main

    return main(argv)
