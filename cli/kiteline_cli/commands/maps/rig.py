"""`kiteline rig`."""

from __future__ import annotations

SUMMARY = "show and export what a base found of the agents' cameras"
EXAMPLES = (
    "kiteline rig show maps",
    "kiteline rig export maps --format kalibr --out calibration",
)


def run(argv: list[str]) -> int | None:
    """Run the command with the arguments after `kiteline rig`; the exit status."""
    from kiteline_lab.tools.rig import main

    return main(argv)
