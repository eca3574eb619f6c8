"""`kiteline doctor`."""

from __future__ import annotations

SUMMARY = "check this machine, and compile the kernels beforehand"
EXAMPLES = (
    "kiteline doctor",
    "kiteline doctor --warm",
)


def run(argv: list[str]) -> int | None:
    """Run the command with the arguments after `kiteline doctor`; the exit status."""
    from kiteline_lab.tools.doctor import main

    return main(argv)
